"""One-shot imitation: one demonstration of a composition drives the distilled policy.

The episodes have other starts and goals than the demonstration, and their actions are executed as
they are or perturbed. The embeddings of the demonstration are compared with a policy that is given
the present task, with behaviour cloning on that demonstration, and with a replay of its actions.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch.nn.functional import mse_loss
from torchrl.envs.transforms import StepCounter, Transform
from torchrl.modules import MLP

from torchrl_bmrl.data.episodes import as_tensordict
from torchrl_bmrl.data.robomimic import keep_episode, read_kept_episode
from torchrl_bmrl.envs.perturbation import PerturbAction
from torchrl_bmrl.envs.transforms import transform_data
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation import bootstrap_interval
from torchrl_bmrl.experts.collect import record_success
from torchrl_bmrl.modules import DemonstrationTaskLatent, StageTaskLatent
from torchrl_bmrl.modules.demonstration_latent import ALIGNMENTS
from torchrl_bmrl.modules.task_latent import check_reads_transitions
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.reports import Section, Table, write_study
from torchrl_bmrl.reports.tables import MISSING
from torchrl_bmrl.rows import one_of, read_rows, success_cell, whole, write_rows
from torchrl_bmrl.run.folder import open_run
from torchrl_bmrl.run.progress import progress
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.run.stops import check_stop
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.tasks import Task

METHODS = (*(f"demonstration, by {name}" for name in ALIGNMENTS), "task index", "cloning", "replay")
PERTURBATIONS = ("none", "magnitude", "direction", "both", "both, constant")
_COLUMNS: dict[str, Any] = {
    **dict.fromkeys(("method", "perturbation"), str),
    **dict.fromkeys(("demonstration", "episode", "stages"), whole),
    "success": one_of("", "0", "1"),  # empty for a task without a definition of success
}


@dataclass
class ImitateSettings:
    """Settings of :func:`imitate`."""

    composition: str = "reach-lift-reach"
    demonstrations: int = setting(5, above=0)  # each drives its share of the episodes alone
    episodes: int = setting(50, above=0)  # of each method and perturbation
    magnitude: tuple[float, float] = setting((0.5, 1.5), above=0)  # factor of the perturbed motion
    max_angle: float = setting(45.0, at_least=0, at_most=180)  # tilt of its direction [degrees]
    cloning_updates: int = setting(2000, above=0)  # of behaviour cloning on the demonstration
    folder: ClassVar[str] = "imitation"  # of the study, below the run's


Job = tuple[ImitateSettings, str, str, int]
"""Settings, method, perturbation and number of the demonstration."""


def imitate(run: Run, settings: ImitateSettings) -> str:
    """Records demonstrations of a composition and plays every method and perturbation.

    Writes ``imitation/results.csv`` and the table ``imitation``. Demonstrations and episodes that
    are there already are read back.

    Args:
        run: an open run with stage 2.
        settings: of the study.

    Returns:
        the table as Markdown.

    Raises:
        BMRLError: for settings that are not valid, or a missing policy.
    """
    run.check_open()
    task = run.composition(settings.composition)
    _check(settings, task)
    # A missing policy, or one that cannot take part, is an error before anything is written.
    check_reads_transitions(run.student()[0].task_encoder)
    open_run(run.folder / settings.folder, asdict(settings))
    with progress(settings.demonstrations, "demonstrating", "demonstration") as bar:
        for number in range(settings.demonstrations):
            demonstrate(run, task, number)
            bar.update(1)
            check_stop()
    jobs = [
        (settings, method, perturbation, number)
        for method in METHODS
        for perturbation in PERTURBATIONS
        for number in range(settings.demonstrations)
    ]
    episodes = settings.episodes // settings.demonstrations
    results = run.jobs(
        play_job,
        jobs,
        total=len(jobs) * episodes * run.horizon(task),
        description="imitating",
        unit="step",
    )
    rows = [row for part in results for row in part]
    write_rows(run.folder / settings.folder / "results.csv", rows)
    table = make_table(settings, [run.titles[name] for name in task.stages], rows)
    section = Section(heading="One-shot imitation", tables=[table])
    write_study(run.folder, "imitation", section, {})
    return table.markdown()


def _check(settings: ImitateSettings, task: Task) -> None:
    if task.record is None or len(task.stages) < 2:
        raise ConfigError(
            f"imitate.composition is {task.name}; valid: several tasks with scripted experts, "
            "joined by -"
        )
    if settings.episodes % settings.demonstrations:
        raise ConfigError(
            f"imitate.episodes is {settings.episodes}; valid: a multiple of "
            f"imitate.demonstrations ({settings.demonstrations})"
        )
    low, high = settings.magnitude
    if low > high:
        raise ConfigError(f"imitate.magnitude is ({low}, {high}); valid: two factors, low to high")


def demonstrate(run: Run, task: Task, number: int) -> TensorDictBase:
    """A demonstration that succeeds, recorded once: normalised, with ``stage`` before actions."""

    def record(path: Path) -> None:
        experts = run.settings.collect.experts_of(task.name)
        expert = experts[number % len(experts)]
        seed_of = partial(run.seed, "imitate", "demonstration", number)
        keep_episode(path, record_success(task, expert, seed_of))

    episode = run.once(
        f"{ImitateSettings.folder}/demonstration-{number}.npz", read_kept_episode, record
    )
    data = transform_data(as_tensordict(episode), task, run.statistics)
    return data.set("stage", torch.as_tensor(episode.extras["stages"]).long())


def play_job(job: tuple[Run, Job], report: Report) -> list[dict[str, Any]]:
    """The episodes that one demonstration drives with one method and perturbation, played once."""
    run, (settings, method, perturbation, number) = job
    task = run.composition(settings.composition)
    count = settings.episodes // settings.demonstrations

    first = {"method": method, "perturbation": perturbation, "demonstration": number}
    episodes = [{**first, "episode": i} for i in range(count)]

    def play(path: Path) -> None:
        policy, sources = make_method(run, settings, method, number)
        transforms = [*sources, *make_perturbation(settings, perturbation)]
        seeds = [run.seed("imitate", number, i) for i in range(count)]
        outcomes = run.play(task, policy, *transforms, seeds=seeds, report=report)
        rows = [
            {**known, "stages": outcome.stages, "success": success_cell(outcome.success)}
            for known, outcome in zip(episodes, outcomes, strict=True)
        ]
        write_rows(path, rows)

    name = f"{method}-{perturbation}-{number}".replace(" ", "_").replace(",", "")
    return run.once(
        f"{settings.folder}/{name}.csv",
        partial(read_rows, columns=_COLUMNS, expected=episodes),
        play,
        skipped=lambda: report(count * run.horizon(task)),
        of=[] if method in ("cloning", "replay") else [run.student_path],
    )


def make_method(
    run: Run, settings: ImitateSettings, method: str, number: int
) -> tuple[TensorDictModuleBase, list[Transform]]:
    """The policy of a method, given a demonstration's number, and the transforms that it needs."""
    task = run.composition(settings.composition)
    demonstration = demonstrate(run, task, number)
    if method == "replay":
        actions = demonstration["action"]
        replay = TensorDictModule(
            lambda count: actions[count.squeeze(-1)], in_keys=["step_count"], out_keys=["action"]
        )
        return replay, [StepCounter()]
    if method == "cloning":
        seed = run.seed("imitate", "cloning", f"demonstration-{number}")
        return clone_behaviour(demonstration, updates=settings.cloning_updates, seed=seed), []
    student, metadata = run.student()
    if method == "task index":
        index = [metadata["tasks"].index(name) for name in task.stages]
        source: Transform = StageTaskLatent(student.prototypes[index])
    else:
        alignment = method.removeprefix("demonstration, by ")
        source = DemonstrationTaskLatent(demonstration, student.task_encoder, alignment=alignment)
    count = run.settings.evaluate.num_candidates
    return student.policy(num_candidates=count, latent_clip=metadata["latent_clip"]), [source]


