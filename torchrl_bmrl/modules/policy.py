"""Policies of BCQ and PLAS."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.modules.batchnorm import _BatchNorm

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import perturbed_action
from torchrl_bmrl.generators import ActionKeys, LatentGenerator, check_bounds, decode_draws
from torchrl_bmrl.modules.following import (
    LossPolicy,
    Made,
    as_number,
    dispatched,
    key_options,
    link,
)
from torchrl_bmrl.ownership import check_trained

PERTURBATION = ("max_perturbation", "action_low", "action_high")
"""Coefficients and buffers of a loss that a perturbation needs."""
LATENT_CLIP = 0.5
"""Bound on the latent of an autoencoder by default."""


class BCQPolicy(LossPolicy):
    r"""Chooses the action with the highest value among many proposals.

    .. math:: \pi(s) = a_{i^*},\quad i^* = \arg\max_i Q_1(s, a_i),\quad
              a_i = G(s, z_i) + \phi\, h\, \xi(s, G(s, z_i))

    with :math:`h` half the action's range. A loss with another ``acting_rule`` than ``"first"``
    gives the policy an :class:`EnsembleCritic` in place of :math:`Q_1`. Reference: *Compositional
    Skill Learning Using Batch Meta RL*, eq. 2, section 7.1.

    It acts in stage 1 and in stage 2: if the generator and the critic read ``task_latent``, so does
    the policy. Proposals are drawn from PyTorch's global generator at every call, whatever the
    exploration type is. :meth:`~LossPolicy.live` and :meth:`~LossPolicy.frozen` make the policy of
    a loss.

    Args:
        generator: a generator as :mod:`torchrl_bmrl.generators` describes it, or a decoder
            (observation, ``action_latent``[, ``task_latent``]) → ``action``.
        qvalue_network: (observation, ``action``[, ``task_latent``]) → ``state_action_value``.
        perturbation_network: optional (observation, ``action``) → ``perturbation``.

    Keyword Args:
        latent_dim: size of ``action_latent``; needed for a decoder that does not declare it.
        num_candidates: proposals per state.
        latent_clip: bound on the latent, ``None`` for none. A generator without this option has
            none; for its decoder alone pass ``None``.
        max_perturbation: φ.
        bounds: of the action, needed for a perturbation network; by default the generator's.
        action_key, action_latent_key, perturbation_key, state_action_value_key: names of these
            entries in the networks.

    Keys read: what the networks read and do not write, such as ``observation (*B, obs_dim)``
    and ``task_latent (*B, m)``. Key written: ``action (*B, action_dim)``. A call with keywords,
    ``policy(observation=observation)``, returns the action.

    Raises:
        BMRLError: for candidates below one, a latent size or bounds that are not the generator's or
            missing, a ``latent_clip`` that the generator does not take, or a critic that a loss has
            copied and trains elsewhere.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> policy = BCQPolicy(ActionVAE(3, 2), make_qvalue_network(3, 2))
        >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["action"].shape
        torch.Size([5, 2])
        >>> policy(observation=torch.zeros(5, 3)).shape
        torch.Size([5, 2])
    """

    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        generator: Any,
        qvalue_network: TensorDictModule,
        perturbation_network: TensorDictModule | None = None,
        *,
        latent_dim: int | None = None,
        num_candidates: int = 100,
        latent_clip: float | None = LATENT_CLIP,
        max_perturbation: float = 0.05,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        action_key: NestedKey = "action",
        action_latent_key: NestedKey = "action_latent",
        perturbation_key: NestedKey = "perturbation",
        state_action_value_key: NestedKey = "state_action_value",
    ) -> None:
        super().__init__()
        if num_candidates < 1:
            raise BMRLError(f"num_candidates is {num_candidates}; valid: at least 1")
        check_trained("qvalue_network", qvalue_network)
        check_trained("generator", generator)
        self.generator = generator
        self.qvalue_network = qvalue_network
        self._flat_rows = any(isinstance(x, _BatchNorm) for x in qvalue_network.modules())
        self.perturbation_network = perturbation_network
        self.keys = ActionKeys(action=action_key, action_latent=action_latent_key)
        self.latent_dim = _latent_dim(generator, latent_dim, action_latent_key)
        self.num_candidates = num_candidates
        self.latent_clip = _latent_clip(generator, latent_clip)
        self.max_perturbation = max_perturbation
        _register_bounds(self, generator, perturbation_network, bounds)
        self.perturbation_key = perturbation_key
        self.state_action_value_key = state_action_value_key
        networks = (getattr(generator, "decoder", generator), qvalue_network, perturbation_network)
        self.in_keys = _state_keys(networks, (action_key, action_latent_key))
        self.out_keys = [action_key]

    @classmethod
    def _from(cls, loss: Any, live: bool, **options: Any) -> Made[BCQPolicy]:
        if hasattr(loss, "actor_network"):
            raise BMRLError(
                f"{type(loss).__name__} acts by its actor_network, not by the best of many "
                "proposals; valid: PLASPolicy for a PLASLoss, loss.get_stateful_net("
                "'actor_network') or extract_network(loss, 'actor_network') for another"
            )
        student = "student_" * hasattr(loss, "student_generator")
        generator = link(loss, f"{student}generator", live)
        part = generator.module
        # Acting needs no encoder where proposals are decoded draws of N(0, I).
        if getattr(type(part), "propose", _DECODES) is _DECODES:
            part = getattr(part, "decoder", part)
        rule = getattr(loss, "acting_rule", "first")
        critic = link(loss, f"{student}qvalue_network", live, critic=rule)
        perturbation = None if student else link(loss, "perturbation_network", live, optional=True)
        bounds = None if student else (loss.action_low, loss.action_high)
        latent_dim = getattr(loss if student else generator.module, "latent_dim", None)
        names = ["action", "action_latent", "state_action_value"]
        policy = cls(
            part,
            critic.module,
            None if perturbation is None else perturbation.module,
            latent_dim=latent_dim,
            latent_clip=as_number(loss.latent_clip),
            bounds=bounds,
            max_perturbation=0.0 if student else as_number(loss.max_perturbation),
            **key_options(loss, *names, *(["perturbation"] if not student else [])),
            **options,
        )
        numbers = ("latent_clip",) if student else ("latent_clip", *PERTURBATION)
        return policy, (generator, critic, perturbation), numbers

    @dispatched
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action."""
        self.follow()
        proposals = self.propose(tensordict.select(*self.in_keys))
        return tensordict.set(self.keys.action, self.choose(proposals))

    def choose(self, proposals: TensorDictBase) -> Tensor:
        """The action with the highest value among proposals, after the policy's perturbation.

        Args:
            proposals: batch ``[*B, N]`` with the state and the action, as :meth:`propose` returns
                them, with any N.

        Returns:
            the action, ``(*B, action_dim)``.
        """
        proposals = _perturb(self, proposals)
        # With more than two dimensions a BatchNorm takes the second for its features.
        rows = proposals.reshape(-1) if self._flat_rows else proposals
        value = self.qvalue_network(rows).get(self.state_action_value_key)
        value = value.reshape(*proposals.batch_size, 1)
        best = value.argmax(dim=-2, keepdim=True)
        action = proposals.get(self.keys.action)
        best = best.expand(*best.shape[:-1], action.shape[-1])
        return action.gather(-2, best).squeeze(-2)

    def propose(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The proposals among which the policy chooses, before they are perturbed.

        Args:
            tensordict: what the policy reads, batch ``[*B]``.

        Returns:
            batch ``[*B, num_candidates]`` with the state and the action.
        """
        number, keys, clip = self.num_candidates, self.keys, self.latent_clip
        if hasattr(self.generator, "propose"):
            options = {"latent_clip": clip} if "latent_clip" in self.generator.options else {}
            return self.generator.propose(tensordict, number, keys, **options)
        weight = next(self.parameters(), self.action_low)
        return decode_draws(self.generator, tensordict, number, self.latent_dim, keys, clip, weight)


class PLASPolicy(LossPolicy):
    r"""The action decoded from the latent that a policy chooses.

    .. math:: \mu(s) = a + \phi\, h\, \xi(s, a),\quad a = G(s, \pi(s))

    with :math:`h` half the action's range. Reference: Zhou et al. 2020,
    https://arxiv.org/abs/2011.07213. :meth:`~LossPolicy.live` and :meth:`~LossPolicy.frozen` make
    the policy of a loss.

    Args:
        actor_network: (observation) → ``action_latent``.
        decoder: (observation, ``action_latent``) → ``action``.
        perturbation_network: optional (observation, ``action``) → ``perturbation``.

    Keyword Args:
        max_perturbation: φ.
        bounds: of the action, needed for a perturbation network; by default the decoder's.
        action_key, action_latent_key, perturbation_key: names of these entries in the networks.

    Keys read: what the networks read and do not write, such as ``observation (*B, obs_dim)``.
    Key written: ``action (*B, action_dim)``. A call with keywords returns the action.

    Raises:
        BMRLError: for bounds that are not the decoder's, or missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE, make_latent_actor
        >>> policy = PLASPolicy(make_latent_actor(3, 4), ActionVAE(3, 2).decoder)
        >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["action"].shape
        torch.Size([5, 2])
    """

    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        actor_network: TensorDictModule,
        decoder: TensorDictModule,
        perturbation_network: TensorDictModule | None = None,
        *,
        max_perturbation: float = 0.05,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        action_key: NestedKey = "action",
        action_latent_key: NestedKey = "action_latent",
        perturbation_key: NestedKey = "perturbation",
    ) -> None:
        super().__init__()
        self.actor_network = actor_network
        self.decoder = decoder
        self.perturbation_network = perturbation_network
        self.max_perturbation = max_perturbation
        _register_bounds(self, decoder, perturbation_network, bounds)
        self.keys = ActionKeys(action=action_key, action_latent=action_latent_key)
        self.perturbation_key = perturbation_key
        networks = (actor_network, decoder, perturbation_network)
        self.in_keys = _state_keys(networks, (action_key, action_latent_key))
        self.out_keys = [action_key]

    @classmethod
    def _from(cls, loss: Any, live: bool, **options: Any) -> Made[PLASPolicy]:
        generator, actor = (link(loss, name, live) for name in ("generator", "actor_network"))
        if loss.tensor_keys.action_latent not in actor.module.out_keys:
            raise BMRLError(
                f"the actor_network of {type(loss).__name__} writes {actor.module.out_keys}; "
                f"valid: {loss.tensor_keys.action_latent!r}, a latent, as of a PLASLoss"
            )
        perturbation = link(loss, "perturbation_network", live, optional=True)
        policy = cls(
            actor.module,
            getattr(generator.module, "decoder", None) or _Decoder(generator.module, loss),
            None if perturbation is None else perturbation.module,
            max_perturbation=as_number(loss.max_perturbation),
            bounds=(loss.action_low, loss.action_high),
            **key_options(loss, "action", "action_latent", "perturbation"),
            **options,
        )
        return policy, (generator, actor, perturbation), PERTURBATION

    @dispatched
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``."""
        self.follow()
        data = _perturb(self, self.decoder(self.actor_network(tensordict.select(*self.in_keys))))
        return tensordict.set(self.keys.action, data.get(self.keys.action))


# -- helpers ---------------------------------------------------------------------------------------

_DECODES = LatentGenerator.propose


class _Decoder(TensorDictModuleBase):
    """The decoder of a generator that has only the method ``decode``."""

    def __init__(self, generator: Any, loss: Any) -> None:
        super().__init__()
        self.generator, self.bounds = generator, getattr(generator, "bounds", None)
        self.keys = ActionKeys(loss.tensor_keys.action, loss.tensor_keys.action_latent)
        self.in_keys = [*generator.in_keys, self.keys.action_latent]
        self.out_keys = [self.keys.action]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action that is decoded from the latent."""
        return self.generator.decode(tensordict, self.keys)


def _latent_dim(generator: Any, given: int | None, key: NestedKey) -> Any:
    """Size of the latent, from the generator or the argument; ``None`` without a latent."""
    own = getattr(generator, "latent_dim", (getattr(generator, "sizes", None) or {}).get(key))
    if given is None and own is None and not hasattr(generator, "propose"):
        raise BMRLError(
            f"latent_dim is None and the decoder does not declare it; valid: the size of {key!r}, "
            "which it reads"
        )
    if None not in (given, own) and given != own:
        raise BMRLError(f"latent_dim is {given}; valid: {own}, the generator's")
    return own if given is None else given


def _latent_clip(generator: Any, given: float | None) -> float | None:
    """The bound on the latent, ``None`` for a generator that has no such option."""
    if not hasattr(generator, "propose") or "latent_clip" in generator.options:
        return given
    if given not in (None, LATENT_CLIP):
        raise BMRLError(
            f"latent_clip is {given!r}, and generator {type(generator).__name__} does not take it; "
            "valid: None"
        )
    return None


def _register_bounds(policy: Any, generator: Any, perturbation: Any, given: Any) -> None:
    """Registers the bounds of the action, from the generator or the argument."""
    own = getattr(generator, "bounds", None)
    if given is None and own is None and perturbation is not None:
        raise BMRLError("bounds are None; valid: (low, high) of the action, to perturb it within")
    bounds = next(x for x in (given, own, (-1.0, 1.0)) if x is not None)
    check_bounds(bounds, generator)
    for name, bound in zip(("low", "high"), bounds, strict=True):
        bound = torch.as_tensor(bound)
        bound = bound if bound.is_floating_point() else bound.to(torch.get_default_dtype())
        policy.register_buffer(f"action_{name}", bound.detach().clone())


def _perturb(policy: BCQPolicy | PLASPolicy, data: TensorDictBase) -> TensorDictBase:
    """Adds the output of the policy's perturbation network to the action, if there is one."""
    network, key = policy.perturbation_network, policy.keys.action
    if network is None:
        return data
    data = network(data)
    action, perturbation = data.get(key), data.get(policy.perturbation_key)
    low, high = policy.action_low, policy.action_high
    return data.set(key, perturbed_action(action, perturbation, policy.max_perturbation, low, high))


def _state_keys(networks: Iterable[TensorDictModule | None], made: Iterable[Any]) -> list[Any]:
    """Keys that networks read, without those that they write for each other."""
    keys = [key for network in networks if network is not None for key in network.in_keys]
    return [key for key in dict.fromkeys(keys) if key not in set(made)]
