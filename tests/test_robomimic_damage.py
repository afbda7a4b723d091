"""A damaged file of demonstrations is refused with its path, its key and what is valid."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py
from episode_files import LENGTHS, lift_file, make_episode, read_file
from file_edits import LFS_POINTER, Edit, edit, first_chunk, put, remove

from torchrl_bmrl.data.robomimic import (
    count_episodes,
    count_steps,
    keep_episode,
    read_kept_episode,
    read_metadata,
)
from torchrl_bmrl.errors import DataError

DEMO = "data/demo_1"
ROWS = LENGTHS[1]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return lift_file(tmp_path)


def refusal(path: Path, **options: Any) -> DataError:
    """The error that reading raises, which begins with the file."""
    with pytest.raises(DataError) as caught:
        read_file(path, **options)
    assert str(caught.value).startswith(f"{path}: ")
    return caught.value


READERS = (count_episodes, read_metadata, lambda path: count_steps(path, ["demo_0"]))


# -- files -----------------------------------------------------------------------------------------


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "no such file" in str(refusal(tmp_path / "lift.hdf5"))
    for reader in READERS:
        with pytest.raises(DataError, match=r"lift\.hdf5: no such file"):
            reader(tmp_path / "lift.hdf5")


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    (tmp_path / "lift.hdf5").mkdir()
    assert "a folder; valid: a file" in str(refusal(tmp_path / "lift.hdf5"))


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all\n" * 100], ids=["empty", "text"])
def test_another_format_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "lift.hdf5"
    path.write_bytes(content)
    assert "not a complete HDF5 file" in str(refusal(path))


def test_a_pointer_to_git_lfs_says_how_to_get_the_data(tmp_path: Path) -> None:
    path = tmp_path / "lift.hdf5"
    path.write_bytes(LFS_POINTER)
    assert "`git lfs pull`" in str(refusal(path))


@pytest.mark.parametrize("share", [0.05, 0.5, 0.99])
def test_a_truncated_file_is_refused(path: Path, share: float) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert "not a complete HDF5 file" in str(refusal(path))
    for reader in READERS:
        with pytest.raises(DataError, match="not a complete HDF5 file"):
            reader(path)


@pytest.mark.parametrize("byte", [b"\x00", b"\xff"])
def test_a_hole_in_the_file_does_not_pass_for_data(path: Path, byte: bytes) -> None:
    whole = path.read_bytes()
    names: list[str] = []

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset):
            names.append(name)

    with h5py.File(path) as file:
        file[DEMO].visititems(visit)
    assert len(names) == 11
    for name in names:
        path.write_bytes(whole)
        hole = first_chunk(path, f"{DEMO}/{name}")
        path.write_bytes(whole[: hole.start] + byte * (hole.stop - hole.start) + whole[hole.stop :])
        if name != "dones":  # not read
            assert refusal(path).key == f"{DEMO}/{name}"


@pytest.mark.parametrize("key", ["actions", "rewards", "successes", "obs/object", "obs/image"])
def test_a_flipped_bit_in_an_array_is_found_when_it_is_read(path: Path, key: str) -> None:
    chunk = first_chunk(path, f"{DEMO}/{key}")
    content = bytearray(path.read_bytes())
    content[(chunk.start + chunk.stop) // 2] ^= 1
    path.write_bytes(content)
    assert refusal(path).key == f"{DEMO}/{key}"


@pytest.mark.parametrize("content", [b"", b"not a zip file", None], ids=["empty", "text", "half"])
def test_a_damaged_kept_episode_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "0.npz"
    keep_episode(path, make_episode())
    path.write_bytes(path.read_bytes()[:-100] if content is None else content)
    with pytest.raises(DataError, match=r"0\.npz: .*remove it"):
        read_kept_episode(path)


def test_a_kept_episode_that_lacks_an_array_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "0.npz", actions=np.zeros((5, 7)))
    with pytest.raises(DataError, match=r"0\.npz: .*attributes"):
        read_kept_episode(tmp_path / "0.npz")


# -- arrays ----------------------------------------------------------------------------------------


STRINGS = np.full((ROWS, 7), "a", dtype=h5py.string_dtype())


DAMAGES: dict[str, tuple[Edit, str, str]] = {
    # name: damage, key, what the message contains
    "no data": (remove("data"), "data", "missing"),
    "data is an array": (put("data", np.zeros(3)), "data", "not a group"),
    "demo is an array": (put(DEMO, np.zeros(3)), DEMO, "not a group"),
    "no actions": (remove(f"{DEMO}/actions"), f"{DEMO}/actions", "missing"),
    "no rewards": (remove(f"{DEMO}/rewards"), f"{DEMO}/rewards", "missing"),
    "no obs": (remove(f"{DEMO}/obs"), f"{DEMO}/obs", "missing"),
    "no next image": (remove(f"{DEMO}/next_obs/image"), f"{DEMO}/next_obs/image", "missing"),
    "group of actions": (put(f"{DEMO}/actions/x", 1), f"{DEMO}/actions", "valid: a dataset"),
    "dangling link": (
        put(f"{DEMO}/actions", h5py.SoftLink("/nowhere")),
        f"{DEMO}/actions",
        "missing",
    ),
    "link to another file": (
        put(f"{DEMO}/obs", h5py.ExternalLink("missing.hdf5", "/x")),
        f"{DEMO}/obs",
        "missing",
    ),
    "text": (put(f"{DEMO}/actions", STRINGS), f"{DEMO}/actions", "valid: numbers"),
    "bytes": (put(f"{DEMO}/rewards", np.full(ROWS, b"a")), f"{DEMO}/rewards", "valid: numbers"),
    "complex": (put(f"{DEMO}/rewards", np.zeros(ROWS, complex)), f"{DEMO}/rewards", "numbers"),
    "half terminated": (
        put(f"{DEMO}/terminated", np.full(ROWS, 0.5)),
        f"{DEMO}/terminated",
        "0.5 in row 0; valid: 0 or 1",
    ),
    "terminated is not a number": (
        put(f"{DEMO}/terminated", np.array([0] * (ROWS - 1) + [np.nan])),
        f"{DEMO}/terminated",
        f"nan in row {ROWS - 1}; valid: 0 or 1",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_answered_with_file_key_and_what_is_valid(path: Path, name: str) -> None:
    damage, key, says = DAMAGES[name]
    if name == "group of actions":
        edit(path, remove(key))
    edit(path, damage)
    error = refusal(path)
    assert error.key == key
    assert f"{path}: {key}: " in str(error)
    assert says in str(error)


def elsewhere(path: Path) -> Path:
    """Another file, which holds an array of actions."""
    other = path.with_name("other.hdf5")
    with h5py.File(other, "w") as file:
        file["actions"] = np.zeros((ROWS, 7))
    return other


def linked(demo: h5py.Group, other: Path) -> None:
    demo["actions"] = h5py.ExternalLink(other, "/actions")


def stored_outside(demo: h5py.Group, other: Path) -> None:
    demo.create_dataset("actions", (ROWS, 7), "u1", external=[(str(other), 0, ROWS * 7)])


def virtual(demo: h5py.Group, other: Path) -> None:
    layout = h5py.VirtualLayout((ROWS, 7), "f8")
    layout[:] = h5py.VirtualSource(other, "actions", (ROWS, 7))
    demo.create_virtual_dataset("actions", layout)


def enormous(demo: h5py.Group, other: Path) -> None:
    options = {"chunks": (1024, 7), "fillvalue": 0.5}
    demo.create_dataset("actions", (10**12, 7), "f8", **options)


@pytest.mark.parametrize(
    ("put_actions", "says"),
    [
        (linked, "lies in .*other.hdf5; valid: in this file"),
        (stored_outside, "its content lies in other files"),
        (virtual, "its content lies in other files"),
        (enormous, "claims 56000000000000 bytes, more than the file can hold"),
    ],
)
def test_what_lies_in_another_file_or_is_larger_than_its_own_is_not_read(
    path: Path, put_actions: Any, says: str
) -> None:
    other = elsewhere(path)
    edit(path, remove(f"{DEMO}/actions"), lambda file: put_actions(file[DEMO], other))
    error = refusal(path)
    assert error.key == f"{DEMO}/actions"
    assert re.search(says, str(error))


@pytest.mark.parametrize("rows", [ROWS - 1, ROWS + 1])
def test_dones_that_terminate_must_have_a_row_for_each_step(path: Path, rows: int) -> None:
    edit(path, remove(f"{DEMO}/terminated"), put(f"{DEMO}/dones", np.zeros(rows)))
    error = refusal(path, dones_terminate=True)
    assert error.key == f"{DEMO}/dones"
    assert f"shape ({rows},); valid: ({ROWS},)" in str(error)
    edit(path, remove(f"{DEMO}/dones"))
    assert refusal(path, dones_terminate=True).key == f"{DEMO}/dones"
    assert len(read_file(path)) == len(LENGTHS)  # dones are read only where they are used


# -- masks and attributes --------------------------------------------------------------------------


@pytest.mark.parametrize("damage", [remove("data"), put("data", np.zeros(3))])
def test_episodes_cannot_be_counted_without_their_group(path: Path, damage: Edit) -> None:
    edit(path, damage)
    for reader in (count_episodes, read_metadata):
        with pytest.raises(DataError, match=r"lift\.hdf5: data: "):
            reader(path)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (remove("mask/valid"), "missing; valid masks: train"),
        (remove("mask"), "missing; valid masks: none; the file has no masks"),
        (put("mask/valid", np.array([b"demo_3", b"demo_9"])), "row 1 names 'demo_9', which is not"),
        (put("mask/valid", np.array([b"demo_3", b"demo_3"])), "row 1 names 'demo_3', again"),
        (put("mask/valid", np.array([], dtype="S6")), "no demonstrations"),
        (put("mask/valid", np.array([3])), "row 0 names '3'"),
        (put("mask/valid", h5py.SoftLink("/data")), "valid: a dataset"),
    ],
    ids=["missing", "no masks", "unknown demo", "twice", "empty", "numbers", "group"],
)
def test_a_bad_mask_is_named(path: Path, damage: Edit, says: str) -> None:
    edit(path, damage)
    error = refusal(path, split="valid")
    assert error.key == "mask/valid"
    assert says in str(error)
    assert len(read_file(path)) == len(LENGTHS)  # without a mask every episode is read


def test_masks_must_be_a_group(path: Path) -> None:
    edit(path, put("mask", np.zeros(3)))
    assert refusal(path, split="train").key == "mask"
    with pytest.raises(DataError, match=r"lift\.hdf5: mask: not a group"):
        read_metadata(path)


def test_a_file_without_demonstrations_is_refused(path: Path) -> None:
    edit(path, remove(*(f"data/demo_{i}" for i in range(4))))
    error = refusal(path)
    assert error.key == "data"
    assert "no demonstrations" in str(error)
    assert count_episodes(path) == 0


@pytest.mark.parametrize("value", ["{not JSON", 3.5, h5py.Empty("f8"), np.zeros(2)])
def test_env_args_that_are_not_json_are_named(path: Path, value: Any) -> None:
    with h5py.File(path, "r+") as file:
        file["data"].attrs["env_args"] = value
    with pytest.raises(DataError, match=r"lift\.hdf5: data: attribute env_args is not"):
        read_metadata(path)


def test_environment_metadata_must_be_an_object(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data"].attrs["env_args"] = "[1]"
    with pytest.raises(DataError, match="env_args; valid: a JSON object"):
        read_metadata(path)
