"""Acting with a generator and a critic."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.functional import one_hot

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import likely_actions, perturbed_action
from torchrl_bmrl.generators import ActionKeys, decode_draws
from torchrl_bmrl.ownership import check_trained

if TYPE_CHECKING:
    from torchrl.objectives import LossModule

Self = TypeVar("Self", bound="_Policy")


def _dispatch(forward: Callable[..., Any]) -> Callable[..., Any]:
    """Tensordict's ``dispatch``, whose signature also says that keywords are taken.

    ``torch.export`` binds a call to the signature. It takes dynamic shapes for names alone, so the
    usual keys are among them.
    """
    wrapper = dispatch(forward)
    signature = inspect.signature(wrapper)
    named = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None)
        for name in ("observation", "task_latent")
    ]
    others = inspect.Parameter("keywords", inspect.Parameter.VAR_KEYWORD)
    wrapper.__signature__ = signature.replace(
        parameters=[*signature.parameters.values(), *named, others]
    )
    return wrapper


class _Policy(TensorDictModuleBase):
    """What the policies share: where their networks come from, and calls with keywords."""

    def __init__(self) -> None:
        super().__init__()
        self.__dict__["_source"] = None

    def _follows(self: Self, loss: Any, links: Sequence[_Link], numbers: Mapping[str, str]) -> Self:
        """Makes the policy act with a loss's own parameters, whatever becomes of them.

        Args:
            loss: that is followed.
            links: the policy's networks and where the loss keeps their parameters.
            numbers: names of the policy's numbers, and of the loss's coefficients.
        """
        # Outside _modules: the loss's parameters are not the policy's.
        self.__dict__["_source"] = (loss, list(links), dict(numbers))
        self.follow()
        return self

    def follow(self) -> None:
        """Takes over the present parameters of the loss that a live policy follows.

        Every call of the policy does it; only what reads ``state_dict()`` after the loss has moved
        to another device or type, and before the next call, must ask for it. For a frozen policy
        nothing happens.
        """
        source = self.__dict__.get("_source")
        if source is None or torch.compiler.is_compiling():
            return
        loss, links, numbers = source
        for link in links:
            for own, now in zip(link.own, link.leaves(loss), strict=True):
                own.data = now.detach()  # the same memory, not a copy
        for name, coefficient in numbers.items():
            setattr(self, name, getattr(loss, coefficient))

    def _states(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The data; in a keyword call's, whose batch size is a guess, features are not rows."""
        rows = tensordict.batch_size
        values = [tensordict.get(key, None) for key in self.in_keys]
        if not rows or all(value is None or value.shape != rows for value in values):
            return tensordict
        result = TensorDict({}, rows[:-1])
        for key, value in zip(self.in_keys, values, strict=True):
            if value is not None:
                result.set(key, value)
        return result

    def __getstate__(self) -> dict[str, Any]:
        # A copy, or what a worker is sent, stands alone; its weights can be updated.
        self.follow()
        return self.__dict__ | {"_source": None}


