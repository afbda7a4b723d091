"""Episodes in Minari's layout come back to the bit, and Minari and TorchRL read them alike."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

pytest.importorskip("h5py")
pytest.importorskip("minari")

import h5py
import minari
from episode_files import assert_identical, assert_same
from file_edits import layout_version
from minari_files import (
    BOXES,
    ID,
    NUMBERS,
    data_set,
    make_buffer,
    minari_episode,
    minari_episodes,
    open_episodes,
    read,
    write_with_minari,
)
from tensordict import TensorDict
from torchrl.data.datasets.minari_data import MinariExperienceReplay

from torchrl_bmrl.data.episodes import Episode, stack_episodes
from torchrl_bmrl.data.minari import join_observations, new_folder, write_episodes
from torchrl_bmrl.errors import BMRLError, DataError

# Minari warns of data sets that name no author, environment or code.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


@pytest.fixture
def path(minari_root: Path) -> Path:
    return data_set(minari_root)


def test_episodes_come_back_to_the_bit(path: Path) -> None:
    with open_episodes(path) as episodes:
        assert list(episodes) == ["episode_0", "episode_1", "episode_2"]
        for ours, theirs in zip(episodes.values(), minari_episodes(), strict=True):
            assert_same(ours, theirs)
            assert list(ours.observations) == list(theirs.observations)


def with_tuples(attributes: Mapping[str, Any]) -> dict[str, Any]:
    return {k: tuple(v) if isinstance(v, list) else v for k, v in attributes.items()}


def test_what_was_read_is_written_again_to_the_byte(path: Path, minari_root: Path) -> None:
    copy, again = minari_root / "copies/lift-v0", minari_root / "again/lift-v0"
    with open_episodes(path) as episodes:
        write_episodes(copy, episodes.values(), fps=20, description="lifts")
    with h5py.File(path / NUMBERS) as ours, h5py.File(copy / NUMBERS) as theirs:
        keys: list[str] = []
        copied: list[str] = []
        ours.visit(keys.append)
        theirs.visit(copied.append)
        assert sorted(keys) == sorted(copied)
        for key in keys:
            assert set(ours[key].attrs) == set(theirs[key].attrs)
            for name, value in ours[key].attrs.items():
                assert_identical(value, theirs[key].attrs[name])
            if isinstance(ours[key], h5py.Dataset):
                assert_identical(ours[key][()], theirs[key][()])
    # The file holds no time of day, and a tuple is stored as a list.
    tuples = [replace(e, attributes=with_tuples(e.attributes)) for e in minari_episodes()]
    write_episodes(again, tuples)
    assert (again / NUMBERS).read_bytes() == (path / NUMBERS).read_bytes()


def test_more_than_ten_episodes_keep_their_order(minari_root: Path) -> None:
    made = [minari_episode(i, 2 + i) for i in range(12)]
    write_episodes(minari_root / ID, made)
    assert [len(episode) for episode in read(minari_root / ID)] == [
        len(episode) for episode in made
    ]


def test_rows_are_where_the_layout_says(path: Path) -> None:
    episode = minari_episodes()[1]
    with h5py.File(path / NUMBERS) as file:
        group = file["episode_1"]
        assert_array_equal(group["infos/success"][1:], episode.extras["successes"])
        assert not group["infos/success"][0]
        assert_array_equal(group["infos/states"][:-1], episode.extras["states"])
        assert_array_equal(group["infos/states"][-1], episode.extras["states"][-1])
        assert group["terminations"][()].tolist() == [False] * 6 + [True]
        assert not group["truncations"][()].any()
        assert file["episode_0/truncations"][()].tolist() == [False] * 4 + [True]


def test_files_are_written_as_older_versions_of_hdf5_read_them(path: Path) -> None:
    for key in ("actions", "observations/wrist", "infos/success"):
        assert layout_version(path / NUMBERS, f"episode_1/{key}") == 4


def test_neither_the_users_data_sets_nor_a_rest_of_the_writing_are_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MINARI_DATASETS_PATH", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    write_episodes(tmp_path / "a" / ID, minari_episodes())
    assert os.environ.get("MINARI_DATASETS_PATH") is None
    assert not (tmp_path / "home").exists()
    assert [file.name for file in (tmp_path / "a" / "sawyer").iterdir()] == ["lift-v0"]


# -- other readers ---------------------------------------------------------------------------------


def test_minari_iterates_over_the_same_episodes(path: Path) -> None:
    dataset = minari.load_dataset(ID)
    made = minari_episodes()
    assert (dataset.id, dataset.total_steps) == (ID, 16)
    assert list(minari.list_local_datasets()) == [ID]
    assert dataset.storage.metadata["description"] == "lifts"
    assert dataset.storage.metadata["fps"] == 20
    seeds = [data["seed"] for data in dataset.storage.get_episode_metadata(range(3))]
    assert seeds == [episode.attributes["seed"] for episode in made]
    for i, (ours, theirs) in enumerate(zip(dataset, made, strict=True)):
        for part, array in join_observations(path, "", theirs).items():
            assert_identical(ours.observations[part], array)
        assert_identical(ours.actions, theirs.actions)
        assert_identical(ours.rewards, theirs.rewards)
        assert_identical(ours.terminations, theirs.terminated)
        assert ours.truncations[-1] == (i != 1)
        assert_identical(ours.infos["success"][1:], theirs.extras["successes"])
        for row in range(len(theirs)):
            observation = {part: array[row] for part, array in ours.observations.items()}
            assert dataset.observation_space.contains(observation)
            assert dataset.action_space.contains(ours.actions[row])


def read_with_torchrl(tmp_path: Path) -> TensorDict:
    return MinariExperienceReplay(
        ID, batch_size=None, root=tmp_path / "torchrl", load_from_local_minari=True
    )[:]


def test_torchrl_reads_the_same_transitions(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The next test shows why: memmap keeps the values, as TorchRL intends.
    monkeypatch.setattr(TensorDict, "memmap_like", TensorDict.memmap)
    made = minari_episodes()
    ours, expected = read_with_torchrl(tmp_path), stack_episodes(made, task=0)
    for part in made[0].observations:
        assert_identical(ours["observation", part], expected[part])
        assert_identical(ours["next", "observation", part], expected["next", part])
    for key in ("action", "episode", ("next", "done"), ("next", "terminated")):
        assert_identical(ours[key], expected[key])
    assert_identical(ours["next", "truncated"], expected["next", "truncated"])
    rewards = np.concatenate([episode.rewards for episode in made])
    assert_identical(ours["next", "reward"].squeeze(-1), rewards)
    assert_identical(ours["next", "info", "success"], expected["next", "success"].squeeze(-1))
    for extra in ("phases", "states"):
        assert_identical(ours["info", extra], np.concatenate([e.extras[extra] for e in made]))


@pytest.mark.xfail(
    strict=True,
    reason="TorchRL 0.14.1 reads every Minari data set as zeros: it stores what it has read with "
    "memmap_like, which keeps only shapes",
)
def test_torchrl_as_it_is_reads_values(minari_root: Path, tmp_path: Path) -> None:
    write_with_minari(*BOXES, make_buffer(4), make_buffer(3))
    assert read_with_torchrl(tmp_path)["action"].any()


# -- refused when writing --------------------------------------------------------------------------


def jump(episode: Episode) -> Episode:
    """A next observation that is not the next step's observation."""
    parts = dict(episode.next_observations)
    parts["joints"] = parts["joints"] + (np.arange(len(episode)) == 2)[:, None].astype(np.float32)
    return replace(episode, next_observations=parts)


