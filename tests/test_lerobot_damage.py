"""A damaged LeRobot data set is refused by name; what is read accounts for every step."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("pyarrow")
pytest.importorskip("tqdm")

import pyarrow as pa
import pyarrow.parquet as pq
from file_edits import LFS_POINTER
from lerobot_files import (
    FIRST,
    LENGTHS,
    VERSIONS,
    Columns,
    columns_of,
    edit_data,
    edit_info,
    open_raw,
    write,
)

from torchrl_bmrl.data.account import Account
from torchrl_bmrl.data.convert import open_source
from torchrl_bmrl.data.schema import find_problems
from torchrl_bmrl.errors import DataError


def edited(change: Callable[[Columns], object]) -> Callable[[Path, str], None]:
    """A damage that changes the columns of the second episode."""

    def damage(path: Path, version: str) -> None:
        episodes = [columns_of(i) for i in range(len(LENGTHS))]
        change(episodes[1])
        write(path, version, episodes)

    return damage


def set_row(key: str, row: int, value: Any) -> Callable[[Columns], object]:
    def change(columns: Columns) -> None:
        values = list(columns[key])
        values[row] = value
        columns[key] = values

    return change


FAULTS: dict[str, tuple[Callable[[Columns], object], str]] = {
    "no action": (lambda c: c.pop("action"), "action: missing"),
    "no index": (lambda c: c.pop("frame_index"), "frame_index: missing"),
    "another episode": (set_row("episode_index", 2, 0), r"episode_index: 0 in row \d+; valid: 1"),
    "swapped rows": (set_row("frame_index", 2, 3), r"frame_index: 3 in row \d+; valid: 2"),
    "a gap": (set_row("index", 5, 99), r"index: 99 in row \d+; valid: 9"),
    "no value": (set_row("next.reward", 3, None), r"next\.reward: no value in row \d+"),
    "no list": (set_row("action", 1, None), r"action: no value in row \d+"),
    "no number": (set_row("action", 1, [0.5, None]), r"action: no value in row \d+"),
    "not finite": (
        set_row("observation.state", 5, [np.nan] * 3),
        r"observation\.state: a value that is not finite in row \d+",
    ),
    "a long list": (set_row("action", 4, [0.0] * 3), r"action: 3 numbers in row \d+; valid: 2"),
    "no flag": (
        lambda c: c.update({"next.done": [0, 0, 2, 0, 0, 1]}),
        r"next\.done: 2 in row \d+; valid: 0 or 1",
    ),
    "pairs of rewards": (
        lambda c: c.update({"next.reward": [[0.0, 1.0]] * 6}),
        r"next\.reward: rows of shape \(2,\); valid: one number in each",
    ),
    "uneven time": (
        set_row("timestamp", 3, 0.9),
        r"timestamp: .* does not match 10 steps a second",
    ),
}


ONE_SCHEMA = ("no action", "no index", "no flag", "pairs of rewards", "uneven time")
"""Faults that need another schema, so that episodes in the same file must have them too."""
CASES = [("v2.1", fault) for fault in FAULTS]
CASES += [("v3.0", fault) for fault in FAULTS if fault not in ONE_SCHEMA]


@pytest.mark.parametrize(("version", "fault"), CASES)
def test_a_fault_is_named_with_file_column_and_row(
    tmp_path: Path, version: str, fault: str
) -> None:
    change, says = FAULTS[fault]
    edited(change)(tmp_path / "set", version)
    with open_raw(tmp_path / "set") as episodes, pytest.raises(DataError, match=says) as caught:
        _ = episodes["episode_1"]
    assert caught.value.path.suffix == ".parquet"


META: dict[str, tuple[Callable[[Path], object], str]] = {
    "no info": (lambda p: (p / "meta/info.json").unlink(), "no such file"),
    "no JSON": (lambda p: (p / "meta/info.json").write_text("{"), "LeRobot's description"),
    "a list": (lambda p: (p / "meta/info.json").write_text("[]"), "valid: a JSON object"),
    "a pointer": (
        lambda p: (p / "meta/info.json").write_bytes(LFS_POINTER),
        "git-LFS pointer",
    ),
    "another version": (
        lambda p: (p / "meta/info.json").write_text('{"codebase_version": "v1.6"}'),
        r"codebase_version: 'v1\.6'; valid: v2\.0, v2\.1, v3\.0",
    ),
    "no features": (
        lambda p: (p / "meta/info.json").write_text('{"codebase_version": "v3.0"}'),
        "features: missing",
    ),
    "no episodes": (
        lambda p: (p / "meta/episodes/chunk-000/file-000.parquet").unlink(),
        "no parquet file",
    ),
    "a damaged table": (
        lambda p: (p / "meta/episodes/chunk-000/file-000.parquet").write_bytes(b"PAR1PAR1"),
        "not a whole parquet file",
    ),
}


@pytest.mark.parametrize("fault", META)
def test_a_fault_of_the_description_is_named(tmp_path: Path, fault: str) -> None:
    path = write(tmp_path / "set", "v3.0")
    damage, says = META[fault]
    damage(path)
    with pytest.raises(DataError, match=says), open_raw(path):
        pass


@pytest.mark.parametrize(
    ("key", "value"),
    [
        pytest.param("fps", 10**400, id="huge"),
        ("fps", True),
        ("fps", 0),
        ("fps", "10"),
        ("chunks_size", 0),
    ],
)
def test_numbers_that_mean_nothing_are_named(tmp_path: Path, key: str, value: Any) -> None:
    path = write(tmp_path / "set", "v2.1")
    edit_info(path, **{key: value})
    with pytest.raises(DataError, match=f"{key}: .*valid"), open_raw(path):
        pass


def test_a_pointer_in_place_of_the_data_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "set", "v2.1")
    (path / "data/chunk-000/episode_000001.parquet").write_bytes(LFS_POINTER)
    with open_raw(path) as episodes, pytest.raises(DataError, match="git lfs pull"):
        _ = episodes["episode_1"]


@pytest.mark.parametrize("version", FIRST)
def test_no_step_of_a_data_file_vanishes(tmp_path: Path, version: str) -> None:
    path = write(tmp_path / "set", version)
    edit_data(path, FIRST[version], lambda table: pa.concat_tables([table, table.slice(0, 2)]))
    with open_raw(path) as episodes, pytest.raises(DataError, match=r"\d rows; valid: \d"):
        episodes["episode_0"]


@pytest.mark.parametrize("version", FIRST)
def test_a_data_file_of_no_episode_is_refused(tmp_path: Path, version: str) -> None:
    path = write(tmp_path / "set", version)
    stray = path / "data" / "chunk-000" / "file-077.parquet"
    stray.write_bytes((path / FIRST[version]).read_bytes())
    with pytest.raises(DataError, match=r"file-077\.parquet: in no episode"), open_raw(path):
        pass


def test_a_column_that_the_description_tells_of_is_missed(tmp_path: Path) -> None:
    path = write(tmp_path / "set", "v2.1")
    edit_info(path, features={"next.reward": {"dtype": "float32", "shape": [1], "names": None}})
    edit_data(path, FIRST["v2.1"], lambda table: table.drop_columns(["next.reward"]))
    with open_raw(path) as episodes, pytest.raises(DataError, match=r"next\.reward: missing"):
        episodes["episode_0"]


def test_two_columns_of_one_name_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "set", "v2.1")
    edit_data(path, FIRST["v2.1"], lambda table: table.append_column("effort", table["effort"]))
    with open_raw(path) as episodes, pytest.raises(DataError, match="effort: several columns"):
        episodes["episode_0"]


# -- hundreds of mutations -------------------------------------------------------------------------


def mutate_bytes(path: Path, rng: np.random.Generator) -> None:
    """Cuts off, flips, overwrites or removes bytes of a file."""
    file = rng.choice(sorted(str(file) for file in path.rglob("*.*") if file.is_file()))
    data = bytearray(Path(file).read_bytes())
    kind = rng.integers(4)
    if kind == 0:
        del data[rng.integers(len(data)) :]
    elif kind == 1:
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    elif kind == 2:
        start = int(rng.integers(len(data)))
        data[start : start + 16] = bytes(len(data[start : start + 16]))
    else:
        del data[int(rng.integers(len(data))) :][:8]
    Path(file).write_bytes(data)


def mutate_columns(path: Path, rng: np.random.Generator) -> None:
    """Drops, renames, shortens, shuffles, empties or adds columns of a data file."""
    files = sorted((path / "data").rglob("*.parquet"))
    file = files[rng.integers(len(files))]
    table = pq.read_table(file)
    name = str(rng.choice(table.column_names))
    kind = rng.integers(6)
    if kind == 0:
        table = table.drop_columns([name])
    elif kind == 1:
        table = table.rename_columns({name: f"{name}_"})
    elif kind == 2:
        table = table.slice(0, max(0, len(table) - int(rng.integers(1, 4))))
    elif kind == 3:
        order = rng.permutation(len(table))
        table = table.take(pa.array(order))
    elif kind == 4:
        values = table[name].to_pylist()
        values[rng.integers(len(values))] = None
        place = table.column_names.index(name)
        table = table.set_column(place, name, pa.array(values, table[name].type))
    else:
        table = table.append_column("further", pa.array(["text"] * len(table)))
    pq.write_table(table, file)


def mutate_meta(path: Path, rng: np.random.Generator) -> None:
    """Gives an entry of the description another value."""
    file = path / "meta/info.json"
    info = json.loads(file.read_text())
    key = str(rng.choice([*info, "fps"]))
    values = (None, -1, "", 3.5, [], {}, "v9", 10**12, True)
    info[key] = values[rng.integers(len(values))]
    file.write_text(json.dumps(info))


def read_all(path: Path) -> tuple[Account, list[Any], str | None]:
    """The account, all episodes without their last steps, and the refusal or ``None``."""
    account, found = Account(), []
    try:
        with open_source(path, last_step="drop") as source:
            for name, episode in source.episodes.items():
                for key, message in find_problems(episode):
                    raise DataError(path, f"{name}/{key}", message)
                account.add(name, episode)
                found.append(episode)
    except DataError as error:
        return account, found, str(error)
    return account, found, None


def test_every_mutated_set_is_refused_by_name_or_accounts_for_every_step(tmp_path: Path) -> None:
    outcomes: Counter[str] = Counter()
    for number in range(240):
        rng = np.random.default_rng(number)
        path = write(tmp_path / str(number), VERSIONS[number % 3])
        (mutate_bytes, mutate_columns, mutate_meta)[number // 3 % 3](path, rng)
        account, episodes, refusal = read_all(path)
        if refusal is not None:
            assert refusal.startswith(str(path)), refusal
            outcomes["refused"] += 1
            continue
        outcomes["read"] += 1
        # What is read is what was written, and every step is read or counted as left out.
        assert account.whole.steps == sum(LENGTHS)
        assert account.cut.steps == len(LENGTHS)
        for i, episode in enumerate(episodes):
            made = columns_of(i)
            np.testing.assert_array_equal(episode.actions, np.float32(made["action"])[:-1])
            np.testing.assert_array_equal(episode.rewards, made["next.reward"][:-1])
            assert "state" in episode.observations  # as the description states
            for part, array in episode.observations.items():
                expected = made.get(f"observation.{part.removesuffix('_')}")
                np.testing.assert_array_equal(array, np.float32(expected)[:-1])
    assert min(outcomes["read"], outcomes["refused"]) > 60, outcomes
