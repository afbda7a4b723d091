"""The extrapolation-error experiment on a MuJoCo task of gymnasium (docs/extrapolation.md).

    python docs/extrapolation.py
    python docs/extrapolation.py --env Walker2d-v5 --seeds 3 4 --algorithms ddpg bcq

A TD3 agent trained online acts with noise and leaves a batch; every algorithm then learns from that
batch alone. The same command resumes a run that was stopped.

Reference: Fujimoto et al. 2019, https://arxiv.org/abs/1812.02900, sections 3.1 and 5.
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import argparse
import statistics
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torchrl_bmrl.run.as_command  # noqa: F401 -- errors at import become one line

# isort: split
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import (
    ActionScaling,
    Compose,
    DoubleToFloat,
    EnvBase,
    GymEnv,
    ObservationNorm,
    RewardSum,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import AdditiveGaussianModule
from torchrl.objectives import DDPGLoss, LossModule, SoftUpdate, TD3Loss

from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.functional import nonzero_scale
from torchrl_bmrl.modules import ActionVAE, BCQPolicy, PLASPolicy, make_latent_actor
from torchrl_bmrl.objectives import BCQLoss, PLASLoss
from torchrl_bmrl.rows import finite, read_rows, whole, write_rows
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.locks import lock_run
from torchrl_bmrl.run.workers import Report, available_cores, derive_seed, run_jobs
from torchrl_bmrl.studies.algorithms import bc, iql, make_actor, make_critics, td3_bc
from torchrl_bmrl.training.checkpoint import load_checkpoint, save_checkpoint
from torchrl_bmrl.training.fit import Every, fit
from torchrl_bmrl.training.health import check_metrics

BEHAVIOUR = "behaviour"
LR, TAU = 1e-3, 0.005
NOISE = 0.1  # standard deviation on the behaviour's actions, online and in the batch
STEPS_PER_UPDATE = 2  # of the online agent
WARMUP = 0.3  # share of PLAS's updates, at the start, that train the generator alone
OPTIONS: dict[str, tuple[int, str]] = {
    "behaviour_steps": (40_000, "steps of the online agent"),
    "exploration_steps": (2_000, "the first of these: random actions, no update"),
    "batch_steps": (20_000, "transitions that the offline algorithms see"),
    "updates": (4_000, "of each offline algorithm"),
    "batch_size": (128, "of the updates"),
    "eval_episodes": (5, "of each trained policy"),
}


def ddpg(*dims: int) -> tuple[LossModule, TensorDictModuleBase]:
    """Off-policy: nothing keeps its actions near the batch."""
    actor = make_actor(*dims)
    return DDPGLoss(actor, make_critics(*dims)[0], delay_actor=True), actor


def plas(*dims: int) -> tuple[LossModule, None]:
    """A policy that chooses the latent of a generator of the batch's actions."""
    generator = ActionVAE(*dims)
    # Published: 2. BCQ's 0.5 keeps to latents that occur in so short a training.
    actor = make_latent_actor(dims[0], generator.latent_dim, max_latent=0.5)
    return PLASLoss(generator, actor, make_critics(*dims), bounds=(-1.0, 1.0)), None


def bcq(*dims: int) -> tuple[LossModule, None]:
    """The best proposal of a generator of the batch's actions."""
    return BCQLoss(ActionVAE(*dims), make_critics(*dims), bounds=(-1.0, 1.0)), None


ALGORITHMS: dict[str, Callable[..., Any]] = {
    build.__name__: build for build in (ddpg, bc, td3_bc, iql, plas, bcq)
}
FROZEN = {"plas": PLASPolicy.frozen, "bcq": BCQPolicy.frozen}  # the others are their actor


def make_env(name: str) -> tuple[EnvBase, tuple[int, int]]:
    """The task with actions in [-1, 1], and the sizes of observation and action."""
    env = TransformedEnv(GymEnv(name), Compose(ActionScaling(), DoubleToFloat(), RewardSum()))
    return env, (env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1])


def make_buffer(size: int, batch_size: int) -> TensorDictReplayBuffer:
    return TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=batch_size)


def make_update(loss: LossModule) -> Callable[[Tensor], None]:
    """One step of Adam on every parameter of a loss, then one of its targets."""
    optimizer = torch.optim.Adam(loss.parameters(), lr=LR)
    has_targets = any(key.startswith("target_") for key in loss.state_dict())
    targets = SoftUpdate(loss, tau=TAU) if has_targets else None

    def update(value: Tensor) -> None:
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()
        if targets is not None:
            targets.step()

    return update


