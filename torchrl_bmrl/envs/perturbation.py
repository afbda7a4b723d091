"""Random perturbations of the actions that an environment executes."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform

from torchrl_bmrl.errors import BMRLError, UnknownNameError


class PerturbAction(Transform):
    """Perturbs the executed action; ``action`` in the data remains the policy's action.

    The motion (position and rotation delta) is scaled, the direction of the position delta is
    tilted, and the result is clipped to [-1, 1]. The gripper's command does not change. Factor and
    angle are uniform, drawn from PyTorch's global random state.

    Args:
        magnitude: range of the factor.
        max_angle: largest angle of the tilt [degrees].
        per: ``"step"`` draws for every action, ``"episode"`` once at each reset, like a badly
            calibrated robot.

    Raises:
        BMRLError: for an empty or negative range, an angle outside [0, 180], or another ``per``.

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
            raise BMRLError(f"magnitude is {magnitude}; valid: two ascending numbers of at least 0")
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
                reset = mask.reshape(*tensordict_reset.batch_size, 1)
                pairs = zip(drawn, self._drawn, strict=True)
                drawn = tuple(torch.where(reset, new, old) for new, old in pairs)  # type: ignore[assignment]
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
    """Rotates vectors by an angle towards other vectors; lengths do not change.

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
