"""The contract of the losses, as test classes."""

from __future__ import annotations

from typing import ClassVar

import pytest

from torchrl_bmrl.objectives import OfflineLoss
from torchrl_bmrl.testing.case import Case
from torchrl_bmrl.testing.contract.claims import ClaimChecks, OfflineClaimChecks
from torchrl_bmrl.testing.contract.compiled import CompileChecks
from torchrl_bmrl.testing.contract.critics import CriticChecks, EnsembleChecks
from torchrl_bmrl.testing.contract.estimators import EstimatorChecks
from torchrl_bmrl.testing.contract.gradients import GradientChecks, OfflineGradientChecks
from torchrl_bmrl.testing.contract.keys import KeyChecks
from torchrl_bmrl.testing.contract.reduction import OfflineReductionChecks, ReductionChecks
from torchrl_bmrl.testing.contract.refusals import OfflineRefusalChecks, RefusalChecks
from torchrl_bmrl.testing.contract.state import OfflineStateChecks, StateChecks


class KeyedLossContract(
    KeyChecks,
    ReductionChecks,
    GradientChecks,
    EnsembleChecks,
    StateChecks,
    CompileChecks,
    RefusalChecks,
    ClaimChecks,  # pytest runs the last one first
):
    """What every :class:`~torchrl_bmrl.objectives.KeyedLoss` must do.

    Derive a test class from it for a loss without critics; for other losses use
    :class:`OfflineLossContract`.

    Attributes:
        case: the loss and its properties.

    Example:
        >>> from torchrl_bmrl.objectives import MetaDistillationLoss
        >>> def make_networks(): ...  # by the names of the loss's arguments
        >>> class TestMyLoss(KeyedLossContract):
        ...     case = Case(MetaDistillationLoss, make_networks, trains={"generator": {"student"}})
    """

    case: Case
    pytestmark: ClassVar = [pytest.mark.filterwarnings("ignore:No target network updater")]

    @pytest.fixture(name="case")
    def _case(self) -> Case:
        return self.case


class OfflineLossContract(
    OfflineReductionChecks,
    OfflineGradientChecks,
    CriticChecks,
    EstimatorChecks,
    OfflineStateChecks,
    OfflineRefusalChecks,
    OfflineClaimChecks,
    KeyedLossContract,
):
    """What every :class:`~torchrl_bmrl.objectives.OfflineLoss` must do.

    Derive a test class from it and give it a :class:`Case`. pytest then runs about ninety checks
    of keys, reductions, masks, priorities, gradients, targets, critics, value estimators, state,
    copies, dtypes, devices, compilation, and errors. It skips checks that need a GPU where there is
    none, and checks of a generator for a loss without one.

    Attributes:
        case: the loss and its properties.

    Example:
        >>> from torchrl_bmrl.modules import ActionVAE, make_qvalue_network
        >>> from torchrl_bmrl.objectives import BCQLoss
        >>> def make_networks():
        ...     return {"generator": ActionVAE(3, 2), "qvalue_network": make_qvalue_network(3, 2)}
        >>> class TestBCQLoss(OfflineLossContract):
        ...     case = Case(
        ...         BCQLoss,
        ...         make_networks,
        ...         trains={"generator": {"generator"}, "qvalue": {"qvalue_network"}},
        ...         targets={"qvalue_network"},
        ...         options={"bounds": (-1.0, 1.0)},
        ...     )
    """

    base = OfflineLoss
