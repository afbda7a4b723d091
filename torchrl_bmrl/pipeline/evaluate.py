"""Evaluation of a run: episodes from new starts, and the report."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from itertools import cycle
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.transforms import Transform

from torchrl_bmrl.data.demonstrations import has_contexts, read_demonstrations, read_phases
from torchrl_bmrl.data.robomimic_file import MASKS
from torchrl_bmrl.envs.transforms import ObservationStatistics
from torchrl_bmrl.errors import CheckpointError, ConfigError
from torchrl_bmrl.evaluation import ResultRow, read_results, write_results
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome
from torchrl_bmrl.experts.settings import ExpertSettings
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS
from torchrl_bmrl.pipeline.films import films_of, shows_embedding
from torchrl_bmrl.pipeline.held_out import evaluate_held_out
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.stage1 import make_policy
from torchrl_bmrl.pipeline.student import Student
from torchrl_bmrl.reports import Embeddings, write_report
from torchrl_bmrl.reports.drawn import draw_embeddings
from torchrl_bmrl.reports.films import explore_demonstrations
from torchrl_bmrl.reports.tables import task_titles
from torchrl_bmrl.rows import check_rows
from torchrl_bmrl.run.folder import read_versions
from torchrl_bmrl.run.stops import beside, wait_for
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.tasks import Task
from torchrl_bmrl.training.checkpoint import load_checkpoint

log = logging.getLogger(__name__)


def evaluate(run: Run) -> str:
    """Evaluates every policy on every task, then writes ``results.csv`` and the report.

    A run with a task that has no environment is evaluated on held-out demonstrations instead
    (:func:`~torchrl_bmrl.pipeline.held_out.evaluate_held_out`).

    Args:
        run: an open run with both stages, or with ``evaluate.policy``, an exported policy.

    Returns:
        the table of results as Markdown, and the path of the report.

    Raises:
        BMRLError: if a file is missing or damaged.

    Example:
        >>> from torchrl_bmrl.pipeline import Settings
        >>> evaluate(Run(Settings(tasks=["reach"])))
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: runs/mine is not open; valid: with Run(settings) as run: ...
    """
    run.check_open()
    settings, alone = run.settings.evaluate, run.settings.evaluate.policy is not None
    if alone:
        known = run.policy()[1]["tasks"]
        if not set(run.names) <= set(known):
            raise ConfigError(f"tasks is {list(run.names)}; valid for {settings.policy}: {known}")
    look = not alone and shows_embedding(run)
    # With one worker the episodes are played here: both would draw from PyTorch's generator.
    at_once = look and run.playable and run.settings.workers > 1
    with beside(look_at_embedding, run) if at_once else nullcontext() as looked:
        if run.playable:
            play(run)
            tables, shown = {}, "results"
        else:
            tables, shown = {"held_out": evaluate_held_out(run)}, "held_out"
        seen = wait_for(looked) if looked else look_at_embedding(run) if look else {}
    write_report(
        run.folder,
        default_source=settings.latent_sources[0],
        facts=run_facts(run),
        titles=run.titles,
        tables=tables,
        seed=run.settings.seed,
        **seen,
    )
    table = (run.folder / "tables" / f"{shown}.md").read_text(encoding="utf-8")
    return f"{table}\nreport: {run.folder / 'report.html'}"


def play(run: Run) -> None:
    """Plays the episodes of all policies, and writes ``results.csv``.

    Args:
        run: an open run whose tasks have environments.
    """
    settings, alone = run.settings.evaluate, run.settings.evaluate.policy is not None
    jobs = [] if alone else jobs_without_student(run)
    for source in settings.latent_sources:
        jobs += [(task, "distilled", source) for task in run.names]
    if settings.reference and not alone:
        jobs += [(task.name, "reference", "") for task in run.tasks if task.record is not None]
    rows = run.jobs(
        evaluate_job,
        jobs,
        total=sum(settings.episodes * run.horizon(run.task(task)) for task, *_ in jobs),
        description="evaluating",
        unit="step",
    )
    write_results(run.folder / "results.csv", [row for part in rows for row in part])


def jobs_without_student(run: Run) -> list[tuple[str, str, str]]:
    """The jobs of :func:`evaluate_job` that need stage 1 only: the experts and the agents.

    Args:
        run: an open run.
    """
    return [(task, policy, "") for policy in ("expert", "bcq") for task in run.names]


def evaluate_once(
    run: Run,
    task: str,
    policy: str,
    play: Callable[[list[int]], list[EpisodeOutcome]],
    *,
    of: Sequence[Path] = (),
    source: str = "",
    development: bool = False,
    report: Report,
) -> list[ResultRow]:
    """Plays the evaluation's episodes of one task, policy and source of m, or loads their file.

    The files are in the folder ``evaluation``, those of development starts in ``development``.

    Args:
        run: the run.
        task: name of the task.
        policy: name of the policy in tables.
        play: plays one episode for each of the given seeds.
        of: the policy's checkpoint.
        source: source of m, for the distilled policy.
        development: whether to start from other seeds than the evaluation's, for tuning.
        report: called with the number of steps if the episodes are loaded.
    """
    starts, folder = ("dev", "development") if development else ("evaluate", "evaluation")
    name = "-".join(filter(None, (task, policy, source)))
    episodes = run.settings.evaluate.episodes

    def read(path: Path) -> list[ResultRow]:
        rows = read_results(path)
        known = {"task": task, "policy": policy, "latent_source": source, "seed": run.settings.seed}
        expected = [{**known, "episode": i} for i in range(max(1, len(rows)))]
        check_rows(path, [asdict(row) for row in rows], expected)
        return rows

    def make(path: Path) -> None:
        outcomes = play([run.seed(starts, task, i) for i in range(episodes)])
        rows = [
            ResultRow(
                task=task,
                policy=policy,
                latent_source=source,
                seed=run.settings.seed,
                episode=i,
                episode_return=outcome.episode_return,
                success=outcome.success,
            )
            for i, outcome in enumerate(outcomes)
        ]
        write_results(path, rows)
        log.debug("%s: mean return %.1f", path, fmean(row.episode_return for row in rows))

    return run.once(
        f"{folder}/{name}.csv",
        read,
        make,
        skipped=lambda: report(episodes * run.horizon(run.task(task))),
        of=of,
    )


def evaluate_job(job: tuple[Run, tuple[str, str, str]], report: Report) -> list[ResultRow]:
    """Evaluates one policy, with one source of m, on one task."""
    run, (name, policy_name, source) = job
    task, count = run.task(name), run.settings.evaluate.num_candidates

    def play(seeds: list[int]) -> list[EpisodeOutcome]:
        if policy_name in ("expert", "reference"):
            outcomes_of = expert_outcomes if policy_name == "expert" else reference_outcomes
            outcomes = outcomes_of(run, name, seeds)
            report(len(seeds) * run.horizon(task))
            return outcomes
        if policy_name == "bcq":
            policy = make_policy(run.teacher(name), run.settings)
            return run.play(task, policy, seeds=seeds, report=report)
        student, metadata = run.policy()
        policy = student.policy(num_candidates=count, latent_clip=metadata["latent_clip"])
        transform = source_of_m(run, name, student, metadata, source)
        statistics = ObservationStatistics.from_lists(metadata["statistics"])
        return run.play(task, policy, transform, seeds=seeds, statistics=statistics, report=report)

    of = {"bcq": [run.agent_path(name)], "distilled": [run.student_path]}.get(policy_name, [])
    return evaluate_once(run, name, policy_name, play, of=of, source=source, report=report)


def source_of_m(
    run: Run, name: str, student: Student, metadata: dict[str, Any], source: str
) -> Transform:
    """Returns the transform that writes ``task_latent`` for a task."""
    demonstration = held_out_episode(run, name) if source == "demonstration" else None
    return student.task_latent_source(source, metadata["tasks"].index(name), demonstration)


def held_out_episode(run: Run, name: str) -> TensorDictBase:
    """Returns the demonstration for the source ``demonstration``; exported policies contain one."""
    if run.settings.evaluate.policy:
        state, _ = load_checkpoint(run.student_path, kind="student")
        _, metadata = run.policy()
        try:
            found = TensorDict(state["demonstrations"][name]).auto_batch_size_(1)
            sizes = [found[key].shape[-1] for key in TRANSITION_KEYS]
        except (AttributeError, KeyError, RuntimeError, TypeError, ValueError) as error:
            message = f"its demonstration of {name} is missing or damaged ({error})"
            raise CheckpointError(run.student_path, message) from error
        dims = [metadata["student"][key] for key in ("observation_dim", "action_dim")]
        if sizes != [*dims, 1, dims[0]]:
            message = f"its demonstration of {name} has rows of {sizes} numbers"
            raise CheckpointError(run.student_path, f"{message}; valid: {[*dims, 1, dims[0]]}")
        return found
    data = run.transitions(name, "valid")
    return data[data["episode"] == data["episode"].min()]


def expert_outcomes(run: Run, name: str, seeds: list[int]) -> list[EpisodeOutcome]:
    """Returns the expert's outcomes: new episodes from the seeds, or its demonstrations."""
    task, path = run.task(name), run.demonstrations(name)
    if run.settings.evaluate.expert_rollouts and task.record is not None:
        return _play_experts(task, run.settings.collect.experts_of(name), seeds)
    outcomes = []
    # In the episodes of another behaviour, other experts act.
    for split in MASKS if has_contexts(path) else (None,):
        index = run.names.index(name)
        data = read_demonstrations(path, task, split=split, index=index)
        success = data.get(("next", "success"), None)
        returns = data["next", "reward"].double()
        for mask in [data["episode"] == i for i in data["episode"].unique()]:
            succeeded = None if success is None else bool(success[mask].any())
            outcomes.append(EpisodeOutcome(float(returns[mask].sum()), succeeded))
    return outcomes


