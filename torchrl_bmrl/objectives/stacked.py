"""Several losses of one kind as one loss, such as the agents of all tasks and seeds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from typing import Any, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor, nn
from torchrl.objectives.common import LossModule
from torchrl.objectives.value import TD0Estimator

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.data import entry
from torchrl_bmrl.objectives.stacking import (
    are_equal,
    check_members,
    is_trained,
    join,
    stack_params,
    state_of,
)
from torchrl_bmrl.ownership import note_copied

Self = TypeVar("Self", bound="StackedLoss")


def _of_members(name: str, doc: str) -> Any:
    """A property of a stack that reads one member's attribute and sets every member's."""

    def read(self: StackedLoss) -> Any:
        template = self.__dict__.get("_template")
        return None if template is None else getattr(template, name)

    def write(self: StackedLoss, value: Any) -> None:
        for loss in self._all() if "_template" in self.__dict__ else ():
            setattr(loss, name, value)

    read.__doc__ = doc
    return property(read, write)


class StackedLoss(LossModule):
    """N losses of one kind; member i reads row i of the data and has its own parameters.

    Use it like a single loss. ``forward`` takes a batch ``[N, *B]``. If the members reduce their
    losses, it returns each ``loss_*`` summed over the members, so that one ``backward()`` gives
    each member its own gradient, and every metric of each member, ``[N]``. The methods
    ``generator_loss``, ``qvalue_loss``, ... return the losses and metrics of each member, ``[N]``.
    ``stack.set_keys(...)``, masks, estimators and coefficients apply to all members.
    ``generator_params``, ``qvalue_network_params``, ... contain the parameters of all members,
    ``[N, ...]``, for one optimizer and one :class:`~torchrl.objectives.SoftUpdate`. On a GPU the
    members run as one program under :func:`torch.vmap`, on a CPU one after the other, which is
    faster there.

    Args:
        losses: the members. They must be equal in class, networks' shapes and options, except for
            coefficients that are buffers, such as ``kl_weight``, which each member keeps. Their
            parameters are copied: :meth:`member` returns a trained one.
        names: of the members, for messages; by default their numbers.

    Keyword Args:
        deactivate_vmap: run the members one after the other (``True``) or under vmap (``False``);
            ``None`` chooses by device.

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
        check_members(losses, names)
        self.names = names
        self.deactivate_vmap = deactivate_vmap
        # Outside _modules: their own parameters are not state of the stack.
        self.__dict__["_losses"] = losses
        for loss in losses:
            for network in (loss, *(x for x in vars(loss).values() if isinstance(x, nn.Module))):
                note_copied(network, type(self).__name__)
        template = deepcopy(losses[0])
        own = [state_of(loss) for loss in losses]
        self._paths: dict[str, str] = {}
        for path in own[0]:
            values = [state[path] for state in own]
            nested = "." in path or isinstance(values[0], Tensor)
            coefficient = path in getattr(template, "_coefficients", ())
            if nested and not coefficient and not is_trained(values[0]) and are_equal(values):
                continue  # equal in all members: the template's is used
            if isinstance(template.get_submodule(path.rpartition(".")[0]), nn.ModuleList):
                raise BMRLError(f"{path!r} differs between the losses; valid: equal ones")
            name = path.replace(".", "_")
            self._paths[name] = path
            if isinstance(values[0], Tensor):
                self.register_buffer(name, torch.stack(values))
            else:
                setattr(self, name, stack_params(values))
        self.__dict__["_template"] = template
        # SoftUpdate and HardUpdate record here what they update.
        self._has_update_associated = {
            name.removesuffix("_params"): False for name in self._paths if name.endswith("_params")
        }

    # -- attributes of all members ---------------------------------------------------------------

    in_keys = _of_members("in_keys", "Keys that a member reads.")
    out_keys = _of_members("out_keys", "Keys that ``forward`` returns, in order.")
    tensor_keys = _of_members("tensor_keys", "Names of the entries, see the members' class.")
    loss_mask_key = _of_members("loss_mask_key", "Key of the mask of the rows that count.")
    value_type = _of_members("value_type", "Kind of the members' value estimator.")
    vmap_randomness = _of_members("vmap_randomness", "How members draw in networks under vmap.")
    deterministic_sampling_mode = _of_members(
        "deterministic_sampling_mode", "Exploration type under which the members run."
    )

    _value_estimator = _of_members("_value_estimator", "The members' value estimator.")

    def set_keys(self, **kwargs: Any) -> None:
        """Renames entries for all members.

        Args:
            **kwargs: names, see the members' class.
        """
        for loss in self._all():
            loss.set_keys(**kwargs)

    def set_vmap_randomness(self, value: str) -> None:
        """Sets how the members draw in critics or teachers under vmap.

        Args:
            value: ``"error"``, ``"same"`` or ``"different"``.
        """
        for loss in self._all():
            loss.set_vmap_randomness(value)

    def make_value_estimator(self: Self, value_type: Any = None, **hyperparams: Any) -> Self:
        """Chooses the estimator of the critics' target for all members; returns the stack itself.

        Args:
            value_type: see :meth:`.OfflineLoss.make_value_estimator`.
            **hyperparams: of the estimator.
        """
        for loss in self._all():
            loss.make_value_estimator(value_type, **hyperparams)
        self._drop_stacked("_value_estimator.")
        return self

    def _drop_stacked(self, prefix: str) -> None:
        """Removes stacked buffers of the members' estimators that are now equal in all members."""
        for name, path in list(self._paths.items()):
            if path.startswith(prefix):
                del self._paths[name]
                delattr(self, name)

    def reset_parameters_recursive(self) -> None:
        """Initialises the parameters of every member anew."""
        for index in range(len(self)):
            loss = self.member(index)
            loss.reset_parameters_recursive()
            own = state_of(loss)
            with torch.no_grad():
                for name, path in self._paths.items():
                    self._held(name)[index].copy_(own[path])

    def __setattr__(self, name: str, value: Any) -> None:
        template = self.__dict__.get("_template")
        if template is None or not _passed_on(template, name) or name in vars(self):
            super().__setattr__(name, value)
            return
        if name not in getattr(template, "_coefficients", ()):  # an option, such as reduction
            for loss in self._all():
                setattr(loss, name, value)
            if name == "gamma":
                self._drop_stacked("_value_estimator.gamma")
            return
        each = [value] * len(self)
        if isinstance(value, Tensor) and value.ndim == 1:
            each = value.tolist()
            if len(each) != len(self):
                raise BMRLError(f"{name} has {len(each)} numbers; valid: {len(self)}, or one")
        for loss, own in zip(self._all(), [each[0], *each], strict=True):
            setattr(loss, name, own)
        # A coefficient that is None has no buffer.
        self._paths.pop(name, None)
        self._buffers.pop(name, None)
        if value is not None:
            self._paths[name] = name
            # Not register_buffer, which would find the members' attribute of this name.
            own = torch.stack([getattr(x, name) for x in self._losses])
            self._buffers[name] = own.to(getattr(template, name))

    def _all(self) -> list[LossModule]:
        return [self._template, *self._losses]

    def __len__(self) -> int:
        return len(self.names)

    def __getattr__(self, name: str) -> Any:
        if name.endswith("_loss") and hasattr(type(self._template), name):
            return partial(self._run, getattr(type(self._template), name))
        template = self.__dict__.get("_template")
        if template is not None and name not in self._buffers and _passed_on(template, name):
            return getattr(template, name)
        return super().__getattr__(name)

    def _apply(self: Self, fn: Callable[[Tensor], Tensor]) -> Self:
        self._template._apply(fn)
        return super()._apply(fn)

    def train(self: Self, mode: bool = True) -> Self:
        """Sets the mode of all members and of their networks.

        Args:
            mode: training, or evaluation.
        """
        for loss in self._all():
            loss.train(mode)
        return super().train(mode)

    def member(self, index: int) -> LossModule:
        """One of the given losses, with its current parameters.

        Args:
            index: its position.

        Returns:
            the loss itself; later updates of the stack reach it at the next call of this method.
        """
        loss = self._losses[index]
        reference = next(self.parameters())
        loss.to(dtype=reference.dtype, device=reference.device)
        own = state_of(loss)
        with torch.no_grad():
            for name, path in self._paths.items():
                own[path].copy_(self._held(name)[index])
        return loss

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Every loss, summed over the members, and every metric of each member, ``[N]``.

        With members of ``reduction="none"`` the losses are those of the rows, ``[N, *B]``.

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
        if self._template.reduction != "none":
            losses = {
                name: value.sum() if name.startswith("loss_") else value
                for name, value in losses.items()
            }
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
            return join(results)
        shape = getattr(self._template, "batch_shape", lambda data: data.batch_size)
        valid = self._template.valid_rows(tensordict, shape(tensordict))
        for key in self.in_keys:
            entry(tensordict, key, valid)  # under vmap a member cannot check it

        def run(state: dict[str, Any], data: TensorDictBase) -> Any:
            with self._holding(state) as loss:
                return function(loss, data)

        return torch.vmap(run, randomness="different")(state, tensordict)

    def _held(self, name: str) -> TensorDictBase | Tensor:
        value = getattr(self, name)
        return getattr(value, "_param_td", value)  # TensorDictParams wraps each of its methods

    @property
    def in_sequence(self) -> bool:
        """Whether the members run one after the other; only TD(0) runs under vmap."""
        estimator = self._template._value_estimator
        if estimator is not None and not isinstance(estimator, TD0Estimator):
            return True
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
                # Python finds these before the module's own, which stay in place.
                owner.__dict__[attribute] = value
            yield template
        finally:
            for owner, attribute in held:
                owner.__dict__.pop(attribute, None)


def _passed_on(template: LossModule, name: str) -> bool:
    """Whether an attribute is one of the members: a coefficient, an option or a network."""
    if name == "gamma" or name in getattr(template, "_coefficients", ()):
        return hasattr(template, name)
    return name in vars(template) and not name.startswith("_") and name != "training"
