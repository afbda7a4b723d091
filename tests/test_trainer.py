"""TorchRL's Trainer over a fixed buffer: what docs/trainer.md shows and what it says."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from helpers import NO_UPDATER, state
from torchrl.objectives import HardUpdate
from torchrl.trainers import ReplayBufferTrainer, TargetNetUpdaterHook

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)

PAGE = Path(__file__).parents[1] / "docs" / "trainer.md"


@pytest.fixture(scope="module")
def page() -> SimpleNamespace:
    """What the page defines."""
    namespace: dict[str, Any] = {"__name__": "example"}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No target network updater")
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
            exec(compile(block, PAGE.name, "exec"), namespace)
    return SimpleNamespace(**namespace)


def seeded(page: SimpleNamespace, folder: Path, rounds: int) -> Any:
    torch.manual_seed(0)
    return page.make_trainer(folder, rounds, updates=3)


def assert_equal(one: Any, other: Any) -> None:
    torch.testing.assert_close(state(one.loss_module), state(other.loss_module), rtol=0, atol=0)


def test_a_trainer_that_loads_a_checkpoint_goes_on_as_if_it_had_never_stopped(
    page: SimpleNamespace, tmp_path: Path
) -> None:
    whole = seeded(page, tmp_path / "whole", 4)
    whole.train()
    seeded(page, tmp_path / "parts", 2).train()
    rest = page.make_trainer(tmp_path / "parts", 4, updates=3)
    rest.load_from_file(tmp_path / "parts" / "trainer")
    rest.train()
    assert (rest.collected_frames, rest._optim_count) == (4 * 3 * 64, 4 * 3)
    assert_equal(rest, whole)
    for rows in ("loss_qvalue", "return"):  # logged once per round, in one file
        log = tmp_path / "parts" / "bcq" / "scalars" / f"{rows}.csv"
        assert [int(row.split(",")[0]) for row in log.read_text().split()] == [192, 384, 576, 768]


def test_evaluation_changes_nothing_in_training(page: SimpleNamespace, tmp_path: Path) -> None:
    trainers = [seeded(page, tmp_path / "one", 2), seeded(page, tmp_path / "other", 2)]
    trainers[1]._post_steps_log_ops.clear()
    for trainer in trainers:
        torch.manual_seed(1)
        trainer.train()
    assert_equal(*trainers)


def test_the_stepper_takes_the_losses_in_published_order_each_with_its_own_networks(
    page: SimpleNamespace, tmp_path: Path
) -> None:
    trainer, by_hand = (seeded(page, tmp_path / name, 1) for name in ("trainer", "hand"))
    loss = by_hand.loss_module
    optimizers = {
        "generator": torch.optim.Adam(loss.generator_params.parameters(), lr=1e-3),
        "qvalue": torch.optim.Adam(loss.qvalue_network_params.parameters(), lr=1e-3),
    }
    torch.manual_seed(1)
    trainer.train()
    torch.manual_seed(1)
    for _ in range(3):
        batch = page.buffer.sample()
        for name, optimizer in optimizers.items():
            optimizer.zero_grad()
            getattr(loss, f"{name}_loss")(batch)[0].backward()
            optimizer.step()
        by_hand.target_net_updater.step()
    assert_equal(trainer, by_hand)


def test_a_checkpoint_holds_tensors_and_json_without_pickle_and_without_the_buffer(
    page: SimpleNamespace, tmp_path: Path
) -> None:
    trainer = seeded(page, tmp_path, 1)
    trainer.train()
    files = [path for path in (tmp_path / "trainer").rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".memmap"}
    assert "replay_buffer" not in trainer.checkpoint.components
    with pytest.warns(FutureWarning, match="post_loss"):
        ReplayBufferTrainer(page.buffer).register(trainer)
    assert "replay_buffer" in trainer.checkpoint.components


def test_a_trainer_that_is_loaded_at_its_end_runs_one_more_round(
    page: SimpleNamespace, tmp_path: Path
) -> None:
    seeded(page, tmp_path, 2).train()
    again = page.make_trainer(tmp_path, 2, updates=3)
    again.load_from_file(tmp_path / "trainer")
    again.train()
    assert again.collected_frames == 3 * 3 * 64


def test_the_hook_of_targets_registers_itself_once_per_round(
    page: SimpleNamespace, tmp_path: Path
) -> None:
    trainer = seeded(page, tmp_path, 1)
    hook = TargetNetUpdaterHook(trainer.target_net_updater)
    hook.register(trainer, "targets")
    assert [op.__wrapped__ for op, _ in trainer._post_steps_ops] == [hook]


def test_a_hard_update_with_interval_n_copies_at_every_n_plus_first_step(
    page: SimpleNamespace, tmp_path: Path
) -> None:
    loss = seeded(page, tmp_path, 1).loss_module
    updater = HardUpdate(loss, value_network_update_interval=3)
    copied = []
    for step in range(1, 13):
        with torch.no_grad():
            for parameter in loss.qvalue_network_params.parameters():
                parameter.add_(1)
        updater.step()
        target = loss.target_qvalue_network_params.values(True, True)
        pairs = zip(target, loss.qvalue_network_params.values(True, True), strict=True)
        if all(torch.equal(x, y) for x, y in pairs):
            copied.append(step)
    assert copied == [4, 8, 12]
