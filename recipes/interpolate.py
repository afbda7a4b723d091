"""What the policy does between the tasks: interpolation in the embedding as exploration.

python recipes/interpolate.py run_dir=runs/mine         # after recipes/distill.py
python recipes/interpolate.py run_dir=runs/mine interpolation.task=push_up

Episodes of one scene whose m lies on lines or curves to the other tasks, or anywhere in the
embedding, beside action noise of the same size; and reach episodes driven by one demonstration,
then by another. ``docs/interpolation.md`` says how to read the tables.

Reference: *Compositional Skill Learning Using Batch Meta RL*, section 7.5.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from interpolation_report import (
    METHODS,
    SWITCH_STEPS,
    SWITCHES,
    Episodes,
    make_pictures,
    method_table,
    switching_table,
)
from omegaconf import DictConfig
from settings import Config, run_recipe
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation.behaviour import matching_noise
from torchrl_bmrl.evaluation.paths import data_path, straight_path, switched_path
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.files import number, read_rows, whole, write_rows
from torchrl_bmrl.modules import BCQPolicy, PathTaskLatent
from torchrl_bmrl.names import horizon_of
from torchrl_bmrl.pipeline.agents import Student, load_student
from torchrl_bmrl.reports import Section, write_study
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs

WITH_NOISE = ("straight", "random")
"""Methods beside which action noise of the same size is played."""
POSITIONS = {"eef": ["eef_x", "eef_y", "eef_z"], "cube": ["goal_x", "goal_y", "goal_z"]}
# The parts of the observation that these are, see OBSERVATION_PARTS.
COLUMNS = {"eef": slice(23, 26), "cube": slice(30, 33)}
Job = tuple[Config, str]
Rows = list[dict[str, Any]]


class Explorer(TensorDictModuleBase):
    """A policy, beside what it does at a fixed m in the same state with the same proposals.

    Args:
        policy: the distilled one.
        task_latent: the fixed m, ``(m,)``.
        noise: standard deviation of noise on the action at the fixed m, in place of the action at
            the m that is given; infinite for uniform actions.
    """

    def __init__(self, policy: BCQPolicy, task_latent: Tensor, noise: float = 0.0) -> None:
        super().__init__()
        self.policy, self.task_latent, self.noise = policy, task_latent, noise
        self.in_keys, self.out_keys = policy.in_keys, ["action", "undisturbed"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` and ``undisturbed``."""
        random_state = torch.get_rng_state()
        fixed = self.task_latent.expand_as(tensordict["task_latent"])
        undisturbed = self.policy(tensordict.copy().set("task_latent", fixed))["action"]
        tensordict["undisturbed"] = undisturbed
        if self.noise == float("inf"):
            return tensordict.set("action", 2 * torch.rand_like(undisturbed) - 1)
        if self.noise:
            noise = self.noise * torch.randn_like(undisturbed)
            return tensordict.set("action", (undisturbed + noise).clamp(-1, 1))
        torch.set_rng_state(random_state)
        return self.policy(tensordict)


# -- where m goes ----------------------------------------------------------------------------------


def training_embeddings(
    config: Config, student: Student, task: str, count: int | None = None
) -> np.ndarray:
    """Embeddings of a task's training transitions, ``(N, m)``: all, or so many at random."""
    data_dir = Path(config.run_dir) / "data"
    statistics = read_statistics(data_dir)
    data = load_transitions(
        data_dir, task, statistics, split="train", num_task=config.tasks.index(task)
    )
    chosen = np.random.default_rng(0).permutation(len(data))[:count]
    return student.embed(data[torch.from_numpy(np.sort(chosen))]).double().numpy()


def other_tasks(config: Config) -> list[str]:
    """The tasks that lines lead to."""
    return [task for task in config.tasks if task != config.interpolation.task]


def make_paths(config: Config, student: Student, kind: str, num_points: int) -> list[np.ndarray]:
    """A path from the scene's prototype to every other task's, ``(num_points, m)`` each."""
    prototypes = dict(zip(config.tasks, student.prototypes.double().numpy(), strict=True))
    start = prototypes[config.interpolation.task]
    ends = [prototypes[task] for task in other_tasks(config)]
    if kind == "straight":
        return [straight_path(start, end, num_points) for end in ends]
    data = np.concatenate([training_embeddings(config, student, t, 250) for t in config.tasks])
    return [data_path(data, start, end, num_points) for end in ends]