class BCQPolicy(_Policy):
    r"""The best of many proposed actions.

    .. math:: \pi(s) = a_{i^*},\quad i^* = \arg\max_i Q_1(s, a_i),\quad
              a_i = G(s, z_i) + \phi\, h\, \xi(s, G(s, z_i))

    with :math:`h` half the action's range. Reference: *Compositional Skill Learning Using Batch
    Meta RL*, eq. 2, section 7.1.

    It serves stage 1 and stage 2 alike: where the generator and the critic read ``task_latent``, so
    does the policy. Proposals are drawn from PyTorch's global generator at every call, whatever the
    exploration type. A trained loss acts through :meth:`live` or :meth:`frozen`.

    Args:
        generator: a generator as :mod:`torchrl_bmrl.generators` describes it, or a decoder
            (observation, ``action_latent``[, ``task_latent``]) → ``action``.
        qvalue_network: (observation, ``action``[, ``task_latent``]) → ``state_action_value``.
        perturbation_network: optional (observation, ``action``) → ``perturbation``.

    Keyword Args:
        latent_dim: size of ``action_latent``; needed for a decoder that does not say it.
        num_candidates: proposals per state. Default 100.
        latent_clip: bound on the latent, ``None`` for none. Default 0.5.
        max_perturbation: φ.
        bounds: of the action, read with a perturbation network alone; by default the generator's.
        action_key, action_latent_key, perturbation_key, state_action_value_key: what the networks
            call them.

    Keys read: what the networks read beside what they write, such as ``observation (*B, obs_dim)``
    and ``task_latent (*B, m)``. Key written: ``action (*B, action_dim)``. Keywords serve, too:
    ``policy(observation=observation)`` returns the action.

    Raises:
        BMRLError: for candidates below one, a latent size or bounds that are not the generator's or
            missing, or a critic that a loss has copied and trains elsewhere.

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
        latent_clip: float | None = 0.5,
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
        self.generator = generator
        self.qvalue_network = qvalue_network
        self.perturbation_network = perturbation_network
        self.keys = ActionKeys(action=action_key, action_latent=action_latent_key)
        self.latent_dim = _latent_dim(generator, latent_dim, action_latent_key)
        self.num_candidates = num_candidates
        self.latent_clip = latent_clip
        self.max_perturbation = max_perturbation
        _register_bounds(self, generator, perturbation_network, bounds)
        self.perturbation_key = perturbation_key
        self.state_action_value_key = state_action_value_key
        networks = (getattr(generator, "decoder", generator), qvalue_network, perturbation_network)
        self.in_keys = _state_keys(networks, (action_key, action_latent_key))
        self.out_keys = [action_key]

    @classmethod
    def live(cls, loss: LossModule, *, num_candidates: int = 100) -> BCQPolicy:
        """The policy that a loss trains, as it is at each call: for hooks, collectors, evaluation.

        It holds the loss's parameters, not copies, so ``update_policy_weights_()`` of a collector
        sends what the loss has learnt. A copy of it, as in a worker's process, stands alone.

        Args:
            loss: a :class:`~torchrl_bmrl.objectives.BCQLoss`, or another loss with a generator and
                critics; of a :class:`~torchrl_bmrl.objectives.MetaDistillationLoss` the student
                acts, which reads ``task_latent``.
            num_candidates: proposals per state.

        Raises:
            BMRLError: for a loss without a generator or critics, or a stack of losses.
        """
        return cls._of(loss, num_candidates, live=True)

    @classmethod
    def frozen(cls, loss: LossModule, *, num_candidates: int = 100) -> BCQPolicy:
        """A copy of the policy that a loss has trained; later updates do not reach it.

        Args:
            loss: as for :meth:`live`.
            num_candidates: proposals per state.

        Raises:
            BMRLError: for a loss without a generator or critics, or a stack of losses.
        """
        return cls._of(loss, num_candidates, live=False)

    @classmethod
    def _of(cls, loss: Any, num_candidates: int, *, live: bool) -> BCQPolicy:
        student = "student_" * hasattr(loss, "student_generator")
        generator = _link(loss, f"{student}generator", live)
        # Acting needs no encoder.
        part = getattr(generator.module, "decoder", generator.module)
        critic = _link(loss, f"{student}qvalue_network", live, critic=0)
        perturbation = None if student else _link(loss, "perturbation_network", live, optional=True)
        bounds = None if student else (loss.action_low, loss.action_high)
        latent_dim = getattr(loss if student else generator.module, "latent_dim", None)
        names = ["action", "action_latent", "state_action_value"]
        policy = cls(
            part,
            critic.module,
            None if perturbation is None else perturbation.module,
            latent_dim=latent_dim,
            num_candidates=num_candidates,
            latent_clip=_number(loss.latent_clip),
            bounds=bounds,
            max_perturbation=0.0 if student else _number(loss.max_perturbation),
            **_keys(loss, *names, *(["perturbation"] if not student else [])),
        )
        if not live:
            return policy
        links = [link for link in (generator, critic, perturbation) if link is not None]
        numbers = {"latent_clip": "latent_clip"}
        if not student:
            numbers |= {name: name for name in ("max_perturbation", "action_low", "action_high")}
        return policy._follows(loss, links, numbers)

    @_dispatch
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action."""
        self.follow()
        tensordict = self._states(tensordict)
        proposals = self.propose(tensordict.select(*self.in_keys))
        return tensordict.set(self.keys.action, self.choose(proposals))

    def choose(self, proposals: TensorDictBase) -> Tensor:
        """The most valuable of proposed actions, perturbed as the policy perturbs them.

        Args:
            proposals: batch ``[*B, N]`` with the state and the action, as :meth:`propose` returns
                them; N is free.

        Returns:
            the action, ``(*B, action_dim)``.
        """
        proposals = _perturb(self, proposals)
        value = self.qvalue_network(proposals).get(self.state_action_value_key)
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


