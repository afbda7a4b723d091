"""The six Sawyer tasks, registered under their names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, GymWrapper
from torchrl.envs.gym_like import default_info_dict_reader
from torchrl.envs.transforms import CatTensors, Transform

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.schema import OBSERVATION_SHAPES
from torchrl_bmrl.envs.transforms import SinCosTransform
from torchrl_bmrl.extras import needs
from torchrl_bmrl.names import TASKS, composition_stages, gymnasium_id, horizon_of
from torchrl_bmrl.tasks import Task, register_task

OBSERVATION_PARTS = (
    "sin_joint_pos",
    "cos_joint_pos",
    "robot0_gripper_qpos",
    "robot0_joint_vel",
    "robot0_eef_pos",
    "robot0_eef_quat",
    "goal_pos",
)
"""Order of the parts in ``observation (33,)``: 7 + 7 + 2 + 7 + 3 + 4 + 3."""


def make_observation() -> list[Transform]:
    """Joint angles as sines and cosines, then all parts in one vector."""
    return [
        SinCosTransform("robot0_joint_pos", "sin_joint_pos", "cos_joint_pos"),
        CatTensors(list(OBSERVATION_PARTS), "observation", dim=-1, sort=False, del_keys=True),
    ]


def make_tabletop_env(*, task: str, num_envs: int | None = None, **kwargs: Any) -> EnvBase:
    """The environment of a task with its named parts."""
    with needs("robosuite"):
        import gymnasium

    from torchrl_bmrl.envs.tasks import REWARD_TERMS

    name = f"torchrl_bmrl.envs:{gymnasium_id(task)}"
    if len(composition_stages(task)) > 1:  # these share one id
        kwargs = {"task": task, "horizon": horizon_of(task)} | kwargs
    env = (
        GymEnv(name, **kwargs)
        if num_envs is None
        else GymWrapper(gymnasium.make_vec(name, num_envs, **kwargs))
    )
    shape = env.batch_size
    keys = ["success", "stage", *(f"reward_{name}" for name in REWARD_TERMS)]
    spec = Composite(
        success=Unbounded(shape, dtype=torch.bool),
        stage=Unbounded(shape, dtype=torch.int64),
        **{key: Unbounded(shape, dtype=torch.float64) for key in keys[2:]},
        shape=shape,
    )
    env.set_info_dict_reader(default_info_dict_reader(keys, spec=spec))
    return env


def record_episode(seed: int, *, task: str, **options: Any) -> Episode:
    """An episode of the scripted expert."""
    from torchrl_bmrl.experts.collect import collect_episode

    return collect_episode(task, seed, **options)


def _make_task(names: str) -> Task:
    return Task(
        name=names,
        make_env=make_tabletop_env,
        record=record_episode,
        parts=tuple(OBSERVATION_SHAPES),
        observation=make_observation,
        options={"task": names, "stepper": "fast"},
        horizon=horizon_of(names),
        success="success",
        compose=_compose,
    )


def _compose(tasks: Sequence[Task]) -> Task:
    return _make_task("-".join(task.name for task in tasks))


for _name in TASKS:
    register_task(_make_task(_name))
