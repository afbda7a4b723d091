"""Tasks that nobody trained on: the distilled policy on held-out members of a family.

Every policy gets what it is allowed to know of a member: the parameter, one episode of an expert or
of another behaviour, its own first episode, the nearest trained member, or nothing.
``docs/families.md`` explains the table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_bmrl.data.episodes import as_tensordict
from torchrl_bmrl.data.robomimic import keep_episode, read_kept_episode
from torchrl_bmrl.envs.transforms import transform_data
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.experts.collect import WANDERING, others_than, record_success
from torchrl_bmrl.families import SPLITS
from torchrl_bmrl.files import number, read_rows, whole, write_rows
from torchrl_bmrl.modules import BCQPolicy, PathTaskLatent, reads_context
from torchrl_bmrl.modules.task_latent import check_reads_transitions
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.settings import DistillSettings
from torchrl_bmrl.pipeline.stage2 import StudentJob, train_student
from torchrl_bmrl.pipeline.student import Student, load_student
from torchrl_bmrl.pipeline.task_files import with_run_options
from torchrl_bmrl.reports import Section, write_study
from torchrl_bmrl.reports.explorer import StoredExplorer
from torchrl_bmrl.reports.members import Member, explore_members
from torchrl_bmrl.run.folder import open_run
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.studies.families_films import film_once, why_no_films
from torchrl_bmrl.studies.families_line import LINES, POINTS, line_table, lines_of, play_line
from torchrl_bmrl.studies.families_report import make_tables
from torchrl_bmrl.studies.imitation import clone_behaviour
from torchrl_bmrl.tasks import Task

HELD_OUT = SPLITS[1:]
METHODS = {
    "told": "told the parameter",
    "demonstration": "m of one demonstration",
    "behaviour": "m of one episode of another behaviour",
    "one_shot": "m of its own first episode",
    "first": "the first episode itself",
    "one_hot": "one-hot code of the nearest trained member",
    "teacher": "agent of the nearest trained member",
    "no_context": "told nothing",
    "cloning": "behaviour cloning of one demonstration",
}
"""Policies that are compared; the nearest member is known by the true parameter."""
_COLUMNS: dict[str, Any] = {
    **dict.fromkeys(("method", "split", "member"), str),
    "episode": whole,
    "return": number,
    "success": str,
}


@dataclass
class FamilySettings:
    """Settings of :func:`generalise`."""

    episodes: int = setting(5, above=0)  # of each held-out member with each method
    demonstrations: int = setting(1, above=0)  # episodes of a context
    methods: list[str] = setting(list(METHODS), choices=tuple(METHODS), unique=True)  # to compare
    cloning_updates: int = setting(2000, above=0)  # of behaviour cloning on the demonstration
    folder: ClassVar[str] = "families"  # of the study, below the run's


_OTHERS: dict[str, str] = {"told": "told", "one_hot": "one_hot", "no_context": "nothing"}
"""Encoders of the students that are trained for the comparison, by method."""


def generalise(run: Run, settings: FamilySettings) -> str:
    """Plays the held-out members of the run's family with every method.

    Trains the students of the comparison first, and also plays points between trained members.
    Writes ``families/results.csv`` and ``families/lines.csv`` with a table each, and the members in
    the embedding for the page. Students and episodes that are there already are read back.

    Args:
        run: an open run with stage 2, whose tasks are the trained members of a family.
        settings: of the study.

    Returns:
        the tables as Markdown.

    Raises:
        BMRLError: for settings that are not valid, or a missing policy.
    """
    run.check_open()
    family, methods = run.family, settings.methods
    run.check_playable()
    student, _ = run.student()  # a missing policy is an error before anything is written
    if not reads_context(student.task_encoder):
        check_reads_transitions(student.task_encoder)
    if "behaviour" in methods and not run.settings.collect.context_episodes:
        raise ConfigError(
            "families.methods has behaviour and collect.context_episodes is 0; valid: without it"
        )
    others = [student_job(run, settings, name) for name in methods if name in _OTHERS]
    open_run(run.folder / settings.folder, asdict(settings))
    run.jobs(
        train_student,
        others,
        total=sum(job.settings.updates for job in others),
        description="training the students of the comparison",
        unit="update",
    )
    members = held_out_members(run)
    steps = sum(run.horizon(task) for _, task in members) * settings.episodes * len(methods)
    jobs = [(settings, split, task) for split, task in members]
    results = run.jobs(play_member, jobs, total=steps, description="playing", unit="step")
    rows = [row for part in results for row in part]
    write_rows(run.folder / settings.folder / "results.csv", rows)
    tables = make_tables(family.title, {name: METHODS[name] for name in methods}, rows)
    explorer = explore(run, settings, members) if "demonstration" in methods else None
    for end, table in tables.items():
        section = Section(
            heading="Tasks that nobody trained on",
            tables=[table],
            explorer=None if end else explorer,
        )
        write_study(run.folder, f"families{end}", section, {})
    said = "\n".join(table.markdown() for table in tables.values())
    if family.measure is None or "one_hot" not in methods:
        return said
    lines = [(settings, code, pair) for code in LINES for pair in lines_of(run)]
    if not lines:  # too few members
        return said
    steps = sum(run.horizon(run.task(start)) for _, _, (start, _) in lines)
    results = run.jobs(
        play_line,
        lines,
        total=steps * settings.episodes * POINTS,
        description="playing between members",
        unit="step",
    )
    rows = [row for part in results for row in part]
    write_rows(run.folder / settings.folder / "lines.csv", rows)
    second = line_table(family.title, rows)
    write_study(
        run.folder,
        "families_lines",
        Section(heading="Between trained members", tables=[second]),
        {},
    )
    return f"{said}\n{second.markdown()}"


def held_out_members(run: Run) -> list[tuple[str, Task]]:
    """Split and task of each held-out member, with the run's robot and stepper.

    Args:
        run: the run.
    """
    return [
        (split, with_run_options(task, run.settings))
        for split in HELD_OUT
        for task in run.family.tasks(split)
    ]


def student_job(run: Run, settings: FamilySettings, method: str) -> StudentJob:
    """The student of a method, trained as the run's own but for what it is told.

    Args:
        run: the run.
        settings: of the study.
        method: one of those with a student of their own.
    """
    changes: dict[str, Any] = {
        "task_encoder": _OTHERS[method],
        "context": "current",
        "context_size": 1,
        "inference_updates": 0,
        "isometry_weight": 0.0,
        "metric_weight": 0.0,
        "distance_weight": 0.0,
        "contrastive_weight": 0.0,
        "classification_weight": None,
    }
    distill: DistillSettings = replace(run.settings.distill, **changes)
    return StudentJob(distill, f"{settings.folder}/{method}")


def explore(
    run: Run, settings: FamilySettings, held_out: Sequence[tuple[str, Task]]
) -> StoredExplorer:
    """All members in the embedding, each with a film if films can be made.

    Args:
        run: the run.
        settings: of the study.
        held_out: members with their splits.
    """
    note = why_no_films()
    members = [*(("train", task) for task in run.tasks), *held_out]
    found = run.jobs(
        look_at_member,
        [(settings, split, task, not note) for split, task in members],
        total=0 if note else sum(run.horizon(task) for _, task in members),
        description="filming members",
        unit="step",
    )
    if not note and not any(member.film and member.film.frames for member in found):
        note = "the environments of these tasks make no pictures."
    return explore_members(run.family, found, demonstrations=settings.demonstrations, note=note)


def look_at_member(
    job: tuple[Run, tuple[FamilySettings, str, Task, bool]], report: Report
) -> Member:
    """m of a member's demonstration and, if wanted, an episode that is played with it."""
    run, (settings, split, task, filmed) = job
    policy, latent = make_method(run, settings, task, "demonstration")
    return Member(
        title=task.title,
        split=split,
        parameter=run.family.parameter(task.name),
        task_latent=latent.numpy(),
        film=film_once(run, settings.folder, task, policy, latent, report) if filmed else None,
    )


