"""Does it learn? The extrapolation-error experiment on a MuJoCo task of gymnasium.

    python recipes/extrapolation.py
    python recipes/extrapolation.py env=Walker2d-v5 "seeds=[3,4]" "algorithms=[ddpg,bcq]"

A TD3 agent trained online acts with noise and leaves a batch; every algorithm then learns from that
batch alone. Started again on the same run folder it goes on where it stopped.

Reference: Fujimoto et al. 2019, https://arxiv.org/abs/1812.02900, sections 3.1 and 5.
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import csv
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import hydra
import torch
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule, TensorDictSequential
from torch import nn
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
from torchrl.modules import AdditiveGaussianModule, IndependentNormal, ProbabilisticActor
from torchrl.objectives import BCLoss, DDPGLoss, IQLLoss, LossModule, SoftUpdate, TD3BCLoss, TD3Loss

from torchrl_bmrl.checkpoint import load_checkpoint, save_checkpoint
from torchrl_bmrl.errors import BMRLError, ConfigError, UnknownNameError
from torchrl_bmrl.evaluation.rollout import rollout_episode
from torchrl_bmrl.files import write_atomic, write_rows
from torchrl_bmrl.modules import (
    ActionVAE,
    BCQPolicy,
    PLASPolicy,
    make_latent_actor,
    make_qvalue_network,
)
from torchrl_bmrl.modules.generator import make_mlp
from torchrl_bmrl.objectives import BCQLoss, PLASLoss
from torchrl_bmrl.parallel import Report, derive_seed, run_jobs
from torchrl_bmrl.runs import check_finite, open_run


@dataclass
class Settings:
    """Everything that decides a run."""

    run_dir: str = "runs/extrapolation-${env}"
    workers: int = 2  # processes; does not change any result
    env: str = "Hopper-v5"
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    algorithms: list[str] = field(default_factory=lambda: list(ALGORITHMS))
    behaviour_steps: int = 20_000  # of the online agent, one update each
    exploration_steps: int = 2_000  # the first of these: random actions, no update
    noise: float = 0.1  # standard deviation on the behaviour's actions, online and in the batch
    batch_steps: int = 20_000  # transitions that the offline algorithms see
    updates: int = 10_000  # of each offline algorithm
    batch_size: int = 128
    lr: float = 1e-3
    tau: float = 0.005
    eval_episodes: int = 10  # of each trained policy


# -- networks, of equal size everywhere; actions are scaled to [-1, 1] -----------------------------


def make_actor(observation_dim: int, action_dim: int) -> TensorDictModule:
    """Deterministic policy."""
    network = nn.Sequential(make_mlp(observation_dim, action_dim, (256, 256)), nn.Tanh())
    return TensorDictModule(network, in_keys=["observation"], out_keys=["action"])


def make_critics(observation_dim: int, action_dim: int) -> list[TensorDictModule]:
    """Twin critics."""
    return [make_qvalue_network(observation_dim, action_dim) for _ in range(2)]


# -- offline algorithms: (observation_dim, action_dim) to a loss and a function to its policy ------

Algorithm = Callable[[int, int], tuple[LossModule, Callable[[], Any]]]
BOUNDS = (-1.0, 1.0)


def ddpg(*dims: int) -> tuple[LossModule, Callable[[], Any]]:
    """Off-policy: nothing keeps its actions near the batch."""
    actor = make_actor(*dims)
    return DDPGLoss(actor, make_qvalue_network(*dims), delay_actor=True), lambda: actor


def bc(*dims: int) -> tuple[LossModule, Callable[[], Any]]:
    """Imitation."""
    actor = make_actor(*dims)
    return BCLoss(actor), lambda: actor


def td3_bc(*dims: int) -> tuple[LossModule, Callable[[], Any]]:
    """TD3 with an imitation term."""
    actor = make_actor(*dims)
    loss = TD3BCLoss(actor, make_critics(*dims), bounds=BOUNDS, loss_function="l2")
    return loss, lambda: actor


def iql(observation_dim: int, action_dim: int) -> tuple[LossModule, Callable[[], Any]]:
    """Expectile values, advantage-weighted imitation."""
    network = nn.Sequential(
        make_mlp(observation_dim, action_dim, (256, 256)),
        nn.Tanh(),
        AddStateIndependentNormalScale(action_dim),
    )
    keys = ["loc", "scale"]
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=keys),
        in_keys=keys,
        distribution_class=IndependentNormal,
    )
    value = TensorDictModule(
        make_mlp(observation_dim, 1, (256, 256)), in_keys=["observation"], out_keys=["state_value"]
    )
    critics = make_critics(observation_dim, action_dim)
    loss = IQLLoss(
        actor, critics, value, temperature=3.0, expectile=0.7, loss_function="l2"
    )  # as published
    return loss, lambda: actor


def plas(observation_dim: int, action_dim: int) -> tuple[LossModule, Callable[[], Any]]:
    """A policy in the latent space of a generator that is trained first."""
    generator = ActionVAE(observation_dim, action_dim)
    actor = make_latent_actor(observation_dim, generator.latent_dim)
    loss = PLASLoss(generator, actor, make_critics(observation_dim, action_dim), bounds=BOUNDS)
    return loss, lambda: PLASPolicy.from_loss(loss)


def bcq(*dims: int) -> tuple[LossModule, Callable[[], Any]]:
    """The best of what a generator of the batch's actions proposes."""
    loss = BCQLoss(ActionVAE(*dims), make_critics(*dims), bounds=BOUNDS)
    return loss, lambda: BCQPolicy.from_loss(loss)