REFUSED: dict[str, tuple[Callable[[Episode], Episode], str]] = {
    "a jump": (jump, r"episode_1/next_obs/joints: row 2 differs from row 3.*valid: one sequence"),
    "other dtypes": (
        lambda e: replace(e, rewards=e.rewards.astype(np.float32)),
        "episode_1/rewards: dtype float32",
    ),
    "missing extras": (
        lambda e: replace(e, extras={"successes": e.extras["successes"]}),
        "episode_1/phases: missing",
    ),
    "too few rows": (lambda e: replace(e, rewards=e.rewards[:-1]), "episode_1/rewards: shape"),
    "a dictionary": (
        lambda e: replace(e, attributes={"a": {"b": 1}}),
        "episode_1, attribute 'a': dict; valid: numbers, strings",
    ),
    "Minari's attribute": (lambda e: replace(e, attributes={"id": 3}), "attribute 'id'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_an_episode_that_cannot_be_kept_leaves_nothing(minari_root: Path, case: str) -> None:
    change, message = REFUSED[case]
    with pytest.raises(DataError, match=message):
        write_episodes(minari_root / ID, [minari_episode(0), change(minari_episode(1))])
    assert list((minari_root / "sawyer").iterdir()) == []


@pytest.mark.parametrize(
    ("extras", "message"),
    [
        ({"success": np.zeros(5, bool)}, "episode_0/success: .*'successes'"),
        ({"big": np.zeros(5, np.uint64)}, "episode_0/infos/big: uint64"),
        ({"a/b": np.zeros(5)}, "episode_0/infos/a/b: valid: names without '/'"),
        ({"text": np.array(list("abcde"))}, "episode_0/text: dtype <U1"),
    ],
)
def test_an_extra_that_cannot_be_kept_is_refused(
    minari_root: Path, extras: dict[str, np.ndarray], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        write_episodes(minari_root / ID, [replace(minari_episode(), extras=extras)])


@pytest.mark.parametrize("name", ["sawyer/lift", "sawyer/lift-v", "sawyer/a b-v0", "s.x/lift-v0"])
def test_a_name_that_is_no_id_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match=r"valid: <namespace>/<name>-v<number>"):
        write_episodes(tmp_path / name, minari_episodes())
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_and_no_episodes_are_refused(path: Path) -> None:
    with pytest.raises(DataError, match="exists already"):
        write_episodes(path, minari_episodes())
    assert len(read(path)) == 3
    with pytest.raises(DataError, match="no episodes; valid: at least one"):
        write_episodes(path.with_name("empty-v0"), [])
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_nothing_is_seen_before_all_is_written(minari_root: Path) -> None:
    def episodes() -> Iterator[Episode]:
        yield minari_episode()
        assert not (minari_root / ID).exists()
        assert minari.list_local_datasets() == {}
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_episodes(minari_root / ID, episodes())
    assert list((minari_root / "sawyer").iterdir()) == []


def test_a_folder_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    target = tmp_path / "new"

    def write() -> None:
        with new_folder(target) as temporary:
            (temporary / "ours").touch()
            target.mkdir()
            (target / "theirs").touch()

    with pytest.raises(OSError, match="not empty"):
        write()
    assert [file.name for file in target.iterdir()] == ["theirs"]
    assert list(tmp_path.iterdir()) == [target]


def test_without_minari_writing_says_what_to_install_and_reading_works(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "minari"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(BMRLError, match=r'valid: pip install "torchrl_bmrl\[data\]"'):
        write_episodes(path.with_name("other-v0"), minari_episodes())
    assert len(read(path)) == 3
