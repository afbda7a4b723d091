"""Policies that act with the networks of a loss: with its own parameters, or with a copy."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar
from weakref import WeakSet

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules.ensemble import EnsembleCritic
from torchrl_bmrl.ownership import is_copied

if TYPE_CHECKING:
    from torchrl.objectives import LossModule

Self = TypeVar("Self", bound="LossPolicy")
Made: TypeAlias = "tuple[Self, Sequence[Link | None], Sequence[str]]"


def dispatched(forward: Callable[..., Any]) -> Callable[..., Any]:
    """A policy's ``forward`` that also takes tensors, by keyword or in the order of ``in_keys``.

    It does the same as tensordict's ``dispatch``, but finds the batch dimensions: where a network
    declares the size of an entry, all dimensions but the last; for other entries, such as pictures,
    the first. The signature contains the usual keys because ``torch.export`` needs names for
    dynamic shapes.
    """

    @wraps(forward)
    def call(self: Any, tensordict: Any = None, *values: Tensor, **keywords: Tensor) -> Any:
        if isinstance(tensordict, TensorDictBase):
            return forward(self, tensordict)
        names = {"_".join([key] if isinstance(key, str) else key): key for key in self.in_keys}
        given = () if tensordict is None else (tensordict, *values)
        entries = dict(zip(names, given, strict=False)) | keywords
        if len(given) > len(names) or set(entries) != set(names):
            raise TypeError(
                f"{type(self).__name__} got {sorted(entries)}; valid: {sorted(names)}, each once"
            )
        return forward(self, self.rows_of({names[k]: x for k, x in entries.items()})).get(
            self.out_keys[0]
        )

    own, tensordict = inspect.signature(forward).parameters.values()
    named = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None)
        for name in ("observation", "task_latent")
    ]
    others = inspect.Parameter("keywords", inspect.Parameter.VAR_KEYWORD)
    parameters = [own, tensordict.replace(default=None), *named, others]
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return call


class LossPolicy(TensorDictModuleBase):
    """Base of the policies that act with the networks of a loss.

    A subclass defines ``_from``, which makes the policy of a loss, its links to the loss's networks
    and the names of the loss's coefficients that it reads.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, BCQPolicy, make_qvalue_network
        >>> from torchrl_bmrl.objectives import BCQLoss
        >>> loss = BCQLoss(ActionVAE(3, 2), make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        >>> live, frozen = BCQPolicy.live(loss), BCQPolicy.frozen(loss, num_candidates=10)
        >>> live(observation=torch.zeros(5, 3)).shape
        torch.Size([5, 2])
    """

    def __init__(self) -> None:
        super().__init__()
        self.__dict__["_source"] = None

    @classmethod
    def live(cls: type[Self], loss: LossModule, **options: Any) -> Self:
        """The policy that a loss trains, for hooks, collectors and evaluation during training.

        It shares the loss's parameters, so ``update_policy_weights_()`` of a collector sends the
        current ones. A copy of the policy, as in a worker's process, is independent.

        Args:
            loss: a loss of the policy's algorithm. A ``BCQPolicy`` also takes other losses with a
                generator and critics; of a
                :class:`~torchrl_bmrl.objectives.MetaDistillationLoss` it is the student's policy,
                which reads ``task_latent``.
            **options: of the policy, such as ``num_candidates``.

        Raises:
            BMRLError: for a loss without the networks of the policy, or a stack of losses.
        """
        policy, links, numbers = cls._from(loss, True, **options)
        return policy._follows(loss, links, numbers)

    @classmethod
    def frozen(cls: type[Self], loss: LossModule, **options: Any) -> Self:
        """A policy with a copy of the loss's parameters; later updates do not reach it.

        Args:
            loss: as for :meth:`live`.
            **options: of the policy, such as ``num_candidates``.

        Raises:
            BMRLError: for a loss without the networks of the policy, or a stack of losses.
        """
        return cls._from(loss, False, **options)[0]

    @classmethod
    def _from(cls: type[Self], loss: Any, live: bool, **options: Any) -> Made[Self]:
        raise NotImplementedError(f"{cls.__name__} has no _from(); valid: a method that makes it")

    def _follows(
        self: Self, loss: Any, links: Sequence[Link | None], numbers: Sequence[str]
    ) -> Self:
        """Makes the policy act with a loss's own parameters, even after they are replaced.

        Args:
            loss: the loss.
            links: the policy's networks and their parameters in the loss.
            numbers: names of the loss's coefficients that the policy has, too.
        """
        # Outside _modules: the loss's parameters are not the policy's.
        used = [link for link in links if link is not None]
        self.__dict__["_source"] = (loss, used, numbers)
        # The loss calls follow() when its parameters are replaced.
        loss.__dict__.setdefault("_followers", WeakSet()).add(self)
        self.follow()
        return self

    def follow(self) -> None:
        """Updates a live policy to the current parameters of its loss.

        Every call of the policy does this, and so does the loss when it moves to another device or
        dtype, or when parameters or coefficients are replaced. A frozen policy does not change.
        """
        source = self.__dict__.get("_source")
        if source is None or torch.compiler.is_compiling():
            return
        loss, links, numbers = source
        for link in links:
            for own, now in zip(link.own, link.leaves(loss), strict=True):
                own.data = now.detach()  # the same memory, not a copy
        for name in numbers:
            setattr(self, name, getattr(loss, name))

    def rows_of(self, entries: Mapping[NestedKey, Tensor]) -> TensorDict:
        """The entries of a call with tensors, with their common batch size.

        Args:
            entries: tensors by key.
        """
        sized = {key for part in self.modules() for key in getattr(part, "sizes", None) or {}}
        batch: Any = None
        for key, value in entries.items():
            shape = value.shape[: value.ndim > 1]
            if key in sized:
                shape = value.shape[:-1]
            if batch is None or len(shape) < len(batch):
                batch = shape
        result = TensorDict({}, batch)
        for key, value in entries.items():
            result.set(key, value)
        return result

    def __getstate__(self) -> dict[str, Any]:
        # A copy, such as a worker's, does not follow the loss; its weights can be updated.
        self.follow()
        return self.__dict__ | {"_source": None}


class Link:
    """A policy's network and its parameters in a loss.

    Args:
        module: the policy's own network.
        name: of the loss's network.
        critic: for critics, the rule of :func:`.ensemble_value`; ``None`` for another network.
    """

    def __init__(self, module: Any, name: str, critic: str | None) -> None:
        self.module, self.name, self.critic = module, name, critic
        params = TensorDict.from_module(module)
        self.keys = list(params.keys(include_nested=True, leaves_only=True))
        self.own = [params.get(key) for key in self.keys]

    def leaves(self, loss: Any) -> list[Tensor]:
        """The loss's parameters and buffers, in the order of the network's own."""
        params = _params(loss, self.name, self.critic)
        return [params.get(key) for key in self.keys]


def _module(loss: Any, name: str, critic: str | None) -> Any:
    """A loss's network; of critics the first, or all as one network."""
    if critic is None or not hasattr(loss, "critic"):
        return getattr(loss, name)
    if critic == "first":
        return loss.critic(0)[0]
    # Copies: critics whose parameters are stacked share one module.
    critics = [deepcopy(loss.critic(i)[0]) for i in range(loss.num_qvalue_nets)]
    return EnsembleCritic(critics, critic, loss.tensor_keys.state_action_value)


def _params(loss: Any, name: str, critic: str | None) -> TensorDictBase:
    """The parameters of :func:`_module` in the loss."""
    if critic is None or not hasattr(loss, "critic"):
        params = getattr(loss, f"{name}_params")
        return getattr(params, "_param_td", params)
    if critic == "first":
        return loss.critic(0)[1]
    own = {str(i): loss.critic(i)[1] for i in range(loss.num_qvalue_nets)}
    return TensorDict({"critics": own})


def link(
    loss: Any, name: str, live: bool, *, critic: str | None = None, optional: bool = False
) -> Any:
    """An independent network with a loss's parameters, or with a copy of them."""
    if hasattr(loss, "member"):
        raise BMRLError(
            f"a {type(loss).__name__} has {len(loss)} policies; valid: a policy of one member, "
            "frozen(stack.member(index))"
        )
    if live and is_copied(loss):
        raise BMRLError(
            f"this {type(loss).__name__} is a member of a stack, which trains a copy of it; valid: "
            "frozen(stack.member(index)), made anew after training"
        )
    module = getattr(loss, name, None)
    if module is None:
        if optional:
            return None
        raise BMRLError(
            f"{type(loss).__name__} has no {name}; valid: a loss that trains one, or the policy's "
            "own constructor"
        )
    module = _instantiate(_module(loss, name, critic), _params(loss, name, critic), live)
    return Link(module, name, critic)


def as_number(value: Any) -> Any:
    """A coefficient as a Python number; ``None`` stays so."""
    return None if value is None else float(value)


def key_options(loss: LossModule, *names: str) -> dict[str, NestedKey]:
    """Arguments that give a policy the loss's names of keys."""
    return {f"{name}_key": getattr(loss.tensor_keys, name) for name in names}


def extract_network(loss: LossModule, name: str) -> Any:
    """An independent, frozen copy of one of a loss's networks; ``None`` if it is ``None``.

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
    """An independent, frozen copy of one of a loss's critics.

    Args:
        loss: such as :class:`~torchrl_bmrl.objectives.BCQLoss`.
        index: of the critic.

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
    """An independent module with the given parameters; it shares their memory if it is live."""
    module = deepcopy(module)
    # As parameters: parameters() and state_dict() would not contain plain tensors.
    own = TensorDictParams(params.data if live else params.data.clone())
    own.to_module(module, preserve_module_state=False)
    return module.requires_grad_(False)