ALGORITHMS: dict[str, Algorithm] = {
    "ddpg": ddpg,
    "bc": bc,
    "td3_bc": td3_bc,
    "iql": iql,
    "plas": plas,
    "bcq": bcq,
}
WARMUP = {"plas": 0.3}  # share of the updates that train the generator alone


# -- the experiment --------------------------------------------------------------------------------

Row = dict[str, str | int | float]
"""``algorithm``, ``seed``, ``episode``, ``return``; the batch's own episodes are ``behaviour``."""

TRANSITION = (
    "observation",
    "action",
    *(("next", key) for key in ("observation", "reward", "done", "terminated")),
)


def make_env(name: str) -> EnvBase:
    """The task with actions in [-1, 1] and the return so far."""
    return TransformedEnv(GymEnv(name), Compose(ActionScaling(), DoubleToFloat(), RewardSum()))


def dimensions(env: EnvBase) -> tuple[int, int]:
    """Sizes of the observation and the action."""
    return env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]


def make_buffer(size: int, batch_size: int) -> TensorDictReplayBuffer:
    """Transitions in memory, sampled one by one."""
    return TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=batch_size)


def collect(
    env: EnvBase, policy: TensorDictSequential, steps: int, random_steps: int = 0
) -> Iterator[TensorDictBase]:
    """Transitions of an exploring policy, at most 100 at a time."""
    collector = Collector(
        env,
        policy,
        frames_per_batch=min(100, steps),
        total_frames=steps,
        init_random_frames=random_steps,
        auto_register_policy_transforms=True,
    )
    for data in collector:
        yield data.exclude("collector")


def make_updater(loss: LossModule, settings: Settings) -> Callable[..., torch.Tensor]:
    """One step of Adam on the sum of the losses, then one of the targets."""
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.lr)
    has_targets = any(key.startswith("target_") for key in loss.state_dict())
    targets = SoftUpdate(loss, tau=settings.tau) if has_targets else None

    def update(batch: TensorDictBase, generator_only: bool = False) -> torch.Tensor:
        if generator_only:
            value, _ = loss.generator_loss(batch)
        else:
            value = sum(term for key, term in loss(batch).items() if key.startswith("loss_"))
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()
        if targets is not None:
            targets.step()
        return value.detach()

    return update


