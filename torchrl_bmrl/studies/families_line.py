"""What a policy does on the way between two trained members of a family.

m lies on the straight line between the points of two members, and the episode is measured in the
family's parameter: a push's direction, a lift's height. A one-hot code mixed in the same way is
played beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.evaluation.statistics import rank_correlation
from torchrl_bmrl.modules import PathTaskLatent
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.student import load_student
from torchrl_bmrl.reports import Table
from torchrl_bmrl.rows import number, read_rows, whole, write_rows
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.studies.families_methods import OWN, FamilySettings, learner_path

LINES = {"m": "m", "one_hot": "one-hot code"}
"""What is mixed, and its title."""
POINTS = 9
"""Points of a line, both ends included."""
STEPS_APART = 3
"""Trained members from one end of a line to the other, in the order of the family."""
MOST_LINES = 6
COLUMNS: dict[str, Any] = {
    **dict.fromkeys(("code", "start", "end"), str),
    **dict.fromkeys(("share", "measured"), number),
    "episode": whole,
}


def lines_of(run: Run) -> list[tuple[str, str]]:
    """Ends of the lines: pairs of trained members, spread over the family."""
    pairs = list(zip(run.names, run.names[STEPS_APART:], strict=False))
    step = max(1, -(-len(pairs) // MOST_LINES))
    return pairs[::step]


def play_line(
    job: tuple[Run, tuple[FamilySettings, str, tuple[str, str]]], report: Report
) -> list[dict[str, Any]]:
    """Episodes along one line, played once: ``share`` of the way, and what was measured."""
    run, (settings, code, (start, end)) = job
    path_of = learner_path(run, settings, OWN if code == "m" else code)

    shares = torch.linspace(0, 1, POINTS).repeat_interleave(settings.episodes)
    places = [
        {"code": code, "start": start, "end": end, "share": x, "episode": i % settings.episodes}
        for i, x in enumerate(shares.tolist())
    ]

    def play(path: Path) -> None:
        student, metadata = load_student(path_of)
        policy = student.policy(
            num_candidates=run.settings.evaluate.num_candidates,
            latent_clip=metadata["latent_clip"],
        )
        first, last = (student.prototypes[run.names.index(name)] for name in (start, end))
        task, family = run.task(start), run.family
        points = torch.lerp(first, last, shares.unsqueeze(-1)).unsqueeze(1)
        seeds = [run.seed("families", "line", start, i) for i in range(settings.episodes)]
        transform = PathTaskLatent(points)
        with closing(run.make_env(task, transform, num_envs=len(points))) as env:
            played = rollout_episodes(
                env,
                policy,
                seed=seeds * POINTS,
                max_steps=run.horizon(task),
                report=report,
            )
        loc, scale = (torch.as_tensor(x) for x in (run.statistics.loc, run.statistics.scale))
        observations = played["next", "observation"] * scale + loc
        assert family.measure is not None
        low, high = (torch.tensor(family.parameter(name)).double() for name in (start, end))
        rows = [
            {
                **place,
                "measured": along(torch.tensor(family.measure(o)), low, high, family.period),
            }
            for place, o in zip(places, observations, strict=True)
        ]
        write_rows(path, rows)

    return run.once(
        f"{settings.folder}/lines/{code}-{start}-{end}.csv",
        partial(read_rows, columns=COLUMNS, expected=places),
        play,
        skipped=lambda: report(POINTS * settings.episodes * run.horizon(run.task(start))),
        of=[path_of],
    )


def along(measured: Tensor, start: Tensor, end: Tensor, period: float | None) -> float:
    """Where a parameter lies on the line between two others: 0 at the start, 1 at the end.

    Args:
        measured: the parameter, ``(n,)``.
        start: of the line, ``(n,)``.
        end: of the line, ``(n,)``.
        period: after which the parameter repeats, or ``None``.

    Example:
        >>> along(torch.tensor([350.0]), torch.tensor([0.0]), torch.tensor([20.0]), 360)
        -0.5
    """
    way, offset = (end - start).double(), measured.double() - start.double()
    if period is not None:
        offset = (offset - way / 2 + period / 2) % period - period / 2 + way / 2
    return float(offset @ way / (way @ way))


def line_table(title: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    """Rank correlation of what is measured with the position on the line.

    Args:
        title: of the family.
        rows: of ``families/lines.csv``, of one run or of several.
    """
    lines = []
    for code, name in LINES.items():
        mine = [row for row in rows if row["code"] == code]
        groups = [f"{row.get('run', '')} {row['start']} {row['end']}" for row in mine]
        shares, measured = ([row[key] for row in mine] for key in ("share", "measured"))
        found = rank_correlation(shares, measured, groups=groups)
        between = [row for row in mine if 0.25 <= row["share"] <= 0.75]
        error = sum(abs(row["measured"] - row["share"]) for row in between) / len(between)
        lines.append([name, str(found), f"{error:.2f}", str(len(set(groups))), str(len(mine))])
    return Table(
        title=f"Between two trained members of {title}",
        caption=(
            "m, or a one-hot code, on the straight line between two trained members, at "
            f"{POINTS} points. Rank correlation: Spearman's, of the parameter that the episode "
            "shows with the position on the line, mean over the lines; brackets: 95% bootstrap "
            "interval over the episodes of each line. Error: mean distance of the two in the "
            "middle half of the line, as a share of its length; a policy that jumps from one end "
            "to the other in the middle has 0.37."
        ),
        header=("Mixed", "Rank correlation", "Error", "Lines", "Episodes"),
        rows=lines,
    )
