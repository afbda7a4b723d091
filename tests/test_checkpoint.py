"""Checkpoints come back bit by bit, and the newest good one is found."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from checkpoint_files import META, checkpoint_path, network, same
from torch import nn

pytest.importorskip("safetensors")

from torchrl_bmrl.errors import CheckpointError
from torchrl_bmrl.training.checkpoint import (
    earlier,
    load_checkpoint,
    load_newest,
    load_state,
    save_checkpoint,
)

path = pytest.fixture(checkpoint_path)


# -- round trips -----------------------------------------------------------------------------------


def test_a_nested_state_comes_back_bit_by_bit(path: Path) -> None:
    base = torch.randn(4, 6)
    state = {
        "tensors": {
            "nan": torch.tensor([float("nan"), -0.0, float("inf")]),
            "double": torch.randn(3, dtype=torch.float64),
            "long": torch.tensor(2**53 + 1),
            "bool": torch.tensor([True, False]),
            "empty": torch.zeros(0, 3),
            "transposed": base.T,
            "a view": base[1:3],
            "the same": base,
            "and again": base,
        },
        "plain": [1, 2.5, None, True, "text", [], {}, {"nested": [torch.ones(2)]}],
        "by number": {0: {"step": torch.tensor(3.0)}, 7: "seven"},
    }
    save_checkpoint(path, state, META)
    loaded, metadata = load_checkpoint(path, kind="example")
    assert same(state, loaded)
    assert metadata.pop("versions")["torch"] == torch.__version__
    assert metadata == META


def training_state(net: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    return {
        "net": net.state_dict(),
        "optimizer": optimizer.state_dict(),
        "rng": torch.get_rng_state(),
    }


def train(net: nn.Module, optimizer: torch.optim.Optimizer, updates: int) -> None:
    for _ in range(updates):
        optimizer.zero_grad()
        (net(torch.randn(8, 3)) - torch.randn(8, 1)).square().mean().backward()
        optimizer.step()


def test_module_optimizer_and_random_state_come_back_bit_by_bit(path: Path) -> None:
    torch.manual_seed(0)
    net = network()
    optimizer = torch.optim.Adam(net.parameters(), lr=0.01, amsgrad=True)
    train(net, optimizer, 3)
    state = training_state(net, optimizer)
    save_checkpoint(path, state, META)
    loaded, _ = load_checkpoint(path, kind="example")
    assert same({**state, "net": dict(state["net"])}, loaded)
    other = network()
    load_state(other, loaded["net"], path)
    assert same(dict(net.state_dict()), dict(other.state_dict()))


def test_five_updates_and_five_more_equal_ten(path: Path) -> None:
    def fresh() -> tuple[nn.Module, torch.optim.Optimizer]:
        torch.manual_seed(0)
        net = network()
        return net, torch.optim.Adam(net.parameters(), lr=0.01)

    whole, optimizer = fresh()
    train(whole, optimizer, 10)

    net, optimizer = fresh()
    train(net, optimizer, 5)
    save_checkpoint(path, training_state(net, optimizer), META)

    torch.manual_seed(99)
    net = network()
    optimizer = torch.optim.Adam(net.parameters(), lr=0.5)
    loaded, _ = load_checkpoint(path, kind="example")
    load_state(net, loaded["net"], path)
    optimizer.load_state_dict(loaded["optimizer"])
    torch.set_rng_state(loaded["rng"])
    train(net, optimizer, 5)
    assert same(dict(whole.state_dict()), dict(net.state_dict()))


def test_a_second_save_replaces_the_first(path: Path) -> None:
    save_checkpoint(path, {"a": torch.ones(100), "b": 1}, META)
    save_checkpoint(path, {"a": torch.zeros(2)}, META)
    assert load_checkpoint(path, kind="example")[0].keys() == {"a"}
    assert [file.name for file in path.parent.iterdir()] == [path.name]


# -- several, one of them damaged ------------------------------------------------------------------


def steps(path: Path) -> dict[str, int]:
    """The step of every checkpoint in a folder, by file name."""
    files = sorted(path.parent.glob("*.safetensors"))
    return {file.name: load_checkpoint(file, kind="example")[0]["step"] for file in files}


def keep_four(path: Path, keep: int) -> None:
    for step in range(4):
        save_checkpoint(path, {"step": step}, META, keep=keep)


@pytest.mark.parametrize("keep", [1, 2, 3])
def test_the_last_ones_are_kept_and_no_more(path: Path, keep: int) -> None:
    keep_four(path, keep)
    names = ["checkpoint.safetensors", "checkpoint.1.safetensors", "checkpoint.2.safetensors"]
    assert steps(path) == {name: 3 - i for i, name in enumerate(names[:keep])}
    assert len(list(path.parent.iterdir())) == keep


@pytest.mark.parametrize("moment", ["link_or_copy", "write_atomic"])
def test_killed_while_it_rotates_the_newest_one_is_there(
    path: Path, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    keep_four(path, 3)
    with monkeypatch.context() as patch:
        patch.setattr(
            f"torchrl_bmrl.training.checkpoint.{moment}", Mock(side_effect=KeyboardInterrupt)
        )
        with pytest.raises(KeyboardInterrupt):
            save_checkpoint(path, {"step": 4}, META, keep=3)
    found = load_newest(path, kind="example")
    assert found is not None
    assert found[0] == {"step": 3}
    save_checkpoint(path, {"step": 4}, META, keep=3)
    assert steps(path)["checkpoint.safetensors"] == 4
    assert steps(path)["checkpoint.1.safetensors"] == 3


def test_without_a_checkpoint_there_is_nothing_to_go_on_from(tmp_path: Path) -> None:
    assert load_newest(tmp_path / "none" / "a.safetensors", kind="example") is None


@pytest.mark.parametrize("damaged", [1, 2])
def test_a_damaged_newest_is_said_and_set_aside_and_the_one_before_is_the_newest(
    path: Path, damaged: int, caplog: pytest.LogCaptureFixture
) -> None:
    keep_four(path, 3)
    for file in [path, earlier(path, 1)][:damaged]:
        data = bytearray(file.read_bytes())
        data[-1] ^= 1
        file.write_bytes(data)
    found = load_newest(path, kind="example")
    assert found is not None
    assert found[0] == {"step": 3 - damaged}
    said = caplog.text
    assert f"{path}: not a complete safetensors checkpoint" in said
    assert f"training continues from checkpoint.{damaged}.safetensors" in said
    assert path.with_name("checkpoint.damaged.safetensors").exists()
    path.with_name("checkpoint.damaged.safetensors").unlink()
    assert steps(path)["checkpoint.safetensors"] == 3 - damaged
    # The next save does not drop a good checkpoint for the damaged one.
    save_checkpoint(path, {"step": 4}, META, keep=2)
    assert steps(path)["checkpoint.1.safetensors"] == 3 - damaged


def test_when_all_are_damaged_the_newest_is_named_and_all_stay(path: Path) -> None:
    keep_four(path, 2)
    for file in path.parent.iterdir():
        file.write_bytes(b"x")
    with pytest.raises(CheckpointError, match="not a complete safetensors checkpoint") as info:
        load_newest(path, kind="example")
    assert info.value.path == path
    assert len(list(path.parent.iterdir())) == 2


def test_another_kind_is_refused_and_not_passed_over(path: Path) -> None:
    keep_four(path, 2)
    with pytest.raises(CheckpointError, match="kind is 'example'; valid: 'student'"):
        load_newest(path, kind="student")
    assert len(steps(path)) == 2