Job = tuple[FamilySettings, str, Task]
"""Settings, split and member."""


def play_member(job: tuple[Run, Job], report: Report) -> list[dict[str, Any]]:
    """Episodes of a held-out member with every method, played once."""
    run, (settings, split, task) = job
    rows = []
    for method in settings.methods:
        steps = settings.episodes * run.horizon(task)
        rows += run.once(
            f"{settings.folder}/{method}/{task.name}.csv",
            partial(read_rows, columns=_COLUMNS),
            partial(_play, run, settings, split, task, method, report),
            skipped=partial(report, steps),
        )
    # Not in the files of the methods, so that studies of earlier versions get these columns, too.
    more = {"family": run.family.name, "data_return": data_return(run, settings, task)}
    return [row | more for row in rows]


def data_return(run: Run, settings: FamilySettings, task: Task) -> float | str:
    """Mean return of the demonstrations that a policy is given; "" for a task without an expert.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
    """
    if task.record is None:
        return ""
    given = context(run, settings, task, "demonstration")
    return float(given["next", "reward"].double().sum()) / settings.demonstrations


def _play(
    run: Run,
    settings: FamilySettings,
    split: str,
    task: Task,
    method: str,
    report: Report,
    path: Path,
) -> None:
    seeds = [run.seed("families", task.name, i) for i in range(settings.episodes)]
    policy, latent = make_method(run, settings, task, method)
    points = latent if latent.ndim > 1 else latent.unsqueeze(0)
    outcomes = run.play(task, policy, PathTaskLatent(points), seeds=seeds, report=report)
    first = {"method": method, "split": split, "member": task.name}
    rows = [
        {
            **first,
            "episode": i,
            "return": outcome.episode_return,
            "success": "" if outcome.success is None else int(outcome.success),
        }
        for i, outcome in enumerate(outcomes)
    ]
    write_rows(path, rows)


