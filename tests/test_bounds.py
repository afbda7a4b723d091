"""Bounds of actions are checked and stored, and several files of equal bounds become one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("tqdm")

import h5py
from file_edits import put
from tool_files import EPISODES, STEPS, checked, load, write

from torchrl_bmrl.data.__main__ import main
from torchrl_bmrl.data.convert import convert, open_source
from torchrl_bmrl.data.robomimic import read_metadata
from torchrl_bmrl.errors import ConfigError, DataError


def test_actions_beyond_1_go_in_with_their_bounds_through_every_command(
    tmp_path: Path, capsys: Any
) -> None:
    actions = np.random.default_rng(3).uniform(-2, 2, (STEPS, 7))
    path = write(tmp_path / "a.hdf5", put("actions", actions), next_obs=True)
    code, out, err = checked(path, capsys)
    assert code == 1
    assert "outside [-1.0, 1.0]; the option bounds sets others" in err
    (line,) = (line for line in out.splitlines() if line.split()[:1] == ["actions"])
    assert line.split()[-2:] == [f"{actions.min():.4g}", f"{actions.max():.4g}"]
    assert checked(path, capsys, "--bounds", "-2", "2")[0] == 0
    flags = ["--to", "robomimic", "--bounds", "-2", "2"]
    assert main(["convert", str(path), str(tmp_path / "b.hdf5"), *flags]) == 0
    assert read_metadata(tmp_path / "b.hdf5")["action_bounds"] == {"low": -2.0, "high": 2.0}
    replay = load(tmp_path / "b.hdf5")
    assert replay.metadata["action_bounds"] == {"low": -2.0, "high": 2.0}
    np.testing.assert_array_equal(replay[:]["action"][:STEPS], actions.astype(np.float32))
    assert checked(tmp_path / "b.hdf5", capsys)[0] == 0
    with pytest.raises(DataError, match=r"outside \[-1\.0, 1\.0\]"):
        load(tmp_path / "b.hdf5", bounds=(-1, 1))


def test_the_range_of_the_data_can_be_their_bounds(tmp_path: Path) -> None:
    actions = np.random.default_rng(3).uniform(-1, 1, (STEPS, 7)) * np.arange(7)
    path = write(tmp_path / "a.hdf5", put("actions", actions), next_obs=True)
    bounds = load(path, bounds="data").metadata["action_bounds"]
    np.testing.assert_allclose(bounds["low"][1:], actions.min(0)[1:])
    np.testing.assert_allclose(bounds["high"][1:], actions.max(0)[1:])
    assert (bounds["low"][0], bounds["high"][0]) == (-1, 1)  # a constant number gets a range too


def test_whole_numbers_have_no_range_of_data(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", put("actions", np.full((STEPS, 7), 5)), next_obs=True)
    assert "action_bounds" not in load(path, bounds="data").metadata


@pytest.mark.parametrize("shape", [(STEPS,), (STEPS, 2, 3)])
def test_actions_that_are_no_vectors_have_one_range(
    tmp_path: Path, capsys: Any, shape: tuple[int, ...]
) -> None:
    pytest.importorskip("minari")
    actions = np.linspace(-3, 2, int(np.prod(shape))).reshape(shape)
    path = write(tmp_path / "a.hdf5", put("actions", actions), next_obs=True)
    assert checked(path, capsys, "--bounds", "data")[0] == 0
    target = tmp_path / "own" / "lift-v0"
    convert(path, target, to="minari", bounds="data")
    with open_source(target) as source:
        assert source.bounds == (-3.0, 2.0)


def test_bounds_of_another_size_are_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    with pytest.raises(DataError, match=r"actions: shape \(20, 7\); valid: \(T, 2\)"):
        load(path, bounds=([-1, -1], [1, 1]))
    assert len(load(path, bounds=([-1] * 7, 1))) == EPISODES * STEPS


def test_bounds_may_be_an_array(tmp_path: Path) -> None:
    path = write(tmp_path / "a.hdf5", next_obs=True)
    told = load(path, bounds=np.array([-2.0, 2.0])).metadata["action_bounds"]
    assert told == {"low": -2.0, "high": 2.0}


# -- several files ---------------------------------------------------------------------------------


def test_files_become_one_without_losing_an_episode(tmp_path: Path, capsys: Any) -> None:
    paths = [write(tmp_path / f"{i}.hdf5", next_obs=True) for i in range(3)]
    for i, path in enumerate(paths[:2]):
        with h5py.File(path, "a") as file:
            file["mask/train"] = np.array([f"demo_{i}", "demo_3"], dtype="S")
            file["data"].attrs["author"] = f"author {i}"
    target = tmp_path / "all.hdf5"
    assert main(["convert", *map(str, paths), str(target), "--to", "robomimic"]) == 0
    told = capsys.readouterr().out
    assert f"{target}: robomimic, 12 episodes, 240 steps, reward 12, 0 successes" in told
    assert "left out, because the format has no place for it: author" in told
    data = load(target)[:]
    assert data["episode"].unique().tolist() == list(range(12))
    masks = read_metadata(target)["masks"]
    assert masks == {"train": ["demo_0", "demo_3", "demo_5", "demo_7"]}


def test_files_of_other_bounds_do_not_become_one(tmp_path: Path) -> None:
    one = write(tmp_path / "a.hdf5", next_obs=True)
    two = write(tmp_path / "b.hdf5", next_obs=True)
    with h5py.File(two, "a") as file:
        file["data"].attrs["action_bounds"] = json.dumps({"low": -2, "high": 2})
    with pytest.raises(ConfigError, match=r"b\.hdf5 have bounds .*; valid: equal bounds"):
        convert([one, two], tmp_path / "c.hdf5", to="robomimic")


def test_equal_bounds_are_equal_however_they_are_written(tmp_path: Path) -> None:
    one, other = (write(tmp_path / f"{name}.hdf5", next_obs=True) for name in "ab")
    with h5py.File(other, "r+") as file:
        file["data"].attrs["action_bounds"] = json.dumps({"low": [-1] * 7, "high": [1] * 7})
    done = convert([one, other], tmp_path / "c.hdf5", to="robomimic")
    assert done.account.read.episodes == 2 * EPISODES
    assert not any("action_bounds" in note for note in done.notes)


def test_files_become_one_with_the_range_of_them_all(tmp_path: Path) -> None:
    low, high = np.linspace(-3, 0, STEPS)[:, None], np.linspace(0, 2, STEPS)[:, None]
    one = write(tmp_path / "a.hdf5", put("actions", low), next_obs=True)
    other = write(tmp_path / "b.hdf5", put("actions", high), next_obs=True)
    convert([one, other], tmp_path / "c.hdf5", to="robomimic", bounds="data")
    assert read_metadata(tmp_path / "c.hdf5")["action_bounds"] == {"low": [-3.0], "high": [2.0]}


def test_a_mask_that_some_of_the_files_lack_is_said(tmp_path: Path) -> None:
    one, other = (write(tmp_path / f"{name}.hdf5", next_obs=True) for name in "ab")
    with h5py.File(one, "r+") as file:
        file["mask/train"] = [b"demo_0"]
    done = convert([one, other], tmp_path / "c.hdf5", to="robomimic")
    assert any(f"mask train has no episodes of {other}" in note for note in done.notes)


def test_an_iterator_of_keys_serves_all_files(tmp_path: Path) -> None:
    files = [write(tmp_path / f"{name}.hdf5", next_obs=True) for name in "ab"]
    done = convert(files, tmp_path / "c.hdf5", to="robomimic", observation_keys=iter(["x"]))
    assert done.account.read.episodes == 2 * EPISODES
