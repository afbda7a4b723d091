r"""Generators: models that propose actions. This is what the losses and policies ask of one.

A generator models the actions of the data. It is any module with these members:

============  =====================================================================================
``in_keys``   keys that it reads of a state
``metrics``   names of the numbers that ``row_loss`` returns beside its loss
``options``   options of a loss that it takes: names of :data:`LOSS_OPTIONS`, ``PROPOSAL_OPTIONS``
``row_loss``  ``(tensordict, keys, **options)`` returns its own loss of each row, ``(*B,)``, and a
              dict of metrics, ``(*B,)`` each. ``tensordict`` has the state's keys and the action.
``propose``   ``(observation, num_candidates, keys, **options)`` returns a TensorDict
              ``[*B, num_candidates]`` with the state's keys and a freshly drawn action for each
============  =====================================================================================

``keys`` contains the names of the entries: ``keys.action``, ``keys.action_latent`` and so on, see
:class:`ActionKeys`. Where the action is a function of the state and a latent z, a generator also
has ``latent_dim`` and ``decode(tensordict, keys)``, which PLAS and the distillation need. Where it
has ``sizes`` (key to size) or ``bounds`` (of its actions), the losses compare these with the other
networks and with their own bounds.

:class:`Autoencoder` is the generator of the published algorithms. :class:`LatentGenerator` is the
base of it and of :class:`torchrl_bmrl.modules.ActionFlow` and
:class:`torchrl_bmrl.modules.ActionMixture`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import gaussian_kl, sample_action_latent, squared_error

LOSS_OPTIONS = ("kl_weight", "kl_reduction")
"""Options of a loss that a generator's ``row_loss`` may take."""
PROPOSAL_OPTIONS = ("latent_clip",)
"""Options of a loss that a generator's ``propose`` may take."""
PARTS = ("encoder", "decoder", "latent_dim")
"""Members that make a module an autoencoder."""


@dataclass
class ActionKeys:
    """Names of the entries that a generator reads and writes, for use outside a loss.

    Attributes:
        action: the action.
        action_latent: the latent z.
        action_latent_loc: mean of the posterior of z.
        action_latent_scale: standard deviation of the posterior of z.

    Example:
        >>> ActionKeys(action="move").action_latent
        'action_latent'
    """

    action: NestedKey = "action"
    action_latent: NestedKey = "action_latent"
    action_latent_loc: NestedKey = "action_latent_loc"
    action_latent_scale: NestedKey = "action_latent_scale"


class LatentGenerator(TensorDictModuleBase):
    """Base of generators whose action is a function of the state and a latent z ~ N(0, I).

    A subclass adds ``metrics`` and ``row_loss``, and ``options`` if it takes some.

    Args:
        decoder: (observation, ``action_latent`` → action).
        latent_dim: size of z.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import make_decoder
        >>> generator = LatentGenerator(make_decoder(3, 2, 4), latent_dim=4)  # as in a subclass
        >>> state = TensorDict({"observation": torch.zeros(5, 3)}, [5])
        >>> generator.propose(state, 10, ActionKeys())["action"].shape
        torch.Size([5, 10, 2])
    """

    options: tuple[str, ...] = ()

    decoder: TensorDictModule

    def __init__(self, decoder: TensorDictModule, latent_dim: int) -> None:
        super().__init__()
        self.decoder = decoder
        self.latent_dim = latent_dim
        self.out_keys = list(decoder.out_keys)

    @property
    def sizes(self) -> dict[NestedKey, int]:
        """Sizes of the entries, as far as the decoder declares them."""
        return dict(getattr(self.decoder, "sizes", {}))

    @property
    def bounds(self) -> tuple[Tensor, Tensor] | None:
        """Bounds of the actions, if the decoder declares them."""
        return getattr(self.decoder, "bounds", None)

    def propose(
        self,
        observation: TensorDictBase,
        num_candidates: int,
        keys: ActionKeys,
        *,
        latent_clip: Any = None,
    ) -> TensorDictBase:
        """Actions decoded from z ~ N(0, I), with a new draw for every candidate.

        Args:
            observation: what the decoder reads beside z, batch ``[*B]``.
            num_candidates: actions for each state.
            keys: names of the entries.
            latent_clip: bound on each dimension of z, ``None`` for none.

        Returns:
            batch ``[*B, num_candidates]`` with the observation, z and the action.
        """
        weight = next(self.decoder.parameters())
        return decode_draws(
            self.decoder, observation, num_candidates, self.latent_dim, keys, latent_clip, weight
        )

    def decode(self, tensordict: TensorDictBase, keys: ActionKeys) -> TensorDictBase:
        """The data with the action decoded from the latent.

        Args:
            tensordict: observation and z, batch ``[*B]``; the action is written into it.
            keys: names of the entries.

        Raises:
            BMRLError: if the decoder writes another key than the action's.
        """
        data = self.decoder(tensordict)
        written(data, keys.action, self.decoder)
        return data


