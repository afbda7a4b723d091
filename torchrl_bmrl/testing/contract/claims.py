"""Checks that the case describes its loss correctly."""

from __future__ import annotations

from typing import ClassVar

import pytest

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives import KeyedLoss, OfflineLoss
from torchrl_bmrl.testing.case import Case


class ClaimChecks:
    """Checks of the case, for every loss."""

    base: ClassVar[type[KeyedLoss]] = KeyedLoss

    def test_a_case_says_what_its_loss_offers(self, case: Case) -> None:
        """``trains`` names the terms of ``forward``, ``targets`` the networks with a target."""
        loss = case.make()
        fitting = OfflineLoss if isinstance(loss, OfflineLoss) else KeyedLoss
        assert isinstance(loss, KeyedLoss), f"{type(loss).__name__} does not derive from KeyedLoss"
        assert self.base is fitting, (
            f"{type(loss).__name__} derives from {fitting.__name__}: derive the test class from "
            f"{fitting.__name__}Contract"
        )
        terms = [key.removeprefix("loss_") for key in loss.out_keys if key.startswith("loss_")]
        assert set(terms) == set(case.trains), "the case's trains and the loss's loss_* differ"
        lacking = [key for key in loss.in_keys if case.batch().get(key, None) is None]
        assert not lacking, f"the loss reads {lacking}, which the case's data lack"
        found = {name for name, _ in loss.named_children() if name.startswith("target_")}
        targets = {f"target_{name}_params" for name in case.targets}
        assert found == targets, "the case's targets and the loss's target networks differ"


class OfflineClaimChecks:
    """Checks of the methods, for losses with critics."""

    def test_every_term_has_a_method_and_other_methods_refuse(self, case: Case) -> None:
        """TorchRL treats every public method whose name ends in ``loss`` as a term."""
        loss = case.make()
        methods = {name[:-5] for name in dir(loss) if name.endswith("_loss") and name[0] != "_"}
        missing = sorted(case.trains.keys() - methods)
        assert not missing, f"the loss has no methods {[f'{name}_loss' for name in missing]}"
        for name in methods - case.trains.keys():  # of a network that this loss does not have
            with pytest.raises(BMRLError):
                getattr(loss, f"{name}_loss")(case.batch())
