"""The part of TorchRL's contract that does not depend on what a loss learns."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_bmrl.errors import UnknownNameError

REDUCTIONS = ("mean", "sum", "none")


class KeyedLoss(LossModule):
    """Base of all losses here: keys that are read and written, coefficients, and the reduction.

    A subclass says what it reads and writes (:meth:`read_keys`, :meth:`written_keys`) and ends its
    construction with :meth:`keep_keys`.

    Keyword Args:
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        deactivate_vmap: run ensembles in a loop and not under :func:`torch.vmap`.
        use_prioritized_weights: ``True``, ``False`` or ``"auto"``, as in TorchRL's losses.

    Raises:
        UnknownNameError: for another ``reduction``.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> from torchrl_bmrl.objectives import BCQLoss
        >>> loss = BCQLoss(ActionVAE(3, 2), make_qvalue_network(3, 2), bounds=(-1.0, 1.0))
        >>> loss.set_keys(reward="points")
        >>> ("next", "points") in loss.in_keys, loss.out_keys[:2]
        (True, ['loss_generator', 'loss_qvalue'])
    """

    def __init__(
        self, *, reduction: str, deactivate_vmap: bool, use_prioritized_weights: str | bool
    ) -> None:
        super().__init__()
        if reduction not in REDUCTIONS:
            raise UnknownNameError("reduction", reduction, REDUCTIONS)
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[str] | None = None
        self.reduction = reduction
        self.deactivate_vmap = deactivate_vmap
        self.use_prioritized_weights = use_prioritized_weights

    def register_coefficients(self, **values: float | None) -> None:
        """Makes hyper-parameters buffers of the networks' type and device; ``None`` stays so.

        Args:
            **values: hyper-parameters by name.
        """
        reference = next(self.parameters())
        for name, value in values.items():
            self.register_coeff_buffer(name, value, device=reference.device, dtype=reference.dtype)

    def keep_keys(self) -> None:
        """Ends the construction: what would be found at the first call is found now.

        Found then, a compiled loss would compile a second time.
        """
        self.set_vmap_randomness(self.vmap_randomness)
        self._in_keys, self._out_keys = self.in_keys, self.out_keys

    def _make_vmap(self) -> None:
        """Nothing is cached that ``set_vmap_randomness`` would have to renew."""

    # -- keys ------------------------------------------------------------------------------------

    def read_keys(self) -> Iterable[NestedKey]:
        """Keys that the loss reads, in a stable order; duplicates are dropped."""
        raise NotImplementedError

    def written_keys(self) -> list[str]:
        """Keys that ``forward`` returns, in order."""
        raise NotImplementedError

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys read from the input, in a stable order."""
        if self._in_keys is None:
            self._in_keys = list(dict.fromkeys(self.read_keys()))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[str]:
        """Keys of the output, in the order of keyword dispatch."""
        if self._out_keys is None:
            self._out_keys = self.written_keys()
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[str]) -> None:
        self._out_keys = values

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        self._in_keys = None
        if self._out_keys is not None:  # construction is over
            self._in_keys = self.in_keys

    # -- reduction -------------------------------------------------------------------------------

    def _maybe_get_priority_weight(self, tensordict: TensorDictBase) -> Tensor | None:
        # TorchRL's own does not find a nested key.
        if self.use_prioritized_weights not in (True, "auto"):
            return None
        return tensordict.get(self.tensor_keys.priority_weight, None)

    def reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Reduces a loss with the data's masks and priority weights.

        Args:
            loss: of each row, ``(*B,)``.
            tensordict: the data.

        Returns:
            ``()``; with ``reduction="none"`` a number for each row that the masks leave.
        """
        weights = self._maybe_get_priority_weight(tensordict)
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights)