class PLASPolicy(_Policy):
    r"""The action decoded from the latent that a policy chooses.

    .. math:: \mu(s) = a + \phi\, h\, \xi(s, a),\quad a = G(s, \pi(s))

    with :math:`h` half the action's range. Reference: Zhou et al. 2020,
    https://arxiv.org/abs/2011.07213. A trained loss acts through :meth:`live` or :meth:`frozen`.

    Args:
        actor_network: (observation) → ``action_latent``.
        decoder: (observation, ``action_latent``) → ``action``.
        perturbation_network: optional (observation, ``action``) → ``perturbation``.

    Keyword Args:
        max_perturbation: φ.
        bounds: of the action, read with a perturbation network alone; by default the decoder's.
        action_key, action_latent_key, perturbation_key: what the networks call them.

    Keys read: what the networks read beside what they write, such as ``observation (*B, obs_dim)``.
    Key written: ``action (*B, action_dim)``. Keywords serve, too.

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
    def live(cls, loss: LossModule) -> PLASPolicy:
        """The policy that a loss trains, as it is at each call; see :meth:`BCQPolicy.live`.

        Args:
            loss: a :class:`~torchrl_bmrl.objectives.PLASLoss`.

        Raises:
            BMRLError: for another loss.
        """
        return cls._of(loss, live=True)

    @classmethod
    def frozen(cls, loss: LossModule) -> PLASPolicy:
        """A copy of the policy that a loss has trained; later updates do not reach it.

        Args:
            loss: a :class:`~torchrl_bmrl.objectives.PLASLoss`.

        Raises:
            BMRLError: for another loss.
        """
        return cls._of(loss, live=False)

    @classmethod
    def _of(cls, loss: Any, *, live: bool) -> PLASPolicy:
        generator, actor = (_link(loss, name, live) for name in ("generator", "actor_network"))
        perturbation = _link(loss, "perturbation_network", live, optional=True)
        policy = cls(
            actor.module,
            generator.module.decoder,
            None if perturbation is None else perturbation.module,
            max_perturbation=_number(loss.max_perturbation),
            bounds=(loss.action_low, loss.action_high),
            **_keys(loss, "action", "action_latent", "perturbation"),
        )
        if not live:
            return policy
        links = [link for link in (generator, actor, perturbation) if link is not None]
        names = ("max_perturbation", "action_low", "action_high")
        return policy._follows(loss, links, {name: name for name in names})

    @_dispatch
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``."""
        self.follow()
        tensordict = self._states(tensordict)
        data = _perturb(self, self.decoder(self.actor_network(tensordict.select(*self.in_keys))))
        return tensordict.set(self.keys.action, data.get(self.keys.action))


class DiscreteBCQPolicy(_Policy):
    r"""The most valuable of the actions that are likely enough.

    .. math:: \pi(s) = \arg\max_a \{Q_1(s, a) : G(a|s) / \max_{a'} G(a'|s) > \tau\}

    Reference: Fujimoto et al. 2019, https://arxiv.org/abs/1910.01708. A trained loss acts through
    :meth:`live` or :meth:`frozen`.

    Args:
        generator: classifier of the data's actions (observation) → ``logits``.
        qvalue_network: (observation) → ``action_value``.

    Keyword Args:
        threshold: τ. Default 0.3.
        action_space: ``"one-hot"``, written as ``(*B, n)``, or ``"categorical"``, ``(*B,)``.
        action_key, logits_key, action_value_key: what the networks call them.

    Keys read: ``observation``. Key written: ``action``, int64. Keywords serve, too.

    Raises:
        BMRLError: for another action space, a critic that a loss has copied and trains elsewhere,
            or at a call for networks of different numbers of actions.

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
        check_trained("qvalue_network", qvalue_network)
        action_space = action_space.replace("_", "-")
        if action_space not in ("one-hot", "categorical"):
            raise UnknownNameError("action_space", action_space, ("one-hot", "categorical"))
        self.logits_key = logits_key
        self.action_value_key = action_value_key
        self.generator = generator
        self.qvalue_network = qvalue_network
        self.threshold = threshold
        self.action_space = action_space
        self.in_keys = list(dict.fromkeys([*generator.in_keys, *qvalue_network.in_keys]))
        self.out_keys = [action_key]

    @classmethod
    def live(cls, loss: LossModule) -> DiscreteBCQPolicy:
        """The policy that a loss trains, as it is at each call; see :meth:`BCQPolicy.live`.

        Args:
            loss: a :class:`~torchrl_bmrl.objectives.DiscreteBCQLoss`.

        Raises:
            BMRLError: for another loss.
        """
        return cls._of(loss, live=True)

    @classmethod
    def frozen(cls, loss: LossModule) -> DiscreteBCQPolicy:
        """A copy of the policy that a loss has trained; later updates do not reach it.

        Args:
            loss: a :class:`~torchrl_bmrl.objectives.DiscreteBCQLoss`.

        Raises:
            BMRLError: for another loss.
        """
        return cls._of(loss, live=False)

    @classmethod
    def _of(cls, loss: Any, *, live: bool) -> DiscreteBCQPolicy:
        links = [_link(loss, "generator", live), _link(loss, "qvalue_network", live, critic=0)]
        policy = cls(
            *(link.module for link in links),
            threshold=_number(loss.threshold),
            action_space=loss.action_space,
            **_keys(loss, "action", "logits", "action_value"),
        )
        return policy._follows(loss, links, {"threshold": "threshold"}) if live else policy

    @_dispatch
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action``.

        Raises:
            BMRLError: if generator and critic know different numbers of actions.
        """
        self.follow()
        tensordict = self._states(tensordict)
        data = self.qvalue_network(self.generator(tensordict.select(*self.in_keys)))
        logits, value = data.get(self.logits_key), data.get(self.action_value_key)
        if logits.shape != value.shape:
            raise BMRLError(
                f"{self.logits_key!r} has the shape {tuple(logits.shape)} and "
                f"{self.action_value_key!r} {tuple(value.shape)}; valid: equal shapes"
            )
        value = value.masked_fill(~likely_actions(logits, self.threshold), -torch.inf)
        action = value.argmax(-1)
        if self.action_space == "one-hot":
            action = one_hot(action, value.shape[-1])
        return tensordict.set(self.out_keys[0], action)


