"""Several losses of one kind as one: the agents of all tasks and seeds in one program."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from typing import Any, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.checks import entry
from torchrl_bmrl.objectives.ensemble import kind

Self = TypeVar("Self", bound="StackedLoss")


class StackedLoss(LossModule):
    """N losses of one kind, member i of which sees row i of the data and has parameters of its own.

    It is used as one of them is: its methods ``generator_loss``, ``qvalue_loss``, ... and
    ``forward`` take a batch ``[N, *B]`` and return what a member returns, with a first dimension of
    N; the gradient of their sum is each member's own. ``generator_params``,
    ``qvalue_network_params``, ... hold the parameters of all members, ``[N, ...]``, for one
    optimizer and one :class:`~torchrl.objectives.SoftUpdate`. On a GPU the members run as one
    program under :func:`torch.vmap`; on a CPU one after the other, where that is faster.

    Args:
        losses: the members; equal in kind, networks' shapes and options, but for coefficients that
            are buffers, such as ``kl_weight``, which each member keeps. Their parameters are
            copied: to see what training made of them ask :meth:`member`.
        names: of the members, for messages; by default their numbers.

    Keyword Args:
        deactivate_vmap: run the members one after the other (``True``, needed for data with masks)
            or under vmap (``False``); ``None`` chooses by device.

    Raises:
        BMRLError: for no members, members that differ, members whose networks share parameters, or
            names that are not one for each; and at a call for data without a row per member.

    Example:
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> from torchrl_bmrl.objectives import BCQLoss
        >>> losses = [
        ...     BCQLoss(ActionVAE(3, 2), make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        ...     for _ in range(4)
        ... ]
        >>> stack = StackedLoss(losses, names=["reach", "lift", "push_left", "push_right"])
        >>> targets = SoftUpdate(stack, tau=0.005)
        >>> data = TensorDict(
        ...     {"observation": torch.randn(4, 8, 3), "action": torch.rand(4, 8, 2)}, [4, 8]
        ... )
        >>> value, metrics = stack.generator_loss(data)
        >>> value.sum().backward()
        >>> value.shape, metrics["kl_divergence"].shape
        (torch.Size([4]), torch.Size([4]))
        >>> stack.generator_params.batch_size, type(stack.member(1)).__name__
        (torch.Size([4]), 'BCQLoss')
    """

    _template: LossModule
    _losses: list[LossModule]

    def __init__(
        self,
        losses: Sequence[LossModule],
        names: Sequence[str] | None = None,
        *,
        deactivate_vmap: bool | None = None,
    ) -> None:
        super().__init__()
        losses = list(losses)
        names = [str(i) for i in range(len(losses))] if names is None else list(names)
        _check_members(losses, names)
        self.names = names
        self.deactivate_vmap = deactivate_vmap
        # Outside _modules: their own parameters are no state of the stack.
        self.__dict__["_losses"] = losses
        self.__dict__["_template"] = deepcopy(losses[0])
        own = [_state(loss) for loss in losses]
        self._paths: dict[str, str] = {}
        for path in own[0]:
            values = [state[path] for state in own]
            nested = "." in path or isinstance(values[0], Tensor)
            if nested and not _trained(values[0]) and _equal(values):
                continue  # alike in all members: the template's will do
            if isinstance(self._template.get_submodule(path.rpartition(".")[0]), nn.ModuleList):
                raise BMRLError(f"{path!r} differs between the losses; valid: equal ones")
            name = path.replace(".", "_")
            self._paths[name] = path
            if isinstance(values[0], Tensor):
                self.register_buffer(name, torch.stack(values))
            else:
                setattr(self, name, _stack(values))
        # SoftUpdate and HardUpdate note here what they move.
        self._has_update_associated = {
            name.removesuffix("_params"): False for name in self._paths if name.endswith("_params")
        }

    @property
    def in_keys(self) -> list[Any]:
        """Keys that a member reads."""
        return self._template.in_keys

    def __len__(self) -> int:
        return len(self.names)

    def __getattr__(self, name: str) -> Any:
        if name.endswith("_loss") and hasattr(type(self._template), name):
            return partial(self._run, getattr(type(self._template), name))
        return super().__getattr__(name)

    def _apply(self: Self, fn: Callable[[Tensor], Tensor]) -> Self:
        self._template._apply(fn)
        return super()._apply(fn)

    def member(self, index: int) -> LossModule:
        """One of the losses that the stack was made of, with its present parameters.

        Args:
            index: its position.

        Returns:
            the loss itself; later updates of the stack do not reach it until it is asked for again.
        """
        loss = self._losses[index]
        own = _state(loss)
        with torch.no_grad():
            for name, path in self._paths.items():
                own[path].copy_(self._held(name)[index])
        return loss

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Every loss and metric of every member, each ``[N]``; see the members' class for keys.

        Raises:
            BMRLError: for data without a row per member, or that do not fit the members.
        """
        priority = self._template.tensor_keys.priority

        def run(loss: LossModule, data: TensorDictBase) -> tuple[dict[str, Tensor], Tensor | None]:
            losses = loss.forward(data)
            return dict(losses.items()), data.get(priority, None)

        losses, written = self._run(run, tensordict)
        if written is not None:
            tensordict.set(priority, written)
        return TensorDict(losses, batch_size=[])

    def _run(self, function: Callable[..., Any], tensordict: TensorDictBase) -> Any:
        """Calls ``function(loss, data)`` for every member; its results are stacked."""
        size = len(self)
        if not tensordict.batch_size or tensordict.batch_size[0] != size:
            raise BMRLError(
                f"the data's batch size is {list(tensordict.batch_size)}; valid: [{size}, ...], "
                "one row per member"
            )
        state = {name: self._held(name) for name in self._paths}
        if self.in_sequence:
            rows = zip(*(value.unbind(0) for value in state.values()), strict=True)
            results = []
            for row, data in zip(rows, tensordict.unbind(0), strict=True):
                with self._holding(dict(zip(state, row, strict=True))) as loss:
                    results.append(function(loss, data))
            return _join(results)
        for key in self.in_keys:
            entry(tensordict, key)  # under vmap no member can look for itself

        def run(state: dict[str, Any], data: TensorDictBase) -> Any:
            with self._holding(state) as loss:
                return function(loss, data)

        return torch.vmap(run, randomness="different")(state, tensordict)

    def _held(self, name: str) -> TensorDictBase | Tensor:
        value = getattr(self, name)
        return getattr(value, "_param_td", value)  # which does not wrap each of its methods

    @property
    def in_sequence(self) -> bool:
        """Whether the members run one after the other."""
        if self.deactivate_vmap is None:
            return next(self.parameters()).device.type == "cpu"
        return self.deactivate_vmap

    @contextmanager
    def _holding(self, state: dict[str, Any]) -> Iterator[LossModule]:
        """The template with one member's parameters and buffers."""
        template, held = self._template, []
        try:
            for name, value in state.items():
                parent, _, attribute = self._paths[name].rpartition(".")
                owner = template.get_submodule(parent)
                held.append((owner, attribute))
                # Found before the module's own, which stay where they are.
                owner.__dict__[attribute] = value
            template.__dict__["_cache_leaves"] = {}
            yield template
        finally:
            for owner, attribute in held:
                owner.__dict__.pop(attribute, None)
            template.__dict__["_cache_leaves"] = {}


def _state(loss: LossModule) -> dict[str, Any]:
    """Parameters and buffers of a loss by where they lie: TensorDicts, and tensors outside them."""
    state: dict[str, Any] = {}
    for path, module in loss.named_modules():
        if isinstance(module, TensorDictParams):
            state[path] = module._param_td
        else:
            prefix = f"{path}." if path else ""
            buffers = module.named_buffers(recurse=False)
            state |= {f"{prefix}{name}": buffer for name, buffer in buffers}
    return state


def _leaves(value: Any) -> list[Tensor]:
    return [value] if isinstance(value, Tensor) else list(value.values(True, True))


def _trained(value: Any) -> bool:
    return any(leaf.requires_grad for leaf in _leaves(value))


def _equal(values: Sequence[Any]) -> bool:
    first, *others = map(_leaves, values)
    return all(all(map(torch.equal, first, other)) for other in others)


def _stack(values: Sequence[TensorDictBase]) -> TensorDictParams:
    """One TensorDictParams over a new first dimension; parameters stay such, buffers too."""
    stacked: Any = torch.stack([value.data for value in values]).contiguous()
    for key, leaf in values[0].items(True, True):
        if leaf.requires_grad:
            stacked.set(key, nn.Parameter(stacked.get(key)))
    return TensorDictParams(stacked, no_convert="skip")


def _join(results: Sequence[Any]) -> Any:
    """Stacks what the members returned: tensors, in tuples and dicts."""
    first = results[0]
    if isinstance(first, Tensor):
        return torch.stack(list(results))
    if isinstance(first, dict):
        return {key: _join([result[key] for result in results]) for key in first}
    if isinstance(first, tuple):
        return tuple(map(_join, zip(*results, strict=True)))
    return first


def _kind(loss: LossModule) -> tuple[Any, ...]:
    """What members of a stack have in common."""
    return type(loss), kind(loss), loss.tensor_keys, loss.in_keys, loss.loss_mask_key


def _check_members(losses: Sequence[LossModule], names: Sequence[str]) -> None:
    if not losses or len(names) != len(losses) or len(set(names)) < len(names):
        raise BMRLError(
            f"{len(losses)} losses named {list(names)}; valid: at least one, each with its own name"
        )
    for name, loss in zip(names, losses, strict=True):
        if _kind(loss) != _kind(losses[0]):
            raise BMRLError(
                f"loss {name!r} differs from {names[0]!r} in kind, keys, networks or options; "
                "valid: equal ones, but for parameters and coefficients"
            )
    held = [leaf for loss in losses for part in _state(loss).values() for leaf in _leaves(part)]
    trained = [id(leaf) for leaf in held if leaf.requires_grad]
    if len(set(trained)) < len(trained):
        raise BMRLError("networks of the losses share parameters; valid: each network has its own")
