"""Networks of the losses: the autoencoder that proposes actions, critics, and actors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.nn.functional import linear
from torchrl.modules import MLP

from torchrl_bmrl.generators import Autoencoder


class CandidateMLP(MLP):
    """TorchRL's MLP, which computes once what all candidates of a state have in common.

    An input that is the same for all candidates is expanded along the second to last dimension
    (its stride there is 0). Its part of the first layer is computed once and added to each
    candidate's own part.

    Example:
        >>> network = CandidateMLP(3, 2, num_cells=[8])
        >>> state, actions = torch.randn(5, 1, 1).expand(5, 10, 1), torch.randn(5, 10, 2)
        >>> whole = network(state.contiguous(), actions)
        >>> torch.allclose(network(state, actions), whole, atol=1e-6)
        True
    """

    def forward(self, *inputs: Tensor) -> Tensor:
        """Output for the inputs, concatenated along the last dimension."""
        first, *rest = self
        alike = [x.ndim > 1 and x.shape[-2] > 1 and x.stride(-2) == 0 for x in inputs]
        if any(alike) and not all(alike):
            weights = first.weight.split([x.shape[-1] for x in inputs], -1)
            parts = list(zip(inputs, weights, alike, strict=True))
            once = [(x[..., :1, :], weight) for x, weight, same in parts if same]
            each = [(x, weight) for x, weight, same in parts if not same]
            hidden = _linear(each) + _linear(once, first.bias)
            shape = hidden.shape[:-1]
            hidden = hidden.reshape(-1, hidden.shape[-1])
        else:
            whole = torch.cat(inputs, -1) if len(inputs) > 1 else inputs[0]
            shape = whole.shape[:-1]
            # As rows: with more dimensions a layer's output is a view, and changing a view in
            # place, as ReLU does here, costs several copies in the backward pass.
            hidden = first(whole.reshape(-1, whole.shape[-1]))
        for layer in rest:
            hidden = layer(hidden)
        return hidden.reshape(*shape, hidden.shape[-1])


def _linear(parts: Sequence[tuple[Tensor, Tensor]], bias: Tensor | None = None) -> Tensor:
    """Linear layer of inputs, each with its columns of the weights."""
    inputs, weights = zip(*parts, strict=True)
    if len(parts) == 1:
        return linear(inputs[0], weights[0], bias)
    return linear(torch.cat(inputs, -1), torch.cat(weights, -1), bias)


class Network(TensorDictModule):
    """TensorDictModule that declares its sizes, and writes its outputs without extra checks.

    tensordict 0.14 searches the disk for pandas at each output that it writes, which takes a tenth
    of a small update.

    Args:
        module: the network.
        in_keys: keys that it reads.
        out_keys: keys that it writes.
        sizes: of the entries; losses compare them between networks.
        **options: of TensorDictModule.

    Example:
        >>> from tensordict import TensorDict
        >>> network = Network(nn.Linear(2, 1), in_keys=["x"], out_keys=["y"])
        >>> network(TensorDict({"x": torch.zeros(5, 2)}, [5]))["y"].shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        module: nn.Module,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        sizes: Mapping[NestedKey, int] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(module, in_keys=list(in_keys), out_keys=list(out_keys), **options)
        self.sizes = dict(sizes or {})

    @property
    def bounds(self) -> tuple[Tensor, Tensor] | None:
        """Bounds of its output, ``None`` where it has none."""
        module = self.module
        return (module.low, module.high) if isinstance(module, BoundedModule) else None

    def _write_to_tensordict(
        self,
        tensordict: TensorDictBase,
        tensors: Any,
        tensordict_out: Any = None,
        out_keys: Any = None,
    ) -> TensorDictBase:
        keys = self.out_keys_source if out_keys is None else out_keys
        simple = tensordict_out is None and self.inplace is True and len(tensors) == len(keys)
        if not simple or not all(isinstance(value, Tensor) for value in tensors):
            return super()._write_to_tensordict(tensordict, tensors, tensordict_out, out_keys)
        for key, value in zip(keys, tensors, strict=True):
            if key != "_":
                tensordict.set(key, value)
        return tensordict


def sized(
    module: nn.Module, reads: Mapping[NestedKey, int], writes: Mapping[NestedKey, int]
) -> Network:
    """A network for entries of known sizes."""
    return Network(module, list(reads), list(writes), {**reads, **writes})


