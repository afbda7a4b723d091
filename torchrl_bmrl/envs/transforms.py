"""From the environment's named parts to ``observation``: the same on data and in environments."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import (
    CatTensors,
    Compose,
    DoubleToFloat,
    ObservationNorm,
    RewardSum,
    Transform,
)

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import nonzero_scale
from torchrl_bmrl.names import horizon_of

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
        """Two parts for the angles' one."""
        spec = observation_spec[self.in_keys[0]]
        del observation_spec[self.in_keys[0]]
        for key in self.out_keys:
            observation_spec[key] = Unbounded(spec.shape, dtype=spec.dtype, device=spec.device)
        return observation_spec


class PerturbAction(Transform):
    """Executes other motions than the policy asks for; ``action`` in the data stays the policy's.

    The motion (position and rotation delta) is scaled, the direction of the position delta is
    tilted, and the result clipped to [-1, 1]. The gripper's command is left alone. The draws are
    uniform, from PyTorch's global random state.

    Args:
        magnitude: range of the factor.
        max_angle: largest angle of the tilt [degrees].
        per: ``"step"`` draws anew for every action, ``"episode"`` once at a reset, as for a robot
            that is calibrated badly.

    Raises:
        BMRLError: if the range is empty or negative, the angle not in [0, 180], or ``per`` another
            word.

    Example:
        >>> from tensordict import TensorDict
        >>> transform = PerturbAction(magnitude=(0.5, 0.5))
        >>> transform.inv(TensorDict({"action": torch.ones(7)}))["action"]
        tensor([0.5000, 0.5000, 0.5000, 0.5000, 0.5000, 0.5000, 1.0000])
    """

    def __init__(
        self,
        *,
        magnitude: tuple[float, float] = (1.0, 1.0),
        max_angle: float = 0.0,
        per: str = "step",
    ) -> None:
        if not 0 <= magnitude[0] <= magnitude[1]:
            raise BMRLError(f"magnitude is {magnitude}; valid: two rising numbers of at least 0")
        if not 0 <= max_angle <= 180:
            raise BMRLError(f"max_angle is {max_angle}; valid: between 0 and 180 degrees")
        if per not in ("step", "episode"):
            raise UnknownNameError("per", per, ("step", "episode"))
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self.magnitude = magnitude
        self.max_angle = math.radians(max_angle)
        self.per = per
        self._drawn: tuple[Tensor, Tensor, Tensor] | None = None

    def _draw(self, shape: torch.Size) -> tuple[Tensor, Tensor, Tensor]:
        low, high = self.magnitude
        factor = low + (high - low) * torch.rand(*shape, 1)
        return factor, self.max_angle * torch.rand(*shape, 1), torch.randn(*shape, 3)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.per == "episode":
            drawn = self._draw(tensordict_reset.batch_size)
            mask = None if tensordict is None else tensordict.get("_reset", None)
            if self._drawn is not None and mask is not None:
                anew = mask.reshape(*tensordict_reset.batch_size, 1)
                pairs = zip(drawn, self._drawn, strict=True)
                drawn = tuple(torch.where(anew, new, old) for new, old in pairs)  # type: ignore[assignment]
            self._drawn = drawn
        return tensordict_reset

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        drawn = self._draw(action.shape[:-1]) if self._drawn is None else self._drawn
        factor, angle, towards = drawn
        motion, turn, gripper = action.split((3, 3, action.shape[-1] - 6), -1)
        moved = tilt(motion, towards.to(action), angle.to(action))
        perturbed = torch.cat([factor * moved, factor * turn], -1).clamp(-1.0, 1.0)
        return torch.cat([perturbed.to(action), gripper], -1)


def tilt(vector: Tensor, towards: Tensor, angle: Tensor) -> Tensor:
    """Turns vectors by an angle towards other ones; their lengths stay.

    Args:
        vector: ``(*B, 3)``.
        towards: ``(*B, 3)``; not parallel to ``vector``.
        angle: ``(*B, 1)`` [rad].

    Example:
        >>> x, y = torch.eye(3)[:2]
        >>> tilt(2 * x, x + y, torch.tensor([torch.pi / 2])).round(decimals=4).abs()
        tensor([0., 2., 0.])
    """
    length = vector.norm(dim=-1, keepdim=True)
    unit = vector / length.clamp_min(1e-12)
    across = towards - (towards * unit).sum(-1, keepdim=True) * unit
    across = across / across.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    return length * (angle.cos() * unit + angle.sin() * across)


