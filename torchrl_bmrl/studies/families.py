"""Unseen tasks: the distilled policy on held-out members of a family.

Every policy gets what it is allowed to know of a member: the parameter, one episode of an expert or
of another behaviour, its own first episode, the nearest trained member, or nothing.
``docs/families.md`` explains the table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from torchrl_bmrl.data.source_files import files_of
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.families import SPLITS
from torchrl_bmrl.modules import embed_context, reads_context
from torchrl_bmrl.modules.task_latent import check_reads_transitions
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.settings import DistillSettings
from torchrl_bmrl.pipeline.stage2 import StudentJob, train_student
from torchrl_bmrl.pipeline.task_files import check_playable, with_run_options
from torchrl_bmrl.reports import Section, write_study
from torchrl_bmrl.reports.explorer import StoredExplorer
from torchrl_bmrl.reports.members import Member, explore_members
from torchrl_bmrl.rows import number, or_nothing, read_rows, success_cell, whole, write_rows
from torchrl_bmrl.run.folder import open_run
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.studies.families_films import film_once, why_no_films
from torchrl_bmrl.studies.families_line import LINES, POINTS, line_table, lines_of, play_line
from torchrl_bmrl.studies.families_methods import (
    METHODS,
    OWN,
    FamilySettings,
    check_files,
    checkpoints_of,
    context,
    has_demonstrations,
    load_learner,
    make_method,
)
from torchrl_bmrl.studies.families_peers import PEERS, PeerJob, train_peer
from torchrl_bmrl.studies.families_report import make_tables
from torchrl_bmrl.tasks import Task

HELD_OUT = SPLITS[1:]
_COLUMNS: dict[str, Any] = {
    **dict.fromkeys(("family", "method", "split", "member"), str),
    "episode": whole,
    "return": number,
    "success": str,
    "data_return": or_nothing,
}
HEADINGS = {
    "": "Unseen tasks",
    "_shares": "Shares of the return of others",
    "_differences": "What m is worth",
}
"""Headings of the tables of :func:`.make_tables` on the page."""
_OTHERS: dict[str, str] = {"told": "told", "one_hot": "one_hot", "no_context": "nothing"}
"""Encoders of the students that are trained for the comparison, by method."""


def generalise(run: Run, settings: FamilySettings) -> str:
    """Plays the held-out members of the run's family with every method.

    Trains the students and the published methods of the comparison first, and also plays points
    between trained members. Writes ``families/results.csv`` and ``families/lines.csv`` with a table
    each, and the members in the embedding for the page. Policies and episodes that are there
    already are read back.

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
    members = held_out_members(run)
    check_playable([*run.tasks, *(task for _, task in members)])
    student, _ = run.student()  # a missing policy is an error before anything is written
    if not reads_context(student.task_encoder):
        check_reads_transitions(student.task_encoder)
    if "behaviour" in methods and not run.has_contexts:
        raise ConfigError(
            "families.methods has behaviour and the run has no episodes of another behaviour; "
            "valid: without it"
        )
    check_files(run, settings, [task for _, task in members])
    others = [student_job(run, settings, name) for name in settings.learners if name in _OTHERS]
    peers = [
        PeerJob(name, getattr(settings, name), f"{settings.folder}/{name}")
        for name in settings.learners
        if name in PEERS
    ]
    for job in peers:
        job.check()
    files = {
        f"demonstrations of {task.name}": files_of(task.files.path)
        for _, task in members
        if task.files is not None
    }
    open_run(run.folder / settings.folder, asdict(settings), files=files)
    run.jobs(
        train_student,
        others,
        total=sum(job.settings.updates for job in others),
        description="training the students of the comparison",
        unit="update",
    )
    run.jobs(
        train_peer,
        peers,
        total=sum(job.settings.total for job in peers),
        description="training the published methods",
        unit="update",
    )
    steps = sum(run.horizon(task) for _, task in members) * settings.episodes * len(methods)
    jobs = [(settings, split, task) for split, task in members]
    results = run.jobs(play_member, jobs, total=steps, description="playing", unit="step")
    rows = [row for part in results for row in part]
    write_rows(run.folder / settings.folder / "results.csv", rows)
    tables = make_tables(family.title, {name: METHODS[name] for name in methods}, rows)
    explorer = explore(run, settings, members) if "demonstration" in methods else None
    for end, table in tables.items():
        section = Section(
            heading=HEADINGS[end],
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
        "reward_updates": 0,
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
    learner = load_learner(run, settings, OWN)
    latent = embed_context(learner.encoder, context(run, settings, task, "demonstration", 0))
    policy = learner.policy
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
    returns = [data_return(run, settings, task, i) for i in range(settings.episodes)]
    rows = []
    for method in settings.methods:
        steps = settings.episodes * run.horizon(task)
        first = {"family": run.family.name, "method": method, "split": split, "member": task.name}
        episodes = [{**first, "episode": i} for i in range(settings.episodes)]
        rows += run.once(
            f"{settings.folder}/{method}/{task.name}.csv",
            partial(read_rows, columns=_COLUMNS, expected=episodes),
            partial(_play, run, settings, task, method, episodes, returns, report),
            skipped=partial(report, steps),
            of=checkpoints_of(run, settings, method),
        )
    return rows


def data_return(run: Run, settings: FamilySettings, task: Task, index: int) -> float | str:
    """Mean return of the demonstrations that a policy is given; "" for a task without any.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        index: number of the episode.
    """
    if not has_demonstrations(settings, task):
        return ""
    given = context(run, settings, task, "demonstration", index)
    return float(given["next", "reward"].double().sum()) / settings.demonstrations


def _play(
    run: Run,
    settings: FamilySettings,
    task: Task,
    method: str,
    episodes: Sequence[Mapping[str, Any]],
    returns: Sequence[float | str],
    report: Report,
    path: Path,
) -> None:
    seeds = [run.seed("families", task.name, i) for i in range(settings.episodes)]
    policy, source = make_method(run, settings, task, method)
    outcomes = run.play(task, policy, source, seeds=seeds, report=report)
    rows = [
        {
            **known,
            "return": outcome.episode_return,
            "success": success_cell(outcome.success),
            "data_return": data,
        }
        for known, outcome, data in zip(episodes, outcomes, returns, strict=True)
    ]
    write_rows(path, rows)