def make_mlp(
    in_features: int, out_features: int, num_cells: Sequence[int], *, layer_norm: bool = False
) -> MLP:
    """ReLU network whose inputs are concatenated along the last dimension.

    Args:
        in_features: size of all inputs together.
        out_features: size of the output.
        num_cells: widths of the hidden layers.
        layer_norm: whether each hidden layer is normalised before its activation.

    Example:
        >>> make_mlp(3, 2, (8,))(torch.zeros(5, 1), torch.zeros(5, 2)).shape
        torch.Size([5, 2])
    """
    return CandidateMLP(
        in_features,
        out_features,
        num_cells=list(num_cells),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},
        norm_class=nn.LayerNorm if layer_norm else None,
        norm_kwargs=[{"normalized_shape": width} for width in num_cells] if layer_norm else None,
    )


class _Posterior(nn.Module):
    """Mean and standard deviation of the latent, with the published clamp of the latter's log."""

    def __init__(self, in_features: int, latent_dim: int, num_cells: Sequence[int]) -> None:
        super().__init__()
        self.network = make_mlp(in_features, 2 * latent_dim, num_cells)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc, log_scale = self.network(*inputs).chunk(2, dim=-1)
        return loc, log_scale.clamp(-4.0, 15.0).exp()


class BoundedModule(nn.Module):
    """Module whose output lies within the action's bounds.

    Args:
        bounds: lower and upper bound, numbers or ``(action_dim,)``.

    Example:
        >>> BoundedModule((-1.0, 1.0)).scaled(torch.tensor([0.5, 2.0]))
        tensor([0.5000, 1.0000])
    """

    low: Tensor
    high: Tensor

    def __init__(self, bounds: tuple[float | Tensor, float | Tensor]) -> None:
        super().__init__()
        low, high = (torch.as_tensor(x, dtype=torch.get_default_dtype()) for x in bounds)
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def scaled(self, unit: Tensor) -> Tensor:
        """Maps [-1, 1] to the bounds; clamps what lies outside."""
        return self.low + (self.high - self.low) * (0.5 * (unit.clamp(-1.0, 1.0) + 1.0))

    def unscaled(self, action: Tensor) -> Tensor:
        """Maps the bounds to [-1, 1], and a dimension whose bounds are equal to -1."""
        span = self.high - self.low
        return 2.0 * (action - self.low) / torch.where(span > 0, span, 1.0) - 1.0


class _BoundedDecoder(BoundedModule):
    """Network whose output is squashed into the action's bounds."""

    def __init__(
        self,
        in_features: int,
        action_dim: int,
        num_cells: Sequence[int],
        bounds: tuple[float | Tensor, float | Tensor],
    ) -> None:
        super().__init__(bounds)
        self.network = make_mlp(in_features, action_dim, num_cells)

    def forward(self, *inputs: Tensor) -> Tensor:
        unit = 0.5 * (self.network(*inputs).tanh() + 1.0)
        return self.low + (self.high - self.low) * unit


