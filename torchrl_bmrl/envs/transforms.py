"""From the environment's named parts to ``observation``: the same on data and in environments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import GymEnv, GymWrapper, TransformedEnv
from torchrl.envs.gym_like import default_info_dict_reader
from torchrl.envs.transforms import (
    CatTensors,
    Compose,
    DoubleToFloat,
    ObservationNorm,
    RewardSum,
    Transform,
)

from torchrl_bmrl.names import composition_stages, gymnasium_id, horizon_of

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


class SinCosTransform(Transform):
    """Replaces angles by their sines and cosines: 0 and 2π become the same point.

    Args:
        in_key: angles [rad], ``(*B, n)``; removed.
        sin_key: their sines.
        cos_key: their cosines.

    Example:
        >>> from tensordict import TensorDict
        >>> transform = SinCosTransform("q", "sin_q", "cos_q")
        >>> sorted(transform(TensorDict({"q": torch.zeros(4, 7)}, [4])).keys())
        ['cos_q', 'sin_q']
    """

    def __init__(self, in_key: str, sin_key: str, cos_key: str) -> None:
        super().__init__(in_keys=[in_key], out_keys=[sin_key, cos_key])

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        angle = next_tensordict.pop(self.in_keys[0])
        next_tensordict.set(self.out_keys[0], angle.sin())
        return next_tensordict.set(self.out_keys[1], angle.cos())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the angles of a batch."""
        return self._call(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Two unit-bounded parts for the angles' one."""
        spec = observation_spec[self.in_keys[0]]
        del observation_spec[self.in_keys[0]]
        for key in self.out_keys:
            observation_spec[key] = Unbounded(spec.shape, dtype=spec.dtype, device=spec.device)
        return observation_spec


@dataclass(frozen=True)
class ObservationStatistics:
    """Mean and scale of ``observation``, ``(33,)`` each, over the training demonstrations.

    Attributes:
        loc: mean.
        scale: standard deviation, at least 1e-3.
    """

    loc: Tensor
    scale: Tensor

    @classmethod
    def of(cls, datasets: Sequence[TensorDictBase]) -> ObservationStatistics:
        """Statistics over all tasks together, each task with the same weight."""
        raw = make_observation_transform()
        observations = [raw(data.copy()).get("observation").double() for data in datasets]
        loc = torch.stack([x.mean(0) for x in observations]).mean(0)
        second = torch.stack([(x - loc).square().mean(0) for x in observations]).mean(0)
        return cls(loc.float(), second.sqrt().clamp_min(1e-3).float())


def make_observation_transform(statistics: ObservationStatistics | None = None) -> Compose:
    """Transform from the named parts to ``observation (33,)`` float32, normalised if asked to.

    It serves an environment (append it) and stored data (call it) alike.

    Args:
        statistics: of the normalisation; ``None`` leaves the observation as it is.
    """
    transforms: list[Transform] = [
        SinCosTransform("robot0_joint_pos", "sin_joint_pos", "cos_joint_pos"),
        CatTensors(list(OBSERVATION_PARTS), "observation", dim=-1, sort=False, del_keys=True),
        DoubleToFloat(in_keys=["observation"]),
    ]
    if statistics is not None:
        transforms.append(
            ObservationNorm(
                loc=statistics.loc,
                scale=statistics.scale,
                in_keys=["observation"],
                standard_normal=True,
            )
        )
    return Compose(*transforms)


def transform_data(data: TensorDictBase, statistics: ObservationStatistics) -> TensorDictBase:
    """Applies :func:`make_observation_transform` to stored transitions, now and next.

    Args:
        data: batch ``[N]`` with the named parts, as
            :func:`torchrl_bmrl.data.stack_episodes` returns it.
        statistics: of the normalisation.
    """
    transform = make_observation_transform(statistics)
    after = transform(data.get("next").copy())
    return transform(data.exclude("next")).set("next", after)


def make_env(
    task: str,
    statistics: ObservationStatistics | None = None,
    *transforms: Transform,
    num_envs: int | None = None,
    **kwargs: Any,
) -> TransformedEnv:
    """One task as a TorchRL environment with ``observation (33,)``.

    ``success``, ``stage`` and each reward term, ``reward_<term>``, are read from ``info`` into the
    tensordict.

    Args:
        task: one of the six, or a composition: several joined by ``-``.
        statistics: of the normalisation.
        *transforms: appended, such as a source of ``task_latent``.
        num_envs: batch size ``[num_envs]``: episodes in one simulator, for a policy that acts in
            all of them with one call; ``None`` for no batch dimension.
        **kwargs: of the gymnasium environment, such as ``render_mode`` or ``stepper``.

    Raises:
        UnknownNameError: for a name that is not a task.
        BMRLError: for ``num_envs`` below one.
    """
    # Imported here: the reading of data does not need the simulator.
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
    return TransformedEnv(
        env, Compose(make_observation_transform(statistics), RewardSum(), *transforms)
    )