# -- from a loss to a policy -----------------------------------------------------------------------


class _Link:
    """A policy's network and where a loss keeps its parameters.

    Args:
        module: the policy's own network.
        name: of the loss's network.
        critic: which of the loss's critics it is.
    """

    def __init__(self, module: Any, name: str, critic: int | None) -> None:
        self.module, self.name, self.critic = module, name, critic
        params = TensorDict.from_module(module)
        self.keys = list(params.keys(include_nested=True, leaves_only=True))
        self.own = [params.get(key) for key in self.keys]

    def leaves(self, loss: Any) -> list[Tensor]:
        """The loss's parameters and buffers, in the order of the network's own."""
        params = _held(loss, self.name, self.critic)[1]
        return [params.get(key) for key in self.keys]


def _held(loss: Any, name: str, critic: int | None) -> tuple[Any, TensorDictBase]:
    """A loss's network and its parameters."""
    if critic is not None and hasattr(loss, "critic"):
        return loss.critic(critic)
    params = getattr(loss, f"{name}_params")
    return getattr(loss, name), getattr(params, "_param_td", params)


def _link(
    loss: Any, name: str, live: bool, *, critic: int | None = None, optional: bool = False
) -> Any:
    """A stand-alone network with a loss's parameters, or a copy of them."""
    if hasattr(loss, "member"):
        raise BMRLError(
            f"a {type(loss).__name__} has {len(loss)} policies; valid: a policy of one member, "
            "frozen(stack.member(index))"
        )
    module = getattr(loss, name, None)
    if module is None:
        if optional:
            return None
        raise BMRLError(
            f"{type(loss).__name__} has no {name}; valid: a loss that trains one, or the policy's "
            "own constructor"
        )
    module, params = _held(loss, name, critic)
    return _Link(_instantiate(module, params, live), name, critic)


def _number(value: Any) -> Any:
    return None if value is None else float(value)


def _latent_dim(generator: Any, given: int | None, key: NestedKey) -> Any:
    """Size of the latent, which generator and argument must agree on; ``None`` without one."""
    said = getattr(generator, "latent_dim", (getattr(generator, "sizes", None) or {}).get(key))
    if given is None and said is None and not hasattr(generator, "propose"):
        raise BMRLError(
            "latent_dim is None and the decoder does not say it; valid: the size of "
            f"{key!r}, which it reads"
        )
    if None not in (given, said) and given != said:
        raise BMRLError(f"latent_dim is {given}; valid: {said}, the generator's")
    return said if given is None else given


def _register_bounds(policy: Any, generator: Any, perturbation: Any, given: Any) -> None:
    """Bounds of the action, which generator and argument must agree on."""
    said = getattr(generator, "bounds", None)
    if given is None and said is None and perturbation is not None:
        raise BMRLError("bounds are None; valid: (low, high) of the action, to perturb it within")
    bounds = given if given is not None else said if said is not None else (-1.0, 1.0)
    for name, bound, own in zip(("low", "high"), bounds, said or bounds, strict=True):
        bound = torch.as_tensor(bound)
        own = torch.as_tensor(own).to(bound)
        one, other = torch.broadcast_tensors(bound, own)
        if not torch.allclose(one, other):
            raise BMRLError(
                f"bounds say {name} {bound.tolist()}; valid: {own.tolist()}, the generator's"
            )
        policy.register_buffer(f"action_{name}", bound.detach().clone())


def _perturb(policy: BCQPolicy | PLASPolicy, data: TensorDictBase) -> TensorDictBase:
    """Moves the action by the policy's perturbation network, if it has one."""
    network, key = policy.perturbation_network, policy.keys.action
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


def _instantiate(
    module: TensorDictModule, params: TensorDictBase, live: bool = False
) -> TensorDictModule:
    """A stand-alone module with the given parameters, in their own memory if it is live."""
    module = deepcopy(module)
    # As parameters: plain tensors would act, but be missing from parameters() and state_dict().
    own = TensorDictParams(params.data if live else params.data.clone())
    own.to_module(module, preserve_module_state=False)
    return module.requires_grad_(False)