def clone_behaviour(
    demonstration: TensorDictBase, *, updates: int, seed: int
) -> TensorDictModuleBase:
    """A policy from regression of a demonstration's actions on its observations."""
    observation, action = demonstration["observation"], demonstration["action"]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = MLP(observation.shape[-1], action.shape[-1], num_cells=[256, 256],
                      activation_class=torch.nn.ReLU)  # fmt: skip
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(updates):
        optimizer.zero_grad()
        mse_loss(network(observation), action).backward()
        optimizer.step()
    return TensorDictModule(
        lambda observation: network(observation).clamp(-1, 1), ["observation"], ["action"]
    )


def make_perturbation(settings: ImitateSettings, name: str) -> list[Transform]:
    """The transform that perturbs the executed actions, if any."""
    magnitude: dict[str, Any] = {"magnitude": settings.magnitude}
    angle: dict[str, Any] = {"max_angle": settings.max_angle}
    options = {
        "none": {},
        "magnitude": magnitude,
        "direction": angle,
        "both": magnitude | angle,
        "both, constant": magnitude | angle | {"per": "episode"},
    }[name]
    return [PerturbAction(**options)] if options else []


def make_table(settings: ImitateSettings, titles: list[str], rows: list[dict[str, Any]]) -> Table:
    """Success of each task and of the whole composition, by method and perturbation."""
    lines = []
    for method in METHODS:
        for perturbation in PERTURBATIONS:
            mine = [r for r in rows if (r["method"], r["perturbation"]) == (method, perturbation)]
            done = [row["stages"] for row in mine]
            whole_chain = [float(row["success"]) for row in mine if row["success"] != ""]
            reached = [sum(d > i for d in done) / len(done) for i in range(len(titles))]
            line = [method, perturbation, *(f"{share:.0%}" for share in reached)]
            if whole_chain:
                strata = [row["demonstration"] for row in mine]
                low, high = bootstrap_interval(whole_chain, strata=strata)
                line += [f"{sum(whole_chain) / len(mine):.0%}", f"[{low:.0%}, {high:.0%}]"]
            else:
                line += [MISSING, MISSING]
            lines.append([*line, str(len(mine))])
    low, high = settings.magnitude
    stages = [f"{i}. {title}" for i, title in enumerate(titles, 1)]
    return Table(
        title=f"One-shot imitation of {settings.composition}",
        caption=(
            "Share of episodes that complete each task of the composition, and all of them, from "
            "starts and to goals that the demonstration does not have. Each of "
            f"{settings.demonstrations} demonstrations drives the same number of episodes. "
            f"Perturbation: the motion is multiplied by {low:g} to {high:g} (magnitude) and its "
            f"direction is tilted by up to {settings.max_angle:g}° (direction), drawn anew at "
            "every step, or once per episode (constant). Task index: the policy is given the "
            "prototype of the present task. Cloning: regression on that one demonstration. "
            "Replay: its actions in open loop. Brackets: 95% bootstrap interval over episodes."
        ),
        header=("Method", "Perturbation", *stages, "Whole", "95% interval", "Episodes"),
        rows=lines,
    )
