"""Interpolation in the task embedding as exploration: what the policy does between the tasks.

Episodes of one scene whose m lies on lines or curves to the other tasks, or anywhere in the
embedding, are compared with action noise of the same size. Other episodes are driven by one
demonstration, then by another one. ``docs/interpolation.md`` explains the tables.

Reference: *Compositional Skill Learning Using Batch Meta RL*, section 7.5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_bmrl.data.demonstrations import read_demonstrations
from torchrl_bmrl.envs.transforms import make_observation_transform, transform_data
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation.behaviour import matching_noise
from torchrl_bmrl.evaluation.paths import data_path, straight_path, switched_path
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.modules import BCQPolicy, PathTaskLatent
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.reports import Section, write_study
from torchrl_bmrl.rows import check_rows, finite, flag, number, one_of, read_rows, whole, write_rows
from torchrl_bmrl.run.folder import check_made_from, open_run
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.studies.interpolation_report import (
    METHODS,
    SWITCH_STEPS,
    SWITCHES,
    Episodes,
    make_pictures,
    method_table,
    switching_table,
)

WITH_NOISE = ("straight", "random")
"""Methods that are compared with action noise of the same size."""
POSITIONS = {"eef": ("eef_x", "eef_y", "eef_z"), "cube": ("goal_x", "goal_y", "goal_z")}
"""Columns of the files, by the setting that names the part of the observation."""


@dataclass
class InterpolationSettings:
    """Settings of :func:`interpolate`."""

    task: str = "lift"  # whose scene is played, and at whose prototype the paths start
    episodes: int = setting(50, above=0)  # of each method
    switching: str = "reach"  # task whose demonstrations drive the episodes that switch
    eef: str = "robot0_eef_pos"  # part of the observation: position of the end-effector [m]
    cube: str = "goal_pos"  # part of the observation: position of the moved object [m]
    frequency: float = setting(20.0, above=0)  # steps per second

    @property
    def folder(self) -> Path:
        """Folder of the episodes, relative to the run's."""
        return Path("interpolation", f"{self.task}-{self.episodes}")


def interpolate(run: Run, settings: InterpolationSettings) -> str:
    """Plays every method in one scene and, with enough demonstrations, the episodes that switch.

    Writes the episodes below ``interpolation/``, the tables ``interpolation`` and ``switching``,
    and two figures. Episodes that are there already are read back.

    Args:
        run: an open run with stage 2.
        settings: of the study.

    Returns:
        the tables as Markdown.

    Raises:
        BMRLError: for settings that are not valid, or a missing policy.
    """
    run.check_open()
    names, count = run.names, settings.episodes
    if settings.task not in names or len(names) < 2:
        raise ConfigError(
            f"interpolation.task is {settings.task}; valid: one of tasks, {list(names)}, which "
            "must be several"
        )
    if count < len(names):
        raise ConfigError(
            f"interpolation.episodes is {count}; valid: at least one for each of the "
            f"{len(names)} tasks"
        )
    embedding = Embedding(run, settings)
    embedding.student.check_embeds("interpolation")
    switching = settings.switching in names and len(embedding.held_out()[0]) > 1
    for name in [settings.task, *([settings.switching] if switching else [])]:
        position_columns(run, settings, name)  # an error here leaves no folder
    open_run(run.folder / settings.folder, asdict(settings))
    jobs = [(settings, name) for name in (*METHODS, *(SWITCHES if switching else ()))]
    results = run.jobs(
        play_job,
        jobs,
        total=sum(_num_steps(run, *job) for job in jobs),
        description="interpolating",
        unit="step",
    )
    played = {name: episodes for part in results for name, episodes in part.items()}
    switched = {name: played.pop(name) for name in SWITCHES if switching}
    pictures = make_pictures(
        played,
        {run.titles[name]: embedding.training(name, 500) for name in names},
        {kind: embedding.paths(kind, 200) for kind in ("straight", "curve")},
        embedding.points("random")[0][:, 0],
    )
    table = method_table(settings.task, played, settings.frequency)
    section = Section(heading="Interpolation as exploration", tables=[table])
    write_study(run.folder, "interpolation", section, pictures)
    if not switching:
        return table.markdown()
    second = switching_table(run.titles[settings.switching], switched, settings.frequency)
    write_study(run.folder, "switching", Section(heading="Switching", tables=[second]), {})
    return f"{table.markdown()}\n{second.markdown()}"