class Autoencoder(LatentGenerator):
    r"""Conditional variational autoencoder of the data's actions.

    Reference: Kingma and Welling, *Auto-Encoding Variational Bayes*, ICLR 2014,
    https://arxiv.org/abs/1312.6114, conditioned on the state as in BCQ,
    https://arxiv.org/abs/1812.02900.

    Args:
        encoder: (observation, action → ``action_latent_loc``, ``action_latent_scale``).
        decoder: (observation, ``action_latent`` → action).
        latent_dim: size of z.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE
        >>> parts = ActionVAE(3, 2)
        >>> generator = Autoencoder(parts.encoder, parts.decoder, parts.latent_dim)
        >>> state = TensorDict({"observation": torch.zeros(5, 3)}, [5])
        >>> generator.propose(state, 10, ActionKeys(), latent_clip=0.5)["action"].shape
        torch.Size([5, 10, 2])
    """

    metrics = ("reconstruction_error", "kl_divergence")
    options = (*LOSS_OPTIONS, *PROPOSAL_OPTIONS)

    encoder: TensorDictModule

    def __init__(
        self, encoder: TensorDictModule, decoder: TensorDictModule, latent_dim: int
    ) -> None:
        super().__init__(decoder, latent_dim)
        del self.decoder  # first the encoder: checkpoints list the optimizer's state in this order
        self.encoder, self.decoder = encoder, decoder
        self.in_keys = [key for key in encoder.in_keys if key not in decoder.out_keys]

    @property
    def sizes(self) -> dict[NestedKey, int]:
        """Sizes of the entries, as far as encoder and decoder declare them."""
        parts = (self.encoder, self.decoder)  # super().sizes would stop torch.export
        return {k: size for part in parts for k, size in getattr(part, "sizes", {}).items()}

    def row_loss(
        self, tensordict: TensorDictBase, keys: ActionKeys, *, kl_weight: Any, kl_reduction: str
    ) -> tuple[Tensor, dict[str, Tensor]]:
        r"""Loss of the variational autoencoder for each row.

        .. math:: \lVert G(s, z) - a \rVert^2 / |a|
            + \beta\, \mathrm{KL}(q(z|s,a)\,\|\,N(0, I)) / |z|,\quad z \sim q(z|s,a)

        With ``kl_reduction="sum"`` the divergence is not divided by :math:`|z|`.

        Args:
            tensordict: observation and action, batch ``[*B]``.
            keys: names of the entries.
            kl_weight: β.
            kl_reduction: ``"mean"`` or ``"sum"`` over the latent's dimensions.

        Returns:
            the loss ``(*B,)``, and ``reconstruction_error`` and ``kl_divergence``, ``(*B,)`` each.

        Raises:
            BMRLError: if the decoder's action has another shape than the data's.
        """
        action = tensordict.get(keys.action)
        data = self.encode(tensordict, keys)
        loc, scale = data.get(keys.action_latent_loc), data.get(keys.action_latent_scale)
        data.set(keys.action_latent, loc + scale * torch.randn_like(scale))
        decoded = self.decode(data, keys).get(keys.action)
        if decoded.shape != action.shape:
            raise BMRLError(
                f"{keys.action!r} has the shape {tuple(action.shape)}; valid: "
                f"{tuple(decoded.shape)}, as the networks have it"
            )
        error = squared_error(decoded, action) / action.shape[-1]
        divergence = gaussian_kl(loc, scale)
        divergence = divergence.sum(-1) if kl_reduction == "sum" else divergence.mean(-1)
        metrics = {"reconstruction_error": error, "kl_divergence": divergence}
        return error + kl_weight * divergence, metrics

    def encode(self, tensordict: TensorDictBase, keys: ActionKeys) -> TensorDictBase:
        """The data with mean and standard deviation of the posterior of z.

        Args:
            tensordict: observation and action, batch ``[*B]``; it is not changed.
            keys: names of the entries.

        Raises:
            BMRLError: if the encoder writes other keys.
        """
        data = self.encoder(tensordict.copy())
        for key in (keys.action_latent_loc, keys.action_latent_scale):
            written(data, key, self.encoder)
        return data


def decode_draws(
    decoder: TensorDictModule,
    observation: TensorDictBase,
    num_candidates: int,
    latent_dim: int,
    keys: ActionKeys,
    latent_clip: Any,
    like: Tensor,
) -> TensorDictBase:
    """Actions decoded from z ~ N(0, I), with a new draw for every candidate.

    Args:
        decoder: (observation, ``action_latent`` → action).
        observation: what it reads beside z, batch ``[*B]``.
        num_candidates: actions for each state.
        latent_dim: size of z.
        keys: names of the entries.
        latent_clip: bound on each dimension of z, ``None`` for none.
        like: a tensor with the dtype and device of z.

    Returns:
        batch ``[*B, num_candidates]`` with the observation, z and the action.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import make_decoder
        >>> state = TensorDict({"observation": torch.zeros(5, 3)}, [5])
        >>> like = state["observation"]
        >>> drawn = decode_draws(make_decoder(3, 2, 4), state, 10, 4, ActionKeys(), 0.5, like)
        >>> drawn["action"].shape, drawn["action_latent"].shape
        (torch.Size([5, 10, 2]), torch.Size([5, 10, 4]))
    """
    data = candidates(observation, num_candidates)
    latent = sample_action_latent(
        (*data.batch_size, latent_dim),
        latent_clip=latent_clip,
        device=like.device,
        dtype=like.dtype,
    )
    return decoder(data.copy().set(keys.action_latent, latent))