def batch_job(job: tuple[Settings, int], report: Report) -> list[Row]:
    """Trains a seed's behaviour online and keeps a batch of its episodes; their returns."""
    settings, seed = job
    path = batch_path(settings, seed)
    if path.exists():
        report(settings.behaviour_steps + settings.batch_steps)
        returns = load_checkpoint(path, kind="batch")[0]["returns"]
        return make_rows("behaviour", seed, returns.tolist())
    torch.manual_seed(derive_seed(seed, "behaviour"))
    with closing(make_env(settings.env)) as env:
        env.set_seed(derive_seed(seed, "behaviour", "env"))
        actor = make_actor(*dimensions(env))
        loss = TD3Loss(
            actor, make_critics(*dimensions(env)), action_spec=env.action_spec, loss_function="l2"
        )
        update = make_updater(loss, settings)
        noise = AdditiveGaussianModule(
            env.action_spec, sigma_init=settings.noise, sigma_end=settings.noise
        )
        policy = TensorDictSequential(actor, noise)
        buffer = make_buffer(settings.behaviour_steps, settings.batch_size)
        for data in collect(env, policy, settings.behaviour_steps, settings.exploration_steps):
            buffer.extend(data)
            if len(buffer) > settings.exploration_steps:
                for _ in range(len(data)):
                    update(buffer.sample())
            report(len(data))
        parts = []
        for data in collect(env, policy, settings.batch_steps):
            parts.append(data)
            report(len(data))
    batch = torch.cat(parts)
    after = batch["next"]
    returns = after["episode_reward"][after["done"]]
    if not len(returns):
        raise ConfigError(f"batch_steps is {settings.batch_steps}; valid: a whole episode at least")
    state = {"batch": batch.select(*TRANSITION).to_dict(), "returns": returns}
    save_checkpoint(path, state, {"kind": "batch", "env": settings.env, "seed": seed})
    return make_rows("behaviour", seed, returns.tolist())


def train_job(job: tuple[Settings, str, int], report: Report) -> list[Row]:
    """Trains an algorithm on a seed's batch alone; the returns of its policy's episodes."""
    settings, name, seed = job
    path = Path(settings.run_dir) / "results" / f"{name}-seed{seed}.csv"
    if path.exists():
        report(settings.updates)
        return read_rows(path)
    state, _ = load_checkpoint(batch_path(settings, seed), kind="batch")
    batch = TensorDict(state["batch"], batch_size=[settings.batch_steps])
    loc, scale = batch["observation"].mean(0), batch["observation"].std(0).clamp_min(1e-3)
    for part in (batch, batch["next"]):
        part["observation"] = (part["observation"] - loc) / scale
    buffer = make_buffer(settings.batch_steps, settings.batch_size)
    buffer.extend(batch)

    torch.manual_seed(derive_seed(seed, name))
    norm = ObservationNorm(loc, scale, in_keys=["observation"], standard_normal=True)
    with closing(make_env(settings.env).append_transform(norm)) as env:
        loss, make_policy = ALGORITHMS[name](*dimensions(env))
        update = make_updater(loss, settings)
        warmup = WARMUP.get(name, 0.0) * settings.updates
        for i in range(settings.updates):
            value = update(buffer.sample(), generator_only=i < warmup)
            if i % 100 == 0:
                check_finite({"loss": value}, f"{name}, seed {seed}, update {i}")
                report(min(100, settings.updates - i))
        policy = make_policy()
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            returns = [
                rollout_episode(env, policy, seed=derive_seed(seed, "evaluate", i), max_steps=1000)[
                    "next", "reward"
                ]
                .sum()
                .item()
                for i in range(settings.eval_episodes)
            ]
    rows = make_rows(name, seed, returns)
    write_rows(path, rows)
    return rows


def read_rows(path: Path) -> list[Row]:
    """What an earlier command left."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def batch_path(settings: Settings, seed: int) -> Path:
    """Where a seed's batch lies."""
    return Path(settings.run_dir) / "batches" / f"seed{seed}.safetensors"


def make_rows(algorithm: str, seed: int, returns: Sequence[float]) -> list[Row]:
    """One row of ``results.csv`` per episode."""
    return [
        {"algorithm": algorithm, "seed": seed, "episode": i, "return": value}
        for i, value in enumerate(returns)
    ]