class Embedding:
    """Points of the distilled policy's embedding.

    Args:
        run: the run.
        settings: of the study.
    """

    def __init__(self, run: Run, settings: InterpolationSettings) -> None:
        self.run, self.settings = run, settings
        self.student, metadata = run.student()
        count = run.settings.evaluate.num_candidates
        clip = metadata["latent_clip"]
        self.policy = self.student.policy(num_candidates=count, latent_clip=clip)
        points = self.student.prototypes.double().numpy()
        self.prototypes = dict(zip(metadata["tasks"], points, strict=True))
        self.others = [name for name in run.names if name != settings.task]

    def training(self, name: str, count: int | None = None) -> np.ndarray:
        """Embeddings of a task's training transitions, ``(N, m)``: all, or some at random."""
        data = self.run.transitions(name, "train")
        chosen = np.random.default_rng(0).permutation(len(data))[:count]
        return self.student.embed(data[torch.from_numpy(np.sort(chosen))]).double().numpy()

    def paths(self, kind: str, num_points: int) -> list[np.ndarray]:
        """A path from the scene's prototype to each other one, ``(num_points, m)``."""
        start = self.prototypes[self.settings.task]
        ends = [self.prototypes[name] for name in self.others]
        if kind == "straight":
            return [straight_path(start, end, num_points) for end in ends]
        data = np.concatenate([self.training(name, 250) for name in self.run.names])
        return [data_path(data, start, end, num_points) for end in ends]

    def points(self, method: str) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Points m of all episodes ``(N, T, m)`` and, for paths, position and target.

        The position along the path ``(N, T)`` lies between 0 and 1, and is NaN without a path; the
        target is a task. T may be 1.
        """
        count, task, names = self.settings.episodes, self.settings.task, self.run.names
        unknown = np.full((count, 1), np.nan)
        if method in ("prototype", "actions"):
            return np.tile(self.prototypes[task], (count, 1, 1)), unknown, [""] * count
        if method == "tasks":
            labels = [names[i % len(names)] for i in range(count)]
            return np.stack([self.prototypes[label] for label in labels])[:, None], unknown, labels
        if method == "random":
            data = np.concatenate([self.training(name) for name in names])
            rng = np.random.default_rng(self.run.seed("interpolate", "random"))
            points = rng.uniform(data.min(0), data.max(0), (count, data.shape[1]))
            return points[:, None], unknown, [""] * count
        kind, _, moving = method.partition("_")
        towards = [i % len(self.others) for i in range(count)]
        labels = [self.others[i] for i in towards]
        if moving:
            horizon = self.run.horizon(self.run.task(task))
            paths = self.paths(kind, horizon)
            along = np.tile(np.linspace(0, 1, horizon), (count, 1))
            return np.stack([paths[i] for i in towards]), along, labels
        # Each episode of a path has one point: from the first one after the prototype to the end.
        levels = -(-count // len(self.others))
        paths = self.paths(kind, levels + 1)
        level = [i // len(self.others) + 1 for i in range(count)]
        points = np.stack([paths[i][j] for i, j in zip(towards, level, strict=True)])
        return points[:, None], np.array(level)[:, None] / levels, labels

    def held_out(self) -> tuple[list[np.ndarray], list[int]]:
        """Embeddings ``(T, m)`` of the held-out demonstrations that drive the episodes that switch.

        With them the step of each one's first success, or its length. Shorter demonstrations
        repeat their last embedding.
        """
        task = self.run.task(self.settings.switching)
        raw = _held_out(self.run, task.name)
        m = self.student.embed(transform_data(raw, task, self.run.statistics)).double().numpy()
        masks = [raw["episode"].numpy() == i for i in np.unique(raw["episode"])]
        longest = max(mask.sum() for mask in masks)
        episodes = [np.pad(m[mask], ((0, longest - mask.sum()), (0, 0)), "edge") for mask in masks]
        successes = [_success(raw).numpy()[mask] for mask in masks]
        return episodes, [int(x.argmax() if x.any() else len(x)) for x in successes]

    def switches(self, how: str) -> tuple[np.ndarray, list[int]]:
        """Points m of the episodes that switch ``(N, T, m)``, and the step at which each does.

        It is half of the time that the first demonstration takes to its success.
        """
        episodes, arrivals = self.held_out()
        pairs = [(a, b) for a in range(len(episodes)) for b in range(len(episodes)) if a != b]
        rng = np.random.default_rng(self.run.seed("interpolate", "pairs"))
        pairs = [pairs[i] for i in rng.permutation(len(pairs))]
        tasks = (self.settings.task, *self.run.names)
        home = self.prototypes[next(name for name in tasks if name != self.settings.switching)]
        paths, leaving = [], []
        for i in range(self.settings.episodes):
            first, second = pairs[i % len(pairs)]
            m, half = episodes[first], max(1, arrivals[first] // 2)
            other = episodes[second] if how == "switch" else np.broadcast_to(home, m.shape)
            steps = min(SWITCH_STEPS, len(m) - half - 1)
            paths.append(m if how == "stay" else switched_path(m, other, at=half, steps=steps))
            leaving.append(half)
        return np.stack(paths), leaving


class Explorer(TensorDictModuleBase):
    """A policy together with its action at a fixed m, in the same state with the same proposals.

    Args:
        policy: the distilled policy.
        task_latent: the fixed m, ``(m,)``.
        noise: standard deviation of noise on the action at the fixed m, which is then executed;
            infinite for uniform actions. With 0 the action at the given m is executed.
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


