"""Files of demonstrations are written whole, in robomimic's layout, with checksums."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py
from episode_files import ENV_ARGS, LENGTHS, PARTS, lift_file, make_episode, write_file
from file_edits import layout_version

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robomimic import write_episodes
from torchrl_bmrl.errors import ConfigError, DataError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return lift_file(tmp_path)


def test_the_layout_is_robomimics(path: Path) -> None:
    with h5py.File(path) as file:
        data = file["data"]
        assert set(data) == {f"demo_{i}" for i in range(4)}
        assert data.attrs["total"] == sum(LENGTHS)
        assert json.loads(data.attrs["env_args"]) == ENV_ARGS
        assert (data.attrs["task"], data.attrs["action_noise"]) == (b"lift", 0.2)
        for i, steps in enumerate(LENGTHS):
            demo = data[f"demo_{i}"]
            assert demo.attrs["num_samples"] == steps
            assert demo.attrs["seed"] == 2**32 - 1 - i
            assert demo.attrs["model_file"].startswith(b"<mujoco")
            assert list(demo.attrs["phase_names"]) == [b"descend", b"grasp", b"lift"]
            assert demo["dones"][:].tolist() == [0] * (steps - 1) + [1]
            assert demo["terminated"].dtype == bool
            assert demo["states"].shape == (steps, 11)
            for name in PARTS:
                np.testing.assert_array_equal(
                    demo[f"obs/{name}"][1:], demo[f"next_obs/{name}"][:-1]
                )
        for split, names in (("train", [b"demo_0", b"demo_1", b"demo_2"]), ("valid", [b"demo_3"])):
            assert file[f"mask/{split}"].dtype.kind == "S"
            assert file[f"mask/{split}"][:].tolist() == names


def test_every_array_carries_checksums(path: Path) -> None:
    unprotected = []

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset) and not node.fletcher32:
            unprotected.append(name)

    with h5py.File(path) as file:
        file.visititems(visit)
    assert unprotected == []


def test_no_text_lies_in_a_heap_without_checksums(path: Path) -> None:
    # HDF5 does not find damage in a heap and may loop for ever on it.
    assert b"GCOL" not in path.read_bytes()


def test_a_file_can_be_read_by_earlier_versions_of_hdf5(path: Path) -> None:
    assert layout_version(path, "data/demo_1/actions") == 4


def test_the_same_episodes_give_the_same_bytes_a_second_later(path: Path, tmp_path: Path) -> None:
    time.sleep(1.1)  # HDF5 stores times in seconds
    write_file(tmp_path / "again.hdf5")
    assert (tmp_path / "again.hdf5").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("existing", [True, False])
def test_a_failed_write_leaves_nothing_behind(tmp_path: Path, existing: bool) -> None:
    path = tmp_path / "data" / "lift.hdf5"
    if existing:
        write_file(path)
    before = path.read_bytes() if existing else b""

    def broken() -> Iterator[Episode]:
        yield make_episode()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_episodes(path, broken(), env_args={})
    assert list(path.parent.iterdir()) == ([path] if existing else [])
    if existing:
        assert path.read_bytes() == before


def test_what_could_not_be_trained_on_is_not_written(tmp_path: Path) -> None:
    path, episode = tmp_path / "a.hdf5", make_episode()
    bad = {
        "not finite in row 0": replace(episode, rewards=np.full(5, np.nan)),
        "names without '/'": replace(
            episode, observations={"a/b": np.zeros(5)}, next_observations={"a/b": np.zeros(5)}
        ),
        "other names than actions": replace(episode, extras={"dones": np.zeros(5)}),
    }
    for message, faulty in bad.items():
        with pytest.raises(DataError, match=message):
            write_episodes(path, [episode, faulty], env_args={})
    with pytest.raises(DataError, match="no episodes"):
        write_episodes(path, [], env_args={})
    with pytest.raises(ConfigError, match="mask 'train' has 1; valid: 0 to 0"):
        write_episodes(path, [episode], env_args={}, masks={"train": [0, 1]})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["actions", "dones", "obs", "obs/object"])
def test_an_extra_cannot_take_the_place_of_the_layout_s_own(tmp_path: Path, name: str) -> None:
    episode = replace(make_episode(), extras={name: np.zeros((5, 7))})
    with pytest.raises(DataError, match=rf"a\.hdf5: data/demo_0/{name}: "):
        write_episodes(tmp_path / "a.hdf5", [episode], env_args={})
    assert list(tmp_path.iterdir()) == []