def make_method(
    run: Run, settings: FamilySettings, task: Task, method: str
) -> tuple[TensorDictModuleBase, Tensor]:
    """The policy of a method on a member, and its m: ``(m,)``, or ``(T, m)`` step by step.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        method: one of :data:`METHODS`.
    """
    family = run.family
    code = torch.tensor(family.told(task.name), dtype=torch.float32)
    codes = torch.tensor(run.codes(), dtype=torch.float32)
    nearest = int((codes - code).norm(dim=-1).argmin())
    count = run.settings.evaluate.num_candidates
    if method == "teacher":
        teacher = BCQPolicy.frozen(run.teacher(run.names[nearest]), num_candidates=count)
        return teacher, torch.zeros(1)
    if method == "cloning":
        data = context(run, settings, task, "demonstration")
        seed = run.seed("families", "cloning", task.name)
        return clone_behaviour(data, updates=settings.cloning_updates, seed=seed), torch.zeros(1)
    if method in _OTHERS:
        path = run.folder / settings.folder / method / "checkpoint.safetensors"
        student, metadata = load_student(path)
        latents = {"told": code, "one_hot": student.prototypes[nearest]}
        latent = latents.get(method, student.prototypes[0])
    else:
        student, metadata = run.student()
        if method == "first":
            latent = first_latents(run, student, task, 0)
        else:
            given = context(run, settings, task, method)
            reads = student.embed_context if method == "demonstration" else student.infer
            latent = reads(given)
    policy = student.policy(num_candidates=count, latent_clip=metadata["latent_clip"])
    return policy, latent


def first_latents(run: Run, student: Student, task: Task, index: int) -> Tensor:
    """m of an episode before anything is known: of some trained members in turn, ``(T, m)``.

    Args:
        run: the run.
        student: the student.
        task: the member.
        index: number of the episode.
    """
    generator = torch.Generator().manual_seed(run.seed("families", "sweep", task.name, index))
    chosen = torch.randperm(len(student.prototypes), generator=generator)[:WANDERING]
    horizon = run.horizon(task)
    step = torch.arange(horizon) * len(chosen) // horizon
    return student.prototypes[chosen[step]]


def context(run: Run, settings: FamilySettings, task: Task, method: str) -> TensorDictBase:
    """Transitions of a member that a policy is given, ``[K]``, normalised.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        method: ``"demonstration"``, ``"behaviour"`` or ``"one_shot"``.
    """
    episodes: list[Any] = []
    for i in range(settings.demonstrations):
        if method == "one_shot":
            episodes.append(own_episode(run, task, i))
            continue
        record: Callable[[Path], None] = partial(_record, run, task, method, i)
        file = f"{settings.folder}/contexts/{task.name}-{method}-{i}.npz"
        episode = run.once(file, read_kept_episode, record)
        episodes.append(transform_data(as_tensordict(episode), task, run.statistics))
    return torch.cat(episodes)


def _record(run: Run, task: Task, method: str, index: int, path: Path) -> None:
    """Records an episode of the member's expert that succeeds, or of another member's expert."""
    expert = run.settings.collect.experts_of(task.name)[0]
    seed_of = partial(run.seed, "families", method, task.name, index)
    if method == "demonstration":
        return keep_episode(path, record_success(task, expert, seed_of))
    assert task.record is not None
    seed = run.seed("families", "like", task.name, index)
    like = others_than(run.tasks, "", seed=seed)
    given = {"noise": expert.noise, "gains": expert.gains, "like": like, **task.options}
    keep_episode(path, task.record(seed_of(0), **given))


def own_episode(run: Run, task: Task, index: int) -> TensorDictBase:
    """The policy's own first episode of a member, ``[K]``: it knows nothing of the parameter."""
    student, metadata = run.student()
    count = run.settings.evaluate.num_candidates
    policy = student.policy(num_candidates=count, latent_clip=metadata["latent_clip"])
    env = run.make_env(task, PathTaskLatent(first_latents(run, student, task, index)), num_envs=1)
    seed = run.seed("families", "first", task.name, index)
    played = rollout_episodes(env, policy, seed=[seed], max_steps=run.horizon(task))
    env.close()
    return played.reshape(-1)
