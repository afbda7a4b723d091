"""FOCAL as a TorchRL loss module."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec

from torchrl_bmrl.behaviour import dual_kl, excess_penalty, interpolated, squashed_gaussian
from torchrl_bmrl.contrast import distance_error
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import average
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.checks import check_network, check_number
from torchrl_bmrl.objectives.common import OfflineLoss
from torchrl_bmrl.objectives.context_rows import context_keys, encode_contexts
from torchrl_bmrl.objectives.contexts import Embedded, assign, group_rows, which_count
from torchrl_bmrl.objectives.data import check_within, entry, next_key
from torchrl_bmrl.objectives.estimators import outcomes
from torchrl_bmrl.objectives.generative import action_bounds, register_bounds
from torchrl_bmrl.objectives.task_rows import draw_pairs, other_tasks


class FOCALLoss(OfflineLoss):
    r"""FOCAL: an encoder of contexts by distances alone, and an actor that stays near the data.

    Reference: Li, Yang and Luo, *FOCAL: Efficient Fully-Offline Meta-Reinforcement Learning via
    Distance Metric Learning and Behavior Regularization*, ICLR 2021,
    https://arxiv.org/abs/2010.01112, eqs. 7-13 and algorithm 1.

    Row i of the data, ``[num_tasks, B]``, belongs to task i. Random contexts of the batch's rows
    are embedded, m = M(context); a row gets the m of a context of its task that it is not part of.
    Losses, in update order:

    1. :meth:`encoder_loss`, over the pairs of contexts:
       :math:`\lVert m - m^+ \rVert^2 + 1 / (\lVert m - m^- \rVert^2 + 0.1)`. It alone trains M: all
       other losses read m without a gradient.
    2. :meth:`divergence_loss`: :math:`-\hat D + 5 \max(0, |c(s, \bar a, m)| - 1)^2`, with
       :math:`\hat D = 1 + \log \mathrm{softplus}(c(s, a_\pi, m)) - \mathrm{softplus}(c(s, a, m))`
       and :math:`\bar a` at random between :math:`a_\pi` and a
    3. :meth:`qvalue_loss`: :math:`\sum_j (Q_j(s, a, m) - y)^2` with
       :math:`y = r + \gamma (1 - \mathrm{terminated}) [\min_j Q'_j(s', a', m) - \eta \log \pi(a')
       - \alpha \hat D]`, the last term with ``value_penalty`` only
    4. :meth:`actor_loss`: :math:`\alpha \hat D - \min_j Q_j(s, a_\pi, m) + \eta \log \pi(a_\pi)
       + \nu \left(\overline{\mu^2} + \overline{\log^2 \sigma}\right)`

    After an update :meth:`adapt_divergence_weight` moves α so that :math:`\hat D` approaches its
    target. :attr:`published` has the settings of the published code
    (https://github.com/LanqingLi1993/FOCAL-ICLR). That code multiplies rewards by 5. The defaults
    of η, α, its rate and limit, and ν are its values divided by 5, which is the same objective.

    Deviations from the code: the critics' target uses target critics at a' ~ π (eq. 8) and not a
    value network; a context has a random size up to ``context_size``; a task's contexts are groups
    of one batch; each context is compared with another one of its task and one of every other task;
    the distance is the one of eq. 13, without the code's root and mean. As in the code, the penalty
    of the second loss bounds c itself, where BRAC bounds its gradient.

    Args:
        task_encoder: M, of sets (``make_context_encoder``, whose pooling ``"mean"`` is FOCAL's).
        actor_network: π, of observation and ``task_latent``; writes ``loc`` and ``scale`` of the
            Gaussian before tanh, as :func:`torchrl_bmrl.modules.make_gaussian_actor` does.
        divergence_network: c, with the keys of a critic.
        qvalue_network: list of critics (observation, action, ``task_latent`` →
            ``state_action_value``), each with its own initialisation, or one critic, which is
            copied ``num_qvalue_nets`` times.

    Keyword Args:
        action_spec: bounded spec of the action. Exclusive with ``bounds``.
        bounds: ``(low, high)`` of the action. Exclusive with ``action_spec``.
        num_qvalue_nets: number of critics; ``None``: 2 from a single critic, or the list's length.
        context_size: largest number of transitions of a context; a batch needs two contexts.
        divergence_weight: α, where it starts.
        target_divergence: what :meth:`adapt_divergence_weight` moves the divergence to.
        divergence_weight_rate: its step size; 0 keeps α.
        max_divergence_weight: upper limit of α.
        value_penalty: whether the critics' target contains the divergence (as for Ant).
        entropy_weight: η.
        actor_norm_weight: ν.
        **options: of :class:`~torchrl_bmrl.objectives.OfflineLoss`.

    Keys read: the networks' inputs but ``task_latent``, now and under ``"next"``, ``action
    (num_tasks, B, action_dim)``, and ``("next", "reward")``, ``("next", "done")`` and ``("next",
    "terminated")``, ``(num_tasks, B, 1)``.

    Keys written: the losses and metrics of the output, and ``td_error (num_tasks, B)`` in the
    input.

    Raises:
        BMRLError: for an encoder of single transitions, invalid options, networks whose sizes
            differ; and at a call for data of less than two tasks or two contexts, missing keys, and
            on CPU actions outside the bounds.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl import modules
        >>> critic, divergence = (
        ...     modules.make_qvalue_network(3, 2, task_latent_dim=5) for _ in "cd"
        ... )
        >>> loss = FOCALLoss(
        ...     modules.make_context_encoder(3, 2, 5, pooling="mean"),
        ...     modules.make_gaussian_actor(3, 2, task_latent_dim=5),
        ...     divergence,
        ...     critic,
        ...     bounds=(-1.0, 1.0),
        ...     context_size=4,
        ... )
        >>> flag = torch.zeros(6, 8, 1, dtype=torch.bool)  # six tasks
        >>> after = {"observation": torch.randn(6, 8, 3), "reward": torch.randn(6, 8, 1)}
        >>> after |= {"done": flag, "terminated": flag}
        >>> data = {"observation": torch.randn(6, 8, 3), "action": torch.rand(6, 8, 2) * 2 - 1}
        >>> losses = loss(TensorDict(data | {"next": after}, batch_size=[6, 8]))
        >>> sum(losses[f"loss_{term}"] for term in loss.terms).backward()
        >>> loss.adapt_divergence_weight(losses["divergence"])
    """

    @dataclass
    class _AcceptedKeys(OfflineLoss._AcceptedKeys):
        """Keys that ``set_keys`` can rename."""

        task_latent: NestedKey = "task_latent"  # the embedding m
        loc: NestedKey = "loc"  # of the actor's Gaussian, before tanh
        scale: NestedKey = "scale"

    default_keys = _AcceptedKeys
    terms = ("encoder", "divergence", "qvalue", "actor")
    metrics = ("divergence", *OfflineLoss.metrics, "entropy")
    published: ClassVar[dict[str, Any]] = {
        "learning_rate": 3e-4,
        "divergence_learning_rate": 1e-4,
        "divergence_updates": 3,  # of c in each update
        "encoder_loss_weight": 10.0,  # no difference to Adam, which trains M by this loss alone
        "tasks_per_update": 16,
        "batch_size": 256,  # transitions of a task in an update
        "context_size": 64,  # 100 to 256 in the files of tasks
        "task_latent_dim": 20,
        "encoder_num_cells": (200, 200, 200),
        "num_cells": (256, 256, 256),  # of actor, critics and c
        "gamma": 0.99,
        "tau": 0.005,
        "reward_scale": 5.0,  # point robot: 100; contained in this class's default weights
        "divergence_weight": 500.0,  # all of these at that scale: 1e6 for Ant
        "max_divergence_weight": 2000.0,
        "divergence_weight_rate": 1.0,
        "target_divergence": 0.05,
        "entropy_weight": 1.0,
        "actor_norm_weight": 1e-3,
    }
    """Settings of the published code; its files of tasks change some of them."""

    _schedulable_buffers = frozenset({"divergence_weight", "entropy_weight", "actor_norm_weight"})
    task_encoder: TensorDictModule
    task_encoder_params: TensorDictParams
    target_task_encoder_params: TensorDictParams
    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    divergence_network: TensorDictModule
    divergence_network_params: TensorDictParams
    target_divergence_network_params: TensorDictParams
    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        task_encoder: TensorDictModule,
        actor_network: TensorDictModule,
        divergence_network: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        action_spec: TensorSpec | None = None,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        num_qvalue_nets: int | None = None,
        context_size: int = 16,
        divergence_weight: float = 100.0,
        target_divergence: float = 0.05,
        divergence_weight_rate: float = 0.2,
        max_divergence_weight: float = 400.0,
        value_penalty: bool = False,
        entropy_weight: float = 0.2,
        actor_norm_weight: float = 2e-4,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.context_size = check_number("context_size", context_size, 1, integer=True)
        self.target_divergence = check_number("target_divergence", target_divergence)
        self.divergence_weight_rate = check_number("divergence_weight_rate", divergence_weight_rate)
        self.max_divergence_weight = check_number("max_divergence_weight", max_divergence_weight)
        self.value_penalty = value_penalty
        networks = {
            "task_encoder": task_encoder,
            "actor_network": actor_network,
            "divergence_network": divergence_network,
        }
        for name, network in networks.items():
            check_network(name, network)
            self.check_sizes(name, network)
            self.convert_to_functional(network, name, create_target_params=False)
        self.register_coefficients(high=max_divergence_weight, divergence_weight=divergence_weight)
        self.register_coefficients(
            entropy_weight=entropy_weight, actor_norm_weight=actor_norm_weight
        )
        register_bounds(self, *action_bounds(action_spec, bounds, self.tensor_keys.action))
        self.convert_critics(qvalue_network, num_qvalue_nets)
        self.finish()

    # -- keys ------------------------------------------------------------------------------------

    @property
    def observation_keys(self) -> list[NestedKey]:
        """Keys of the observation, which the other networks read."""
        made = (self.tensor_keys.action, self.tensor_keys.task_latent)
        networks = (self.actor_network, self.divergence_network, self.qvalue_network)
        keys = [key for network in networks for key in network.in_keys]
        return [key for key in dict.fromkeys(keys) if key not in made]

    def read_keys(self) -> Iterable[NestedKey]:
        """The contexts' transitions, the observation now and after the step, and the outcome."""
        now = [*self.observation_keys, self.tensor_keys.action]
        after = map(next_key, self.observation_keys)
        return [*context_keys(self.task_encoder), *now, *after, *self.outcome_keys]

    # -- the embedding ---------------------------------------------------------------------------

    def embed(self, tensordict: TensorDictBase) -> Embedded:
        """m of another context of each row's task, and m of all contexts.

        Args:
            tensordict: the data, ``[num_tasks, B]``.

        Returns:
            ``(num_tasks, B, m)``, ``(num_tasks, C, m)``, and which of the contexts count,
            ``(num_tasks, C)``, ``None`` for all.

        Raises:
            BMRLError: for data of less than two tasks or two contexts, or that do not fit.
        """
        batch = self.batch_shape(tensordict)
        if len(batch) != 2 or batch[0] < 2:
            raise BMRLError(
                f"the data's batch size is {list(batch)}; valid: [num_tasks, B], two tasks or more"
            )
        valid = self.valid_rows(tensordict, batch)
        outcomes(tensordict, self.tensor_keys, valid, torch.Size([*batch, 1]))
        rows = self.rows(tensordict, context_keys(self.task_encoder))
        contexts, own, filled = group_rows(rows, self.context_size, valid)
        points = encode_contexts(self, contexts, rows)
        latent = assign(points, own, filled, apart=True)
        return Embedded(latent, points, which_count(points.shape[1], filled))

    @torch.no_grad()
    def _with_latent(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
        """Observation, the data's action, and m without a gradient; and the action itself."""
        key = self.tensor_keys.action
        # The action first: the error for one that does not fit names it.
        action = entry(tensordict, key, self.valid_rows(tensordict, self.batch_shape(tensordict)))
        valid = self.valid_rows(tensordict, action.shape[:-1])
        check_within(key, action, self.action_low, self.action_high, valid)
        data = self.rows(tensordict, [*self.observation_keys, key]).copy()
        return data.set(self.tensor_keys.task_latent, self.embed(tensordict).latent), action

    # -- losses, in update order -----------------------------------------------------------------

    def encoder_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Distance metric loss of the contexts; each row has the mean of its task's.

        Returns:
            the loss, and no metrics.
        """
        _, points, valid, _ = self.embed(tensordict)
        near, far = draw_pairs(points, valid)
        error = distance_error(points.unsqueeze(2), near.unsqueeze(2), far)
        if valid is None:
            error = error.mean((1, 2))
        else:
            known = valid.any(1)[other_tasks(len(points), points.device)]
            pairs = valid.unsqueeze(2) & known.unsqueeze(1)
            error = torch.where(pairs, error, 0.0).sum((1, 2)) / pairs.sum((1, 2)).clamp(min=1)
        batch = self.batch_shape(tensordict)
        return self.reduce(error.unsqueeze(-1).expand(batch), tensordict), {}

    def divergence_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the classifier by which the divergence is estimated.

        Returns:
            the loss and, detached, the mean ``divergence``.
        """
        data, action = self._with_latent(tensordict)
        with torch.no_grad():
            acted, _ = self._act(data)
            between = interpolated(acted, action)
        divergence = dual_kl(self._logit(data, acted), self._logit(data, action))
        penalty = 5.0 * excess_penalty(self._logit(data, between))
        valid = self.valid_rows(tensordict, divergence.shape)
        loss = self.reduce(penalty - divergence, tensordict)
        return loss, {"divergence": average(divergence, valid)}

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the critics, summed over them; only the critics receive gradients.

        Returns:
            the loss and, detached, ``td_error (num_qvalue_nets, *B)``, ``pred_value``,
            ``target_value`` and ``next_state_value``.
        """
        keys = self.tensor_keys
        data, _ = self._with_latent(tensordict)
        with torch.no_grad():
            after = self.rows(tensordict, self.observation_keys, after=True).copy()
            after = after.set(keys.task_latent, data.get(keys.task_latent))
            action, log_prob = self._act(after)
            value = self.qvalue(after.set(keys.action, action), target=True).amin(0)
            next_value = value - self.entropy_weight * log_prob
            if self.value_penalty:
                # Of the current state: the data need not have the next action.
                penalty = self._divergence(data, self._act(data)[0])
                next_value = next_value - self.divergence_weight * penalty
        return self.temporal_difference(tensordict, self.qvalue(data), next_value)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Divergence from the data minus the action's value; only the actor receives gradients.

        Returns:
            the loss and, detached, the ``entropy``.
        """
        data, _ = self._with_latent(tensordict)
        acted = self._run_actor(data)
        action, log_prob = self._sample(*acted)
        loc, scale = acted
        value = self.qvalue(data.copy().set(self.tensor_keys.action, action), frozen=True).amin(0)
        loss = self.divergence_weight * self._divergence(data, action) - value
        loss = loss + self.entropy_weight * log_prob
        norm = loc.square().mean(-1) + scale.log().square().mean(-1)
        loss = loss + self.actor_norm_weight * norm
        valid = self.valid_rows(tensordict, value.shape)
        return self.reduce(loss, tensordict), {"entropy": average(-log_prob, valid)}

    @torch.no_grad()
    def adapt_divergence_weight(self, divergence: Tensor) -> None:
        """Increases α while the divergence is above its target, and decreases it below.

        Args:
            divergence: of the update, the metric of :meth:`divergence_loss`.
        """
        step = self.divergence_weight_rate * (divergence.detach() - self.target_divergence)
        self.divergence_weight.add_(step).clamp_(0, self.max_divergence_weight)

    # -- networks --------------------------------------------------------------------------------

    def _run_actor(self, data: TensorDictBase) -> tuple[Tensor, Tensor]:
        keys, network = self.tensor_keys, self.actor_network
        acted = self.call("actor_network", data.copy())
        return written(acted, keys.loc, network), written(acted, keys.scale, network)

    def _sample(self, loc: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        noise = torch.randn_like(loc)
        return squashed_gaussian(loc, scale, noise, self.action_low, self.action_high)

    def _act(self, data: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Action and its log-density."""
        return self._sample(*self._run_actor(data))

    def _logit(self, data: TensorDictBase, action: Tensor, *, frozen: bool = False) -> Tensor:
        """c of an action, ``(*B,)``."""
        data = data.copy().set(self.tensor_keys.action, action)
        data = self.call("divergence_network", data, frozen=frozen)
        key = self.tensor_keys.state_action_value
        return written(data, key, self.divergence_network).squeeze(-1)

    def _divergence(self, data: TensorDictBase, action: Tensor) -> Tensor:
        """Estimate for an action, whose gradient reaches the action alone."""
        with torch.no_grad():
            own = self._logit(data, data.get(self.tensor_keys.action))
        return dual_kl(self._logit(data, action, frozen=True), own)