def reference_outcomes(run: Run, name: str, seeds: Sequence[int]) -> list[EpisodeOutcome]:
    """Plays a task's scripted expert without noise and with default gains, once per seed."""
    return _play_experts(run.task(name), [ExpertSettings(noise=0.0)], seeds)


def _play_experts(
    task: Task, experts: Sequence[ExpertSettings], seeds: Sequence[int]
) -> list[EpisodeOutcome]:
    """Plays one episode per seed; the episodes use the experts in turn."""
    assert task.record is not None
    episodes = (
        task.record(seed, noise=expert.noise, gains=expert.gains, **task.options)
        for seed, expert in zip(seeds, cycle(experts), strict=False)
    )
    return [
        EpisodeOutcome(
            float(episode.rewards.sum()), None if successes is None else bool(successes.any())
        )
        for episode in episodes
        for successes in [episode.extras.get("successes")]
    ]


def embed(run: Run, split: str) -> tuple[Embeddings, float | None]:
    """Embeddings of a split of the demonstrations and the classifier's accuracy, if there is one.

    Args:
        run: the run.
        split: of the demonstrations.
    """
    student, metadata = run.student()
    with torch.random.fork_rng([]):
        torch.manual_seed(run.seed("untrained encoder"))
        untrained = Student(**metadata["student"])
    parts: list[Any] = []
    distances, successes, phases = [], [], []
    phase_names: dict[str, tuple[str, ...]] = {}
    for index, task in enumerate(run.tasks):
        path = run.demonstrations(task.name)
        parts.append(run.transitions(task.name, split))
        raw = read_demonstrations(path, task, split=split, index=index)
        distances.append(_distance(raw))
        successes.append(_success(raw))
        phase, names = read_phases(path, split=split)
        phases.append(phase.numpy())
        phase_names |= {task.name: names} if names else {}
    data: TensorDictBase = torch.cat(parts)
    embeddings = Embeddings(
        task_latent=_embed(student, data),
        task=data["task"].numpy(),
        tasks=run.names,
        episode=data["episode"].numpy(),
        step=data["step"].numpy(),
        distance=np.concatenate(distances),
        success=np.concatenate(successes),
        phase=np.concatenate(phases),
        phase_names=phase_names,
        baselines={
            "raw transition": torch.cat([data[key] for key in TRANSITION_KEYS], -1).numpy(),
            "untrained encoder": _embed(untrained, data),
        },
    )
    return embeddings, None if metadata["accuracy"] is None else student.accuracy(data)