def embedding_points(
    config: Config, student: Student, method: str
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """m of every episode, ``(N, T, m)``; how far along its path, ``(N, T)``; and to which task."""
    count, task = config.interpolation.episodes, config.interpolation.task
    prototypes = dict(zip(config.tasks, student.prototypes.double().numpy(), strict=True))
    unknown = np.full((count, 1), np.nan)
    if method in ("prototype", "actions"):
        return np.tile(prototypes[task], (count, 1, 1)), unknown, [""] * count
    if method == "tasks":
        names = [config.tasks[i % len(config.tasks)] for i in range(count)]
        return np.stack([prototypes[name] for name in names])[:, None], unknown, names
    if method == "random":
        data = np.concatenate([training_embeddings(config, student, t) for t in config.tasks])
        rng = np.random.default_rng(derive_seed(config.seed, "interpolate", "random"))
        points = rng.uniform(data.min(0), data.max(0), (count, data.shape[1]))
        return points[:, None], unknown, [""] * count
    others = other_tasks(config)
    towards = [i % len(others) for i in range(count)]
    kind, _, moving = method.partition("_")
    names = [others[i] for i in towards]
    if moving:
        paths = make_paths(config, student, kind, horizon_of(task))
        along = np.tile(np.linspace(0, 1, horizon_of(task)), (count, 1))
        return np.stack([paths[i] for i in towards]), along, names
    # Episodes of a path hold one point each: from the first after the prototype to the other end.
    levels = -(-count // len(others))
    paths = make_paths(config, student, kind, levels + 1)
    level = [i // len(others) + 1 for i in range(count)]
    points = np.stack([paths[i][j] for i, j in zip(towards, level, strict=True)])
    return points[:, None], np.array(level)[:, None] / levels, names


def switching_points(config: Config, student: Student, how: str) -> tuple[np.ndarray, list[int]]:
    """m of reach episodes driven by held-out demonstrations, ``(N, T, m)``; the steps of leaving.

    Halfway is half of the time that the first demonstration takes to its success.
    """
    data_dir = Path(config.run_dir) / "data"
    index = config.tasks.index("reach")
    held_out = load_transitions(
        data_dir, "reach", read_statistics(data_dir), split="valid", num_task=index
    )
    embedding = student.embed(held_out).double().numpy()
    success = held_out["next", "success"].reshape(-1).numpy()
    episodes = [held_out["episode"].numpy() == i for i in np.unique(held_out["episode"])]
    pairs = [(a, b) for a in range(len(episodes)) for b in range(len(episodes)) if a != b]
    rng = np.random.default_rng(derive_seed(config.seed, "interpolate", "pairs"))
    pairs = [pairs[i] for i in rng.permutation(len(pairs))]
    home = student.prototypes[config.tasks.index(elsewhere(config))].double().numpy()
    paths, leaving = [], []
    for i in range(config.interpolation.episodes):
        first, second = (episodes[k] for k in pairs[i % len(pairs)])
        m, arrived = embedding[first], success[first]
        half = max(1, int(arrived.argmax() if arrived.any() else len(m)) // 2)
        other = embedding[second] if how == "switch" else np.broadcast_to(home, m.shape)
        steps = min(SWITCH_STEPS, len(m) - half - 1)
        paths.append(m if how == "stay" else switched_path(m, other, at=half, steps=steps))
        leaving.append(half)
    return np.stack(paths), leaving


def elsewhere(config: Config) -> str:
    """The task whose prototype ends the episodes that leave reaching."""
    return next(task for task in (config.interpolation.task, *config.tasks) if task != "reach")


# -- episodes --------------------------------------------------------------------------------------


def play(
    config: Config,
    student: Student,
    metadata: Mapping[str, Any],
    task: str,
    points: np.ndarray,
    report: Report,
    *,
    noise: float = 0.0,
    home: str,
) -> dict[str, np.ndarray]:
    """Episodes with given m; positions, actions and successes over time, ``(N, T, ...)``."""
    statistics = read_statistics(Path(config.run_dir) / "data")
    count = config.interpolation.episodes
    policy = student.policy(
        num_candidates=config.evaluate.num_candidates, latent_clip=metadata["latent_clip"]
    )
    explorer = Explorer(policy, student.prototypes[config.tasks.index(home)], noise)
    seeds = [derive_seed(config.seed, "interpolate", task, i) for i in range(count)]
    transform = PathTaskLatent(torch.from_numpy(points).float())
    options = {"num_envs": count, "stepper": config.stepper}
    with closing(make_env(task, statistics, transform, **options)) as env:
        data = rollout_episodes(env, explorer, seed=seeds, report=report)
    observation = data["observation"] * statistics.scale + statistics.loc
    return {
        **{name: observation[..., part].numpy() for name, part in COLUMNS.items()},
        "undisturbed": data["undisturbed"].numpy(),
        "deviation": (data["action"] - data["undisturbed"]).norm(dim=-1).numpy(),
        "success": data["next", "success"].squeeze(-1).numpy(),
    }


def make_rows(played: Mapping[str, np.ndarray], along: np.ndarray, labels: Sequence[Any]) -> Rows:
    """One row for each step of each episode."""
    count, length = played["deviation"].shape
    along = np.broadcast_to(along, (count, max(length, along.shape[1])))
    rows = []
    for i in range(count):
        for t in range(length):
            row = {"episode": i, "label": labels[i], "step": t, "along": f"{along[i, t]:.4f}"}
            for name, columns in POSITIONS.items():
                row |= {c: f"{x:.5f}" for c, x in zip(columns, played[name][i, t], strict=True)}
            row |= {"deviation": f"{played['deviation'][i, t]:.5f}"}
            rows.append(row | {"success": int(played["success"][i, t])})
    return rows


def folder(config: Config) -> Path:
    """Where episodes are kept; other settings of the interpolation have another folder."""
    settings = config.interpolation
    return Path(config.run_dir) / "interpolation" / f"{settings.task}-{settings.episodes}"


def job_files(job: Job) -> list[Path]:
    """What a job leaves."""
    config, name = job
    names = [name, f"{name}_noise"] if name in WITH_NOISE else [name]
    return [folder(config) / f"{part}.csv" for part in names]


def job_size(job: Job) -> int:
    """Steps of a job."""
    settings = job[0].interpolation
    return len(job_files(job)) * settings.episodes * horizon_of(settings.task)


def run_job(job: Job, report: Report) -> None:
    """Episodes of a method, and of the noise beside it; kept when done, skipped if there."""
    config, name = job
    files = job_files(job)
    if all(path.exists() for path in files):
        report(job_size(job))
        return
    student, metadata = load_student(Path(config.run_dir) / "distill" / "checkpoint.safetensors")
    if name in SWITCHES:
        points, leaving = switching_points(config, student, name)
        played = play(config, student, metadata, "reach", points, report, home="reach")
        write_rows(files[0], make_rows(played, np.full((len(points), 1), np.nan), leaving))
        return
    task = config.interpolation.task
    points, along, labels = embedding_points(config, student, name)
    noise = float("inf") if name == "actions" else 0.0
    played = play(config, student, metadata, task, points, report, noise=noise, home=task)
    if name in WITH_NOISE:
        actions = played["undisturbed"].reshape(-1, played["undisturbed"].shape[-1])
        noise = matching_noise(actions, float(played["deviation"].mean()))
        points, unknown, nowhere = embedding_points(config, student, "prototype")
        noisy = play(config, student, metadata, task, points, report, noise=noise, home=task)
        write_rows(files[1], make_rows(noisy, unknown, nowhere))
    write_rows(files[0], make_rows(played, along, labels))


def read_episodes(path: Path) -> Episodes:
    """What :func:`make_rows` made, as arrays ``(N, T, ...)``; labels ``(N,)``."""
    positions = [name for names in POSITIONS.values() for name in names]
    measured = [*positions, "along", "deviation", "success"]
    columns = {"episode": whole, "step": whole, "label": str, **dict.fromkeys(measured, number)}
    rows = read_rows(path, columns)
    count = 1 + max(row["episode"] for row in rows)

    def column(*names: str) -> np.ndarray:
        values = np.array([[row[name] for name in names] for row in rows])
        return values.reshape(count, -1, len(names))

    episodes = {name: column(*columns) for name, columns in POSITIONS.items()}
    episodes |= {name: column(name)[..., 0] for name in ("along", "deviation", "success")}
    return episodes | {"label": np.array([row["label"] for row in rows if row["step"] == 0])}


def interpolate(config: Config) -> None:
    """Plays what is not kept yet, then writes tables and figures."""
    run_dir, task = Path(config.run_dir), config.interpolation.task
    if task not in config.tasks or len(config.tasks) < 2:
        raise ConfigError(
            f"interpolation.task is {task}; valid: one of tasks, {config.tasks}, beside others"
        )
    if config.interpolation.episodes < len(config.tasks):
        raise ConfigError(
            f"interpolation.episodes is {config.interpolation.episodes}; valid: at least one for "
            f"each of the {len(config.tasks)} tasks"
        )
    names = list(METHODS)
    switching = "reach" in config.tasks and config.collect.valid_episodes > 1
    jobs = [(config, name) for name in names + list(SWITCHES) * switching]
    run_jobs(
        run_job,
        jobs,
        workers=config.workers,
        total=sum(map(job_size, jobs)),
        description="interpolating",
        unit="step",
    )
    played = {
        path.stem: read_episodes(path) for name in names for path in job_files((config, name))
    }
    student, _ = load_student(run_dir / "distill" / "checkpoint.safetensors")
    pictures = make_pictures(
        played,
        {name: training_embeddings(config, student, name, 500) for name in config.tasks},
        {kind: make_paths(config, student, kind, 200) for kind in ("straight", "curve")},
        embedding_points(config, student, "random")[0][:, 0],
    )
    table = method_table(task, played)
    section = Section(heading="Interpolation as exploration", tables=[table])
    write_study(run_dir, "interpolation", section, pictures)
    print(table.markdown())
    if switching:
        ways = {name: read_episodes(folder(config) / f"{name}.csv") for name in SWITCHES}
        table = switching_table(ways)
        write_study(run_dir, "switching", Section(heading="Switching", tables=[table]), {})
        print(table.markdown())


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, interpolate, trains=False)


if __name__ == "__main__":
    main()
