"""Random rows of a batch: of the same task, of other tasks, and never of padding."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchrl_bmrl.objectives.task_rows import draw_others, draw_pairs, draw_rows, other_tasks

TASKS, ROWS = 3, 4
VALID = torch.tensor([[True, False, True, True], [False, True, False, True], [True] * 4])


def named_rows() -> Tensor:
    """An m for each row that names it: (task, row)."""
    task, row = torch.meshgrid(torch.arange(TASKS), torch.arange(ROWS), indexing="ij")
    return torch.stack([task, row], -1).double()


def repeated(draw: Callable[[], tuple[Tensor, ...]], number: int = 200) -> list[Tensor]:
    """The results of many draws, stacked along a new first dimension."""
    torch.manual_seed(0)
    return [torch.stack(each) for each in zip(*(draw() for _ in range(number)), strict=True)]


def test_another_row_of_the_task_is_every_row_of_it_but_the_row_itself() -> None:
    m = named_rows()
    near, _ = repeated(lambda: draw_others(m, None))
    assert (near[..., 0] == m[..., 0]).all()
    assert (near[..., 1] != m[..., 1]).all()
    for row in range(ROWS):
        assert set(near[:, 0, row, 1].tolist()) == {*range(ROWS)} - {row}


def test_the_only_row_of_a_task_is_its_own_other_row() -> None:
    m = named_rows()[:, :1]
    near, far = draw_others(m, None)
    assert torch.equal(near, m)
    assert (far[..., 0] != m[..., 0]).all()


@pytest.mark.parametrize("valid", [None, VALID], ids=["all", "masked"])
def test_a_row_of_another_task_is_any_row_of_any_other_task(valid: Tensor | None) -> None:
    m = named_rows()
    _, far = repeated(lambda: draw_others(m, valid))
    counting = m.flatten(0, 1) if valid is None else m[valid]
    for task in range(TASKS):
        drawn = {tuple(each) for each in far[:, task].flatten(0, 1).tolist()}
        assert drawn == {tuple(each) for each in counting[counting[:, 0] != task].tolist()}


def test_rows_that_a_mask_leaves_out_are_never_drawn_and_all_others_are() -> None:
    m = named_rows()
    near, _ = repeated(lambda: draw_others(m, VALID))
    (several,) = repeated(lambda: (draw_rows(m, VALID, 5),))
    assert several.shape[1:] == (TASKS, ROWS, 5, 2)
    for task in range(TASKS):
        expected = {tuple(each) for each in m[task][VALID[task]].tolist()}
        for drawn in (near[:, task], several[:, task]):
            assert {tuple(each) for each in drawn.flatten(0, -2).tolist()} == expected


@pytest.mark.parametrize("empty", [0, 1, 2])
def test_a_task_of_padding_alone_is_no_other_task_of_any(empty: int) -> None:
    m, valid = named_rows(), VALID.clone()
    valid[empty] = False
    _, far = repeated(lambda: draw_others(m, valid))
    for task in {0, 1, 2} - {empty}:
        (other,) = {0, 1, 2} - {empty, task}
        drawn = {tuple(each) for each in far[:, task].flatten(0, 1).tolist()}
        assert drawn == {tuple(each) for each in m[other][valid[other]].tolist()}


@pytest.mark.parametrize("valid", [None, VALID], ids=["all", "masked"])
def test_each_other_task_has_one_of_its_rows_in_turn(valid: Tensor | None) -> None:
    m = named_rows()
    near, far = repeated(lambda: draw_pairs(m, valid))
    counts = torch.ones(TASKS, ROWS, dtype=torch.bool) if valid is None else valid
    others = other_tasks(TASKS, m.device)
    assert others.tolist() == [[1, 2], [2, 0], [0, 1]]
    for task in range(TASKS):
        own = {tuple(each) for each in near[:, task].flatten(0, 1).tolist()}
        assert own == {tuple(each) for each in m[task][counts[task]].tolist()}
        for turn, other in enumerate(others[task]):
            drawn = {tuple(each) for each in far[:, task, :, turn].flatten(0, 1).tolist()}
            assert drawn == {tuple(each) for each in m[other][counts[other]].tolist()}
    assert (near != m)[:, counts].any(-1).all()
