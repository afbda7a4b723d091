"""Checks of the critics: an ensemble from a list or from a single critic."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.testing.case import CRITIC, Case
from torchrl_bmrl.testing.measures import gradients, run, same, state, total
from torchrl_bmrl.testing.wrappers import OnTorso, observation_of, on_torso, with_dropout

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


class EnsembleChecks:
    """Checks of ensembles, for every loss."""

    @pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_cuda)])
    def test_a_loop_instead_of_vmap_changes_nothing(self, case: Case, device: str) -> None:
        """On CPU the critics always run in a loop."""
        results, grads = [], []
        for deactivate_vmap in (False, True):
            loss = case.make(deactivate_vmap=deactivate_vmap).to(device)
            results.append(run(loss, case.batch().to(device)))
            total(results[-1]).backward()
            grads.append(gradients(loss))
        one, other = (result.detach().to_dict() for result in results)
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
        torch.testing.assert_close(*grads, rtol=0, atol=1e-12)

    @pytest.mark.parametrize("randomness", [None, "different", "same"])
    def test_critics_may_hold_dropout(self, case: Case, randomness: str | None) -> None:
        """Random layers draw in a loss, also under :func:`torch.vmap`."""
        if not any(name.rstrip("s").endswith(CRITIC) for name in case.networks()):
            pytest.skip("this loss has no critics")
        loss, plain = case.make(edit=with_dropout), case.make()
        if randomness is not None:
            loss.set_vmap_randomness(randomness)
        losses = run(loss, case.batch())
        assert not same(losses, run(plain, case.batch()))
        total(losses).backward()
        assert same(run(loss.eval(), case.batch()), run(plain, case.batch())), "eval() has dropout"
        assert same(run(loss.train(), case.batch()), losses), "train() has no dropout"


class CriticChecks:
    """Checks of the critics, for losses with critics."""

    @pytest.mark.parametrize("number", [1, 2, 3])
    def test_critics_of_a_list_keep_their_initialisations_and_are_trained(
        self, case: Case, number: int
    ) -> None:
        """``qvalue_network`` may be a list; pass it to ``convert_critics``."""
        critics = case.critics(number)
        values = [state(critic) for critic in critics]
        count = len(list(critics[0].parameters()))
        loss = case.make(critics=critics)
        assert loss.num_qvalue_nets == number
        for index, value in enumerate(values):
            params = loss.critic(index)[1].flatten_keys(".")
            assert all(torch.equal(params[key], entry) for key, entry in value.items())
        result, info = loss.qvalue_loss(case.batch())
        assert info["td_error"].shape == (number, *case.shape)
        result.backward()
        own = [g for name, g in gradients(loss).items() if name.startswith(f"{CRITIC}_params.")]
        assert len(own) >= count
        assert all(gradient.any() for gradient in own)

    @pytest.mark.parametrize("shared", [False, True])
    @pytest.mark.parametrize("number", [1, 2])
    def test_critics_compute_what_the_given_networks_do(
        self, case: Case, shared: bool, number: int
    ) -> None:
        """The loss's parameters, frozen or not, give the values of the given networks."""
        data = case.batch()
        if shared:
            loss, _, networks = on_torso(case, num_critics=number, separate_losses=True)
            critics = networks[CRITIC]
        else:
            critics = case.critics(number)
            loss = case.make(critics=critics)
        key = critics[0].out_keys[-1]
        expected = torch.stack([critic(data.clone())[key] for critic in critics])
        assert torch.equal(loss.evaluate(data, key), expected)
        assert torch.equal(loss.evaluate(data, key, frozen=True), expected)
        assert not torch.equal(loss.evaluate(data, key, target=True), expected)
        for index, critic in enumerate(critics):
            module, params = loss.critic(index)
            with params.to_module(module, preserve_module_state=False):
                assert torch.equal(module(data.clone())[key], critic(data.clone())[key])

    def test_a_single_critic_is_copied_with_new_initialisations(self, case: Case) -> None:
        """This needs ``reset_parameters`` in the critic's layers."""
        (critic,) = case.critics(1)
        given = state(critic)
        loss = case.make(critics=critic, num_qvalue_nets=3)
        values = [loss.critic(index)[1].flatten_keys(".").data for index in range(3)]
        assert all(torch.equal(values[0][key], value) for key, value in given.items())
        for key in (key for key, value in given.items() if value.ndim > 1):
            assert len(torch.stack([value[key] for value in values]).unique(dim=0)) == 3, key
        assert loss.qvalue_loss(case.batch())[1]["td_error"].shape == (3, *case.shape)

    def test_critics_that_cannot_be_taken_are_refused(self, case: Case) -> None:
        """Pass ``qvalue_network`` and ``num_qvalue_nets`` to ``convert_critics``."""
        critics = case.critics(2)
        with pytest.raises(BMRLError, match=r"list of 0 critics.*valid: at least one critic"):
            case.make(critics=[])
        with pytest.raises(BMRLError, match=r"2 critics and num_qvalue_nets is 3; valid: .*number"):
            case.make(critics=critics, num_qvalue_nets=3)
        with pytest.raises(BMRLError, match="num_qvalue_nets is 0; valid: at least 1"):
            case.make(critics=critics[0], num_qvalue_nets=0)
        key, size = observation_of(case)
        torso = nn.Linear(size, size, dtype=torch.float64)
        lasting = OnTorso(critics[0], torso, key)  # with a parameter that nothing resets
        with pytest.raises(BMRLError, match=r"OnTorso, has no reset_parameters.*valid: a list"):
            case.make(critics=lasting, num_qvalue_nets=2)
