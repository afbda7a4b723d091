"""D4RL's flat files are read row by row, and refused with the key and row at fault."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

pytest.importorskip("h5py")

import h5py
from d4rl_files import (
    LENGTHS,
    NAMES,
    N,
    find_oddities,
    joined,
    make_arrays,
    open_raw,
    read,
    read_metadata,
    write,
)

from torchrl_bmrl.data import d4rl_layout
from torchrl_bmrl.data.d4rl import is_d4rl
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import complete
from torchrl_bmrl.errors import DataError


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "hopper.hdf5"


def test_every_row_is_read_once_where_it_is(path: Path) -> None:
    arrays = make_arrays()
    episodes = read(write(path, arrays))
    assert list(episodes) == NAMES
    assert [len(raw.actions) for raw in episodes.values()] == list(LENGTHS.values())
    for field in ("observations", "next_observations", "actions", "rewards"):
        assert_array_equal(joined(episodes, field), arrays[field], strict=True)
    assert_array_equal(joined(episodes, "terminated"), arrays["terminals"], strict=True)
    for raw in episodes.values():
        assert (raw.extras, raw.left_alone, raw.dones, raw.succeeded) == ({}, (), None, None)
    assert find_oddities(path) == [
        "rows 16 to 18 end in neither a terminal nor a timeout: read as an episode that was cut"
    ]


def test_named_parts_are_read_and_what_lies_beside_them_is_named(path: Path) -> None:
    arrays = make_arrays()
    x, after = arrays.pop("observations"), arrays.pop("next_observations")
    arrays |= {f"observations/{name}": x[:, i] for i, name in enumerate("abc")}
    arrays |= {f"next_observations/{name}": after[:, i] for i, name in enumerate("abc")}
    write(path, arrays, **{"observations/text": [b"a"] * N, "next_observations/d": np.zeros(N)})
    raw = read(path)["rows_4_to_9"]
    assert list(raw.observations) == list("abc")
    assert_array_equal(raw.observations["b"], x[4:10, 1], strict=True)
    assert raw.next_observations is not None
    assert_array_equal(raw.next_observations["c"], after[4:10, 2], strict=True)
    assert raw.left_alone == ("observations/text", "next_observations/d")


def test_older_files_have_columns_and_single_actions(path: Path) -> None:
    arrays = make_arrays()
    columns = {
        key: arrays[key].astype(np.float64)[:, None] for key in ("rewards", "terminals", "timeouts")
    }
    episodes = read(write(path, arrays, **columns, actions=arrays["actions"][:, 0]))
    assert list(episodes) == NAMES
    assert_array_equal(joined(episodes, "actions"), arrays["actions"][:, :1], strict=True)
    assert_array_equal(joined(episodes, "rewards"), arrays["rewards"].astype(float), strict=True)
    assert_array_equal(joined(episodes, "terminated"), arrays["terminals"], strict=True)


def test_actions_that_are_numbers_of_choices_stay_numbers(path: Path) -> None:
    choices = np.arange(N) % 4
    episodes = read(write(path, make_arrays(), actions=choices))
    assert_array_equal(joined(episodes, "actions"), choices, strict=True)


def test_infos_and_other_arrays_of_n_rows_become_extras(path: Path) -> None:
    rows = np.arange(N)
    more = {
        "infos/qpos": rows[:, None] * np.ones((1, 5)),
        "infos/policy/log_prob": rows / 7,
        "infos/success": (rows % 5 == 4)[:, None].astype(np.float64),
        "infos/rewards": rows,  # a name of robomimic's layout
        "infos/text": [b"a"] * N,
        "infos/short": rows[:-1],
        "goals": rows * 3,
        "qpos": rows,  # infos/qpos takes the name
        "policy_net/weights": np.zeros((N, 2)),
        "version": 3.0,
        "infos/link": h5py.SoftLink("/nowhere"),
    }
    episodes = read(write(path, make_arrays(), **more))
    raw = episodes["rows_10_to_15"]
    assert set(raw.extras) == {"qpos", "policy_log_prob", "successes", "goals"}
    assert_array_equal(raw.extras["qpos"], more["infos/qpos"][10:16], strict=True)
    assert_array_equal(raw.extras["policy_log_prob"], rows[10:16] / 7, strict=True)
    assert_array_equal(raw.extras["successes"], rows[10:16] % 5 == 4, strict=True)
    assert_array_equal(raw.extras["goals"], rows[10:16] * 3, strict=True)
    assert raw.left_alone == (
        *("infos/link", "infos/rewards", "infos/short", "infos/text"),
        *("policy_net", "qpos", "version"),
    )


def test_metadata_is_told_and_large_arrays_are_named(path: Path) -> None:
    write(
        path,
        make_arrays(),
        **{
            "metadata/algorithm": "SAC",
            "metadata/iteration": 100,
            "metadata/policy/nonlinearity": np.bytes_("relu"),
            "metadata/policy/fc0/weight": np.zeros((3, 4)),
            "metadata/policy/fc0/bias": np.zeros(4),
        },
    )
    with h5py.File(path, "r+") as file:
        file.attrs["author"] = "someone"
        file["metadata"].attrs["env"] = "hopper-medium-v2"
    assert read_metadata(path) == {
        "author": "someone",
        "env": "hopper-medium-v2",
        "algorithm": "SAC",
        "iteration": 100,
        "policy/nonlinearity": "relu",
    }
    assert find_oddities(path)[-1] == (
        "2 arrays below metadata are not read, such as metadata/policy/fc0/bias"
    )


def test_a_circle_of_groups_ends(path: Path) -> None:
    write(path, make_arrays(), **{"infos/a": np.arange(N), "metadata/b": 1})
    with h5py.File(path, "r+") as file:
        file["infos/self"] = h5py.SoftLink("/infos")
        file["metadata/self"] = file["metadata"]
    raw = read(path)["rows_0_to_3"]
    assert "a" in raw.extras
    assert any(key.startswith("infos/self/self") for key in raw.left_alone)
    assert read_metadata(path)["b"] == 1


def test_no_more_than_an_episode_is_read_at_once(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(path, make_arrays(), **{"infos/qpos": np.zeros((N, 4))})
    sizes: dict[str, int] = {}
    whole = h5py.Dataset.__getitem__

    def getitem(self: Any, rows: Any, **options: Any) -> Any:
        array = whole(self, rows, **options)
        sizes[self.name] = max(sizes.get(self.name, 0), len(array))
        return array

    monkeypatch.setattr(h5py.Dataset, "__getitem__", getitem)
    monkeypatch.setattr(d4rl_layout, "BLOCK", 40)
    read(path)
    find_oddities(path)
    flags = {"/terminals": N, "/timeouts": N}
    large = ("observations", "next_observations", "actions", "rewards", "infos/qpos")
    assert sizes == {**{f"/{key}": 6 for key in large}, **flags}


def test_without_rewards_they_are_asked_for(path: Path) -> None:
    write(path, make_arrays(), rewards=None)
    raw = read(path)["rows_0_to_3"]
    assert raw.rewards is None
    with pytest.raises(DataError, match=r"rows_0_to_3/rewards: missing; valid: .*option reward"):
        complete(path, "rows_0_to_3", raw, ReadOptions())
    assert complete(path, "", raw, ReadOptions(reward="last")).rewards.tolist() == [0, 0, 0, 1]


# -- what is recognised, and what is refused -------------------------------------------------------


@pytest.mark.parametrize(
    ("keys", "flat"),
    [
        (("observations", "actions", "rewards", "terminals"), True),
        (("actions", "rewards"), True),
        (("data/demo_0/actions",), False),
        (("data/demo_0/actions", "actions", "rewards"), False),
        (("actions",), False),
    ],
)
def test_flat_files_are_recognised(path: Path, keys: tuple[str, ...], flat: bool) -> None:
    write(path, {key: np.zeros(3) for key in keys})
    with h5py.File(path) as file:
        assert is_d4rl(path, file) == flat


def with_value(key: str, row: int, value: float) -> Callable[[dict[str, Any]], dict[str, Any]]:
    def change(arrays: dict[str, Any]) -> dict[str, Any]:
        array = arrays[key].astype(np.float64)
        array[row] = value
        return {key: array}

    return change


REFUSED: dict[str, tuple[Callable[[dict[str, Any]], dict[str, Any]], str]] = {
    "no observations": (lambda a: {"observations": None}, "hdf5: observations: missing"),
    "no actions": (lambda a: {"actions": None}, "actions: missing"),
    "no terminals": (lambda a: {"terminals": None}, "terminals: missing"),
    "a row less": (
        lambda a: {"actions": a["actions"][:-1]},
        r"actions: shape \(18, 2\); valid: 19 rows, since most arrays have 19 steps",
    ),
    "a row more": (
        lambda a: {"timeouts": np.append(a["timeouts"], True)},
        r"timeouts: shape \(20,\); valid: 19 rows",
    ),
    "a number": (lambda a: {"rewards": 1.0}, "rewards: one number; valid: a row for each step"),
    "wide rewards": (
        lambda a: {"rewards": np.zeros((N, 2))},
        r"rewards: rows of shape \(2,\); valid: one number in each",
    ),
    "other next observations": (
        lambda a: {"next_observations": a["next_observations"][:, :2]},
        r"next_observations: float32 of shape \(19, 2\); valid: float32 of \(19, 3\), as obs",
    ),
    "next observations of float64": (
        lambda a: {"next_observations": a["next_observations"].astype(float)},
        r"next_observations: float64 of shape",
    ),
    "text": (lambda a: {"rewards": [b"a"] * N}, r"rewards: dtype .*; valid: numbers"),
    "half a terminal": (with_value("terminals", 7, 0.5), "terminals: 0.5 in row 7; valid: 0 or 1"),
    "NaN in a flag": (with_value("timeouts", 7, np.nan), "timeouts: nan in row 7; valid: 0 or 1"),
    "NaN": (with_value("rewards", 12, np.nan), "rewards: a value that is not finite in row 12"),
    "infinity": (with_value("actions", 17, -np.inf), "actions: .* not finite in row 17"),
    "success of 2": (
        lambda a: {"infos/success": 2 * (np.arange(N) == 11)},
        "infos/success: 2 in row 11; valid: 0 or 1",
    ),
    "success of fewer rows": (
        lambda a: {"infos/success": np.zeros(N - 1)},
        r"infos/success: shape \(18,\); valid: 19 rows",
    ),
    "no rows": (
        lambda a: {key: array[:0] for key, array in a.items()},
        r"actions: shape \(0, 2\); valid: at least one row",
    ),
    "another file": (
        lambda a: {"next_observations": h5py.ExternalLink("other.hdf5", "observations")},
        r"next_observations: lies in .*other.hdf5; valid: in this file",
    ),
    "a group": (
        lambda a: {"actions": None, "actions/x": np.zeros(N)},
        "actions: a group; valid: a dataset",
    ),
    "no part": (
        lambda a: {"observations": None, "observations/x": [b"a"] * N},
        "observations: no part of the observation; valid: at least one",
    ),
    "a part without a next one": (
        lambda a: {
            **{"observations": None, "next_observations": None},
            **{"observations/x": a["observations"], "observations/y": a["observations"]},
            "next_observations/x": a["next_observations"],
        },
        "next_observations/y: missing",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_refused_with_the_files_own_key_and_row(
    path: Path, case: str
) -> None:
    change, message = REFUSED[case]
    write(path.with_name("other.hdf5"), make_arrays())
    arrays = make_arrays()
    write(path, arrays, **change(arrays))
    with pytest.raises(DataError, match=message):
        read(path)


def test_one_damaged_episode_leaves_the_others_readable(path: Path) -> None:
    arrays = make_arrays()
    write(path, arrays, **with_value("rewards", 12, np.nan)(arrays))
    with open_raw(path) as episodes:
        assert len(episodes["rows_4_to_9"].actions) == 6
        with pytest.raises(DataError, match="row 12"):
            episodes["rows_10_to_15"]


@pytest.mark.parametrize("key", ["infos", "goals", "infos/qpos"])
def test_what_is_damaged_is_not_taken_for_what_is_not_there(path: Path, key: str) -> None:
    with h5py.File(path, "w", libver=("v110", "v110")) as file:
        for name, array in make_arrays().items():
            file[name] = array
        file["infos/qpos"], file["goals"] = np.zeros(N), np.ones(N)
        address = h5py.h5o.get_info(file[key].id).addr
    content = bytearray(path.read_bytes())
    content[address + 4] ^= 1  # the version of the header
    path.write_bytes(content)
    with pytest.raises(DataError, match=f"{key}: unreadable"):
        read(path)
