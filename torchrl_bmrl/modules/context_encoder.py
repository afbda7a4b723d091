"""Encoders of sets of transitions: the task embedding m from a context of any size.

A context is a set of transitions of one task, from any behaviour. :func:`as_context` makes one of
stored transitions, :class:`ContextTaskLatent` collects one while a policy acts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl.context_keys import CONTEXT, reads_context
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.modules.generator import Network, make_mlp
from torchrl_bmrl.modules.scales import set_scales, unmarked
from torchrl_bmrl.modules.task_latent import (
    TRANSITION_KEYS,
    PrototypeTaskLatent,
    check_reads_transitions,
    last_transition,
    only_in_environments,
)

CONTEXT_KEYS = tuple(unravel_key((CONTEXT, key)) for key in (*TRANSITION_KEYS, "mask"))
"""Keys that a context encoder reads."""
POOLINGS = ("mean", "attention")


class ContextNetwork(nn.Module):
    r"""Embeds each transition of a set, pools the embeddings, and maps the result to m.

    .. math:: m = \rho\Big(\sum_k w_k\, \phi(x_k)\Big),
        \quad w_k = 1/K \ \text{ or } \ \mathrm{softmax}_k\, \psi(x_k),
        \quad x_k = (s_k, a_k, (r_k - \mu) / \rho, (s'_k - s_k) / \sigma)

    Reference: Zaheer et al., *Deep Sets*, NeurIPS 2017, https://arxiv.org/abs/1703.06114; the
    attention is the pooling with one seed vector of Lee et al., *Set Transformer*, ICML 2019,
    https://arxiv.org/abs/1810.00825.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        task_latent_dim: size of m.
        pooling: ``"mean"`` or ``"attention"``.
        num_features: size of φ.
        num_cells: widths of the hidden layers of φ and ψ together, and of ρ.

    Attributes:
        step_scale: σ, how far each number of the observation moves in a step, ``(obs_dim,)``. A
            step is much smaller than the spread of the observations that a network is made for.
        reward_loc: μ, ``(1,)``.
        reward_scale: ρ, ``(1,)``.
        read: which numbers of the observation are read, 1, or not, 0, ``(obs_dim,)``.
    """

    read: Tensor
    step_scale: Tensor
    reward_loc: Tensor
    reward_scale: Tensor

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        task_latent_dim: int,
        pooling: str,
        num_features: int,
        num_cells: Sequence[int],
    ) -> None:
        super().__init__()
        self.register_buffer("read", torch.ones(observation_dim))
        self.register_buffer("step_scale", torch.ones(observation_dim))
        self.register_buffer("reward_loc", torch.zeros(1))
        self.register_buffer("reward_scale", torch.ones(1))
        transition_dim = 2 * observation_dim + action_dim + 1
        self.attends = pooling == "attention"
        self.each = make_mlp(transition_dim, num_features + self.attends, num_cells)
        self.whole = make_mlp(num_features, task_latent_dim, num_cells[-1:])

    def features(
        self, observation: Tensor, action: Tensor, reward: Tensor, following: Tensor
    ) -> Tensor:
        """φ and, with attention, ψ of each transition, ``(*B, K, n)``."""
        step = (following - observation) / self.step_scale
        reward = (reward - self.reward_loc) / self.reward_scale
        return self.each(torch.cat([observation * self.read, action, reward, step], -1))

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *args: Any) -> None:
        # Checkpoints of earlier versions have encoders that read everything.
        state_dict.setdefault(f"{prefix}read", torch.ones_like(self.read))
        super()._load_from_state_dict(state_dict, prefix, *args)

    @torch.no_grad()
    def set_scales(self, *datasets: TensorDictBase) -> None:
        """Sets the buffers, so that rewards and steps are as large as the rest of the input.

        Numbers of the observation that tell the data sets apart in the first ``step`` of episodes,
        such as where an object lies, are not read. An encoder could know each trained task by them,
        and then would not learn to read what tells a new task.

        Args:
            *datasets: transitions of all tasks and behaviours, ``[N_i]`` each.
        """
        self.read.copy_(unmarked(*datasets))
        set_scales(self, *datasets)

    def combine(self, features: Tensor, mask: Tensor) -> Tensor:
        """m of the transitions that count, ``(*B, m)``.

        Args:
            features: of :meth:`features`, ``(*B, K, n)``.
            mask: which transitions count, ``(*B, K)``; at least one.
        """
        if self.attends:
            score = features[..., -1].masked_fill(~mask, -torch.inf)
            weight, features = score.softmax(-1), features[..., :-1]
        else:
            weight = mask.to(features.dtype) / mask.sum(-1, keepdim=True)
        return self.whole((weight.unsqueeze(-1) * features).sum(-2))

    def forward(self, *context: Tensor) -> Tensor:
        """m of a context: the entries of :data:`CONTEXT_KEYS`."""
        *entries, mask = context
        # What does not count may hold anything, also no numbers, which a weight of 0 leaves in.
        entries = [entry.masked_fill(~mask.unsqueeze(-1), 0) for entry in entries]
        return self.combine(self.features(*entries), mask)


def make_context_encoder(
    observation_dim: int,
    action_dim: int,
    task_latent_dim: int = 8,
    *,
    pooling: str = "attention",
    num_features: int = 64,
    num_cells: Sequence[int] = (256, 256),
) -> TensorDictModule:
    """Encoder :math:`M` of a set of transitions.

    Reads :data:`CONTEXT_KEYS`: under ``"context"``, batch ``[*B, K]``, the ``observation``,
    ``action``, ``("next", "reward")`` and ``("next", "observation")`` of K transitions, and
    ``mask (*B, K)``, which of them count. Writes ``task_latent (*B, task_latent_dim)``. The order
    of the transitions does not matter.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        task_latent_dim: size of m.
        pooling: ``"mean"``, or ``"attention"``: a weighted mean with learned weights.
        num_features: size of the embedding of one transition.
        num_cells: widths of the hidden layers.

    Raises:
        UnknownNameError: for another pooling.

    Example:
        >>> encoder = make_context_encoder(3, 2, task_latent_dim=4)
        >>> after = {"observation": torch.randn(9, 3), "reward": torch.randn(9, 1)}
        >>> data = {"observation": torch.randn(9, 3), "action": torch.randn(9, 2), "next": after}
        >>> encoder(as_context(TensorDict(data, [9])))["task_latent"].shape
        torch.Size([4])
    """
    if pooling not in POOLINGS:
        raise UnknownNameError("pooling", pooling, POOLINGS)
    network = ContextNetwork(
        observation_dim, action_dim, task_latent_dim, pooling, num_features, num_cells
    )
    sizes = {
        (CONTEXT, "observation"): observation_dim,
        (CONTEXT, "action"): action_dim,
        "task_latent": task_latent_dim,
    }
    return Network(network, in_keys=list(CONTEXT_KEYS), out_keys=["task_latent"], sizes=sizes)


def as_context(transitions: TensorDictBase, mask: Tensor | None = None) -> TensorDict:
    """Makes the input of a context encoder of stored transitions.

    Args:
        transitions: batch ``[*B, K]``, with :data:`~torchrl_bmrl.modules.TRANSITION_KEYS`.
        mask: which of them count, boolean, ``(*B, K)``, at least one of each set; ``None`` if all
            do.

    Returns:
        batch ``[*B]``, with the transitions and ``mask`` under ``"context"``.

    Raises:
        BMRLError: for no transition, a missing key, or a mask that does not fit.

    Example:
        >>> after = {"observation": torch.randn(9, 3), "reward": torch.randn(9, 1)}
        >>> data = {"observation": torch.randn(9, 3), "action": torch.randn(9, 2), "next": after}
        >>> as_context(TensorDict(data, [9]))["context"].shape
        torch.Size([9])
    """
    shape = transitions.batch_size
    if not shape or not shape[-1]:
        raise BMRLError(f"a context of batch size {list(shape)}; valid: [..., K], K > 0")
    present = set(transitions.keys(include_nested=True, leaves_only=True))
    for key in TRANSITION_KEYS:
        if key not in present:
            raise BMRLError(f"the context has no {key!r}; valid: {list(TRANSITION_KEYS)}")
    chosen = transitions.select(*TRANSITION_KEYS)
    if mask is None:
        device = chosen.get("observation").device
        mask = torch.ones(shape, dtype=torch.bool, device=device)
    elif mask.shape != shape or mask.dtype != torch.bool or not mask.any(-1).all():
        raise BMRLError(
            f"the mask is {mask.dtype} of shape {list(mask.shape)}; valid: torch.bool of shape "
            f"{list(shape)}, with at least one transition of each set"
        )
    return TensorDict({CONTEXT: chosen.set("mask", mask)}, batch_size=shape[:-1])


@torch.no_grad()
def embed_context(encoder: TensorDictModule, transitions: TensorDictBase) -> Tensor:
    """The task embedding m of a context, whatever the encoder reads.

    Args:
        encoder: :func:`make_context_encoder`'s module, or
            :func:`~torchrl_bmrl.modules.make_task_encoder`'s, whose embeddings are averaged.
        transitions: batch ``[*B, K]``.

    Returns:
        ``(*B, m)``.

    Raises:
        BMRLError: for no transition, a missing key, sizes that the encoder does not take, or an
            encoder that reads something else.

    Example:
        >>> from torchrl_bmrl.modules import make_task_encoder
        >>> after = {"observation": torch.randn(9, 3), "reward": torch.randn(9, 1)}
        >>> data = {"observation": torch.randn(9, 3), "action": torch.randn(9, 2), "next": after}
        >>> embed_context(make_task_encoder(3, 2), TensorDict(data, [9])).shape
        torch.Size([2])
    """
    context = as_context(transitions)
    if not reads_context(encoder):
        check_reads_transitions(encoder)
    try:
        if reads_context(encoder):
            return encoder(context).get("task_latent")
        return encoder(context.get(CONTEXT).exclude("mask")).get("task_latent").mean(-2)
    except RuntimeError as error:
        shapes = {str(key): tuple(transitions[key].shape) for key in TRANSITION_KEYS}
        raise BMRLError(
            f"the context's shapes are {shapes}; valid: those that the encoder was trained on "
            f"({error})"
        ) from error


class ContextTaskLatent(PrototypeTaskLatent):
    """Writes the embedding of a context that grows by every transition of the episode.

    Args:
        task_latent: m of the first step of an empty context, ``(m,)``.
        encoder: :func:`make_context_encoder`'s module, trained.
        context: transitions that the context starts with in each episode, batch ``[K]``, or
            ``[*B, K]`` for the environments of a batch; ``None`` for none.
        mask: which of these count, boolean, ``(*B, K)``; ``None`` if all do.

    Raises:
        BMRLError: for an encoder of single transitions, or a context that :func:`as_context`
            refuses; at a reset, if the context's batch is not the environment's.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
        >>> growing = ContextTaskLatent(torch.zeros(4), make_context_encoder(7, 7, 4))
        >>> env = TransformedEnv(ContinuousActionVecMockEnv(), growing)
        >>> latent = env.rollout(3)["task_latent"]
        >>> latent.shape, latent[0]
        (torch.Size([3, 4]), tensor([0., 0., 0., 0.]))
    """

    given: Tensor | None
    counts: Tensor | None

    def __init__(
        self,
        task_latent: Tensor,
        encoder: TensorDictModule,
        context: TensorDictBase | None = None,
        mask: Tensor | None = None,
    ) -> None:
        super().__init__(task_latent)
        if not reads_context(encoder):
            raise BMRLError("the encoder reads single transitions; valid: make_context_encoder")
        self.encoder = encoder
        self.network = cast(ContextNetwork, encoder.module)
        given = counts = None
        if context is not None:
            whole = as_context(context, mask)
            counts = whole[CONTEXT, "mask"]
            # What does not count may hold anything, also no numbers.
            given = self._features(whole).masked_fill(~counts.unsqueeze(-1), 0)
        self.register_buffer("given", given)
        self.register_buffer("counts", counts)
        self._kept: Tensor | None = None
        self._valid: Tensor | None = None

    @torch.no_grad()
    def _features(self, context: TensorDictBase) -> Tensor:
        return self.network.features(*(context.get(key) for key in CONTEXT_KEYS[:-1]))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape = tensordict_reset.batch_size
        reset = None if tensordict is None else tensordict.get("_reset", None)
        if reset is None or self._kept is None or self._valid is None:
            self._begin(shape)
        else:  # some of several environments begin anew
            given = 0 if self.given is None else self.given.shape[-2]
            number = torch.arange(self._valid.shape[-1], device=self._valid.device)
            valid = self._valid & ~(reset.reshape(*shape, 1) & (number >= given))
            # What counts nowhere any more would stay in memory for ever.
            used = valid.reshape(-1, valid.shape[-1]).any(0) | (number < given)
            self._kept, self._valid = self._kept[..., used, :], valid[..., used]
        return self._write(tensordict_reset)

    def _begin(self, shape: torch.Size) -> None:
        """All environments begin anew."""
        if self.given is None or self.counts is None:
            self._kept = self._valid = None
            return
        batch = self.given.shape[:-2]
        if batch and batch != shape:
            raise BMRLError(
                f"a context of batch {tuple(batch)} in an environment of {tuple(shape)}; valid: "
                "one context, or one for each"
            )
        self._kept = self.given.expand(*shape, *self.given.shape[-2:])
        self._valid = self.counts.expand(*shape, self.counts.shape[-1])

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        shape = tensordict.batch_size
        start = self.task_latent.expand(*shape, -1)
        if self._kept is None or self._valid is None:
            return tensordict.set("task_latent", start.clone())
        known = self._valid.any(-1, keepdim=True)
        mask = self._valid | ~known  # an empty context must not be pooled
        with torch.no_grad():
            latent = self.network.combine(self._kept, mask)
        return tensordict.set("task_latent", torch.where(known, latent, start))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        last = last_transition(tensordict, next_tensordict).unsqueeze(-1)
        features = self._features(as_context(last))
        valid = features.new_ones(features.shape[:-1], dtype=torch.bool)
        if self._kept is not None and self._valid is not None:
            features = torch.cat([self._kept, features], -2)
            valid = torch.cat([self._valid, valid], -1)
        self._kept, self._valid = features, valid
        return self._write(next_tensordict)

    forward = only_in_environments


def make_told_encoder(codes: Tensor) -> TensorDictModule:
    """Encoder that writes given numbers of the task as m; it has no parameters.

    With the parameter of each task of a family it makes the policy that is told the task; with
    equal numbers for all tasks, a policy that knows nothing about it. It reads ``task (*B,)``,
    int64, and writes ``task_latent (*B, n)``.

    Args:
        codes: the numbers of each task, ``(num_tasks, n)``.

    Example:
        >>> encoder = make_told_encoder(torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
        >>> encoder(TensorDict({"task": torch.tensor([1])}, [1])).get("task_latent")
        tensor([[1., 0.]])
    """
    sizes = {"task_latent": codes.shape[-1]}
    return Network(_Table(codes), in_keys=["task"], out_keys=["task_latent"], sizes=sizes)


class _Table(nn.Module):
    codes: Tensor

    def __init__(self, codes: Tensor) -> None:
        super().__init__()
        self.register_buffer("codes", codes.detach().clone())

    def forward(self, task: Tensor) -> Tensor:
        return self.codes[task]
