"""Made-up results of weak demonstrations that meet everything that was asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from published_data import Arm, make_curves, make_rows, make_run

# isort: split
from published import TASKS, DiagnosticsRow, Published

from torchrl_bmrl.evaluation import ResultRow

ARMS: Mapping[Arm, float] = {
    ("expert", ""): 1.0,
    ("reference", ""): 2.0,
    ("bcq", ""): 1.9,
    ("distilled", "prototype"): 1.89,
    ("distilled", "online"): 1.6,
    ("bc", ""): 1.1,
    ("iql", ""): 1.15,
}
"""Policies and their returns as shares of the expert's."""


def make_weak_rows(
    seed: int = 1,
    *,
    shares: Mapping[tuple[Arm, str], float] | None = None,
    failures: Mapping[tuple[Arm, str], int] | None = None,
    episodes: int = 20,
) -> list[ResultRow]:
    """Episodes of every policy.

    Args:
        seed: training seed.
        shares: changed shares by policy and task.
        failures: number of failed episodes by policy and task.
        episodes: episodes of each policy and task.
    """
    failures = failures or {}
    return make_rows(seed, episodes=episodes, arms=ARMS, shares=shares, failures=failures)


def make_agents(preset: str, ablation: str, seed: int) -> list[DiagnosticsRow]:
    """Diagnostics of the agents of all tasks but the last."""
    return [
        DiagnosticsRow(
            preset=preset,
            ablation=ablation,
            task=task,
            seed=seed,
            update=5000,
            spread_ratio=0.9,
            relative_gap=None if index else 0.25,
            outside_share=0.1,
        )
        for index, task in enumerate(TASKS[:-1])
    ]


def make_weak() -> Published:
    """Two main runs, and a preset whose runs have stage 1 alone: one of them has a change."""
    published = Published()
    for seed in (1, 2):
        curves = make_curves(seed, epochs=3, preset="weak_paper")
        agents = make_agents("weak_paper", "none", seed)
        run = make_run("weak_paper", seed=seed)
        published = published.with_run(run, make_weak_rows(seed), curves, agents)
    for seed, ablation in ((0, "none"), (1, "none"), (0, "dim4")):
        run = replace(make_run("weak", ablation, seed), accuracy=None)
        curves = make_curves(seed, epochs=4, preset="weak", ablation=ablation)
        if ablation == "dim4":
            curves = [
                replace(c, episode_return=c.episode_return / 2, success=False) for c in curves
            ]
        published = published.with_run(run, [], curves)
    return published
