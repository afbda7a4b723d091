"""A family of tasks that takes no simulator: a point walks in a hidden direction."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_bmrl import pipeline
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.families import Family, register_family
from torchrl_bmrl.run.workers import derive_seed
from torchrl_bmrl.tasks import Task

HORIZON = 6


def towards(angle: float) -> np.ndarray:
    return np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))])


class Plane(EnvBase):
    """The reward is the step along the direction; success is a walk of 1."""

    def __init__(self, angle: float, stepper: str, num_envs: int | None) -> None:
        super().__init__(batch_size=() if num_envs is None else (num_envs,))
        self.direction = torch.as_tensor(towards(angle)).float()
        self.stepper = stepper
        shape = self.batch_size
        flags = {"success": Unbounded((*shape, 1), dtype=torch.bool)}
        self.observation_spec = Composite(position=Unbounded((*shape, 2)), **flags, shape=shape)
        self.action_spec = Bounded(-1.0, 1.0, shape=(*shape, 2))
        self.reward_spec = Unbounded((*shape, 1))
        self.start = self.position = torch.zeros(*shape, 2)

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        seeds = kwargs.get("seed")
        seeds = seeds if isinstance(seeds, list) else [seeds or 0] * self.batch_size.numel()
        starts = [torch.randn(2, generator=torch.Generator().manual_seed(x)) for x in seeds]
        self.start = self.position = 0.1 * torch.stack(starts).reshape(*self.batch_size, 2)
        success = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict({"position": self.start, "success": success}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        before = self.position  # the transforms of a run drop the named parts
        self.position = position = before + 0.3 * tensordict["action"]
        moved = ((position - before) @ self.direction).unsqueeze(-1)
        success = ((position - self.start) @ self.direction).unsqueeze(-1) > 1
        never = torch.zeros_like(success)
        after = {"position": position, "reward": moved, "success": success}
        return TensorDict({**after, "done": never, "terminated": never}, self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        pass


def make_plane(*, num_envs: int | None = None, angle: float, stepper: str, horizon: int) -> EnvBase:
    return Plane(angle, stepper, num_envs)


def record_walk(
    seed: int,
    *,
    noise: float,
    gains: Any = None,
    after: Sequence[Task] = (),
    like: Sequence[Task] = (),
    angle: float,
    stepper: str,
    horizon: int,
) -> Episode:
    """Walks along the direction; with ``like`` along those of other members in turn."""
    rng = np.random.default_rng(derive_seed(seed, "walk"))
    angles = [task.options["angle"] for task in like] or [angle]
    position = 0.1 * rng.standard_normal(2)
    positions, actions, rewards, successes = [position], [], [], []
    for step in range(horizon):
        action = towards(angles[step * len(angles) // horizon])
        action = np.clip(action + noise * rng.standard_normal(2), -1, 1).astype(np.float32)
        positions.append(positions[-1] + 0.3 * action)
        actions.append(action)
        rewards.append(float(0.3 * action @ towards(angle)))
        successes.append(bool((positions[-1] - positions[0]) @ towards(angle) > 1))
    whole = np.stack(positions).astype(np.float32)
    return Episode(
        observations={"position": whole[:-1]},
        next_observations={"position": whole[1:]},
        actions=np.stack(actions),
        rewards=np.array(rewards),
        terminated=np.zeros(horizon, dtype=bool),
        extras={"successes": np.array(successes)},
        attributes={"seed": seed, **({"like": ", ".join(x.name for x in like)} if like else {})},
    )


def make_walk(angle: float) -> Task:
    return Task(
        name=f"walk_{angle:g}",
        make_env=make_plane,
        record=record_walk,
        parts=("position",),
        options={"angle": angle, "stepper": "fast", "horizon": HORIZON},
        horizon=HORIZON,
        success="success",
    )


def code(angle: float) -> tuple[float, ...]:
    return tuple(towards(angle).tolist())


def measure(observations: Any) -> tuple[float, ...]:
    """The direction of an episode's walk [°]."""
    way = np.asarray(observations)[-1] - np.asarray(observations)[0]
    return (float(np.rad2deg(np.arctan2(way[1], way[0]))),)


FAMILY = Family(
    name="walk",
    parameters=("angle [°]",),
    members={
        "train": [(0.0,), (40.0,), (80.0,), (120.0,)],
        "inside": [(60.0,)],
        "outside": [(150.0,)],
    },
    make=make_walk,
    code=code,
    measure=measure,
    period=360.0,
)


def settings(folder: Path, distill: dict[str, Any] | None = None, **changes: Any) -> Any:
    """Settings of the smallest run whose student reads sets of transitions."""
    small = {
        "updates": 4,
        "inference_updates": 4,
        "reward_updates": 3,
        "batch_size": 8,
        "num_cells": [16],
        "task_encoder": "set_attention",
        "task_latent_dim": 3,
        "context": "given",
        "context_fraction": 1.0,
        "context_size": 4,
        "classification_weight": None,
        "isometry_weight": 0.0,
    }
    return replace(
        pipeline.Settings(
            run_dir=str(folder),
            workers=1,
            tasks=["walk"],
            log_interval=2,
            checkpoint_interval=2,
            collect=pipeline.CollectSettings(
                train_episodes={"default": 2}, valid_episodes=1, context_episodes=2, noise=0.1
            ),
            bcq=pipeline.BCQSettings(
                epochs=1, updates_per_epoch=3, eval_episodes=1, batch_size=8, num_cells=[16]
            ),
            distill=pipeline.DistillSettings(**(small | (distill or {}))),
            evaluate=pipeline.EvaluateSettings(
                episodes=2, num_candidates=3, latent_sources=["prototype"]
            ),
        ),
        **changes,
    )


def study(**changes: Any) -> Any:
    """Settings of the smallest study of held-out members, with every method."""
    from torchrl_bmrl.studies.families_methods import FamilySettings
    from torchrl_bmrl.studies.families_peers import FocalSettings, MBMLSettings

    small: dict[str, Any] = {"updates": 4, "batch_size": 8, "context_size": 4}
    peers = {"focal": FocalSettings(**small), "mbml": MBMLSettings(**small, reward_updates=2)}
    return FamilySettings(**{"episodes": 2, "cloning_updates": 3, **peers, **changes})


def register() -> None:
    register_family(FAMILY)
