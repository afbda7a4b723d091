"""Checks of gradients and targets: which parameters a term trains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import HardUpdate, SoftUpdate

from torchrl_bmrl.testing.case import CRITIC, Case
from torchrl_bmrl.testing.measures import (
    all_of,
    assert_same,
    by_method,
    gradients,
    network_of,
    reached,
    run,
    same,
    state,
    total,
)
from torchrl_bmrl.testing.wrappers import on_torso


def by_forward(loss: Any, term: str, data: TensorDict) -> Tensor:
    """One term of ``forward``."""
    return run(loss, data)[f"loss_{term}"]


def check_gradients(case: Case, through: Callable[[Any, str, TensorDict], Tensor]) -> None:
    """Fails unless the gradient of every term reaches exactly the parameters of its networks."""
    loss = case.make()
    for term, networks in case.trains.items():
        loss.zero_grad()
        through(loss, term, case.batch()).backward()
        found = reached(loss)
        assert found == set(networks), (
            f"loss_{term} sends gradients to {sorted(found)}; the case says {sorted(networks)}"
        )
        missed = [
            name
            for name, gradient in gradients(loss).items()
            if network_of(name) in networks and not gradient.any()
        ]
        assert not missed, f"loss_{term} sends no gradient to {missed}"
    trained = [
        name for name, p in loss.named_parameters() if name[:6] == "target" and p.requires_grad
    ]
    assert not trained, f"target networks require a gradient: {trained}"


class GradientChecks:
    """Checks of gradients, for every loss."""

    def test_only_losses_require_a_gradient(self, case: Case) -> None:
        """Trainers sum all keys ``loss_*``; detach the metrics."""
        for key, value in case.make()(case.batch()).items():
            assert value.requires_grad == key.startswith("loss_"), key

    def test_a_term_of_forward_sends_gradients_to_its_networks_alone(self, case: Case) -> None:
        """``frozen=True`` runs another network without training it."""
        check_gradients(case, by_forward)


class OfflineGradientChecks:
    """Checks of gradients and targets, for losses with critics."""

    def test_a_method_sends_gradients_to_its_networks_alone(self, case: Case) -> None:
        """``frozen=True`` runs another network without training it."""
        check_gradients(case, by_method)

    @pytest.mark.parametrize("separate", [True, False])
    def test_separate_losses_leave_a_shared_torso_to_the_generator(
        self, case: Case, separate: bool
    ) -> None:
        """It makes a difference only for losses with a generator."""
        if "generator" not in case.trains:
            pytest.skip("this loss has no generator that its networks could share a torso with")
        loss, torso, _ = on_torso(case, separate_losses=separate)
        other, *_ = on_torso(case, separate_losses=not separate)
        assert_same(run(loss, case.batch()), run(other, case.batch()), "with separate_losses")
        for term in case.trains:
            loss.zero_grad()
            by_method(loss, term, case.batch()).backward()
            moved = torso.weight.grad is not None and bool(torso.weight.grad.any())
            assert moved == (term == "generator" or not separate), term
            assert {*case.trains[term]} <= reached(loss) | {"generator"}, term

    @pytest.mark.parametrize("separate", [True, False])
    @pytest.mark.parametrize("sharing", ["all", "critics", "first"])
    def test_shared_parameters_are_trained_once_for_all(
        self, case: Case, separate: bool, sharing: str
    ) -> None:
        """An optimizer finds a shared parameter once, and every network uses it."""
        options: dict[str, Any] = {"separate_losses": separate, "sharing": sharing}
        loss, torso, networks = on_torso(case, **options)
        own = {id(p) for each in networks.values() for part in each for p in part.parameters()}
        trained = [p for p in loss.parameters() if p.requires_grad]
        assert len(trained) == len({id(p) for p in trained}) == len(own)
        assert {id(p) for p in trained} == own
        before = torso.weight.detach().clone()
        total(loss(case.batch())).backward()
        torch.optim.SGD(trained, lr=1.0).step()
        assert not torch.equal(torso.weight, before)
        holders = {
            name
            for name, params in loss.named_children()
            if any(value is torso.weight for value in params.parameters())
        }
        # An encoder of contexts reads no observation, but contexts.
        reading = {
            name
            for name, parts in networks.items()
            if any(hasattr(part, "torso") for part in parts)
        }
        readers = {CRITIC} if sharing == "critics" else all_of(case.trains) & reading
        assert holders == {f"{name}_params" for name in readers}, "who holds the shared torso"
        fresh, *_ = on_torso(case, **options, seed=1)
        fresh.load_state_dict(loss.state_dict(), strict=True)
        assert_same(run(fresh, case.batch()), run(loss, case.batch()), "with the state loaded")

    def test_an_optimizer_leaves_the_targets_to_the_updater(self, case: Case) -> None:
        """``SoftUpdate`` finds every target that ``convert_to_functional`` made."""
        loss = case.make()
        updater = SoftUpdate(loss, tau=0.1)
        before = state(loss)
        total(loss(case.batch())).backward()
        torch.optim.Adam(loss.parameters(), lr=0.1).step()
        trained = state(loss)
        moved = {network_of(key) for key in before if (before[key] != trained[key]).any()}
        assert moved == all_of(case.trains), "the optimizer moved others than the case's networks"
        updater.step()
        after = state(loss)
        for key, value in trained.items():
            if key.startswith("target_"):
                value = 0.9 * value + 0.1 * trained[key.removeprefix("target_")]
                assert not torch.equal(after[key], before[key]) or not value.is_floating_point()
            torch.testing.assert_close(after[key], value)

    def test_every_target_network_is_used(self, case: Case) -> None:
        """A target that no loss runs (``target=True``) is unnecessary, or a mistake."""
        for name in case.targets:
            loss = case.make()
            before = run(loss, case.batch())
            for value in getattr(loss, f"target_{name}_params").values(True, True):
                if value.is_floating_point():
                    value.data.add_(1.0)
            assert not same(run(loss, case.batch()), before), f"no loss runs the target of {name}"

    def test_a_hard_update_copies_the_networks_at_its_interval(self, case: Case) -> None:
        """``HardUpdate`` finds every target that ``convert_to_functional`` made."""
        loss = case.make()
        updater = HardUpdate(loss, value_network_update_interval=1)
        for parameter in loss.parameters():
            parameter.data.add_(1.0)

        def copied() -> set[bool]:
            children = dict(loss.named_children())
            names = [f"{name}_params" for name in case.targets]
            return {bool((children[f"target_{name}"] == children[name]).all()) for name in names}

        assert copied() == {False}
        updater.step()
        assert copied() == {False}
        updater.step()
        assert copied() == {True}