def make_table(rows: Sequence[Row]) -> str:
    """Mean return per algorithm and seed, over seeds, and against the behaviour's, in Markdown.

    The deviation is that of the seeds' means; the last column is the mean over the seeds of what
    share of its own behaviour's return an algorithm reaches.
    """
    returns: dict[str, dict[int, list[float]]] = {}
    for row in rows:
        seeds = returns.setdefault(str(row["algorithm"]), {})
        seeds.setdefault(int(row["seed"]), []).append(float(row["return"]))
    means = {
        name: {seed: statistics.fmean(values) for seed, values in seeds.items()}
        for name, seeds in returns.items()
    }
    seeds = sorted(means["behaviour"])
    header = ["Algorithm", *(f"Seed {seed}" for seed in seeds), "Mean ± std", "Of behaviour"]
    lines = [header, ["---", *["---:"] * (len(header) - 1)]]
    for name, mean in means.items():
        values = [mean[seed] for seed in seeds]
        share = statistics.fmean(mean[seed] / means["behaviour"][seed] for seed in seeds)
        total = f"{statistics.fmean(values):.0f} ± {statistics.pstdev(values):.0f}"
        lines.append([name, *(f"{value:.0f}" for value in values), total, f"{share:.0%}"])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def extrapolation(settings: Settings) -> None:
    """Runs everything that is not done yet, then writes ``results.csv`` and ``table.md``."""
    started, run_dir = time.monotonic(), Path(settings.run_dir)
    count = len(settings.seeds)
    behaviour = run_jobs(
        batch_job,
        [(settings, seed) for seed in settings.seeds],
        workers=settings.workers,
        total=(settings.behaviour_steps + settings.batch_steps) * count,
        description="behaviour",
        unit="step",
    )
    jobs = [(settings, name, seed) for name in settings.algorithms for seed in settings.seeds]
    trained = run_jobs(
        train_job,
        jobs,
        workers=settings.workers,
        total=settings.updates * len(jobs),
        description="offline",
        unit="update",
    )
    rows = [row for part in [*behaviour, *trained] for row in part]
    write_rows(run_dir / "results.csv", rows)
    write_atomic(run_dir / "table.md", make_table(rows))
    print(make_table(rows))
    print(f"{run_dir / 'results.csv'}: {(time.monotonic() - started) / 60:.1f} min")


# -- the command line ------------------------------------------------------------------------------


def check_settings(settings: Settings) -> None:
    """Checks what types cannot say.

    Raises:
        BMRLError: naming the setting, its value and what is valid.
    """
    envs = [
        name
        for name, spec in gymnasium.registry.items()
        if name.endswith("-v5") and "mujoco" in str(spec.entry_point)
    ]
    if settings.env not in envs:
        raise UnknownNameError("env", settings.env, envs)
    for name in settings.algorithms:
        if name not in ALGORITHMS:
            raise UnknownNameError("algorithm", name, ALGORITHMS)
    for name in ("seeds", "algorithms"):
        value = getattr(settings, name)
        if not value or len(set(value)) < len(value):
            raise ConfigError(f"{name} is {value}; valid: at least one, each once")
    for name, value in asdict(settings).items():
        if isinstance(value, (int, float)) and value <= 0:
            raise ConfigError(f"{name} is {value}; valid: above 0")
    if settings.exploration_steps >= settings.behaviour_steps:
        raise ConfigError(
            f"exploration_steps is {settings.exploration_steps}; valid: below behaviour_steps, "
            f"{settings.behaviour_steps}"
        )


store = ConfigStore.instance()
store.store(name="extrapolation_schema", node=Settings)
store.store(
    name="extrapolation",
    node={
        "defaults": [
            "extrapolation_schema",
            "_self_",
            {"override hydra/hydra_logging": "disabled"},
            {"override hydra/job_logging": "disabled"},
        ],
        "hydra": {"output_subdir": None, "run": {"dir": "."}},  # the run folder holds the settings
    },
)


@hydra.main(version_base="1.3", config_path=None, config_name="extrapolation")
def main(config: DictConfig) -> None:
    """Command line; an expected error becomes one line and exit code 1."""
    try:
        settings = OmegaConf.to_object(config)
        check_settings(settings)
        open_run(Path(settings.run_dir), asdict(settings))
        extrapolation(settings)
    except BMRLError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
