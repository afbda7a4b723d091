"""Checkpoints come back bit by bit, or are refused by name."""

from __future__ import annotations

import json
import os
import random
import struct
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from helpers import NO_UPDATER
from tensordict import TensorDict
from torch import Tensor, nn

pytest.importorskip("safetensors")

from torchrl_bmrl.errors import CheckpointError
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.agents import Student, load_bcq_loss, load_student, make_bcq_loss
from torchrl_bmrl.training.checkpoint import (
    earlier,
    load_checkpoint,
    load_newest,
    load_state,
    save_checkpoint,
)

META = {"kind": "example", "epochs": 3, "tasks": ["reach", "σ"], "loss": {"clip": None, "lr": 1e-5}}
SAID = {
    "tasks": ["reach", "lift", "push_up"],
    "latent_clip": 0.5,
    "accuracy": 0.9,
    "statistics": {"loc": [0.0, 1.0, 2.0], "scale": [1.0, 1.0, 0.5]},
}
"""What a student's checkpoint must say beside its networks."""
SMALL = {"num_cells": [8], "observation_dim": 3, "action_dim": 2}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "checkpoint.safetensors"


def same(a: Any, b: Any) -> bool:
    """Equality of nested states, tensors bit by bit with their dtype; tuples count as lists."""
    if isinstance(a, Tensor):
        return (
            isinstance(b, Tensor)
            and a.dtype == b.dtype
            and a.shape == b.shape
            and a.contiguous().numpy().tobytes() == b.contiguous().numpy().tobytes()
        )
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def network(width: int = 4) -> nn.Sequential:
    return nn.Sequential(nn.Linear(3, width), nn.BatchNorm1d(width), nn.Linear(width, 1))


def train(net: nn.Module, optimizer: torch.optim.Optimizer, updates: int) -> None:
    for _ in range(updates):
        optimizer.zero_grad()
        (net(torch.randn(8, 3)) - torch.randn(8, 1)).square().mean().backward()
        optimizer.step()


# -- round trips -------------------------------------------------------------------------------


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


def test_module_optimizer_and_random_state_come_back_bit_by_bit(path: Path) -> None:
    torch.manual_seed(0)
    net = network()
    optimizer = torch.optim.Adam(net.parameters(), lr=0.01, amsgrad=True)
    train(net, optimizer, 3)
    state = {
        "net": net.state_dict(),
        "optimizer": optimizer.state_dict(),
        "rng": torch.get_rng_state(),
    }
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
    state = {
        "net": net.state_dict(),
        "optimizer": optimizer.state_dict(),
        "rng": torch.get_rng_state(),
    }
    save_checkpoint(path, state, META)

    torch.manual_seed(99)
    net = network()
    optimizer = torch.optim.Adam(net.parameters(), lr=0.5)
    loaded, _ = load_checkpoint(path, kind="example")
    load_state(net, loaded["net"], path)
    optimizer.load_state_dict(loaded["optimizer"])
    torch.set_rng_state(loaded["rng"])
    train(net, optimizer, 5)
    assert same(dict(whole.state_dict()), dict(net.state_dict()))


@pytest.mark.filterwarnings(NO_UPDATER)
@pytest.mark.parametrize("perturbation", [False, True])
def test_a_trained_loss_comes_back_from_its_file_alone(path: Path, perturbation: bool) -> None:
    options = {**SMALL, "perturbation": perturbation, "num_candidates": 5, "latent_clip": None}
    loss = make_bcq_loss(**options)
    save_checkpoint(path, {"module": loss.state_dict()}, {"kind": "bcq", "loss": options})
    again, metadata = load_bcq_loss(path)
    assert metadata["loss"] == options
    assert again.num_candidates == 5
    assert again.latent_clip is None
    assert same(dict(loss.state_dict()), dict(again.state_dict()))
    assert not any(parameter.requires_grad for parameter in again.parameters())
    actions = []
    for module in (loss, again):
        policy = BCQPolicy.frozen(module)
        torch.manual_seed(0)
        actions.append(policy(TensorDict({"observation": torch.zeros(4, 3)}, [4]))["action"])
    assert torch.equal(*actions)


def test_a_student_comes_back_with_its_prototypes(path: Path) -> None:
    options = {**SMALL, "num_tasks": 3, "latent_dim": 4}
    student = Student(**options)
    student.prototypes.normal_()
    save_checkpoint(
        path, {"module": student.state_dict()}, {"kind": "student", "student": options, **SAID}
    )
    again, _ = load_student(path)
    assert same(dict(student.state_dict()), dict(again.state_dict()))


