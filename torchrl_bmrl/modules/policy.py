"""Acting with a generator and a critic."""

from __future__ import annotations

from collections.abc import Iterable
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.functional import one_hot

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.functional import likely_actions, perturbed_action, sample_action_latent

if TYPE_CHECKING:
    from torchrl.objectives import LossModule


class BCQPolicy(TensorDictModuleBase):
    r"""The best of many proposed actions.

    .. math:: \pi(s) = a_{i^*},\quad i^* = \arg\max_i Q_1(s, a_i),\quad
              a_i = G(s, z_i) + \phi\,\xi(s, G(s, z_i))

    Reference: *Compositional Skill Learning Using Batch Meta RL*, eq. 2, section 7.1.

    It serves stage 1 and stage 2 alike: where the decoder and the critic read ``task_latent``, so
    does the policy. Proposals are drawn from PyTorch's global generator at every call, whatever the
    exploration type.

    Args:
        decoder: (observation, ``action_latent``[, ``task_latent``]) → ``action``.
        qvalue_network: (observation, ``action``[, ``task_latent``]) → ``state_action_value``.
        perturbation_network: optional (observation, ``action``) → ``perturbation``.

    Keyword Args:
        latent_dim: size of ``action_latent``.
        num_candidates: proposals per state. Default 100.
        latent_clip: bound on the latent, ``None`` for none. Default 0.5.
        max_perturbation: φ.
        bounds: of the action, used with a perturbation network.
        action_key, action_latent_key, perturbation_key, state_action_value_key: what the networks
            call them.

    Keys read: what the networks read beside what they write, such as ``observation (*B, obs_dim)``
    and ``task_latent (*B, m)``. Key written: ``action (*B, action_dim)``.

    Raises:
        BMRLError: for candidates below one.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> generator, critic = ActionVAE(3, 2), make_qvalue_network(3, 2)
        >>> policy = BCQPolicy(generator.decoder, critic, latent_dim=generator.latent_dim)
        >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["action"].shape
        torch.Size([5, 2])
    """

    action_low: Tensor
    action_high: Tensor

    def __init__(
        self,
        decoder: TensorDictModule,
        qvalue_network: TensorDictModule,
        perturbation_network: TensorDictModule | None = None,
        *,
        latent_dim: int,
        num_candidates: int = 100,
        latent_clip: float | None = 0.5,
        max_perturbation: float = 0.05,
        bounds: tuple[float | Tensor, float | Tensor] = (-1.0, 1.0),
        action_key: NestedKey = "action",
        action_latent_key: NestedKey = "action_latent",
        perturbation_key: NestedKey = "perturbation",
        state_action_value_key: NestedKey = "state_action_value",
    ) -> None:
        super().__init__()
        if num_candidates < 1:
            raise BMRLError(f"num_candidates is {num_candidates}; valid: at least 1")
        self.decoder = decoder
        self.qvalue_network = qvalue_network
        self.perturbation_network = perturbation_network
        self.latent_dim = latent_dim
        self.num_candidates = num_candidates
        self.latent_clip = latent_clip
        self.max_perturbation = max_perturbation
        low, high = (torch.as_tensor(bound) for bound in bounds)
        self.register_buffer("action_low", low)
        self.register_buffer("action_high", high)
        self.action_latent_key = action_latent_key
        self.perturbation_key = perturbation_key
        self.state_action_value_key = state_action_value_key
        networks = (decoder, qvalue_network, perturbation_network)
        self.in_keys = _state_keys(networks, (action_key, action_latent_key))
        self.out_keys = [action_key]

    @classmethod
    def from_loss(cls, loss: LossModule, *, num_candidates: int = 100) -> BCQPolicy:
        """Policy of a trained :class:`~torchrl_bmrl.objectives.BCQLoss`, as a copy.

        Later updates of the loss do not reach the policy.

        Args:
            loss: whose generator, first critic and perturbation network act.
            num_candidates: proposals per state.
        """
        generator = extract_network(loss, "generator")
        return cls(
            generator.decoder,
            extract_critic(loss),
            extract_network(loss, "perturbation_network"),
            latent_dim=generator.latent_dim,
            num_candidates=num_candidates,
            latent_clip=None if loss.latent_clip is None else float(loss.latent_clip),
            max_perturbation=float(loss.max_perturbation),
            bounds=(loss.action_low, loss.action_high),
            **_keys(loss, "action", "action_latent", "perturbation", "state_action_value"),
        )

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action."""
        proposals = tensordict.select(*self.in_keys).unsqueeze(-1)
        proposals = proposals.expand(*tensordict.batch_size, self.num_candidates)
        weight = next(self.parameters(), self.action_low)
        latent = sample_action_latent(
            (*proposals.batch_size, self.latent_dim),
            latent_clip=self.latent_clip,
            device=weight.device,
            dtype=weight.dtype,
        )
        proposals = self.decoder(proposals.copy().set(self.action_latent_key, latent))
        proposals = _perturb(self, proposals)
        value = self.qvalue_network(proposals).get(self.state_action_value_key)
        best = value.argmax(dim=-2, keepdim=True)
        action = proposals.get(self.out_keys[0])
        best = best.expand(*best.shape[:-1], action.shape[-1])
        return tensordict.set(self.out_keys[0], action.gather(-2, best).squeeze(-2))


class PLASPolicy(TensorDictModuleBase):
    r"""The action decoded from the latent that a policy chooses.

    .. math:: \mu(s) = a + \phi\,\xi(s, a),\quad a = G(s, \pi(s))

    Reference: Zhou et al. 2020, https://arxiv.org/abs/2011.07213.

    Args:
        actor_network: (observation) → ``action_latent``.
        decoder: (observation, ``action_latent``) → ``action``.
        perturbation_network: optional (observation, ``action``) → ``perturbation``.

    Keyword Args:
        max_perturbation: φ.
        bounds: of the action, used with a perturbation network.
        action_key, action_latent_key, perturbation_key: what the networks call them.

    Keys read: what the networks read beside what they write, such as ``observation (*B, obs_dim)``.
    Key written: ``action (*B, action_dim)``.

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
        bounds: tuple[float | Tensor, float | Tensor] = (-1.0, 1.0),
        action_key: NestedKey = "action",
        action_latent_key: NestedKey = "action_latent",
        perturbation_key: NestedKey = "perturbation",
    ) -> None:
        super().__init__()
        self.actor_network = actor_network
        self.decoder = decoder
        self.perturbation_network = perturbation_network
        self.max_perturbation = max_perturbation
        low, high = (torch.as_tensor(bound) for bound in bounds)
        self.register_buffer("action_low", low)
        self.register_buffer("action_high", high)
        self.perturbation_key = perturbation_key
        networks = (actor_network, decoder, perturbation_network)
        self.in_keys = _state_keys(networks, (action_key, action_latent_key))
        self.out_keys = [action_key]

    @classmethod
    def from_loss(cls, loss: LossModule) -> PLASPolicy:
        """Policy of a trained :class:`~torchrl_bmrl.objectives.PLASLoss`, as a copy.

        Args:
            loss: whose actor, generator and perturbation network act.
        """
        generator, actor, perturbation = (
            extract_network(loss, name)
            for name in ("generator", "actor_network", "perturbation_network")
        )
        return cls(
            actor,
            generator.decoder,
            perturbation,
            max_perturbation=float(loss.max_perturbation),
            bounds=(loss.action_low, loss.action_high),
            **_keys(loss, "action", "action_latent", "perturbation"),
        )

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``."""
        data = _perturb(self, self.decoder(self.actor_network(tensordict.select(*self.in_keys))))
        return tensordict.set(self.out_keys[0], data.get(self.out_keys[0]))


class DiscreteBCQPolicy(TensorDictModuleBase):
    r"""The most valuable of the actions that are likely enough.

    .. math:: \pi(s) = \arg\max_a \{Q_1(s, a) : G(a|s) / \max_{a'} G(a'|s) > \tau\}

    Reference: Fujimoto et al. 2019, https://arxiv.org/abs/1910.01708.

    Args:
        generator: classifier of the data's actions (observation) → ``logits``.
        qvalue_network: (observation) → ``action_value``.

    Keyword Args:
        threshold: τ. Default 0.3.
        action_space: ``"one-hot"``, written as ``(*B, n)``, or ``"categorical"``, ``(*B,)``.
        action_key, logits_key, action_value_key: what the networks call them.

    Keys read: ``observation``. Key written: ``action``, int64.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP
        >>> generator, critic = (
        ...     TensorDictModule(MLP(3, 4), in_keys=["observation"], out_keys=[key])
        ...     for key in ("logits", "action_value")
        ... )
        >>> policy = DiscreteBCQPolicy(generator, critic)
        >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["action"].sum(-1)
        tensor([1, 1, 1, 1, 1])
    """

    def __init__(
        self,
        generator: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        threshold: float = 0.3,
        action_space: str = "one-hot",
        action_key: NestedKey = "action",
        logits_key: NestedKey = "logits",
        action_value_key: NestedKey = "action_value",
    ) -> None:
        super().__init__()
        self.logits_key = logits_key
        self.action_value_key = action_value_key
        self.generator = generator
        self.qvalue_network = qvalue_network
        self.threshold = threshold
        self.action_space = action_space
        self.in_keys = list(dict.fromkeys([*generator.in_keys, *qvalue_network.in_keys]))
        self.out_keys = [action_key]

    @classmethod
    def from_loss(cls, loss: LossModule) -> DiscreteBCQPolicy:
        """Policy of a trained :class:`~torchrl_bmrl.objectives.DiscreteBCQLoss`, as a copy.

        Args:
            loss: whose generator and first critic act.
        """
        return cls(
            extract_network(loss, "generator"),
            extract_critic(loss),
            threshold=float(loss.threshold),
            action_space=loss.action_space,
            **_keys(loss, "action", "logits", "action_value"),
        )

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``."""
        data = self.qvalue_network(self.generator(tensordict.select(*self.in_keys)))
        allowed = likely_actions(data.get(self.logits_key), self.threshold)
        value = data.get(self.action_value_key).masked_fill(~allowed, -torch.inf)
        action = value.argmax(-1)
        if self.action_space == "one-hot":
            action = one_hot(action, value.shape[-1])
        return tensordict.set(self.out_keys[0], action)


