"""A file is converted once for each set of options, and again where the copy is damaged."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")

from episode_files import LENGTHS, entries, lift_file
from file_edits import edit, put
from tensordict import TensorDict

from torchrl_bmrl.data import datasets
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.sampler import read_memmap
from torchrl_bmrl.errors import DataError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return lift_file(tmp_path / "source")


# -- where and when a file is converted ------------------------------------------------------------


def test_a_file_is_converted_once_beside_itself(path: Path, converted: list[Path]) -> None:
    first = RobomimicExperienceReplay(path)
    again = RobomimicExperienceReplay(str(path))
    assert converted == [path]
    assert first.data_path == again.data_path == first.data_path_root
    assert first.data_path.parent == path.parent
    assert entries(path.parent) == sorted([path.name, first.data_path.name])
    assert first.data_path.name.startswith("lift-")
    os.utime(path)
    RobomimicExperienceReplay(path)
    assert converted == [path]  # the content decides, not the time


def test_it_is_converted_under_the_root_that_is_given(path: Path, tmp_path: Path) -> None:
    root = tmp_path / "elsewhere" / "deep"
    replay = RobomimicExperienceReplay(path, root=root)
    assert replay.data_path.parent == replay.root == root
    assert entries(root) == [replay.data_path.name]
    assert entries(path.parent) == [path.name]


def test_a_changed_file_is_converted_anew(path: Path, converted: list[Path]) -> None:
    old = RobomimicExperienceReplay(path)
    before = old[:]["next", "reward"].clone()
    edit(path, put("data/demo_0/rewards", np.full(LENGTHS[0], 9.0)))
    new = RobomimicExperienceReplay(path)
    assert len(converted) == 2
    assert new.data_path != old.data_path
    assert (new[:]["next", "reward"][: LENGTHS[0]] == 9).all()
    assert torch.equal(old[:]["next", "reward"], before)


def test_a_file_that_is_replaced_while_it_is_converted_is_read_whole(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, other = path.read_bytes(), tmp_path / "other.hdf5"
    shutil.copy(path, other)
    edit(other, put("data/demo_0/rewards", np.full(LENGTHS[0], 9.0)))
    convert = datasets._convert

    def replaced(source: Path, *args: Any) -> None:
        if other.exists():
            os.replace(other, source)
        convert(source, *args)

    monkeypatch.setattr(datasets, "_convert", replaced)
    first, second = RobomimicExperienceReplay(path), RobomimicExperienceReplay(path)
    rewards = [replay[:]["next", "reward"][: LENGTHS[0]] for replay in (first, second)]
    assert (rewards[0] < 1).all()
    assert (rewards[1] == 9).all()
    path.write_bytes(before)
    again = RobomimicExperienceReplay(path)
    assert again.data_path == first.data_path
    assert torch.equal(again[:]["next", "reward"], first[:]["next", "reward"])


def test_a_file_that_is_written_while_it_is_converted_is_refused(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = datasets._write_rows

    def written(*args: Any) -> Any:
        data = write(*args)
        with path.open("r+b") as file:  # the same file, not another one of its name
            file.seek(-1, os.SEEK_END)
            file.write(b"!")
        return data

    monkeypatch.setattr(datasets, "_write_rows", written)
    with pytest.raises(DataError, match=r"lift\.hdf5: changed while it was read; valid: a"):
        RobomimicExperienceReplay(path)
    assert entries(path.parent) == [path.name]


def test_each_set_of_options_has_its_folder(path: Path, converted: list[Path]) -> None:
    options: list[dict[str, Any]] = [
        {},
        {"split": "train"},
        {"split": "valid"},
        {"observation_keys": ["object"]},
        {"observation_keys": ["object", "image"]},
        {"dones_terminate": True},
        {"split_trajs": True},
    ]
    for _ in range(2):
        folders = {RobomimicExperienceReplay(path, **option).data_path for option in options}
        assert len(folders) == len(converted) == len(options)


def test_the_order_of_the_parts_asked_for_makes_no_other_folder(path: Path) -> None:
    first = RobomimicExperienceReplay(path, observation_keys=["object", "image"])
    second = RobomimicExperienceReplay(path, observation_keys=["image", "object", "image"])
    assert first.data_path == second.data_path


def test_files_of_equal_content_and_name_share_a_folder(
    path: Path, tmp_path: Path, converted: list[Path]
) -> None:
    copy = tmp_path / path.name
    copy.write_bytes(path.read_bytes())
    paths = {RobomimicExperienceReplay(p, root=tmp_path / "r").data_path for p in (path, copy)}
    assert len(paths) == len(converted) == 1


def test_a_relative_path_outlives_the_working_directory(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(path.parent)
    replay = RobomimicExperienceReplay(path.name)
    monkeypatch.chdir(tmp_path.parent)
    assert replay.metadata["episodes"][0] == "demo_0"
    replay.delete()
    assert not replay.data_path.exists()


def test_deleting_removes_the_folder_and_not_the_file(path: Path) -> None:
    train = RobomimicExperienceReplay(path, split="train")
    valid = RobomimicExperienceReplay(path, split="valid")
    train.delete()
    assert entries(path.parent) == sorted([path.name, valid.data_path.name])
    assert len(RobomimicExperienceReplay(path, split="train")) == sum(LENGTHS[:3])


def test_the_source_is_only_read(path: Path) -> None:
    before, stat = path.read_bytes(), path.stat()
    path.chmod(0o444)
    for options in ({}, {"split": "train"}, {"split_trajs": True}):
        RobomimicExperienceReplay(path, **options)
    assert path.read_bytes() == before
    assert path.stat().st_mtime_ns == stat.st_mtime_ns


# -- damaged copies --------------------------------------------------------------------------------


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "shortened": lambda folder: os.truncate(folder / "data/object.memmap", 16),
    "removed": lambda folder: (folder / "data/object.memmap").unlink(),
    "renamed": lambda folder: (folder / "data").rename(folder / "other"),
    "emptied": lambda folder: (shutil.rmtree(folder), folder.mkdir()),
    "no checksum": lambda folder: (folder / "metadata.crc32").unlink(),
    "no metadata": lambda folder: (folder / "metadata.json").unlink(),
    "other metadata": lambda folder: (
        (folder / "metadata.json").write_text("[]"),
        (folder / "metadata.crc32").write_text(datasets._crc32(folder / "metadata.json")),
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_cache_is_made_anew(path: Path, damage: str, converted: list[Path]) -> None:
    replay = RobomimicExperienceReplay(path)
    before, metadata = replay[:].clone(), replay.metadata
    DAMAGES[damage](replay.data_path)
    again = RobomimicExperienceReplay(path)
    assert len(converted) == 2
    assert (again[:] == before).all()
    assert again.metadata == metadata
    assert entries(path.parent) == sorted([path.name, replay.data_path.name])


@pytest.mark.parametrize("split_trajs", [False, True])
def test_a_flipped_bit_in_any_file_leads_to_a_new_conversion(
    path: Path, split_trajs: bool, converted: list[Path]
) -> None:
    replay = RobomimicExperienceReplay(path, split_trajs=split_trajs)
    before, metadata, folder = replay[:].clone(), replay.metadata, replay.data_path
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    assert len(files) == len(metadata["crc32"]) + 2
    for number, file in enumerate(files, start=1):
        assert len(converted) == number
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
        again = RobomimicExperienceReplay(path, split_trajs=split_trajs)
        assert len(converted) == number + 1, file
        assert (again[:] == before).all()
        assert again.metadata == metadata


def test_a_disk_that_does_not_keep_what_is_written_is_named(
    path: Path, monkeypatch: pytest.MonkeyPatch, converted: list[Path]
) -> None:
    monkeypatch.setattr(datasets, "_crc32", lambda file: os.urandom(4).hex())
    with pytest.raises(DataError, match=r"lift\.hdf5: its conversion .* is damaged as soon as"):
        RobomimicExperienceReplay(path)
    assert len(converted) == datasets.ATTEMPTS


def test_a_conversion_that_vanishes_while_it_is_read_is_made_anew(
    path: Path, monkeypatch: pytest.MonkeyPatch, converted: list[Path]
) -> None:
    folder = RobomimicExperienceReplay(path).data_path
    read = datasets.read_memmap
    memmap = folder / "data" / "object.memmap"

    def remove_first(data: Path) -> TensorDict:
        memmap.unlink()  # tensordict reads the rest and does not complain
        monkeypatch.setattr(datasets, "read_memmap", read)
        return read(data)

    monkeypatch.setattr(datasets, "read_memmap", remove_first)
    assert "object" in set(RobomimicExperienceReplay(path)[:].keys())
    assert len(converted) == 2


class Executed:
    """Creates a file when its pickle is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_a_pickle_among_the_converted_data_is_refused_and_not_executed(
    path: Path, tmp_path: Path
) -> None:
    folder = RobomimicExperienceReplay(path).data_path
    executed = tmp_path / "executed"
    data = TensorDict.load_memmap(folder / "data").clone()
    data.set_non_tensor("x", Executed(executed))
    data.memmap(tmp_path / "changed")
    shutil.copytree(tmp_path / "changed", folder / "data", dirs_exist_ok=True)
    metadata = json.loads((folder / "metadata.json").read_text())
    metadata["crc32"] = {name: datasets._crc32(folder / name) for name in metadata["crc32"]}
    (folder / "metadata.json").write_text(json.dumps(metadata))
    (folder / "metadata.crc32").write_text(datasets._crc32(folder / "metadata.json"))
    with pytest.raises(DataError, match="pickle"):
        read_memmap(folder / "data")
    shutil.copytree(folder, tmp_path / "kept")
    assert "x" not in set(RobomimicExperienceReplay(path)[:].keys())
    assert not executed.exists()
    folder = tmp_path / "kept"
    with pytest.warns(FutureWarning, match="pickle"):  # tensordict itself executes it
        TensorDict.load_memmap(folder / "data")
    assert executed.exists()
