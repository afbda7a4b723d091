"""n-step transitions: rewards summed over n steps, followed by the state after the last of them."""

from __future__ import annotations

import torch
from tensordict import LazyStackedTensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.checks import check_number
from torchrl_bmrl.objectives.data import missing, next_key

STEPS_KEY = "steps_to_next_obs"
EPISODE_KEYS: tuple[NestedKey, ...] = (("collector", "traj_ids"), "episode")
MASK_KEYS: tuple[NestedKey, ...] = (("collector", "mask"), "mask")


class NStep(nn.Module):
    r"""Turns transitions into n-step transitions that stop at the end of an episode.

    Row t gets the summed rewards of the k steps from t on and, under ``"next"``, the outcome of the
    last of them:

    .. math::
        R_t = \sum_{i=0}^{k-1} \gamma^i r_{t+i}, \qquad
        y_t = R_t + \gamma^k (1 - d_{t+k-1}) V(s_{t+k}), \qquad k \le n.

    k is n, or the number of steps left in the episode, in the data, or before padding. The loss
    computes the target y: TorchRL's TD(0) estimator reads k and the flag d of step t + k - 1,
    ``("next", "terminated")``. It bootstraps with :math:`\gamma^k` after a truncation and at the
    end of the data, but not after a termination.

    An episode ends at its first ``done`` or ``terminated``, that step included. If the data have
    ``("collector", "traj_ids")`` or ``episode``, it also ends before this number changes. Without
    either, an episode that was cut off without ``done`` cannot be told from the next one: mark its
    last step as done and truncated, or its rows will contain steps of the next one. Rows whose
    ``("collector", "mask")`` or ``mask`` is ``False`` are padding and do not change.

    The rewards after the first step follow the actions in the data, so that the target belongs to
    the policy that collected them for k - 1 steps. This is not corrected.

    Reference: Sutton and Barto, Reinforcement Learning: An Introduction (2nd edition, 2018),
    equation 7.1, http://incompleteideas.net/book/the-book-2nd.html

    Args:
        n_steps: n, at least 1; 1 does not change rewards and ``"next"``.
        gamma: discount, between 0 and 1; the same as the loss's.
        reward_key: reward under ``"next"``.
        done_key: flag of an episode's end under ``"next"``.
        terminated_key: flag of a termination under ``"next"``, which the data may lack.

    Raises:
        BMRLError: for invalid options.

    Example:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([[False], [False], [True], [False]])
        >>> after = {"reward": torch.ones(4, 1), "done": done, "terminated": done}
        >>> data = NStep(2, gamma=0.5)(TensorDict({"next": after}, [4]))
        >>> data["next", "reward"].squeeze(-1).tolist()
        [1.5, 1.5, 1.0, 1.0]
        >>> data["next", "terminated"].squeeze(-1).tolist()
        [False, True, True, False]
        >>> data["steps_to_next_obs"].squeeze(-1).tolist()
        [2, 2, 1, 1]
    """

    def __init__(
        self,
        n_steps: int,
        gamma: float,
        *,
        reward_key: NestedKey = "reward",
        done_key: NestedKey = "done",
        terminated_key: NestedKey = "terminated",
    ) -> None:
        super().__init__()
        self.n_steps = check_number("n_steps", n_steps, 1, integer=True)
        self.gamma = float(check_number("gamma", gamma, 0.0, 1.0))
        self.reward_key = next_key(reward_key)
        self.done_key = next_key(done_key)
        self.terminated_key = next_key(terminated_key)

    def extra_repr(self) -> str:
        """n and the discount, for ``repr``."""
        return f"n_steps={self.n_steps}, gamma={self.gamma}"

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Makes n-step transitions; the given data do not change.

        Args:
            tensordict: transitions in order of time along the last batch dimension: ``[T]``, with
                several episodes one after the other, or ``[*B, T]``. Randomly sampled transitions
                have no such order: apply this to whole episodes, before a replay buffer gets them,
                or as a collector's ``postproc``. Under ``"next"`` it reads the reward
                ``(*B, T, 1)`` and the flags ``(*B, T, 1)`` bool.

        Returns:
            a copy with ``"next"`` replaced, and k in ``steps_to_next_obs (*B, T, 1)`` int64.

        Raises:
            BMRLError: for data without transitions, without reward or done, with an entry of
                another shape or type, or with ``steps_to_next_obs`` already.
        """
        if not tensordict.batch_dims or not tensordict.batch_size.numel():
            size = list(tensordict.batch_size)
            raise BMRLError(f"the data have the batch size {size}; valid: [*B, T] with T >= 1")
        check_single_steps(tensordict)
        data = tensordict.copy()
        ends = episode_ends(data, self.done_key, self.terminated_key)
        # gamma ** i is a Python number: rewards keep their dtype, and float64 its precision.
        single = _outcome(data, self.reward_key, number=True)[..., 0]
        reward, steps = single.clone(), torch.ones_like(ends, dtype=torch.int64)
        alive = torch.ones_like(ends)
        for i in range(1, self.n_steps):
            # Row t includes step t + i if it is in the data and no step before it is an end.
            alive = alive[..., :-1] & ~ends[..., i - 1 : -1]
            if not alive.any():
                break
            later = self.gamma**i * single[..., i:]
            reward[..., :-i] += later.where(alive, torch.zeros_like(later))
            steps[..., :-i] += alive
        after = data.get("next")
        if isinstance(after, LazyStackedTensorDict):  # it cannot be indexed along time
            after = after.contiguous()
        data.set("next", after[rows_later(steps - 1)])
        data.set(self.reward_key, reward.unsqueeze(-1))
        return data.set(STEPS_KEY, steps.unsqueeze(-1))


def check_single_steps(data: TensorDictBase) -> None:
    """Checks that rows are transitions of one step.

    Raises:
        BMRLError: for data with ``steps_to_next_obs``.
    """
    if data.get(STEPS_KEY, None) is not None:
        raise BMRLError(f"the data have {STEPS_KEY!r} already; valid: transitions of one step")


def episode_ends(
    data: TensorDictBase,
    done_key: NestedKey = ("next", "done"),
    terminated_key: NestedKey = ("next", "terminated"),
) -> Tensor:
    """Steps after which the data have no further step of the same episode, ``(*B, T)`` bool.

    An episode ends at its flags, before its number changes and before padding, as described at
    :class:`NStep`. The last row of the data is not marked.

    Args:
        data: transitions in order of time along the last batch dimension.
        done_key: flag of an episode's end, ``(*B, T, 1)`` bool.
        terminated_key: flag of a termination, which the data may lack.

    Raises:
        BMRLError: for data without ``done_key``, or a flag or mask of another shape or type.
    """
    ends = _outcome(data, done_key)[..., 0].clone()
    if data.get(terminated_key, None) is not None:
        ends |= _outcome(data, terminated_key)[..., 0]
    for key in EPISODE_KEYS:
        if (number := data.get(key, None)) is not None:
            number = _check_tensor(key, number).reshape(*ends.shape, -1)
            ends[..., :-1] |= (number[..., 1:, :] != number[..., :-1, :]).any(-1)
    for key in MASK_KEYS:
        if (mask := data.get(key, None)) is not None:
            mask = _check_tensor(key, mask)
            if mask.dtype != torch.bool or mask.numel() != ends.numel():
                raise BMRLError(
                    f"{key!r} is {mask.dtype} {tuple(mask.shape)}; valid: torch.bool "
                    f"{tuple(ends.shape)}, False for padding"
                )
            padding = ~mask.reshape(ends.shape)
            ends |= padding
            ends[..., :-1] |= padding[..., 1:]
    return ends


def _outcome(data: TensorDictBase, key: NestedKey, *, number: bool = False) -> Tensor:
    """The reward, a ``number``, or a flag, ``(*B, T, 1)``."""
    value = data.get(key, None)
    if value is None:
        raise missing(data, key)
    value, shape = _check_tensor(key, value), (*data.batch_size, 1)
    if value.shape != shape:
        raise BMRLError(f"{key!r} has the shape {tuple(value.shape)}; valid: {shape}")
    if not (value.is_floating_point() if number else value.dtype == torch.bool):
        valid = "floating-point numbers" if number else "torch.bool"
        raise BMRLError(f"{key!r} is {value.dtype}; valid: {valid}")
    return value


def rows_later(steps: Tensor) -> tuple[Tensor, ...]:
    """Index of the rows so many steps later, one tensor for each batch dimension.

    Args:
        steps: for each row, ``(*B, T)``.
    """
    # gather() would drop entries that are not tensors, such as strings.
    rows = [torch.arange(size, device=steps.device) for size in steps.shape]
    *batch, time = torch.meshgrid(*rows, indexing="ij")
    return (*batch, time + steps)


def _check_tensor(key: NestedKey, value: object) -> Tensor:
    if not isinstance(value, Tensor):
        raise BMRLError(f"{key!r} is a {type(value).__name__}; valid: a tensor")
    return value
