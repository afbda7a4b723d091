"""A checkpoint that is damaged, foreign or cannot be written is refused and harms nothing."""

from __future__ import annotations

import json
import os
import random
import struct
from pathlib import Path
from typing import Any

import pytest
import torch
from checkpoint_files import META, checkpoint_path, network, same
from torch import nn

pytest.importorskip("safetensors")

from torchrl_bmrl.errors import CheckpointError
from torchrl_bmrl.pipeline.agents import load_bcq_loss
from torchrl_bmrl.pipeline.student import load_student
from torchrl_bmrl.training.checkpoint import load_checkpoint, load_state, save_checkpoint

path = pytest.fixture(checkpoint_path)


@pytest.fixture
def saved(path: Path) -> Path:
    torch.manual_seed(0)
    save_checkpoint(path, {"net": network().state_dict()}, META)
    return path


def refused(path: Path, match: str = "", kind: str = "example") -> None:
    with pytest.raises(CheckpointError, match=match) as info:
        load_checkpoint(path, kind=kind)
    assert str(path) in str(info.value)
    assert info.value.path == path


# -- damaged files ---------------------------------------------------------------------------------


def test_a_missing_file_or_a_folder_is_refused_by_name(tmp_path: Path) -> None:
    refused(tmp_path / "none.safetensors", "no such checkpoint")
    refused(tmp_path, "no such checkpoint")


@pytest.mark.parametrize("keep", [0, 4, 8, 100, 0.5, -1])
def test_a_truncated_file_is_refused_by_name(saved: Path, keep: float) -> None:
    data = saved.read_bytes()
    saved.write_bytes(data[: int(keep * len(data)) if keep == 0.5 else int(keep)])
    refused(saved, "not a complete safetensors checkpoint")


def test_trailing_bytes_are_refused_by_name(saved: Path) -> None:
    saved.write_bytes(saved.read_bytes() + b"\0\0\0\0")
    refused(saved, "not a complete safetensors checkpoint")


@pytest.mark.parametrize("bit", range(64))
def test_a_flipped_bit_in_the_header_s_length_is_refused_by_name(saved: Path, bit: int) -> None:
    data = bytearray(saved.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    saved.write_bytes(data)
    refused(saved, "not a complete safetensors checkpoint")


def test_any_flipped_bit_is_refused_by_name_or_changes_nothing(saved: Path) -> None:
    data, expected = saved.read_bytes(), load_checkpoint(saved, kind="example")
    (length,) = struct.unpack("<Q", data[:8])
    refused_bits = 0
    for bit in random.Random(0).sample(range(8 * len(data)), 1000):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        saved.write_bytes(flipped)
        try:
            assert same(load_checkpoint(saved, kind="example"), expected)
            assert bit < 8 * (8 + length)  # a blank in the header's JSON
        except CheckpointError:
            refused_bits += 1
    assert refused_bits > 900


# -- files and headers of another structure --------------------------------------------------------


def test_a_pickle_is_refused_and_not_run(path: Path) -> None:
    class Trap:
        def __reduce__(self) -> tuple[Any, ...]:
            return (os.mkdir, (str(path.parent / "trapped"),))

    path.parent.mkdir()
    torch.save({"net": network().state_dict(), "trap": Trap()}, path)
    refused(path, "not a complete safetensors checkpoint")
    assert not (path.parent / "trapped").exists()


def test_safetensors_of_another_program_are_refused_by_name(path: Path) -> None:
    from safetensors.torch import save_file

    path.parent.mkdir()
    for header in (None, {"format": "pt"}, {"checkpoint": "not json"}, {"checkpoint": "{}"}):
        save_file({"a": torch.ones(2)}, path, header)
        refused(path, "not a complete safetensors checkpoint")


def test_a_checkpoint_without_a_checksum_is_refused_by_what_is_missing(path: Path) -> None:
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"checkpoint": json.dumps({"state": {}, "metadata": META})}
    save_file({}, path, header)
    refused(path, "'sha256' is missing")


