"""Small made-up results to publish, and what is read back from a page's tables."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

DOCS = Path(__file__).parents[1] / "docs"
sys.path.append(str(DOCS / "results"))

from comparisons import Arm  # noqa: E402
from published import TASKS, CurveRow, Published, RunRow  # noqa: E402

from torchrl_bmrl.evaluation import ResultRow  # noqa: E402

ARMS: Mapping[Arm, float] = {
    ("expert", ""): 1.0,
    ("bcq", ""): 1.02,
    ("distilled", "prototype"): 1.0,
    ("distilled", "online"): 0.9,
    ("bc", ""): 0.8,
    ("bcq_one_hot", ""): 0.7,
}
"""Policies and sources, and their returns as shares of the expert's but for some noise."""


def make_run(preset: str = "paper", ablation: str = "none", seed: int = 1) -> RunRow:
    return RunRow(
        preset=preset,
        ablation=ablation,
        seed=seed,
        command=f"python recipes/two_stage.py preset={preset} ablation={ablation} seed={seed}",
        commit="abc123",
        versions="torch 2.13",
        accuracy=0.99 - seed / 1000,
        task_latent_dim=2,
        seconds_collect=60.0,
        seconds_stage_1=600.0,
        seconds_stage_2=None,
        seconds_evaluate=90.0,
        device="cpu",
        workers=2,
    )


BC_FAILS: Mapping[tuple[Arm, str], int] = {(("bc", ""), task): 1 for task in TASKS}


def make_rows(
    seed: int = 1,
    *,
    factor: float = 1.0,
    episodes: int = 6,
    arms: Mapping[Arm, float] = ARMS,
    shares: Mapping[tuple[Arm, str], float] | None = None,
    failures: Mapping[tuple[Arm, str], int] = BC_FAILS,
) -> list[ResultRow]:
    """Episodes of every policy; starts decide most of a return.

    Args:
        seed: training seed.
        factor: factor of all returns.
        episodes: episodes of each policy and task.
        arms: policies, and their returns as shares of the expert's.
        shares: changed shares by policy and task.
        failures: number of failed episodes by policy and task.
    """
    rng = np.random.default_rng(seed)
    rows = []
    for index, task in enumerate(TASKS):
        starts = rng.normal(200.0 + 100.0 * index, 5.0, episodes)
        for arm, usual in arms.items():
            share = (shares or {}).get((arm, task), usual)
            returns = factor * share * starts + rng.normal(0.0, 1.0, episodes)
            rows += [
                ResultRow(
                    task=task,
                    policy=arm[0],
                    latent_source=arm[1],
                    seed=seed,
                    episode=episode,
                    episode_return=round(float(value), 3),
                    success=episode >= failures.get((arm, task), 0),
                )
                for episode, value in enumerate(returns)
            ]
    return rows


def make_curves(
    seed: int = 1, *, epochs: int = 10, preset: str = "paper", ablation: str = "none"
) -> list[CurveRow]:
    """Rollouts whose spread falls as one over the epoch."""
    return [
        CurveRow(
            preset=preset,
            ablation=ablation,
            task=task,
            seed=seed,
            epoch=epoch,
            update=1000 * epoch,
            episode=episode,
            episode_return=round(300.0 + (20.0 if episode else -20.0) / epoch, 3),
            success=True,
        )
        for task in TASKS
        for epoch in range(1, epochs + 1)
        for episode in range(2)
    ]


def make_published() -> Published:
    """Two runs of the paper's sizes, and a small one with its ablation."""
    published = Published()
    for seed in (1, 2):
        published = published.with_run(make_run(seed=seed), make_rows(seed), make_curves(seed))
    for ablation, factor in (("none", 1.0), ("dim4", 0.5)):
        run = make_run("quick", ablation, 1)
        published = published.with_run(run, make_rows(1, factor=factor), [])
    return published


def cells(text: str, title: str) -> list[dict[str, str]]:
    """The lines of the Markdown table below a heading, by the names of the columns."""
    part = re.split(rf"^#+ {re.escape(title)}$", text, flags=re.MULTILINE)[1]
    part = re.split(r"^#", part, flags=re.MULTILINE)[0]
    header, _, *lines = [line for line in part.splitlines() if line.startswith("|")]
    split: Callable[[str], list[str]] = lambda line: [c.strip() for c in line.strip("|").split("|")]  # noqa: E731
    return [dict(zip(split(header), split(line), strict=True)) for line in lines]
