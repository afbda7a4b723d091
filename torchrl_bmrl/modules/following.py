"""How a policy takes over what a loss has trained: as it is now, or as it is at each call."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakSet

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.ownership import is_copied

if TYPE_CHECKING:
    from torchrl.objectives import LossModule

Self = TypeVar("Self", bound="LossPolicy")


def dispatched(forward: Callable[..., Any]) -> Callable[..., Any]:
    """A policy's ``forward`` that also takes tensors, by keyword or in the order of ``in_keys``.

    It does what tensordict's ``dispatch`` does, and knows which dimensions are rows: where a
    network says the size of an entry, all but the last one; of another, such as a picture, the
    first.
    The signature names the usual keys, since ``torch.export`` takes dynamic shapes for names alone.
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
    """What the policies share: where their networks come from, and calls with keywords."""

    def __init__(self) -> None:
        super().__init__()
        self.__dict__["_source"] = None

    def _follows(self: Self, loss: Any, links: Sequence[Link], numbers: Mapping[str, str]) -> Self:
        """Makes the policy act with a loss's own parameters, whatever becomes of them.

        Args:
            loss: that is followed.
            links: the policy's networks and where the loss keeps their parameters.
            numbers: names of the policy's numbers, and of the loss's coefficients.
        """
        # Outside _modules: the loss's parameters are not the policy's.
        self.__dict__["_source"] = (loss, list(links), dict(numbers))
        # The loss tells when its parameters lie elsewhere: what reads them may not call the policy.
        loss.__dict__.setdefault("_followers", WeakSet()).add(self)
        self.follow()
        return self

    def follow(self) -> None:
        """Takes over the present parameters of the loss that a live policy follows.

        Every call of the policy does it, and the loss when it moves to another device or type, or
        when parameters or coefficients are replaced. For a frozen policy nothing happens.
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

    def rows_of(self, entries: Mapping[NestedKey, Tensor]) -> TensorDict:
        """The entries of a call with tensors, with the batch size that they have in common.

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
        # A copy, or what a worker is sent, stands alone; its weights can be updated.
        self.follow()
        return self.__dict__ | {"_source": None}


class Link:
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


def link(
    loss: Any, name: str, live: bool, *, critic: int | None = None, optional: bool = False
) -> Any:
    """A stand-alone network with a loss's parameters, or a copy of them."""
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
    module, params = _held(loss, name, critic)
    return Link(_instantiate(module, params, live), name, critic)


def as_number(value: Any) -> Any:
    """A coefficient as a Python number; ``None`` stays so."""
    return None if value is None else float(value)


def key_options(loss: LossModule, *names: str) -> dict[str, NestedKey]:
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
