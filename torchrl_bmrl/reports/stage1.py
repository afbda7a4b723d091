"""Stage 1 on the page: the training curves, and the diagnostics of the agents."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import count
from pathlib import Path

import numpy as np

from torchrl_bmrl.evaluation.results import Summary
from torchrl_bmrl.reports.figures import Curve, stage1_curves
from torchrl_bmrl.reports.page import Picture
from torchrl_bmrl.reports.tables import MISSING, Table, percent
from torchrl_bmrl.rows import finite, read_rows, whole
from torchrl_bmrl.training.diagnostics import (
    ACTIVE,
    COLLAPSED,
    OUTSIDE,
    USUAL,
    Diagnostics,
    read_diagnostics,
)

_CURVE_COLUMNS = {"epoch": whole, "update": whole, "return": finite}


def read_stage1_curves(run_dir: Path, tasks: Iterable[str]) -> dict[str, Curve]:
    """Reads ``bcq/<task>/evaluations.csv`` of a run folder, for those tasks that have one.

    Args:
        run_dir: Run folder.
        tasks: Names of the tasks.

    Returns:
        Evaluations by task: epoch, update and returns, in the order of the epochs.

    Raises:
        DataError: if a file lacks a column, or a value is not a finite number.

    Example:
        >>> read_stage1_curves(Path("no-such-run"), ["lift"])
        {}
    """
    files = {task: run_dir / "bcq" / task / "evaluations.csv" for task in tasks}
    curves = {task: _read_curve(path) for task, path in files.items() if path.is_file()}
    return {task: curve for task, curve in curves.items() if curve}


def read_stage1_diagnostics(
    run_dir: Path, titles: Mapping[str, str]
) -> dict[str, tuple[int, Diagnostics]]:
    """Reads the last diagnostics of every agent that has some.

    Args:
        run_dir: Run folder.
        titles: Titles by task.

    Returns:
        Update and diagnostics by the agent's title; those of a task's further agents are numbered.

    Raises:
        DataError: if a file lacks a column, or a value is not valid.

    Example:
        >>> read_stage1_diagnostics(Path("no-such-run"), {"lift": "Lift"})
        {}
    """
    last = {}
    for task, title in titles.items():
        for seed in count():
            name, shown = (f"{task}-{seed}", f"{title}, {seed}") if seed else (task, title)
            path = run_dir / "bcq" / name / "diagnostics.csv"
            if not path.is_file():
                break
            if found := read_diagnostics(path):
                update = max(found)
                last[shown] = (update, found[update])
    return last


def diagnostics_table(diagnosed: Mapping[str, tuple[int, Diagnostics]]) -> Table:
    """Returns a table of how each agent's candidates vary and how its critic values them.

    Args:
        diagnosed: Update and diagnostics by the agent's title.

    Example:
        >>> diagnostics_table({}).header[:4]
        ('Agent', 'Update', 'Spread', 'Spread ratio')
    """
    return Table(
        title="Candidates and critics of stage 1",
        caption=(
            "On training demonstrations, after the last epoch. Spread: deviation of a state's "
            "candidates from their mean, in half the action's range. Spread ratio: the same over "
            "the deviation of the demonstrated action; 1 if the generator models the "
            f"demonstrations, below {COLLAPSED} the policy clones them, far above 1 it proposes "
            "actions that they do not contain. Value gap: how much more the critic promises for "
            "the chosen action than for the demonstrated one, in standard deviations of its "
            "values. Outside: share of the chosen actions that are farther from the candidates' "
            f"mean than {USUAL:.0%} of the demonstrated ones; above {OUTSIDE:.0%} the "
            "policy leaves the demonstrations. Active latents: dimensions of the autoencoder's "
            f"latent with a KL divergence above {ACTIVE} nats."
        ),
        header=(
            "Agent",
            "Update",
            "Spread",
            "Spread ratio",
            "Value gap",
            "Outside",
            "Active latents",
            "Finding",
        ),
        rows=[
            (
                title,
                str(update),
                f"{found.candidate_spread:.3f}",
                f"{found.spread_ratio:.2f}",
                f"{found.relative_gap:+.2f}",
                percent(found.outside_share),
                _active(found),
                _finding(found),
            )
            for title, (update, found) in diagnosed.items()
        ],
    )


def _active(found: Diagnostics) -> str:
    if found.latent_kl is None:
        return MISSING
    return f"{found.active_latents} of {len(found.latent_kl)}"


def _finding(found: Diagnostics) -> str:
    if found.collapsed:
        return "clones the demonstrations"
    return "leaves the demonstrations" if found.outside else MISSING


def draw_stage1(
    curves: Mapping[str, Curve], summaries: Sequence[Summary], titles: Mapping[str, str]
) -> tuple[dict[str, Picture], list[str]]:
    """Draws the training curves, and names the tasks that have none."""
    if not curves:
        return {}, ["The figure of training curves is left out: no evaluations were found."]
    missing = [title for task, title in titles.items() if task not in curves]
    note = [f"No training curve was found for {', '.join(missing)}."] if missing else []
    experts = {s.task: s.mean_return for s in summaries if s.policy == "expert"}
    return {
        "stage1_curves": Picture(
            png=stage1_curves(curves, titles=titles, expert_means=experts),
            alt="Return against training epoch, one panel per task",
            caption=(
                "Return of the BCQ policy, rolled out after each training epoch: mean over the "
                "episodes, and a band of one standard deviation to either side. Dashed: mean "
                "return of the expert whose demonstrations it learns from. Compare the paper's "
                "figure 3 (push tasks)."
            ),
        )
    }, note


def _read_curve(path: Path) -> Curve:
    epochs: dict[tuple[int, int], list[float]] = {}
    for row in read_rows(path, _CURVE_COLUMNS):
        epochs.setdefault((row["epoch"], row["update"]), []).append(row["return"])
    return [(epoch, update, np.array(epochs[epoch, update])) for epoch, update in sorted(epochs)]
