"""Recordings of robosuite: recorded by a scripted expert, edited and read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from file_edits import rewrite

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robosuite import Relabelling, open_episodes
from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.experts.controllers import make_expert


@dataclass
class Recorded:
    """A recording, and what the environment returned while it was made."""

    path: Path
    observations: list[dict[str, np.ndarray]]
    actions: np.ndarray
    rewards: list[float]
    successes: list[bool]


def record(path: Path, task: str, steps: int, seed: int = 0) -> Recorded:
    """Records an episode of a task's expert in the layout of robosuite 1.5."""
    env = TabletopScene(task, use_object_obs=False, seed=seed)
    env.reset()
    expert = make_expert(env)
    observations, states = [env.named_observation()], [env.sim.get_state().flatten()]
    actions, rewards, successes = [], [], []
    for _ in range(steps):
        actions.append(np.clip(expert(), -1, 1))
        env.step(actions[-1])
        observations.append(env.named_observation())
        states.append(env.sim.get_state().flatten())
        rewards.append(env.reward())
        successes.append(env._check_success())
    with h5py.File(path, "w") as file:
        file["data/demo_1/states"] = np.stack(states)
        file["data/demo_1/actions"] = np.stack(actions)
        file["data/demo_1"].attrs["model_file"] = env.sim.model.get_xml()
    env.close()
    return Recorded(path, observations, np.stack(actions), rewards, successes)


def read(path: Path, name: str = "demo_1", task: str = "lift", **options: Any) -> Episode:
    """One episode of a recording as transitions of a task."""
    with open_episodes(path, task=task, **options) as episodes:
        return episodes[name]


def relabelling_table(path: Path, **options: Any) -> list[Relabelling]:
    """How well each episode of a recording is reproduced."""
    with open_episodes(path, **options) as episodes:
        return [Relabelling.of(name, episode) for name, episode in episodes.items()]


def assert_close(one: Episode, two: Episode, tolerance: float = 1e-9) -> None:
    """Equal observations, actions and rewards up to rounding."""
    for name, part in one.observations.items():
        np.testing.assert_allclose(two.observations[name], part, atol=tolerance)
    np.testing.assert_allclose(two.actions, one.actions, atol=max(tolerance, 1e-6))
    np.testing.assert_allclose(two.rewards, one.rewards, atol=max(tolerance, 1e-9))


def edit_states(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Replaces the states of the first demonstration by what a function makes of them."""
    with h5py.File(path, "r+") as file:
        rewrite(file, "data/demo_1/states", change)
