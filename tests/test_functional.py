"""Every equation against an independent computation in numpy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Normal, kl_divergence

from torchrl_bmrl import functional


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def close(result: Tensor, expected: np.ndarray) -> None:
    assert result.dtype == torch.float64
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("batch", [(), (5,), (2, 4)])
def test_gaussian_kl_is_that_of_torch_distributions_per_dimension(
    batch: tuple[int, ...], rng: np.random.Generator
) -> None:
    loc = torch.as_tensor(rng.normal(size=(*batch, 4)))
    scale = torch.as_tensor(np.exp(rng.normal(size=(*batch, 4))))
    expected = kl_divergence(Normal(loc, scale), Normal(torch.zeros(()), torch.ones(())))
    close(functional.gaussian_kl(loc, scale), expected.numpy())


def test_gaussian_kl_has_its_minimum_of_zero_at_the_standard_normal() -> None:
    loc = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    scale = torch.ones(3, dtype=torch.float64, requires_grad=True)
    divergence = functional.gaussian_kl(loc, scale)
    divergence.sum().backward()
    for value in (divergence, loc.grad, scale.grad):
        assert value.eq(0).all()


@pytest.mark.parametrize("clip", [0.5, torch.tensor(0.5)])
def test_action_latent_is_a_standard_normal_clipped_at_the_bound(clip: float | Tensor) -> None:
    torch.manual_seed(0)
    free = functional.sample_action_latent((2000, 4), latent_clip=None)
    torch.manual_seed(0)
    clipped = functional.sample_action_latent((2000, 4), latent_clip=clip)
    assert abs(free.mean()) < 0.05
    assert abs(free.std() - 1) < 0.05
    assert free.abs().max() > 3
    assert torch.equal(clipped, free.clamp(-0.5, 0.5))


def test_action_latent_has_the_dtype_asked_for() -> None:
    latent = functional.sample_action_latent((3,), latent_clip=0.5, dtype=torch.float64)
    assert latent.dtype == torch.float64


def test_perturbed_action_is_moved_by_phi_and_clipped_per_dimension(
    rng: np.random.Generator,
) -> None:
    action, perturbation = rng.uniform(-1, 1, (2, 50, 3))
    low, high = np.array([-0.5, -1.0, -0.2]), np.array([0.5, 1.0, 0.9])
    moved = action + 0.3 * (high - low) / 2 * perturbation
    expected = np.minimum(np.maximum(moved, low), high)
    assert (expected == low).any()
    assert (expected == high).any()
    result = functional.perturbed_action(
        *(torch.as_tensor(x) for x in (action, perturbation)),
        0.3,
        *map(torch.as_tensor, (low, high)),
    )
    close(result, expected)


@pytest.mark.parametrize("largest", [0.01, 1.0, 400.0])
def test_perturbation_has_the_published_share_of_the_largest_action(
    largest: float, rng: np.random.Generator
) -> None:
    # As published: (a + phi * max_action * tanh(...)) clipped to +-max_action.
    action, output = largest * rng.uniform(-1, 1, (1000, 3)), rng.normal(size=(1000, 3))
    expected = np.clip(action + 0.05 * largest * np.tanh(output), -largest, largest)
    bound = torch.tensor(largest, dtype=torch.float64)
    perturbation = torch.as_tensor(output).tanh()
    result = functional.perturbed_action(torch.as_tensor(action), perturbation, 0.05, -bound, bound)
    close(result, expected)
    assert (result.abs() == bound).double().mean() < 0.05


@pytest.mark.parametrize("lmbda", [0.0, 0.75, 1.0])
def test_soft_clipped_value_mixes_minimum_and_maximum(
    lmbda: float, rng: np.random.Generator
) -> None:
    q = rng.normal(size=(3, 5, 7))
    expected = lmbda * q.min(0) + (1 - lmbda) * q.max(0)
    close(functional.soft_clipped_value(torch.as_tensor(q), lmbda), expected)


def test_next_value_is_the_best_mixed_candidate(rng: np.random.Generator) -> None:
    q = rng.normal(size=(3, 2, 5, 10))
    mixed = 0.75 * q.min(0) + 0.25 * q.max(0)
    close(functional.bcq_next_value(torch.as_tensor(q), 0.75), mixed.max(-1))


def test_next_value_takes_the_maximum_over_candidates_after_the_mix() -> None:
    # Critics disagree on the first candidate and agree on the second.
    q = torch.tensor([[0.0, 3.0], [8.0, 3.0]], dtype=torch.float64)
    # After the mix: max(0.75*0 + 0.25*8, 3) = 3. Before: 0.75*min(3, 8) + 0.25*max(3, 8) = 4.25.
    assert functional.bcq_next_value(q, 0.75).item() == 3.0


def test_squared_error_is_the_squared_distance(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 4, 6, 3))
    close(
        functional.squared_error(torch.as_tensor(a), torch.as_tensor(b)),
        np.linalg.norm(a - b, axis=-1) ** 2,
    )


def test_direction_error_is_one_minus_the_cosine(rng: np.random.Generator) -> None:
    a, b = rng.normal(size=(2, 4, 6, 3))
    cosine = (a * b).sum(-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    close(functional.direction_error(torch.as_tensor(a), torch.as_tensor(b)), 1 - cosine)


@pytest.mark.parametrize(("factor", "expected"), [(3.0, 0.0), (-0.5, 2.0)])
def test_direction_error_ignores_length(factor: float, expected: float) -> None:
    a = torch.tensor([0.3, -0.4, 1.2], dtype=torch.float64)
    assert functional.direction_error(factor * a, a).item() == pytest.approx(expected, abs=1e-12)


def test_direction_error_of_a_zero_action_is_finite_with_its_gradient() -> None:
    action = torch.zeros(3, requires_grad=True)
    error = functional.direction_error(action, torch.ones(3))
    error.backward()
    assert error.item() == 1.0
    assert action.grad.isfinite().all()


@pytest.mark.parametrize("threshold", [0.0, 0.3, 1.0])
def test_likely_actions_are_those_near_the_likeliest(
    threshold: float, rng: np.random.Generator
) -> None:
    logits = rng.normal(size=(2, 50, 4))
    probability = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    expected = probability / probability.max(-1, keepdims=True) > threshold
    if threshold == 1:  # no ratio is above one, but the likeliest action is always allowed
        assert not expected.any()
        expected = probability == probability.max(-1, keepdims=True)
    result = functional.likely_actions(torch.as_tensor(logits), threshold)
    assert result.dtype == torch.bool
    assert np.array_equal(result.numpy(), expected)


def test_likely_actions_of_extreme_logits_are_never_none() -> None:
    logits = torch.tensor([[1e4, -1e4], [-1e4, -1e4], [0.0, -torch.inf]])
    for threshold in (0.0, 0.3, 1.0):
        likely = functional.likely_actions(logits, threshold)
        assert likely.tolist() == [[True, False], [True, True], [True, False]]


def test_triplet_error_is_the_hinge_of_the_two_distances(rng: np.random.Generator) -> None:
    a, near, far = rng.normal(size=(3, 4, 6, 3))
    distance = [np.linalg.norm(a - x, axis=-1) for x in (near, far)]
    expected = np.maximum(0, distance[0] - distance[1] + 0.5)
    assert (expected == 0).any()
    result = functional.triplet_error(*map(torch.as_tensor, (a, near, far)), 0.5)
    # PyTorch adds 1e-6 to every difference, so that the root has a gradient at zero.
    np.testing.assert_allclose(result, expected, atol=1e-5)


def test_triplet_error_of_equal_embeddings_is_the_margin_with_a_finite_gradient() -> None:
    m = torch.zeros(2, 3, requires_grad=True)
    error = functional.triplet_error(m, m, m, 0.7)
    error.sum().backward()
    torch.testing.assert_close(error.detach(), torch.full((2,), 0.7))
    assert m.grad.isfinite().all()


@pytest.mark.parametrize(
    ("equation", "shapes"),
    [
        (lambda loc, log_scale: functional.gaussian_kl(loc, log_scale.exp()), [(2, 3), (2, 3)]),
        (
            lambda a, p: functional.perturbed_action(
                a, p, 0.05, -a.new_tensor(9.0), a.new_tensor(9.0)
            ),
            [(2, 3), (2, 3)],
        ),
        (lambda q: functional.bcq_next_value(q, 0.75), [(2, 3, 4)]),
        (functional.squared_error, [(2, 3), (2, 3)]),
        (functional.direction_error, [(2, 3), (2, 3)]),
    ],
)
def test_gradients_are_those_of_finite_differences(
    equation: Callable[..., Tensor], shapes: list[tuple[int, ...]]
) -> None:
    generator = torch.Generator().manual_seed(0)
    inputs = [
        torch.randn(shape, dtype=torch.float64, generator=generator).requires_grad_()
        for shape in shapes
    ]
    assert torch.autograd.gradcheck(equation, inputs)