def play_job(
    job: tuple[Run, tuple[InterpolationSettings, str]], report: Report
) -> dict[str, Episodes]:
    """The episodes of a method and of the noise that it is compared with, played once."""
    run, (settings, name) = job
    paths = {part: run.folder / settings.folder / f"{part}.csv" for part in _parts(name)}
    check_made_from(paths[name], [run.student_path])
    if all(path.exists() for path in paths.values()):
        report(_num_steps(run, settings, name))
        return {part: read_episodes(path, run.names) for part, path in paths.items()}
    embedding, task, noise = Embedding(run, settings), _task(settings, name), 0.0
    if name in SWITCHES:
        points, leaving = embedding.switches(name)
        along, labels = np.full((len(points), 1), np.nan), list(map(str, leaving))
    else:
        points, along, labels = embedding.points(name)
        noise = float("inf") if name == "actions" else 0.0
    played = play(embedding, task, points, report, noise=noise)
    if name in WITH_NOISE:
        actions = played["undisturbed"].reshape(-1, played["undisturbed"].shape[-1])
        noise = matching_noise(actions, float(played["deviation"].mean()))
        points, unknown, nowhere = embedding.points("prototype")
        noisy = play(embedding, task, points, report, noise=noise)
        write_episodes(paths[f"{name}_noise"], noisy, unknown, nowhere)
    write_episodes(paths[name], played, along, labels)
    return {part: read_episodes(path, run.names) for part, path in paths.items()}


def _parts(name: str) -> list[str]:
    return [name, f"{name}_noise"] if name in WITH_NOISE else [name]


def _task(settings: InterpolationSettings, name: str) -> str:
    return settings.switching if name in SWITCHES else settings.task


def _num_steps(run: Run, settings: InterpolationSettings, name: str) -> int:
    horizon = run.horizon(run.task(_task(settings, name)))
    return len(_parts(name)) * settings.episodes * horizon