def total(losses: TensorDictBase) -> Tensor:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def collect(
    env: EnvBase, policy: TensorDictModuleBase, steps: int, report: Report, random_steps: int = 0
) -> Iterator[TensorDictBase]:
    """Transitions of an exploring policy, 100 at a time."""
    for data in Collector(
        env,
        policy,
        frames_per_batch=min(100, steps),
        total_frames=steps,
        init_random_frames=random_steps,
        auto_register_policy_transforms=True,
    ):
        yield data.exclude("collector")
        report(len(data))


def make_batch(options: Namespace, seed: int, report: Report) -> list[float]:
    """Trains a behaviour online, saves a batch of its steps and returns its episodes' returns."""
    torch.manual_seed(derive_seed(seed, BEHAVIOUR))
    env, dims = make_env(options.env)
    env.set_seed(derive_seed(seed, BEHAVIOUR, "env"))
    actor, spec = make_actor(*dims), env.action_spec
    loss = TD3Loss(actor, make_critics(*dims), action_spec=spec, loss_function="l2")
    update = make_update(loss)
    noise = AdditiveGaussianModule(spec, sigma_init=NOISE, sigma_end=NOISE)
    policy = TensorDictSequential(actor, noise)
    buffer = make_buffer(options.behaviour_steps, options.batch_size)
    random_steps = options.exploration_steps
    for data in collect(env, policy, options.behaviour_steps, report, random_steps):
        buffer.extend(data)
        if len(buffer) > random_steps:
            for _ in range(len(data) // STEPS_PER_UPDATE):
                update(total(loss(buffer.sample())))
    batch = torch.cat(list(collect(env, policy, options.batch_steps, report)))
    env.close()
    after = batch["next"]
    returns = after["episode_reward"][after["done"]].tolist()
    if not returns:
        raise ConfigError(f"batch_steps is {options.batch_steps}; valid: at least one episode")
    keep = ("observation", "reward", "done", "terminated")
    batch = batch.select("observation", "action", *(("next", key) for key in keep))
    save_checkpoint(batch_path(options, seed), batch.to_dict(), {"kind": "batch"})
    return returns


def train(options: Namespace, name: str, seed: int, report: Report) -> list[float]:
    """Trains an algorithm on a seed's batch and returns the returns of its policy's episodes."""
    state, _ = load_checkpoint(batch_path(options, seed), kind="batch")
    batch = TensorDict(state, batch_size=[len(state["action"])])
    observation = batch["observation"]
    loc, largest = observation.mean(0), observation.abs().amax(0)
    scale = nonzero_scale(observation.std(0), largest, observation.dtype).clamp_min(1e-3)
    for part in (batch, batch["next"]):
        part["observation"] = (part["observation"] - loc) / scale
    buffer = make_buffer(len(batch), options.batch_size)
    buffer.extend(batch)

    torch.manual_seed(derive_seed(seed, name))
    env, dims = make_env(options.env)
    env = env.append_transform(ObservationNorm(loc, scale, ["observation"], standard_normal=True))
    loss, actor = ALGORITHMS[name](*dims)
    update = make_update(loss)
    warmup = int(WARMUP * options.updates) if name == "plas" else 0

    def step(number: int, batch: TensorDictBase) -> dict[str, Tensor]:
        if number <= warmup:
            value, _ = loss.generator_loss(batch)
        else:
            losses = loss(batch)
            value = total(losses.exclude("loss_generator") if warmup else losses)
        update(value)
        return {"loss": value.detach()}

    fit(
        step,
        buffer.sample,
        total=options.updates,
        every=Every(log=100, save=options.updates),
        check=lambda number, metrics, *_: check_metrics(
            metrics, f"{name}, seed {seed}, update {number}"
        ),
        save=lambda number: None,
        report=report,
    )
    policy, returns = FROZEN[name](loss) if name in FROZEN else actor, []
    for i in range(options.eval_episodes):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            start = derive_seed(seed, "evaluate", i)
            episode = rollout_episodes(env, policy, seed=start, max_steps=1000)
        returns.append(episode["next", "reward"].sum().item())
    env.close()
    return returns


def batch_path(options: Namespace, seed: int) -> Path:
    return Path(options.run_dir) / "batches" / f"seed{seed}.safetensors"


def job_size(options: Namespace, name: str) -> int:
    """Steps of a behaviour, updates of an algorithm."""
    behaviour = name == BEHAVIOUR
    return options.behaviour_steps + options.batch_steps if behaviour else options.updates


def run_job(job: tuple[Namespace, str, int], report: Report) -> list[dict[str, Any]]:
    """Rows of one algorithm, or of the behaviour, and one seed; computed once."""
    options, name, seed = job
    path = Path(options.run_dir) / "results" / f"{name}-seed{seed}.csv"
    if path.exists():
        report(job_size(options, name))
    else:
        behaviour = name == BEHAVIOUR
        returns = make_batch(options, seed, report) if behaviour else train(*job, report)
        rows = [
            {"algorithm": name, "seed": seed, "episode": i, "return": round(value, 3)}
            for i, value in enumerate(returns)
        ]
        write_rows(path, rows)
    columns = {"algorithm": str, "seed": whole, "episode": whole, "return": finite}
    return read_rows(path, columns)


def make_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Mean return per algorithm and seed, over seeds, and against the behaviour's, in Markdown.

    The deviation is that of the seeds' means. The last column is the mean over the seeds of an
    algorithm's return divided by that of its own behaviour.
    """
    returns: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        seeds = returns.setdefault(row["algorithm"], {})
        seeds.setdefault(row["seed"], []).append(row["return"])
    means = {
        name: {seed: statistics.fmean(values) for seed, values in seeds.items()}
        for name, seeds in returns.items()
    }
    seeds = sorted(means[BEHAVIOUR])
    header = ["Algorithm", *(f"Seed {seed}" for seed in seeds), "Mean ± std", "Of behaviour"]
    lines = [header, ["---", *["---:"] * (len(header) - 1)]]
    for name, mean in means.items():
        values = [mean[seed] for seed in seeds]
        over_seeds = f"{statistics.fmean(values):.0f} ± {statistics.pstdev(values):.0f}"
        share = "–"  # there is no share of a return that is not positive
        if min(means[BEHAVIOUR].values()) > 0:
            share = f"{statistics.fmean(mean[i] / means[BEHAVIOUR][i] for i in seeds):.0%}"
        lines.append([name, *(f"{value:.0f}" for value in values), over_seeds, share])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def extrapolation(options: Namespace) -> str:
    """Runs the unfinished jobs, then writes ``results.csv`` and ``table.md``; returns the table."""
    parts = []
    for names, unit in ([BEHAVIOUR], "step"), (options.algorithms, "update"):
        jobs = [(options, name, seed) for name in names for seed in options.seeds]
        parts += run_jobs(
            run_job,
            jobs,
            workers=options.workers,
            total=sum(job_size(options, name) for _, name, _ in jobs),
            description=f"extrapolation: {unit}s",
            unit=unit,
        )
    rows = [row for part in parts for row in part]
    write_rows(Path(options.run_dir) / "results.csv", rows)
    table = make_table(rows)
    write_atomic(Path(options.run_dir) / "table.md", table)
    return table


def parse(words: Sequence[str] | None = None) -> Namespace:
    """Options of the command line."""

    def positive(text: str) -> int:
        if int(text) < 1:
            raise ValueError
        return int(text)

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--run-dir", help="by default runs/extrapolation-ENV")
    parser.add_argument("--workers", type=positive, default=available_cores())
    parser.add_argument("--env", default="HalfCheetah-v5", help="a MuJoCo task of gymnasium")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument(
        "--algorithms", nargs="+", choices=list(ALGORITHMS), default=list(ALGORITHMS)
    )
    for name, (default, what) in OPTIONS.items():
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=positive, default=default, help=f"{what} ({default})")
    options = parser.parse_args(words)
    if options.exploration_steps >= options.behaviour_steps:
        parser.error(
            f"--exploration-steps is {options.exploration_steps}; valid: fewer than "
            f"{options.behaviour_steps}, the behaviour's steps"
        )
    options.run_dir = options.run_dir or f"runs/extrapolation-{options.env}"
    return options


def main(words: Sequence[str] | None = None) -> None:
    """Command line."""
    options = parse(words)
    with exit_codes():
        # More seeds and algorithms may join the finished ones.
        held = {name: getattr(options, name) for name in ("env", *OPTIONS)}
        with lock_run(Path(options.run_dir), held):
            print(extrapolation(options))


if __name__ == "__main__":
    main()
