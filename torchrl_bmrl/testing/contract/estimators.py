"""Checks of the value estimators, which compute the critics' target."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.value import TD0Estimator, TDLambdaEstimator

from torchrl_bmrl.testing.case import Case
from torchrl_bmrl.testing.measures import total

GAMMA = 0.99  # not exact in float32


def next_values(*shape: int) -> Tensor:
    """Values of the next states."""
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def lambda_return(data: TensorDict, value: Tensor, lmbda: float) -> Tensor:
    """Backward recursion over the last dimension; the end of an episode uses the bootstrap only."""
    reward, done, terminated = (
        data["next", key].squeeze(-1) for key in ("reward", "done", "terminated")
    )
    result = torch.zeros_like(reward)
    after = value[:, -1]
    for t in reversed(range(reward.shape[1])):
        mixed = (1 - lmbda) * value[:, t] + lmbda * after
        bootstrap = torch.where(done[:, t], value[:, t], mixed)
        bootstrap = torch.where(terminated[:, t], 0.0, bootstrap)
        result[:, t] = after = reward[:, t] + GAMMA * bootstrap
    return result


class EstimatorChecks:
    """Checks of value estimators, for losses with critics."""

    @pytest.mark.parametrize(
        ("estimator", "lmbda"),
        [
            (None, 0.0),
            (ValueEstimators.TD0, 0.0),
            (ValueEstimators.TD1, 1.0),
            (ValueEstimators.TDLambda, 0.8),
        ],
    )
    def test_target_is_that_of_the_estimator(
        self, case: Case, estimator: ValueEstimators | None, lmbda: float
    ) -> None:
        """The last dimension of the batch is time."""
        data, value = case.batch(3, 5), next_values(3, 5)
        loss = case.make(gamma=GAMMA if estimator is None else 0.5)
        if estimator is not None:
            options = {"lmbda": lmbda} if estimator is ValueEstimators.TDLambda else {}
            assert loss.make_value_estimator(estimator, gamma=GAMMA, **options) is loss
        assert loss.value_estimator.gamma.item() == GAMMA
        target = loss.td_target(data, value.clone().requires_grad_())
        assert not target.requires_grad
        expected = lambda_return(data, value, lmbda)
        torch.testing.assert_close(target, expected, rtol=1e-12, atol=0)
        total(loss(data)).backward()

    @pytest.mark.parametrize("estimator", [None, ValueEstimators.TD0, ValueEstimators.TDLambda])
    def test_gamma_follows_the_estimator(
        self, case: Case, estimator: ValueEstimators | None
    ) -> None:
        """``loss.gamma`` is the discount of the target."""
        loss = case.make(gamma=0.5)
        assert float(loss.gamma) == 0.5
        loss.make_value_estimator(estimator, gamma=0.9)
        assert float(loss.gamma) == 0.9
        loss.make_value_estimator(estimator)
        assert float(loss.gamma) == loss.value_estimator.gamma.item() == 0.9

    @pytest.mark.parametrize("instance", [False, True])
    def test_an_estimator_of_the_user_gives_the_target(self, case: Case, instance: bool) -> None:
        """A class or an instance of TorchRL's, made with ``value_network=None``."""
        data, value = case.batch(), next_values(*case.shape)
        expected = case.make(gamma=0.5).td_target(data, value)
        loss = case.make(gamma=0.1)
        if instance:
            estimator = TD0Estimator(gamma=0.5, value_network=None)
            assert loss.make_value_estimator(estimator) is loss
        else:
            assert loss.make_value_estimator(TD0Estimator, gamma=0.5, value_network=None) is loss
        assert torch.equal(loss.td_target(data, value), expected)

    def test_an_estimator_of_the_user_reads_the_renamed_keys(self, case: Case) -> None:
        """``set_keys`` before and after ``make_value_estimator``."""
        loss = case.make()
        loss.set_keys(reward="prize")
        loss.make_value_estimator(TDLambdaEstimator(gamma=GAMMA, lmbda=0.8, value_network=None))
        assert loss.value_estimator.tensor_keys.reward == "prize"
        loss.set_keys(reward="score")
        assert loss.value_estimator.tensor_keys.reward == "score"

    def test_n_step_data_bootstrap_with_the_discount_of_their_steps(self, case: Case) -> None:
        """``steps_to_next_obs`` is the number of steps to the next state."""
        data, value = case.batch(), next_values(*case.shape)
        expected = case.make(gamma=GAMMA**3).td_target(data, value)
        data["steps_to_next_obs"] = torch.full((*case.shape, 1), 3)
        torch.testing.assert_close(case.make(gamma=GAMMA).td_target(data, value), expected)

    def test_estimators_that_make_no_sense_are_refused(self, case: Case) -> None:
        """Generalised advantage estimation needs on-policy data; the error names valid ones."""
        with pytest.raises(NotImplementedError, match=r"TD0.*TD1.*TDLambda"):
            case.make().make_value_estimator(ValueEstimators.GAE)