def play(
    embedding: Embedding, name: str, points: np.ndarray, report: Report, *, noise: float
) -> dict[str, np.ndarray]:
    """Plays a task with given m; positions, actions and successes over time, ``(N, T, ...)``."""
    run, settings, task = embedding.run, embedding.settings, embedding.run.task(name)
    columns = position_columns(run, settings, name)
    fixed = torch.from_numpy(embedding.prototypes[name]).float()
    explorer = Explorer(embedding.policy, fixed, noise)
    seeds = [run.seed("interpolate", name, i) for i in range(len(points))]
    source, steps = PathTaskLatent(torch.from_numpy(points).float()), run.horizon(task)
    with closing(run.make_env(task, source, num_envs=len(points))) as env:
        data = rollout_episodes(env, explorer, seed=seeds, max_steps=steps, report=report)
    observation = data["observation"] * run.statistics.scale + run.statistics.loc
    return {
        **{key: observation[..., part].numpy() for key, part in columns.items()},
        "undisturbed": data["undisturbed"].numpy(),
        "deviation": (data["action"] - data["undisturbed"]).norm(dim=-1).numpy(),
        "success": _success(data).numpy(),
    }


def position_columns(run: Run, settings: InterpolationSettings, name: str) -> dict[str, list[int]]:
    """Columns of a task's observation that contain each position: those that change with it."""
    raw = _held_out(run, name)[:1].exclude("next")
    transform = make_observation_transform(run.task(name), parts=run.statistics.parts)
    found = {}
    for key in POSITIONS:
        part, columns = getattr(settings, key), []
        if part in raw.keys():  # noqa: SIM118 (a TensorDict)
            moved = raw.copy().set(part, raw[part] + 1)
            before, after = (transform(data.copy())["observation"] for data in (raw, moved))
            columns = (after != before).squeeze(0).nonzero().flatten().tolist()
        if len(columns) != 3:
            raise ConfigError(
                f"the observation of task {name} has no position {part}; valid for "
                "interpolation.eef and interpolation.cube: a part with three coordinates"
            )
        found[key] = columns
    return found


def _held_out(run: Run, name: str) -> TensorDictBase:
    path, task = run.demonstrations(name), run.task(name)
    return read_demonstrations(path, task, split="valid", index=run.names.index(name))


def _success(data: TensorDictBase) -> Tensor:
    """Successes without their last dimension; none for a task without a definition of success."""
    return data.get(("next", "success"), torch.zeros_like(data["next", "done"])).squeeze(-1)


def write_episodes(
    path: Path, played: Mapping[str, np.ndarray], along: np.ndarray, labels: Sequence[str]
) -> None:
    """Writes one row per step of each episode."""
    count, length = played["deviation"].shape
    along = np.broadcast_to(along, (count, max(length, along.shape[1])))

    def row(i: int, t: int) -> dict[str, Any]:
        numbers = {
            column: f"{x:.5f}"
            for key, columns in POSITIONS.items()
            for column, x in zip(columns, played[key][i, t], strict=True)
        }
        numbers["deviation"] = f"{played['deviation'][i, t]:.5f}"
        start = {"episode": i, "label": labels[i], "step": t, "along": f"{along[i, t]:.4f}"}
        return start | numbers | {"success": int(played["success"][i, t])}

    write_rows(path, [row(i, t) for i in range(count) for t in range(length)])


def read_episodes(path: Path, tasks: Sequence[str]) -> Episodes:
    """Reads a file of :func:`write_episodes` as arrays ``(N, T, ...)``; labels are ``(N,)``."""
    measured = ("along", "deviation", "success")
    numbers = dict.fromkeys((*POSITIONS["eef"], *POSITIONS["cube"], "deviation"), finite)
    label = whole if path.stem in SWITCHES else one_of("", *tasks)
    columns = {"episode": whole, "step": whole, "label": label, "along": number, "success": flag}
    rows = read_rows(path, columns | numbers)
    count = max(1, len({row["episode"] for row in rows}))
    length = max(1, len(rows) // count)
    steps = [{"episode": i, "step": t} for i in range(count) for t in range(length)]
    check_rows(path, rows, steps)
    values = {key: np.array([row[key] for row in rows]).reshape(count, -1) for key in rows[0]}
    positions = {
        key: np.stack([values[column] for column in columns], -1)
        for key, columns in POSITIONS.items()
    }
    return {**positions, **{key: values[key] for key in measured}, "label": values["label"][:, 0]}
