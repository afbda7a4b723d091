"""Does it learn? The extrapolation-error experiment on a MuJoCo task of gymnasium.

    python recipes/extrapolation.py
    python recipes/extrapolation.py env=Walker2d-v5 "seeds=[3,4]" "algorithms=[ddpg,bcq]"

A TD3 agent trained online acts with noise and leaves a batch; every algorithm then learns from that
batch alone. Started again on the same run folder it goes on where it stopped.

Reference: Fujimoto et al. 2019, https://arxiv.org/abs/1812.02900, sections 3.1 and 5.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import importlib
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import hydra
import torch
from algorithms import bc, bcq, ddpg, iql, make_actor, make_critics, plas, td3_bc
from given import with_folders_settings
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
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
from torchrl.objectives import LossModule, SoftUpdate, TD3Loss

from torchrl_bmrl.errors import ConfigError, UnknownNameError
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.extras import needs
from torchrl_bmrl.files import finite, read_rows, whole, write_atomic, write_rows
from torchrl_bmrl.functional import nonzero_scale
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.locks import hold_run
from torchrl_bmrl.run.workers import Report, available_cores, derive_seed, run_jobs
from torchrl_bmrl.training.checkpoint import load_checkpoint, save_checkpoint
from torchrl_bmrl.training.health import check_metrics

with needs("robosuite"):
    import gymnasium


@dataclass
class Settings:
    """Everything that decides a run."""

    run_dir: str = "runs/extrapolation-${env}"
    workers: int = field(default_factory=available_cores)  # processes; no result depends on them
    env: str = "HalfCheetah-v5"
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2])
    algorithms: list[str] = field(default_factory=lambda: list(ALGORITHMS))
    behaviour_steps: int = 40_000  # of the online agent
    exploration_steps: int = 2_000  # the first of these: random actions, no update
    steps_per_update: int = 2  # of the online agent
    noise: float = 0.1  # standard deviation on the behaviour's actions, online and in the batch
    batch_steps: int = 20_000  # transitions that the offline algorithms see
    updates: int = 4_000  # of each offline algorithm
    batch_size: int = 128
    lr: float = 1e-3
    tau: float = 0.005
    eval_episodes: int = 5  # of each trained policy


# -- offline algorithms --------------------------------------------------------------------------

ALGORITHMS = {build.__name__: build for build in (ddpg, bc, td3_bc, iql, plas, bcq)}
WARMUP = {"plas": 0.3}  # first share of the updates: the generator alone, held afterwards


# -- the experiment --------------------------------------------------------------------------------

BEHAVIOUR = "behaviour"
Row = dict[str, Any]
"""Of ``results.csv``: algorithm, seed, episode, return."""


def make_env(name: str) -> tuple[EnvBase, tuple[int, int]]:
    """The task with actions in [-1, 1], and the sizes of observation and action."""
    env = TransformedEnv(GymEnv(name), Compose(ActionScaling(), DoubleToFloat(), RewardSum()))
    return env, (env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1])


def make_buffer(size: int, settings: Settings) -> TensorDictReplayBuffer:
    """Transitions, sampled one by one."""
    return TensorDictReplayBuffer(storage=LazyTensorStorage(size), batch_size=settings.batch_size)


def make_update(loss: LossModule, settings: Settings) -> Callable[[Tensor], None]:
    """One step of Adam on every parameter of a loss, then one of its targets."""
    optimizer = torch.optim.Adam(loss.parameters(), lr=settings.lr)
    has_targets = any(key.startswith("target_") for key in loss.state_dict())
    targets = SoftUpdate(loss, tau=settings.tau) if has_targets else None

    def update(value: Tensor) -> None:
        optimizer.zero_grad(set_to_none=True)
        value.backward()
        optimizer.step()
        if targets is not None:
            targets.step()

    return update


def total(losses: TensorDictBase) -> Tensor:
    """Sum of what a loss wants minimised."""
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


def make_batch(settings: Settings, seed: int, report: Report) -> list[float]:
    """Trains a seed's behaviour online and keeps a batch of its steps; its episodes' returns."""
    torch.manual_seed(derive_seed(seed, "behaviour"))
    env, dims = make_env(settings.env)
    env.set_seed(derive_seed(seed, "behaviour", "env"))
    actor, spec = make_actor(*dims), env.action_spec
    loss = TD3Loss(actor, make_critics(*dims), action_spec=spec, loss_function="l2")
    update = make_update(loss, settings)
    noise = AdditiveGaussianModule(spec, sigma_init=settings.noise, sigma_end=settings.noise)
    policy = TensorDictSequential(actor, noise)
    buffer = make_buffer(settings.behaviour_steps, settings)
    random_steps = settings.exploration_steps
    for data in collect(env, policy, settings.behaviour_steps, report, random_steps):
        buffer.extend(data)
        if len(buffer) > random_steps:
            for _ in range(len(data) // settings.steps_per_update):
                update(total(loss(buffer.sample())))
    batch = torch.cat(list(collect(env, policy, settings.batch_steps, report)))
    env.close()
    after = batch["next"]
    returns = after["episode_reward"][after["done"]].tolist()
    if not returns:
        raise ConfigError(f"batch_steps is {settings.batch_steps}; valid: an episode at least")
    keep = ("observation", "reward", "done", "terminated")
    batch = batch.select("observation", "action", *(("next", key) for key in keep))
    save_checkpoint(batch_path(settings, seed), batch.to_dict(), {"kind": "batch"})
    return returns


def train(settings: Settings, name: str, seed: int, report: Report) -> list[float]:
    """Trains an algorithm on a seed's batch alone; the returns of its policy's episodes."""
    state, _ = load_checkpoint(batch_path(settings, seed), kind="batch")
    batch = TensorDict(state, batch_size=[len(state["action"])])
    observation = batch["observation"]
    loc, largest = observation.mean(0), observation.abs().amax(0)
    scale = nonzero_scale(observation.std(0), largest, observation.dtype).clamp_min(1e-3)
    for part in (batch, batch["next"]):
        part["observation"] = (part["observation"] - loc) / scale
    buffer = make_buffer(len(batch), settings)
    buffer.extend(batch)

    torch.manual_seed(derive_seed(seed, name))
    env, dims = make_env(settings.env)
    env = env.append_transform(ObservationNorm(loc, scale, ["observation"], standard_normal=True))
    loss, make_policy = ALGORITHMS[name](*dims)
    update = make_update(loss, settings)
    warmup = int(WARMUP.get(name, 0.0) * settings.updates)
    for i in range(settings.updates):
        if i < warmup:
            value, _ = loss.generator_loss(buffer.sample())
        else:
            losses = loss(buffer.sample())
            value = total(losses.exclude("loss_generator") if warmup else losses)
        update(value)
        report(1)
        if i % 100 == 0:
            check_metrics({"loss": value.detach()}, f"{name}, seed {seed}, update {i}")
    policy, returns = make_policy(), []
    for i in range(settings.eval_episodes):
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            start = derive_seed(seed, "evaluate", i)
            episode = rollout_episodes(env, policy, seed=start, max_steps=1000)
        returns.append(episode["next", "reward"].sum().item())
    env.close()
    return returns


def batch_path(settings: Settings, seed: int) -> Path:
    """Where a seed's batch lies."""
    return Path(settings.run_dir) / "batches" / f"seed{seed}.safetensors"