def _embed(student: Student, data: TensorDictBase) -> np.ndarray:
    """m of every transition; in parts, since all hidden layers take hundreds of megabytes."""
    return torch.cat([student.embed(part) for part in data.split(8192)]).numpy()


def _distance(raw: TensorDictBase) -> np.ndarray:
    """Distance of the end-effector to the goal [m]; nan for observations that do not show it.

    Where a task hides its goal, ``goal_pos`` is the position of the end-effector itself.
    """
    distance = np.zeros(len(raw))
    if "goal_pos" in raw and "robot0_eef_pos" in raw:
        distance = (raw["robot0_eef_pos"] - raw["goal_pos"]).norm(dim=-1).numpy()
    return distance if distance.any() else np.full(len(raw), np.nan)


def _success(raw: TensorDictBase) -> np.ndarray:
    success = raw.get(("next", "success"), None)
    return np.zeros(len(raw), dtype=bool) if success is None else success.squeeze(-1).numpy()


def look_at_embedding(run: Run) -> dict[str, Any]:
    """The parts of the report that show the embedding."""
    embeddings, accuracy = embed(run, "valid")
    training, titles = embed(run, "train")[0], task_titles(run.names, run.titles)
    # Films are rendered in another process. Waiting for it changes PyTorch's number of threads, and
    # so the last bits of what is computed meanwhile: all embeddings come first.
    with beside(films_of, run) as films:
        drawn = draw_embeddings(embeddings, training, titles, seed=run.settings.seed)
        explorer = explore_demonstrations(
            run.data_dir, embeddings, wait_for(films), titles=run.titles
        )
    return {
        "embeddings": embeddings,
        "training": training,
        "accuracy": accuracy,
        "drawn": drawn,
        "explorer": explorer,
    }


def run_facts(run: Run) -> dict[str, str]:
    """Facts about the run for the report."""
    settings = run.settings
    versions = read_versions(run.folder)
    used = {"Versions": ", ".join(f"{name} {version}" for name, version in versions.items())}
    if settings.evaluate.policy:
        return {
            "Policy": settings.evaluate.policy,
            "Seed of the starts": str(settings.seed),
        } | used
    counts = settings.collect.train_episodes
    recorded = [f"{task.name} {counts[task.name]}" for task in run.tasks if task.record]
    held_out = f"{settings.collect.valid_episodes} held out of each"
    sources = [f"{', '.join(recorded)}; {held_out}"] if recorded else []
    sources += [f"{task.name} from {task.files.path}" for task in run.tasks if task.files]
    ablation = f", {settings.ablation}" if settings.ablation != "none" else ""
    return {
        "Preset": settings.preset + ablation,
        "Seed": str(settings.seed),
        "Demonstrations": "; ".join(sources),
        "Stage 1": f"{settings.bcq.epochs} epochs of {settings.bcq.updates_per_epoch} updates",
        "Stage 2": f"{settings.distill.updates} updates",
    } | used