def candidates(observation: TensorDictBase, num_candidates: int) -> TensorDictBase:
    """The observation repeated for every candidate, without a copy.

    Args:
        observation: batch ``[*B]``.
        num_candidates: N.

    Returns:
        batch ``[*B, N]``.

    Example:
        >>> from tensordict import TensorDict
        >>> candidates(TensorDict({"observation": torch.zeros(5, 3)}, [5]), 4)["observation"].shape
        torch.Size([5, 4, 3])
    """
    batch = observation.batch_size
    return observation.unsqueeze(-1).expand(*batch, num_candidates)


def written(tensordict: TensorDictBase, key: NestedKey, network: TensorDictModule) -> Tensor:
    """The entry that a network has written, checked.

    Args:
        tensordict: the network's output.
        key: of the entry.
        network: for the message.

    Raises:
        BMRLError: if the network writes other keys.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import make_decoder
        >>> decoder = make_decoder(3, 2, 4)
        >>> data = TensorDict(
        ...     {"observation": torch.zeros(1, 3), "action_latent": torch.zeros(1, 4)}
        ... )
        >>> written(decoder(data), "action", decoder).shape
        torch.Size([1, 2])
    """
    value = tensordict.get(key, None)
    if value is None or key not in network.out_keys:
        raise BMRLError(
            f"a network writes {list(network.out_keys)}, not {key!r}; valid: a network that writes "
            "it, or another name for it in set_keys()"
        )
    return value


def check_bounds(bounds: Any, network: Any, size: int | None = None) -> None:
    """Checks that bounds of the action are those that a generator or decoder declares.

    Args:
        bounds: ``(low, high)``, numbers or tensors.
        network: a network that may have ``bounds``.
        size: of an action, where it is known.

    Raises:
        BMRLError: for bounds of another length, or other bounds than the network's.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE
        >>> check_bounds((-1.0, 1.0), ActionVAE(3, 2))
    """
    own = getattr(network, "bounds", None) or bounds
    own = bounds if torch.as_tensor(own[0]).is_meta else own  # on the meta device: no numbers
    for name, bound, other in zip(("lower", "upper"), bounds, own, strict=True):
        bound, other = (torch.as_tensor(x, device="cpu").double() for x in (bound, other))
        if size is not None and bound.ndim and len(bound) != size:
            raise BMRLError(
                f"the {name} bound of the action has {len(bound)} numbers; valid: a number, or "
                f"{size}, the size of the generator's actions"
            )
        alike = not (bound.ndim and other.ndim) or len(bound) == len(other)
        if not alike or not torch.allclose(*torch.broadcast_tensors(bound, other)):
            raise BMRLError(
                f"the {name} bound of the action is {bound.tolist()}, and the generator's "
                f"{other.tolist()}; valid: equal ones, such as "
                "ActionVAE(..., bounds=(spec.space.low, spec.space.high))"
            )


def as_generator(module: Any) -> Any:
    """The module as a generator: itself, or an autoencoder made of its parts.

    Args:
        module: a generator, or a module with ``encoder``, ``decoder`` and ``latent_dim``.

    Raises:
        BMRLError: naming what it lacks.

    Example:
        >>> parts = torch.nn.Module()
        >>> as_generator(parts)
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: generator Module has no 'encoder'; valid: ...
    """
    missing = [part for part in PARTS if not hasattr(module, part)]
    if isinstance(module, Autoencoder) and not missing:
        return module
    protocol = ("in_keys", "metrics", "options", "row_loss", "propose")
    if not isinstance(module, Autoencoder):
        lacking = [name for name in protocol if not hasattr(module, name)]
        if not lacking:
            return module
        if hasattr(module, "row_loss") or hasattr(module, "propose"):
            raise BMRLError(
                f"generator {type(module).__name__} has no {lacking[0]!r}; valid: a generator with "
                + ", ".join(map(repr, protocol))
            )
    if missing:
        raise BMRLError(
            f"generator {type(module).__name__} has no {missing[0]!r}; valid: a module with "
            "'encoder', 'decoder' and 'latent_dim', such as torchrl_bmrl.modules.ActionVAE, or "
            "a generator as torchrl_bmrl.generators describes it"
        )
    return Autoencoder(module.encoder, module.decoder, module.latent_dim)