class ActionVAE(Autoencoder):
    r"""Generator of actions :math:`G`: encoder :math:`q(z | s, a)` and decoder :math:`G(s, z)`.

    Reference: Fujimoto et al. 2019, https://arxiv.org/abs/1812.02900, appendix A (latent of twice
    the action's size, log-deviation clamped to [-4, 15], squashed output).

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.

    Keyword Args:
        latent_dim: size of z. Default ``2 * action_dim``.
        num_cells: widths of the hidden layers of both networks.
        bounds: lower and upper bound of the action, numbers or ``(action_dim,)``.
        observation_key: key of the observation.

    ``encoder`` reads ``observation (*B, observation_dim)`` and ``action (*B, action_dim)`` and
    writes ``action_latent_loc`` and ``action_latent_scale``, ``(*B, latent_dim)``. ``decoder``
    reads ``observation`` and ``action_latent`` and writes ``action``.
    :meth:`forward` proposes actions: it draws z ~ N(0, I) anew at every call, and decodes.

    Example:
        >>> from tensordict import TensorDict
        >>> generator = ActionVAE(observation_dim=3, action_dim=2)
        >>> proposal = generator(TensorDict({"observation": torch.zeros(5, 3)}, [5]))
        >>> proposal["action"].shape, proposal["action_latent"].shape
        (torch.Size([5, 2]), torch.Size([5, 4]))
    """

    def __init__(
        self,
        observation_dim: int,
        action_dim: int,
        *,
        latent_dim: int | None = None,
        num_cells: Sequence[int] = (256, 256),
        bounds: tuple[float | Tensor, float | Tensor] = (-1.0, 1.0),
        observation_key: NestedKey = "observation",
    ) -> None:
        size = 2 * action_dim if latent_dim is None else latent_dim
        encoder = sized(
            _Posterior(observation_dim + action_dim, size, num_cells),
            {observation_key: observation_dim, "action": action_dim},
            {"action_latent_loc": size, "action_latent_scale": size},
        )
        decoder = make_decoder(
            observation_dim,
            action_dim,
            size,
            num_cells=num_cells,
            bounds=bounds,
            in_keys=(observation_key, "action_latent"),
        )
        super().__init__(encoder, decoder, size)
        self.out_keys = ["action_latent", "action"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Proposes one action per row."""
        weight = next(self.parameters())
        shape = (*tensordict.batch_size, self.latent_dim)
        latent = torch.randn(shape, device=weight.device, dtype=weight.dtype)
        return self.decoder(tensordict.set("action_latent", latent))


def make_decoder(
    observation_dim: int,
    action_dim: int,
    latent_dim: int,
    *,
    task_latent_dim: int = 0,
    num_cells: Sequence[int] = (256, 256),
    bounds: tuple[float | Tensor, float | Tensor] = (-1.0, 1.0),
    in_keys: Sequence[NestedKey] | None = None,
) -> TensorDictModule:
    """Decoder from observation, ``action_latent`` and, with ``task_latent_dim``, ``task_latent``.

    The student of the distillation is such a decoder; it needs no encoder.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        latent_dim: size of ``action_latent``.
        task_latent_dim: size of ``task_latent``; 0 for a decoder without this input.
        num_cells: widths of the hidden layers.
        bounds: lower and upper bound of the action, numbers or ``(action_dim,)``; the output is
            squashed between them.
        in_keys: names of the inputs, in the order above; ``None`` for those above.

    Returns:
        a module that writes ``action (*B, action_dim)``.

    Example:
        >>> make_decoder(3, 2, 4, task_latent_dim=2).in_keys
        ['observation', 'action_latent', 'task_latent']
    """
    sizes = {"observation": observation_dim, "action_latent": latent_dim}
    if task_latent_dim:
        sizes["task_latent"] = task_latent_dim
    network = _BoundedDecoder(sum(sizes.values()), action_dim, num_cells, bounds)
    reads = dict(zip(sizes if in_keys is None else in_keys, sizes.values(), strict=True))
    return sized(network, reads, {"action": action_dim})


def make_qvalue_network(
    observation_dim: int,
    action_dim: int,
    *,
    task_latent_dim: int = 0,
    num_cells: Sequence[int] = (256, 256),
    layer_norm: bool = False,
) -> TensorDictModule:
    """Critic from observation, action and, with ``task_latent_dim``, ``task_latent``.

    Writes ``state_action_value (*B, 1)``.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        task_latent_dim: size of ``task_latent``; 0 for a critic without this input.
        num_cells: widths of the hidden layers.
        layer_norm: whether each hidden layer is normalised, which bounds the values of actions
            that the data do not contain (https://arxiv.org/abs/2302.02948).

    Example:
        >>> make_qvalue_network(3, 2).in_keys
        ['observation', 'action']
    """
    reads = {"observation": observation_dim, "action": action_dim}
    if task_latent_dim:
        reads["task_latent"] = task_latent_dim
    network = make_mlp(sum(reads.values()), 1, num_cells, layer_norm=layer_norm)
    return sized(network, reads, {"state_action_value": 1})


class _Tanh(nn.Module):
    def __init__(self, network: nn.Module, scale: float = 1.0) -> None:
        super().__init__()
        self.network = network
        self.scale = scale

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.scale * self.network(*inputs).tanh()


def make_perturbation_network(
    observation_dim: int, action_dim: int, *, num_cells: Sequence[int] = (256, 256)
) -> TensorDictModule:
    """Perturbation network: observation and action to ``perturbation (*B, action_dim)`` in [-1, 1].

    Reference: Fujimoto et al. 2019, https://arxiv.org/abs/1812.02900, algorithm 1.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        num_cells: widths of the hidden layers.

    Example:
        >>> make_perturbation_network(3, 2).out_keys
        ['perturbation']
    """
    network = _Tanh(make_mlp(observation_dim + action_dim, action_dim, num_cells))
    reads = {"observation": observation_dim, "action": action_dim}
    return sized(network, reads, {"perturbation": action_dim})


def make_latent_actor(
    observation_dim: int,
    latent_dim: int,
    *,
    num_cells: Sequence[int] = (256, 256),
    max_latent: float = 2.0,
) -> TensorDictModule:
    """Policy in the latent action space: observation to ``action_latent (*B, latent_dim)``.

    Reference: Zhou et al. 2020, https://arxiv.org/abs/2011.07213; as published, every dimension is
    squashed into ± ``max_latent``, in standard deviations of the prior.

    Args:
        observation_dim: size of the observation.
        latent_dim: size of ``action_latent``, the generator's.
        num_cells: widths of the hidden layers.
        max_latent: bound on each dimension, positive.

    Example:
        >>> make_latent_actor(3, 4).out_keys
        ['action_latent']
    """
    network = _Tanh(make_mlp(observation_dim, latent_dim, num_cells), max_latent)
    return sized(network, {"observation": observation_dim}, {"action_latent": latent_dim})