def job_size(settings: Settings, name: str) -> int:
    """Steps of a behaviour, updates of an algorithm."""
    behaviour = name == BEHAVIOUR
    return settings.behaviour_steps + settings.batch_steps if behaviour else settings.updates


def run_job(job: tuple[Settings, str, int], report: Report) -> list[Row]:
    """Rows of an algorithm (or of the behaviour) and a seed; kept when done, read back if there."""
    settings, name, seed = job
    path = Path(settings.run_dir) / "results" / f"{name}-seed{seed}.csv"
    if path.exists():
        report(job_size(settings, name))
        columns = {"algorithm": str, "seed": whole, "episode": whole, "return": finite}
        return read_rows(path, columns)
    if name == BEHAVIOUR:
        returns = make_batch(settings, seed, report)
    else:
        returns = train(settings, name, seed, report)
    rows = [
        {"algorithm": name, "seed": seed, "episode": i, "return": round(value, 3)}
        for i, value in enumerate(returns)
    ]
    write_rows(path, rows)
    return rows


def make_table(rows: Sequence[Mapping[str, Any]]) -> str:
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
    seeds = sorted(means[BEHAVIOUR])
    header = ["Algorithm", *(f"Seed {seed}" for seed in seeds), "Mean ± std", "Of behaviour"]
    lines = [header, ["---", *["---:"] * (len(header) - 1)]]
    for name, mean in means.items():
        values = [mean[seed] for seed in seeds]
        total = f"{statistics.fmean(values):.0f} ± {statistics.pstdev(values):.0f}"
        share = "–"  # of a return that is not positive, a share says nothing
        if min(means[BEHAVIOUR].values()) > 0:
            share = f"{statistics.fmean(mean[i] / means[BEHAVIOUR][i] for i in seeds):.0%}"
        lines.append([name, *(f"{value:.0f}" for value in values), total, share])
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def extrapolation(settings: Settings) -> None:
    """Runs what is not done yet, then writes ``results.csv`` and ``table.md``."""
    started, run_dir = time.monotonic(), Path(settings.run_dir)
    parts = []
    for names, unit in ([BEHAVIOUR], "step"), (settings.algorithms, "update"):
        jobs = [(settings, name, seed) for name in names for seed in settings.seeds]
        parts += run_jobs(
            run_job,
            jobs,
            workers=settings.workers,
            total=sum(job_size(settings, name) for _, name, _ in jobs),
            description=f"extrapolation: {unit}s",
            unit=unit,
        )
    rows = [row for part in parts for row in part]
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
    try:
        importlib.import_module("gymnasium.envs.mujoco")
    except (ImportError, gymnasium.error.DependencyNotInstalled) as error:  # imageio, mujoco
        raise ConfigError(f"env {settings.env} needs one more package: {error}") from error
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


ConfigStore.instance().store(name="extrapolation_schema", node=Settings)


@hydra.main(version_base="1.3", config_path="config", config_name="extrapolation")
def main(config: DictConfig) -> None:
    """Command line."""
    with exit_codes():
        settings = OmegaConf.to_object(with_folders_settings(config))
        check_settings(settings)
        with hold_run(Path(settings.run_dir), asdict(settings)):
            extrapolation(settings)


if __name__ == "__main__":
    main()