def test_a_student_without_an_encoder_is_refused_by_the_missing_key(path: Path) -> None:
    options = {**SMALL, "num_tasks": 3, "latent_dim": 4}
    state = Student(**options).state_dict()
    rest = {key: value for key, value in state.items() if not key.startswith("task_encoder")}
    save_checkpoint(path, {"module": rest}, {"kind": "student", "student": options})
    with pytest.raises(CheckpointError, match="task_encoder"):
        load_student(path)


def test_a_second_save_replaces_the_first(path: Path) -> None:
    save_checkpoint(path, {"a": torch.ones(100), "b": 1}, META)
    save_checkpoint(path, {"a": torch.zeros(2)}, META)
    assert load_checkpoint(path, kind="example")[0].keys() == {"a"}
    assert [file.name for file in path.parent.iterdir()] == [path.name]


# -- several, one of them damaged ----------------------------------------------------------------


def steps(path: Path) -> dict[str, int]:
    """By name, the step of every checkpoint in a folder."""
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
    # The next one does not push a good one out for a damaged one.
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


# -- refusals ----------------------------------------------------------------------------------


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


def test_a_checkpoint_without_a_checksum_is_refused_by_what_is_missing(path: Path) -> None:
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"checkpoint": json.dumps({"state": {}, "metadata": META})}
    save_file({}, path, header)
    refused(path, "'sha256' is missing")


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
            assert bit < 8 * (8 + length)  # in the header alone: a blank in its JSON
        except CheckpointError:
            refused_bits += 1
    assert refused_bits > 900


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
    assert same(before, dict(other.state_dict()))  # nothing was loaded by halves


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


def test_networks_of_another_size_are_refused_by_name(path: Path) -> None:
    loss = make_bcq_loss(**SMALL)
    options = {**SMALL, "num_cells": [7]}
    save_checkpoint(path, {"module": loss.state_dict()}, {"kind": "bcq", "loss": options})
    with pytest.raises(CheckpointError, match="has shape"):
        load_bcq_loss(path)


def with_header(path: Path, header: Any) -> None:
    """Writes a checkpoint whose header says this, its checksum right if it has a place for one."""
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


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_parameters_that_are_not_finite_are_not_acted_with(path: Path, number: float) -> None:
    state = make_bcq_loss(**SMALL).state_dict()
    key = next(key for key in state if key.endswith("0.weight"))
    state[key][1, 2] = number
    save_checkpoint(path, {"module": state}, {"kind": "bcq", "loss": SMALL})
    with pytest.raises(CheckpointError, match=f"'{key}' contains numbers that are not finite"):
        load_bcq_loss(path)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (None, "contains no networks"),
        ({**SMALL, "num_cells": [10**9]}, "num_cells is .*no tensor in the file is that large"),
        ({**SMALL, "num_cells": [8] * 999}, "num_cells is .*no tensor in the file is that large"),
        ({**SMALL, "num_qvalue_nets": 10**9}, "num_qvalue_nets is .*that large"),
        ({**SMALL, "num_cells": "eight"}, "its options build no networks"),
        ({**SMALL, "num_cells": [-1]}, "its options build no networks"),
        ({**SMALL, "hidden": 8}, "its options build no networks"),
        ({**SMALL, "latent_clip": -1.0}, "its options build no networks"),
    ],
)
def test_settings_of_no_networks_are_refused_before_any_are_made(
    path: Path, options: Any, match: str
) -> None:
    state = {"module": make_bcq_loss(**SMALL).state_dict()}
    save_checkpoint(path, state, {"kind": "bcq", "loss": options})
    with pytest.raises(CheckpointError, match=match) as info:
        load_bcq_loss(path)
    assert info.value.path == path


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("tasks", ["reach", "lift"]),
        ("tasks", ["reach", "lift", "../../etc/passwd"]),
        ("tasks", ["reach", "lift", "lift"]),
        ("tasks", "abc"),
        ("tasks", [["reach"], "lift", "push_up"]),
        ("latent_clip", -1),
        ("latent_clip", "0.5"),
        ("latent_clip", float("nan")),
        ("accuracy", 2),
        ("accuracy", None),
        ("statistics", {"loc": [0.0], "scale": [1.0, 2.0]}),
        ("statistics", {"loc": [0.0], "scale": [0.0]}),
        ("statistics", {"loc": ["0"], "scale": [1.0]}),
        ("statistics", {"loc": [float("inf")], "scale": [1.0]}),
        ("statistics", {"loc": 1.0, "scale": 1.0}),
        ("statistics", []),
    ],
)
def test_what_a_student_must_say_is_checked_when_it_is_loaded(
    path: Path, key: str, value: Any
) -> None:
    options = {**SMALL, "num_tasks": 3, "latent_dim": 4}
    metadata = {"kind": "student", "student": options, **SAID, key: value}
    save_checkpoint(path, {"module": Student(**options).state_dict()}, metadata)
    with pytest.raises(CheckpointError, match=f"{key} is .*; valid: "):
        load_student(path)


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