class StageReward(Transform):
    """Rewards what a composition has done, and nothing else: +1 for each stage completed.

    Reads ``stage (*B,)`` before and after a step. Writes ``("next", "reward") (*B, 1)`` and, so
    that an agent knows what is left to do, ``progress (*B, 1)``: the share of stages done.

    Args:
        num_stages: tasks of the composition.

    Raises:
        BMRLError: for fewer than one.

    Example:
        >>> from tensordict import TensorDict
        >>> transform = StageReward(2)
        >>> now, after = (TensorDict({"stage": torch.tensor(i)}) for i in (0, 1))
        >>> after = transform._step(now, after)
        >>> after["reward"], after["progress"]
        (tensor([1.]), tensor([0.5000]))
    """

    def __init__(self, num_stages: int) -> None:
        if num_stages < 1:
            raise BMRLError(f"num_stages is {num_stages}; valid: at least 1")
        super().__init__(in_keys=["stage"], out_keys=["progress"])
        self.num_stages = num_stages

    def _apply_transform(self, stage: Tensor) -> Tensor:
        return stage.unsqueeze(-1).float() / self.num_stages

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        gained = next_tensordict.get("stage") - tensordict.get("stage")
        return self._call(next_tensordict).set("reward", gained.unsqueeze(-1).float())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Rewards are whole numbers of stages."""
        reward_spec["reward"] = Bounded(0, self.num_stages, (*reward_spec.shape, 1))
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds ``progress``."""
        observation_spec["progress"] = Bounded(0, 1, (*observation_spec.shape, 1))
        return observation_spec


@dataclass(frozen=True)
class ObservationStatistics:
    """Mean and scale of ``observation``, ``(33,)`` each, over the training demonstrations.

    Attributes:
        loc: mean.
        scale: standard deviation, at least 1e-3; 1 where the observation is constant.

    Example:
        >>> ObservationStatistics(loc=torch.zeros(33), scale=torch.ones(33)).scale.shape
        torch.Size([33])
    """

    loc: Tensor
    scale: Tensor

    @classmethod
    def from_lists(cls, lists: Mapping[str, Sequence[float]]) -> ObservationStatistics:
        """Statistics as a checkpoint's metadata keep them.

        Args:
            lists: ``loc`` and ``scale``, as many numbers in each.

        Example:
            >>> ObservationStatistics.from_lists({"loc": [1.0], "scale": [2.0]})
            ObservationStatistics(loc=tensor([1.]), scale=tensor([2.]))
        """
        return cls(torch.tensor(lists["loc"]), torch.tensor(lists["scale"]))

    @classmethod
    def of(cls, datasets: Sequence[TensorDictBase]) -> ObservationStatistics:
        """Statistics over all tasks together, each task with the same weight.

        Args:
            datasets: one batch ``[N_i]`` per task, with the named parts.
        """
        raw = make_observation_transform()
        observations = [raw(data.copy()).get("observation").double() for data in datasets]
        loc = torch.stack([x.mean(0) for x in observations]).mean(0)
        second = torch.stack([(x - loc).square().mean(0) for x in observations]).mean(0)
        largest = torch.stack([x.abs().amax(0) for x in observations]).amax(0)
        scale = nonzero_scale(second.sqrt(), largest, torch.float32)  # as they were before double()
        return cls(loc.float(), scale.clamp_min(1e-3).float())


def make_observation_transform(statistics: ObservationStatistics | None = None) -> Compose:
    """Transform from the named parts to ``observation (33,)`` float32, normalised if asked to.

    It serves an environment (append it) and stored data (call it) alike.

    Args:
        statistics: of the normalisation; ``None`` leaves the observation as it is.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.data.schema import OBSERVATION_SHAPES
        >>> parts = {name: torch.zeros(4, size) for name, size in OBSERVATION_SHAPES.items()}
        >>> make_observation_transform()(TensorDict(parts, [4]))["observation"].shape
        torch.Size([4, 33])
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

    Returns:
        batch ``[N]`` with ``observation (N, 33)`` in place of the parts, now and under ``"next"``,
        and what else there was.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.data.schema import OBSERVATION_SHAPES
        >>> parts = {name: torch.zeros(4, size) for name, size in OBSERVATION_SHAPES.items()}
        >>> statistics = ObservationStatistics(torch.zeros(33), torch.ones(33))
        >>> data = transform_data(TensorDict({**parts, "next": parts}, [4]), statistics)
        >>> data["next", "observation"].shape
        torch.Size([4, 33])
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

    Example:
        >>> env = make_env("push_up", num_envs=2)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 33])
    """
    # Imported here: the reading of data does not need the simulator.
    from torchrl_bmrl.experts.tabletop import make_tabletop_env

    env = make_tabletop_env(
        skills=task, num_envs=num_envs, **({"horizon": horizon_of(task)} | kwargs)
    )
    return TransformedEnv(
        env, Compose(make_observation_transform(statistics), RewardSum(), *transforms)
    )
