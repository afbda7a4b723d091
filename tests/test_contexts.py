"""Groups of a batch's rows as contexts, and which row gets which of them."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_bmrl.contrast import contrastive_error, distance_error
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.contexts import assign, group_rows
from torchrl_bmrl.objectives.task_rows import draw_others

TASKS, ROWS, SIZE = 3, 14, 4
COUNT = ROWS // SIZE
VALID = torch.arange(TASKS * ROWS).view(TASKS, ROWS) % 3 > 0
VALID[1] = torch.arange(ROWS) < 2  # two rows for three contexts
VALID[2] = False


def named() -> TensorDict:
    """Rows that name their task and their place."""
    task, row = torch.meshgrid(torch.arange(TASKS), torch.arange(ROWS), indexing="ij")
    return TensorDict({"row": torch.stack([task, row], -1)}, [TASKS, ROWS])


def grouped(seed: int, valid: Tensor | None = None, size: int = SIZE):
    torch.manual_seed(seed)
    contexts, own, filled = group_rows(named(), size, valid)
    return contexts["context"], own, filled


every_mask = pytest.mark.parametrize("valid", [None, VALID], ids=["all", "masked"])


@every_mask
def test_contexts_hold_different_rows_of_one_task(valid: Tensor | None) -> None:
    contexts, *_ = grouped(0, valid)
    assert contexts.shape == (TASKS, COUNT, SIZE)
    for task in range(TASKS):
        rows = contexts["row"][task].flatten(0, 1)
        assert (rows[:, 0] == task).all()
        assert len(rows.unique(dim=0)) == COUNT * SIZE


@every_mask
def test_each_row_knows_its_own_context(valid: Tensor | None) -> None:
    contexts, own, _ = grouped(1, valid)
    assert own.shape == (TASKS, ROWS)
    for task in range(TASKS):
        for number in range(COUNT):
            inside = set(contexts["row"][task, number, :, 1].tolist())
            assert set((own[task] == number).nonzero().flatten().tolist()) == inside
        assert (own[task] == COUNT).sum() == ROWS - COUNT * SIZE


def test_contexts_have_from_one_to_all_transitions() -> None:
    sizes = torch.cat([grouped(seed)[0]["mask"].sum(-1).flatten() for seed in range(50)])
    assert set(sizes.tolist()) == set(range(1, SIZE + 1))


def test_padding_is_in_no_context_that_has_a_row() -> None:
    for seed in range(50):
        contexts, _, filled = grouped(seed, VALID)
        assert filled.tolist() == [COUNT, 2, 0]
        task, row = contexts["row"].unbind(-1)
        counts = VALID[task, row]
        for i in range(TASKS):
            for number in range(COUNT):
                mask = contexts["mask"][i, number]
                assert mask.any()
                if number < filled[i]:
                    assert counts[i, number][mask].all()


def test_the_rows_that_count_are_spread_evenly() -> None:
    contexts, _, _ = grouped(0, VALID)
    task, row = contexts["row"].unbind(-1)
    number = VALID[task, row].sum(-1)[0]
    assert number.sum() == VALID[0].sum()
    assert number.max() - number.min() <= 1


def test_a_mask_that_leaves_no_row_out_leaves_all_contexts() -> None:
    _, _, filled = grouped(0, torch.ones(TASKS, ROWS, dtype=torch.bool))
    assert filled.tolist() == [COUNT] * TASKS


@every_mask
@pytest.mark.parametrize("apart", [True, False])
def test_a_row_gets_every_other_context_of_its_task_and_its_own_only_if_it_may(
    valid: Tensor | None, apart: bool
) -> None:
    seen: dict[tuple[int, int], set[int]] = {}
    for seed in range(150):
        _, own, filled = grouped(seed, valid)
        number = torch.arange(COUNT).expand(TASKS, COUNT)
        points = torch.stack([torch.arange(TASKS).unsqueeze(-1).expand(TASKS, COUNT), number], -1)
        chosen = assign(points, own, filled, apart=apart)
        assert (chosen[..., 0] == torch.arange(TASKS).unsqueeze(-1)).all()
        for task in range(TASKS):
            limit = COUNT if filled is None else int(filled[task])
            counting = torch.ones(ROWS, dtype=torch.bool) if valid is None else valid[task]
            for row in counting.nonzero().flatten().tolist():
                got, mine = int(chosen[task, row, 1]), int(own[task, row])
                assert got < limit  # never a context of padding alone
                seen.setdefault((task, mine), set()).add(got)
    for (task, mine), found in seen.items():
        limit = 2 if valid is not None and task == 1 else COUNT
        own_too = set() if apart and mine < COUNT else {mine} & set(range(limit))
        everything = set(range(limit)) - {mine} | own_too
        if mine == COUNT:  # in no context: it may get any, but need not get all
            assert found <= set(range(limit))
        else:
            assert found == everything


def test_the_only_row_of_a_task_gets_its_own_context() -> None:
    valid = torch.zeros(TASKS, ROWS, dtype=torch.bool)
    valid[:, 5] = True
    _, own, filled = grouped(0, valid)
    points = torch.arange(COUNT).view(1, COUNT, 1).expand(TASKS, COUNT, 1)
    assert (assign(points, own, filled, apart=True)[:, 5] == own[:, 5, None]).all()


@pytest.mark.parametrize("size", [8, 14, 100])
def test_fewer_rows_than_two_contexts_are_refused(size: int) -> None:
    with pytest.raises(BMRLError, match=f"14 rows .*context_size is {size}; valid: .*{2 * size}"):
        group_rows(named(), size)


@every_mask
def test_everything_lies_on_the_data_s_device(valid: Tensor | None) -> None:
    data = TensorDict({"x": torch.zeros(TASKS, ROWS, 2, device="meta")}, [TASKS, ROWS])
    contexts, own, filled = group_rows(data, SIZE, None if valid is None else valid.to("meta"))
    points = contexts["context", "x"].mean(2)
    latent = assign(points, own, filled, apart=True)
    near, far = draw_others(points, None if valid is None else valid[:, :COUNT].to("meta"))
    errors = distance_error(points, near, far), contrastive_error(points, near, 0.1)
    assert {each.device.type for each in (latent, near, far, *errors)} == {"meta"}
