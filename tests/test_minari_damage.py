"""A damaged data set of Minari's is refused with its file and key; contradictions are reported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("minari")

import h5py
from episode_files import assert_same
from file_edits import LFS_POINTER, change, first_chunk, put, remove
from minari_files import (
    NUMBERS,
    Damage,
    data_set,
    find_oddities,
    in_metadata,
    in_numbers,
    minari_episodes,
    open_episodes,
    open_raw,
    read,
)

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.minari import write_episodes
from torchrl_bmrl.errors import DataError

# Minari warns of data sets that name no author, environment or code.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


@pytest.fixture
def path(minari_root: Path) -> Path:
    return data_set(minari_root)


def overwrite(name: str, content: bytes | None) -> Damage:
    """Replaces a file of the data set, or removes it where there is no content."""

    def damage(path: Path) -> None:
        file = path / "data" / name
        if content is None:
            file.unlink()
        else:
            file.write_bytes(content)

    return damage


def truncate(path: Path) -> None:
    file = path / NUMBERS
    file.write_bytes(file.read_bytes()[:-100])


DAMAGES: dict[str, tuple[Damage, str]] = {
    "no numbers": (overwrite("main_data.hdf5", None), "main_data.hdf5: no such file"),
    "no metadata": (overwrite("metadata.json", None), "metadata.json: no such file"),
    "empty file": (overwrite("main_data.hdf5", b""), "main_data.hdf5: not a complete HDF5 file"),
    "truncated file": (truncate, "main_data.hdf5: not a complete HDF5 file"),
    "pointer": (overwrite("main_data.hdf5", LFS_POINTER), "main_data.hdf5: a git-LFS pointer"),
    "pointer of metadata": (overwrite("metadata.json", LFS_POINTER), "metadata.json: a git-LFS"),
    "half metadata": (overwrite("metadata.json", b'{"total'), "metadata.json: not Minari's"),
    "a list": (overwrite("metadata.json", b"[]"), "metadata.json: not Minari's metadata"),
    "no space": (in_metadata(observation_space=None), "observation_space: missing"),
    "no part in the space": (
        in_metadata(observation_space='{"type": "Dict", "subspaces": {}}'),
        "observation_space: no part; valid: at least one",
    ),
    "Arrow": (in_metadata(data_format="arrow"), "data_format: 'arrow'; valid: 'hdf5'"),
    "no episodes": (
        in_numbers(lambda file: file.clear()),
        "main_data.hdf5: no episodes; valid: at least episode_0",
    ),
    "no rewards": (in_numbers(remove("episode_1/rewards")), "episode_1/rewards: missing"),
    "no part": (
        in_numbers(remove("episode_1/observations/joints")),
        "observations/joints: missing",
    ),
    "no flags": (in_numbers(remove("episode_1/truncations")), "episode_1/truncations: missing"),
    "T observations": (
        in_numbers(put("episode_1/observations/joints", np.zeros((7, 7)))),
        r"episode_1/observations/joints: shape \(7, 7\); valid: 8 rows",
    ),
    "T - 1 rewards": (
        in_numbers(put("episode_1/rewards", np.zeros(6))),
        "rewards: shape .*valid: 7 rows",
    ),
    "infos of 3": (
        in_numbers(put("episode_1/infos/success", np.zeros(3))),
        "success: .*valid: 7 or 8 rows",
    ),
    "no action": (
        in_numbers(put("episode_1/actions", np.zeros((0, 7)))),
        r"episode_1/actions: shape \(0, 7\); valid: 7 rows, since most arrays have 7 steps",
    ),
    "a number": (
        in_numbers(put("episode_1/actions", 3.0)),
        "actions: one number; valid: a row for each",
    ),
    "half an action more": (
        in_numbers(put("episode_1/actions", np.zeros((7, 8), np.float32))),
        r"episode_1/actions: shape \(7, 8\); valid: \(T, 7\), as metadata.json says",
    ),
    "actions of integers": (
        in_numbers(put("episode_1/actions", np.zeros((7, 7), int))),
        "episode_1/actions: dtype int64; valid: float32, as metadata.json says",
    ),
    "a part of other rows": (
        in_numbers(put("episode_1/observations/joints", np.zeros((8, 3), np.float32))),
        r"observations/joints: shape \(8, 3\); valid: \(T, 7\), as metadata.json says",
    ),
    "a part of floats": (
        in_numbers(put("episode_1/observations/touch", np.zeros((8, 4)))),
        "observations/touch: dtype float64; valid: int32, as metadata.json says",
    ),
    "half an end": (
        in_numbers(put("episode_1/terminations", np.linspace(0, 0.5, 7))),
        "episode_1/terminations: 0.083.* in row 1; valid: 0 or 1",
    ),
    "text": (in_numbers(put("episode_1/rewards", b"abc")), "episode_1/rewards: dtype"),
    "infos are an array": (
        in_numbers(put("episode_1/infos", np.zeros(7))),
        "episode_1/infos: not a group",
    ),
    "an early end": (
        in_numbers(put("episode_1/truncations", np.arange(7) == 3)),
        "episode_1/truncations: set in row 3 of 7; valid: in the last only",
    ),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damage_is_refused_with_file_and_key(path: Path, case: str) -> None:
    damage, message = DAMAGES[case]
    damage(path)
    with pytest.raises(DataError, match=message):
        read(path)


def test_one_damaged_episode_leaves_the_others_readable(path: Path) -> None:
    in_numbers(remove("episode_1/rewards"))(path)
    with open_episodes(path) as episodes:
        assert_same(episodes["episode_2"], minari_episodes()[2])
        with pytest.raises(DataError, match="episode_1/rewards"):
            episodes["episode_1"]


def test_a_hole_in_the_file_is_found(path: Path) -> None:
    file = path / NUMBERS
    hole = first_chunk(file, "episode_1/observations/eef_pos")
    content = bytearray(file.read_bytes())
    content[hole] = bytes(hole.stop - hole.start)
    file.write_bytes(content)
    with pytest.raises(DataError, match="episode_1/observations/eef_pos: unreadable"):
        read(path)


@pytest.mark.parametrize(
    ("key", "row", "says"),
    [
        ("observations/x", -1, "a value that is not finite in row 5"),
        ("infos/success", 2, "nan in row 2; valid: 0 or 1"),
    ],
)
def test_what_is_not_finite_is_named_as_the_file_has_it(
    tmp_path: Path, key: str, row: int, says: str
) -> None:
    x = np.zeros((6, 3))
    episode = Episode(
        observations={"x": x[:-1]},
        next_observations={"x": x[1:]},
        actions=np.zeros((5, 2)),
        rewards=np.zeros(5),
        terminated=np.zeros(5, bool),
        extras={"successes": np.zeros(5)},
    )
    path = tmp_path / "own" / "lift-v0"
    write_episodes(path, [episode])
    in_numbers(change(f"episode_0/{key}", row, np.nan))(path)
    with open_raw(path) as episodes, pytest.raises(DataError) as caught:
        episodes["episode_0"]
    assert (caught.value.key, caught.value.message) == (f"episode_0/{key}", says)


# -- what is reported and read all the same --------------------------------------------------------


def test_what_is_not_read_is_named(path: Path) -> None:
    with h5py.File(path / NUMBERS, "r+") as file:
        group = file["episode_1"]
        group["camera"] = np.zeros(7)
        group["observations/video"] = np.zeros((8, 3))
        group["infos/nested/x"] = np.zeros(8)
        group["infos/note"] = [b"a"] * 8
        group["infos/other"] = np.zeros(3)
        group["infos/number"] = 3.0
        group["infos/rewards"] = np.zeros(8)  # a name of robomimic's layout
        group["infos/successes"] = np.zeros(8)  # infos/success is read as successes
        file["notes/x"] = np.zeros(3)
        file["episode_01"] = 3.0
    with open_raw(path) as episodes:
        assert list(episodes) == ["episode_0", "episode_1", "episode_2"]
        assert episodes["episode_0"].left_alone == ()
        assert set(episodes["episode_1"].extras) == {"successes", "phases", "states"}
        assert episodes["episode_1"].left_alone == (
            "camera",
            *(f"infos/{name}" for name in ("nested", "note", "number", "other", "rewards")),
            "infos/successes",
            "observations/video",
        )
    with open_episodes(path) as episodes:
        assert episodes["episode_1"].left_out.arrays[0] == "camera"
        assert_same(episodes["episode_1"], minari_episodes()[1])
    assert find_oddities(path) == ["beside the episodes, not read: 'episode_01', 'notes'"]


def change_attribute(name: str, key: str, value: Any) -> Damage:
    return in_numbers(lambda file: file[name].attrs.__setitem__(key, value))


CONTRADICTIONS: dict[str, tuple[Damage, list[str]]] = {
    "total_steps of an episode": (
        change_attribute("episode_1", "total_steps", 9),
        [
            "the attribute total_steps contradicts name and arrays in 1 episodes, such as "
            "episode_1 (9, not 7)"
        ],
    ),
    "id": (
        change_attribute("episode_2", "id", 0),
        [
            "the attribute id contradicts name and arrays in 1 episodes, such as episode_2 "
            "(0, not 2)"
        ],
    ),
    "total_steps": (
        in_metadata(total_steps=15),
        ["total_steps is 15 in metadata.json, the arrays have 16"],
    ),
    "total_episodes": (
        in_metadata(total_episodes="four"),
        ["total_episodes is 'four' in metadata.json, the arrays have 3"],
    ),
    "a missing episode": (
        in_numbers(remove("episode_1")),
        [
            "1 episodes are missing, such as episode_1",
            "total_episodes is 3 in metadata.json, the arrays have 2",
            "total_steps is 16 in metadata.json, the arrays have 9",
        ],
    ),
    "integers in a box of floats": (
        in_numbers(put("episode_0/observations/joints", np.zeros((6, 7), np.int16))),
        [
            "observations/joints: int16, though its space is of float32 in 1 episodes, such as "
            "episode_0"
        ],
    ),
    "no totals": (in_metadata(total_steps=None, total_episodes=None), []),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_what_contradicts_the_arrays_is_said_and_the_arrays_are_read(path: Path, case: str) -> None:
    damage, oddities = CONTRADICTIONS[case]
    assert find_oddities(path) == []
    damage(path)
    assert find_oddities(path) == oddities
    lengths = [len(episode) for episode in read(path)]
    assert lengths == ([5, 4] if case == "a missing episode" else [5, 7, 4])


def test_a_reward_of_another_layout_is_asked_for(path: Path) -> None:
    in_numbers(remove("episode_1/rewards"))(path)
    with open_raw(path) as episodes:
        assert episodes["episode_1"].rewards is None