def _perturb(policy: BCQPolicy | PLASPolicy, data: TensorDictBase) -> TensorDictBase:
    """Moves the action by the policy's perturbation network, if it has one."""
    network, key = policy.perturbation_network, policy.out_keys[0]
    if network is None:
        return data
    data = network(data)
    action, perturbation = data.get(key), data.get(policy.perturbation_key)
    low, high = policy.action_low, policy.action_high
    return data.set(key, perturbed_action(action, perturbation, policy.max_perturbation, low, high))


def _state_keys(networks: Iterable[TensorDictModule | None], made: Iterable[Any]) -> list[Any]:
    """What networks read beside what they make for each other."""
    keys = [key for network in networks if network is not None for key in network.in_keys]
    return [key for key in dict.fromkeys(keys) if key not in set(made)]


def _keys(loss: LossModule, *names: str) -> dict[str, NestedKey]:
    """Arguments that carry a loss's names of keys over to its policy."""
    return {f"{name}_key": getattr(loss.tensor_keys, name) for name in names}


def extract_network(loss: LossModule, name: str) -> Any:
    """A stand-alone, frozen copy of one of a loss's networks; ``None`` for one it does not have.

    Args:
        loss: such as :class:`~torchrl_bmrl.objectives.PLASLoss`.
        name: such as ``"generator"``; for a critic see :func:`extract_critic`.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> from torchrl_bmrl.objectives import BCQLoss
        >>> loss = BCQLoss(ActionVAE(3, 2), make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        >>> extract_network(loss, "generator").decoder.out_keys
        ['action']
    """
    module = getattr(loss, name)
    return None if module is None else _instantiate(module, getattr(loss, f"{name}_params"))


def extract_critic(loss: LossModule, index: int = 0) -> TensorDictModule:
    """A stand-alone, frozen copy of one of a loss's critics.

    Args:
        loss: such as :class:`~torchrl_bmrl.objectives.BCQLoss`.
        index: of the critic; policies act by the first, 0.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> from torchrl_bmrl.objectives import BCQLoss
        >>> loss = BCQLoss(ActionVAE(3, 2), make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        >>> extract_critic(loss, 1).out_keys
        ['state_action_value']
    """
    return _instantiate(*loss.critic(index))


def _instantiate(module: TensorDictModule, params: TensorDictBase) -> TensorDictModule:
    """A stand-alone copy of a functional module that holds the given parameters."""
    module = deepcopy(module)
    # As parameters: plain tensors would act, but be missing from parameters() and state_dict().
    own = TensorDictParams(params.data.clone())
    own.to_module(module, preserve_module_state=False)
    return module.requires_grad_(False)
