"""Discrete Batch-Constrained Q-learning as a TorchRL loss module."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data.tensor_specs import Categorical, OneHot, TensorSpec

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import average, likely_actions
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.checks import check_network, leaf_of
from torchrl_bmrl.objectives.common import OfflineLoss
from torchrl_bmrl.objectives.data import (
    check_index,
    check_one_hot,
    check_same_shape,
    entry,
    next_key,
)

ACTION_SPACES = ("one-hot", "categorical")


class DiscreteBCQLoss(OfflineLoss):
    r"""Discrete Batch-Constrained deep Q-learning.

    A classifier :math:`G` learns which actions the data contain. The critics bootstrap only from
    actions that are likely enough under it.

    Reference: Fujimoto et al., *Benchmarking Batch Deep Reinforcement Learning Algorithms*, 2019,
    https://arxiv.org/abs/1910.01708.

    Losses, in update order:

    1. :meth:`generator_loss`: :math:`-\log G(a|s) + w\, \overline{l(s)^2}`, where :math:`l` are
       the logits, averaged over the actions
    2. :meth:`qvalue_loss`: :math:`\sum_j d(Q_j(s, a), y)` with
       :math:`y = r + \gamma (1 - \mathrm{terminated}) \min_j Q'_j(s', a')`,
       :math:`a' = \arg\max_{a} \{\min_j Q_j(s', a) : G(a|s') / \max_{a} G(a|s') > \tau\}`

    With one critic this is the published algorithm (Double DQN within the likely actions); with
    several critics, their minimum counts.

    Args:
        generator: classifier of the data's actions (observation → ``logits (*B, n)``).
        qvalue_network: critic, or list of critics (observation → ``action_value (*B, n)``).

    Keyword Args:
        action_space: format of ``action``: ``"one-hot"`` (or ``"one_hot"``), ``(*B, n)``, as
            :class:`~torchrl.envs.GymEnv` has it, ``"categorical"``, ``(*B,)`` or ``(*B, 1)``, or
            the action's spec, :class:`~torchrl.data.OneHot` or :class:`~torchrl.data.Categorical`.
        num_qvalue_nets: number of critics; ``None``: 1 from a single critic, or the list's length.
        threshold: τ. 0 is Double DQN, 1 is imitation.
        logits_weight: w.
        loss_function: ``"l2"``, ``"l1"`` or ``"smooth_l1"`` (Huber) between value and target.
        **options: of :class:`~torchrl_bmrl.objectives.OfflineLoss`: ``gamma``,
            ``separate_losses`` (off, as published for a shared convolution), ``reduction``,
            ``deactivate_vmap``, ``use_prioritized_weights``.

    Keys read: ``observation (*B, ...)``, ``action``, and under ``"next"`` ``observation``,
    ``reward``, ``done``, ``terminated``, each of the last three ``(*B, 1)``. Key written to the
    input: ``td_error (*B,)``, the priority.

    Raises:
        BMRLError: for a threshold outside [0, 1], no critics, an unknown ``action_space``,
            ``loss_function`` or ``reduction``; and at a call for data with missing keys, other
            shapes or, on CPU and not compiled, numbers that are not finite.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP
        >>> def network(name):
        ...     return TensorDictModule(MLP(4, 2), in_keys=["observation"], out_keys=[name])
        >>> loss = DiscreteBCQLoss(network("logits"), network("action_value"))
        >>> flag = torch.zeros(8, 1, dtype=torch.bool)
        >>> after = {"observation": torch.randn(8, 4), "reward": torch.randn(8, 1)}
        >>> after |= {"done": flag, "terminated": flag}
        >>> data = {
        ...     "observation": torch.randn(8, 4),
        ...     "action": torch.eye(2)[torch.randint(2, (8,))],
        ... }
        >>> data = TensorDict(data | {"next": after}, batch_size=[8])
        >>> losses = loss(data)
        >>> (losses["loss_generator"] + losses["loss_qvalue"]).backward()
    """

    @dataclass
    class _AcceptedKeys(OfflineLoss._AcceptedKeys):
        """Keys that ``set_keys`` can rename: those of the base and these."""

        logits: NestedKey = "logits"  # the generator's output
        action_value: NestedKey = "action_value"  # the critics' output
        state_action_value: NestedKey = "chosen_action_value"  # the value of the next action

    terms = ("generator", "qvalue")
    metrics = ("cross_entropy", *OfflineLoss.metrics)
    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset({"threshold", "logits_weight"})

    generator: TensorDictModule
    generator_params: TensorDictParams
    target_generator_params: TensorDictParams

    def __init__(
        self,
        generator: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        action_space: str | TensorSpec = "one-hot",
        num_qvalue_nets: int | None = None,
        threshold: float = 0.3,
        logits_weight: float = 1e-2,
        loss_function: str = "smooth_l1",
        **options: Any,
    ) -> None:
        super().__init__(loss_function=loss_function, **options)
        self.action_space, self.num_actions = action_space_of(action_space, self.tensor_keys.action)
        check_network("generator", generator)
        self.check_sizes("generator", generator)
        self.convert_to_functional(generator, "generator", create_target_params=False)
        self.register_coefficients(high=1.0, threshold=threshold)
        self.register_coefficients(logits_weight=logits_weight)
        self.convert_critics(qvalue_network, num_qvalue_nets, default=1)
        self.finish()

    def read_keys(self) -> list[NestedKey]:
        """Observation and action, and what followed."""
        return [
            *self.observation_keys,
            self.tensor_keys.action,
            *map(next_key, self.observation_keys),
            *self.outcome_keys,
        ]

    @property
    def observation_keys(self) -> list[NestedKey]:
        """What the networks read of a state."""
        return list(dict.fromkeys([*self.generator.in_keys, *self.qvalue_network.in_keys]))

    # -- actions and values ----------------------------------------------------------------------

    def _batch_of(self, action: Tensor, ndim: int) -> torch.Size:
        flat = self.action_space == "categorical" and action.ndim == max(ndim, 1)
        return action.shape if flat else action.shape[:-1]

    def action_index(self, tensordict: TensorDictBase, num_actions: int) -> Tensor:
        """Index of the data's action, ``(*B,)``.

        Args:
            tensordict: the data.
            num_actions: n, of which the action is one.

        Raises:
            BMRLError: for an action that is not written as ``action_space`` says.
        """
        key, batch = self.tensor_keys.action, self.batch_shape(tensordict)
        action = entry(tensordict, key, self.valid_rows(tensordict, batch))
        one_hot = self.action_space == "one-hot"
        shapes = [(*batch, num_actions)] if one_hot else [tuple(batch), (*batch, 1)]
        if action.shape not in shapes:
            raise BMRLError(
                f"{key!r} has the shape {tuple(action.shape)}; valid for action_space="
                f"{self.action_space!r}: {' or '.join(map(str, shapes))}"
            )
        if not one_hot:
            action = action.reshape(batch)
            check_index(key, action, num_actions)
            return action.long()
        check_one_hot(key, action, self.valid_rows(tensordict, batch))
        # In the action's own type: as an integer 0.999 is 0.
        return (action.to(torch.uint8) if action.dtype == torch.bool else action).argmax(-1)

    def logits(self, tensordict: TensorDictBase, *, after: bool = False) -> Tensor:
        """Logits of the generator, ``(*B, n)``.

        Args:
            tensordict: the data.
            after: whether to return those of the next state.

        Raises:
            BMRLError: if the action's spec knows another number of actions.
        """
        data = self.rows(tensordict, self.generator.in_keys, after=after)
        logits = written(self.call("generator", data), self.tensor_keys.logits, self.generator)
        if self.num_actions not in (None, logits.shape[-1]):
            raise BMRLError(
                f"{self.tensor_keys.logits!r} has the shape {tuple(logits.shape)}, and the spec of "
                f"the action {self.num_actions} actions; valid: a logit for each action"
            )
        return logits

    def qvalue(
        self, tensordict: TensorDictBase, *, target: bool = False, frozen: bool = False
    ) -> Tensor:
        """Value of every action under each critic, ``(num_qvalue_nets, *B, n)``.

        Args:
            tensordict: what the critics read, batch ``[*B]``.
            target: whether the targets' parameters are used.
            frozen: whether their parameters receive no gradient.
        """
        key = self.tensor_keys.action_value
        return self.evaluate(tensordict, key, target=target, frozen=frozen)

    def likely(self, tensordict: TensorDictBase, value: Tensor) -> Tensor:
        """Which actions of the next state are likely enough, ``(*B, n)``.

        Args:
            tensordict: the data.
            value: of every action there, ``(*B, n)``.

        Raises:
            BMRLError: if generator and critics know different numbers of actions.
        """
        logits = self.logits(tensordict, after=True)
        check_same_shape(self.tensor_keys.action_value, value, logits)
        return likely_actions(logits, self.threshold)

    # -- losses, in update order -----------------------------------------------------------------

    def generator_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the classifier; only the generator receives gradients.

        Returns:
            the loss and, detached, ``cross_entropy``.
        """
        logits = self.logits(tensordict)
        action = self.action_index(tensordict, logits.shape[-1])
        cross_entropy = -logits.log_softmax(-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)
        loss = cross_entropy + self.logits_weight * logits.square().mean(-1)
        loss = self.reduce(loss, tensordict)
        valid = self.valid_rows(tensordict, cross_entropy.shape)
        return loss, {"cross_entropy": average(cross_entropy, valid)}

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the critics, summed over them; only the critics receive gradients.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``.
        """
        with torch.no_grad():
            after = self.rows(tensordict, self.qvalue_network.in_keys, after=True)
            value = self.qvalue(after).amin(0)
            best = value.masked_fill(~self.likely(tensordict, value), -torch.inf).argmax(
                -1, keepdim=True
            )
            value = self.qvalue(after, target=True).amin(0)
            next_value = value.gather(-1, best).squeeze(-1)
        data = self.rows(tensordict, self.qvalue_network.in_keys)
        value = self.qvalue(data)
        index = self.action_index(tensordict, value.shape[-1]).expand(value.shape[:-1])
        predicted = value.gather(-1, index.unsqueeze(-1)).squeeze(-1)
        return self.temporal_difference(tensordict, predicted, next_value)


def action_space_of(
    action_space: str | TensorSpec, action_key: NestedKey
) -> tuple[str, int | None]:
    """Format of the actions, and their number where a spec has it.

    Args:
        action_space: ``"one-hot"``, ``"one_hot"``, ``"categorical"``, or a spec.
        action_key: of the action in a composite spec.

    Raises:
        UnknownNameError: for anything else.

    Example:
        >>> action_space_of("one_hot", "action"), action_space_of(OneHot(4), "action")
        (('one-hot', None), ('one-hot', 4))
    """
    action_space = leaf_of(action_space, action_key)
    # These classes exactly: specs of several actions at once derive from them.
    if type(action_space) is OneHot:
        return "one-hot", action_space.space.n
    if type(action_space) is Categorical:
        return "categorical", action_space.space.n
    name = action_space.replace("_", "-") if isinstance(action_space, str) else action_space
    if name not in ACTION_SPACES:
        raise UnknownNameError("action_space", action_space, ACTION_SPACES)
    return str(name), None