def with_header(path: Path, header: Any) -> None:
    """Writes a checkpoint with this header, and with a correct checksum if it is a dictionary."""
    from safetensors.torch import save

    from torchrl_bmrl.training import checkpoint

    tensors = {"/a": torch.ones(2)}
    if isinstance(header, dict):
        header = {**header, "sha256": checkpoint._checksum(header, tensors)}
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(save(tensors, {"checkpoint": json.dumps(header)}))


@pytest.mark.parametrize(
    "header",
    [
        [],
        7,
        {"state": {}},
        {"metadata": {"kind": "example"}},
        {"state": {}, "metadata": [1]},
        {"state": {}, "metadata": None},
        {"state": {"__tensor__": "/b"}, "metadata": {"kind": "example"}},
        {"state": {"__tensor__": ["/a"]}, "metadata": {"kind": "example"}},
        {"state": {"__pairs__": 3}, "metadata": {"kind": "example"}},
        {"state": {"__pairs__": [[1]]}, "metadata": {"kind": "example"}},
        {"state": {"__pairs__": [[[], 1]]}, "metadata": {"kind": "example"}},
    ],
)
def test_a_header_of_another_structure_is_refused_by_name(path: Path, header: Any) -> None:
    with_header(path, header)
    refused(path, "not a complete safetensors checkpoint")


def test_a_header_nested_without_end_is_refused_by_name(path: Path) -> None:
    from safetensors.torch import save

    path.parent.mkdir()
    text = '{"state": ' + "[" * 100_000 + "]" * 100_000 + "}"
    path.write_bytes(save({"a": torch.ones(1)}, {"checkpoint": text}))
    refused(path, "not a complete safetensors checkpoint")


# -- another kind, other networks ------------------------------------------------------------------


def test_another_kind_is_refused_with_the_valid_one(saved: Path) -> None:
    refused(saved, "kind is 'example'; valid: 'student'", kind="student")
    with pytest.raises(CheckpointError, match="valid: 'bcq'"):
        load_bcq_loss(saved)
    with pytest.raises(CheckpointError, match="valid: 'student'"):
        load_student(saved)


def test_other_shapes_are_refused_with_key_and_shapes(saved: Path) -> None:
    state = load_checkpoint(saved, kind="example")[0]["net"]
    other = network(width=5)
    before = {key: value.clone() for key, value in other.state_dict().items()}
    with pytest.raises(CheckpointError, match=r"'0.weight' has shape \(4, 3\).*\(5, 3\)") as info:
        load_state(other, state, saved)
    assert str(saved) in str(info.value)
    assert same(before, dict(other.state_dict()))  # no tensor was loaded


@pytest.mark.parametrize("where", ["checkpoint", "networks"])
def test_a_missing_key_is_named_with_where_it_is_missing(saved: Path, where: str) -> None:
    state = load_checkpoint(saved, kind="example")[0]["net"]
    net = network()
    if where == "checkpoint":
        del state["2.bias"]
    else:
        net = nn.Sequential(*net[:2], nn.Linear(4, 1, bias=False))
    with pytest.raises(CheckpointError, match=f"'2.bias' is missing in the {where}") as info:
        load_state(net, state, saved)
    assert info.value.path == saved


# -- saving ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("failure", ["state", "metadata", "disk"])
def test_a_failed_save_leaves_the_old_file(
    saved: Path, failure: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = saved.read_bytes()
    state: dict[str, Any] = {"net": network().state_dict()}
    metadata: dict[str, Any] = dict(META)
    if failure == "state":
        state["what"] = object()
    elif failure == "metadata":
        metadata["where"] = saved
    else:

        def full(*_: Any) -> None:
            raise OSError("no space left on device")

        monkeypatch.setattr(os, "fsync", full)
    with pytest.raises((TypeError, OSError)):
        save_checkpoint(saved, state, metadata)
    assert saved.read_bytes() == before
    assert [file.name for file in saved.parent.iterdir()] == [saved.name]


def test_what_a_checkpoint_cannot_hold_is_named(path: Path) -> None:
    with pytest.raises(TypeError, match="/a/1 is a set"):
        save_checkpoint(path, {"a": [1, {2}]}, META)
    assert not path.exists()
