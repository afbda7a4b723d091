"""The terms that arrange tasks are their papers' equations, in numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from torchrl_bmrl.contrast import contrastive_error, distance_error

SHAPE = (3, 5, 4)


def points(seed: int = 0, *shape: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape or SHAPE, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("power", [1.0, 2.0, 3.0])
@pytest.mark.parametrize("epsilon", [0.1, 1.0])
def test_the_distance_is_equation_13_of_focal(power: float, epsilon: float) -> None:
    a, near, far = (points(seed) for seed in range(3))
    found = distance_error(a, near, far, power=power, epsilon=epsilon)
    x, y, z = (each.numpy() for each in (a, near, far))
    same = np.linalg.norm(x - y, axis=-1) ** 2
    other = 1 / (np.linalg.norm(x - z, axis=-1) ** power + epsilon)
    np.testing.assert_allclose(found, same + other, rtol=1e-9)


def test_the_distance_in_numbers() -> None:
    a, near, far = (torch.tensor(x) for x in ([0.0, 0.0], [3.0, 4.0], [0.0, 2.0]))
    assert distance_error(a, near, far).item() == pytest.approx(25 + 1 / 4.1)
    assert distance_error(a, a, a).item() == pytest.approx(10.0)


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_equal_points_have_a_finite_gradient(power: float) -> None:
    a = points().requires_grad_()
    distance_error(a, a.detach().clone(), a.detach().clone(), power=power).sum().backward()
    assert a.grad is not None
    assert a.grad.isfinite().all()


def test_the_distance_pulls_the_same_task_and_pushes_another() -> None:
    a = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    near, far = torch.tensor([[1.0, 0.0]]).double(), torch.tensor([[0.0, 1.0]]).double()
    distance_error(a, near, far).sum().backward()
    assert a.grad is not None
    step = -a.grad[0]
    assert step[0] > 0  # towards the same task
    assert step[1] < 0  # away from the other


@pytest.mark.parametrize("temperature", [0.05, 0.1, 1.0])
def test_infonce_is_the_cross_entropy_of_the_cosines(temperature: float) -> None:
    a, near = points(0), points(1)
    found = contrastive_error(a, near, temperature)
    assert found.shape == SHAPE[:2]
    for row in range(SHAPE[1]):
        cosines = F.cosine_similarity(a[:, None, row], near[None, :, row], dim=-1)
        expected = F.cross_entropy(cosines / temperature, torch.arange(3), reduction="none")
        torch.testing.assert_close(found[:, row], expected)


def test_infonce_of_points_that_say_nothing_is_the_logarithm_of_the_tasks() -> None:
    same = torch.ones(SHAPE, dtype=torch.float64)
    torch.testing.assert_close(
        contrastive_error(same, same, 0.1), torch.full(SHAPE[:2], math.log(3)).double()
    )


def test_infonce_knows_no_length() -> None:
    a, near = points(0), points(1)
    lengths = torch.rand(3, 5, 1, dtype=torch.float64) + 0.1
    torch.testing.assert_close(
        contrastive_error(lengths * a, 5 * near, 0.1), contrastive_error(a, near, 0.1)
    )


def test_infonce_does_not_depend_on_the_order_of_the_tasks() -> None:
    order = torch.tensor([2, 0, 1])
    a, near = points(0), points(1)
    torch.testing.assert_close(
        contrastive_error(a[order], near[order], 0.1), contrastive_error(a, near, 0.1)[order]
    )


def test_infonce_recognises_a_task_among_those_that_are_compared() -> None:
    a, near = points(0), points(1)
    found = contrastive_error(a, near, 0.1, torch.tensor([True, False, True]))
    kept = [0, 2]
    torch.testing.assert_close(found[kept], contrastive_error(a[kept], near[kept], 0.1))
    assert found[1].isfinite().all()


def test_infonce_is_finite_at_zero_and_for_a_small_temperature() -> None:
    a = torch.zeros(SHAPE, requires_grad=True)
    contrastive_error(a, a, 0.1).sum().backward()
    assert a.grad is not None
    assert a.grad.isfinite().all()
    assert contrastive_error(points(0).float(), points(1).float(), 1e-6).isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_are_differentiable_in_the_type_of_the_points(dtype: torch.dtype) -> None:
    a, near, far = (points(seed).to(dtype).requires_grad_() for seed in range(3))
    for error in (distance_error(a, near, far), contrastive_error(a, near, 0.1)):
        assert error.dtype == dtype
    small = [points(seed, 2, 2, 3).requires_grad_() for seed in range(3)]
    assert torch.autograd.gradcheck(distance_error, small)
    assert torch.autograd.gradcheck(lambda *x: contrastive_error(*x, 0.5), small[:2])
