"""LeRobot data sets of three versions, made by hand: exact numbers, or an error with its place."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("tqdm")

import pyarrow as pa
import pyarrow.parquet as pq
from episode_files import make_episode, readers

from torchrl_bmrl.data import lerobot
from torchrl_bmrl.data.account import Account
from torchrl_bmrl.data.convert import open_source
from torchrl_bmrl.data.lerobot_reader import open_data
from torchrl_bmrl.data.schema import find_problems
from torchrl_bmrl.errors import DataError

open_raw, read_metadata, find_oddities = readers(open_data)
LENGTHS, FPS = (4, 6, 5), 10
VERSIONS = ("v2.0", "v2.1", "v3.0")
Columns = dict[str, Any]
PARTS = {"goal": ((3,), np.float64), "joints": ((4,), np.float64), "opening": ((), np.float64)}


def columns_of(i: int) -> Columns:
    """An episode as LeRobot has it; lists for what has several numbers a row."""
    rng, steps = np.random.default_rng(i), LENGTHS[i]
    frames, start = np.arange(steps), sum(LENGTHS[:i])
    return {
        "observation.state": rng.standard_normal((steps, 3)).astype("f4").tolist(),
        "observation.environment_state": rng.standard_normal((steps, 2)).astype("f4").tolist(),
        "observation.images.top": [{"bytes": b"png", "path": None}] * steps,
        "action": rng.uniform(-1, 1, (steps, 2)).astype("f4").tolist(),
        "next.reward": rng.random(steps).astype("f4"),
        "next.done": frames == steps - 1,
        "next.success": (frames == steps - 1) & (i != 1),
        "effort": rng.standard_normal((steps, 2, 2)).tolist(),
        "timestamp": (frames / FPS).astype("f4"),
        "frame_index": frames,
        "episode_index": np.full(steps, i),
        "index": start + frames,
        "task_index": np.full(steps, i % 2),
    }


def write(path: Path, version: str, episodes: list[Columns] | None = None) -> Path:
    """A data set of that version; the new one has the last episode in a second file."""
    episodes = [columns_of(i) for i in range(len(LENGTHS))] if episodes is None else episodes
    meta = path / "meta"
    meta.mkdir(parents=True)
    info = {
        "codebase_version": version,
        "fps": FPS,
        "total_episodes": len(episodes),
        "total_frames": sum(len(columns["index"]) for columns in episodes),
        "chunks_size": 2,
        "features": {
            "observation.state": {"dtype": "float32", "shape": [3], "names": {"axes": ["x"]}},
            "observation.images.top": {"dtype": "image", "shape": [8, 8, 3], "names": None},
            "observation.images.wrist": {"dtype": "video", "shape": [8, 8, 3], "names": None},
        },
    }
    (meta / "info.json").write_text(json.dumps(info))
    rows, start = [], 0
    for i, columns in enumerate(episodes):
        steps = len(columns["index"])
        rows.append({"episode_index": i, "tasks": [f"task {i % 2}"], "length": steps})
        last = i == len(episodes) - 1
        rows[-1] |= {"data/chunk_index": 0, "data/file_index": int(last)}
        rows[-1] |= {"dataset_from_index": start, "dataset_to_index": start + steps}
        start += steps
    if version == "v3.0":
        for name, part in (("000", episodes[:-1]), ("001", episodes[-1:])):
            tables = [pa.table(columns) for columns in part]
            put(path / f"data/chunk-000/file-{name}.parquet", pa.concat_tables(tables))
        put(meta / "episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(rows))
    else:
        for i, columns in enumerate(episodes):
            name = f"data/chunk-{i // 2:03d}/episode_{i:06d}.parquet"
            put(path / name, pa.table(columns))
        lines = [{key: row[key] for key in ("episode_index", "tasks", "length")} for row in rows]
        (meta / "episodes.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


def put(path: Path, table: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, row_group_size=3, write_page_checksum=True)


@pytest.mark.parametrize("version", VERSIONS)
def test_every_number_is_the_file_s(tmp_path: Path, version: str) -> None:
    with open_raw(write(tmp_path / "set", version)) as episodes:
        assert list(episodes) == ["episode_0", "episode_1", "episode_2"]
        for i in (2, 0, 1):
            raw, made = episodes[f"episode_{i}"], columns_of(i)
            assert list(raw.observations) == ["state", "environment_state"]
            for part, array in raw.observations.items():
                np.testing.assert_array_equal(array, np.float32(made[f"observation.{part}"]))
            np.testing.assert_array_equal(raw.actions, np.float32(made["action"]))
            np.testing.assert_array_equal(raw.rewards, made["next.reward"])
            np.testing.assert_array_equal(raw.dones, made["next.done"])
            np.testing.assert_array_equal(raw.extras["successes"], made["next.success"])
            np.testing.assert_array_equal(raw.extras["effort"], made["effort"])
            assert set(raw.extras) == {"successes", "effort"}
            assert raw.attributes == {"task": f"task {i % 2}"}
            assert raw.left_alone == ("observation.images.top",)
            assert raw.next_observations is None
            assert raw.succeeded == (i != 1)


@pytest.mark.parametrize("version", VERSIONS)
def test_what_a_set_says_of_itself_is_read_and_contradictions_are_named(
    tmp_path: Path, version: str
) -> None:
    path = write(tmp_path / "set", version)
    assert read_metadata(path) == {"dataset_id": "set", "fps": FPS}  # of several tasks: no task
    pictures = "pictures are not read: observation.images.top, observation.images.wrist"
    assert find_oddities(path) == [pictures]
    info = json.loads((path / "meta/info.json").read_text())
    (path / "meta/info.json").write_text(json.dumps(info | {"total_frames": 16}))
    assert "total_frames is 16, but there are 15" in find_oddities(path)[0]


def test_what_was_written_here_comes_back_in_its_parts(tmp_path: Path) -> None:
    made = [make_episode(i, 5 + i, parts=PARTS) for i in range(3)]
    lerobot.write_episodes(tmp_path / "le", made, fps=20, task="lift")
    assert read_metadata(tmp_path / "le")["task"] == "lift"
    with open_source(tmp_path / "le", last_step="truncate") as source:
        for episode, original in zip(source.episodes.values(), made, strict=True):
            assert list(episode.observations) == list(original.observations)
            for part, array in original.observations.items():
                np.testing.assert_array_equal(
                    episode.observations[part], array.astype("f4"), strict=True
                )
            np.testing.assert_array_equal(episode.actions, original.actions)
            np.testing.assert_array_equal(episode.rewards, original.rewards.astype("f4"))
            solved = original.extras["successes"]
            np.testing.assert_array_equal(episode.extras["successes"], solved)


@pytest.mark.parametrize(
    "names",
    [
        ["x.0", "x.2", "y"],
        ["x.1", "x.0", "y"],
        ["x", "y", "z"],
        ["left.pos", "x.0", "x.1"],
        ["x.0", "x.1"],
        {"axes": ["x.0", "x.1", "x.2"]},
        None,
    ],
    ids=str,
)
def test_names_that_are_not_numbered_parts_leave_one_part(tmp_path: Path, names: Any) -> None:
    path = write(tmp_path / "set", "v3.0")
    info = json.loads((path / "meta/info.json").read_text())
    info["features"]["observation.state"]["names"] = names
    (path / "meta/info.json").write_text(json.dumps(info))
    with open_raw(path) as episodes:
        assert episodes["episode_0"].observations["state"].shape == (4, 3)


# -- damage ----------------------------------------------------------------------------------------


def edited(change: Callable[[Columns], object]) -> Callable[[Path, str], None]:
    """Changes the columns of the second episode."""

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
"""Faults that an episode cannot have alone where one file holds several."""
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
        lambda p: (p / "meta/info.json").write_text("version https://git-lfs.github.com"),
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


def test_a_pointer_in_place_of_the_data_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "set", "v2.1")
    (path / "data/chunk-000/episode_000001.parquet").write_text("version https://git-lfs.g")
    with open_raw(path) as episodes, pytest.raises(DataError, match="git lfs pull"):
        _ = episodes["episode_1"]


# -- hundreds of mutations -------------------------------------------------------------------------


def mutate_bytes(path: Path, rng: np.random.Generator) -> None:
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
    file = path / "meta/info.json"
    info = json.loads(file.read_text())
    key = str(rng.choice([*info, "fps"]))
    values = (None, -1, "", 3.5, [], {}, "v9", 10**12, True)
    info[key] = values[rng.integers(len(values))]
    file.write_text(json.dumps(info))


def read_all(path: Path) -> tuple[Account, list[Any], str | None]:
    """All episodes, without their last steps, and their account; or why they cannot be read."""
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
        # Whatever is read is what was written, and nothing of it is missing.
        assert account.whole.steps == sum(LENGTHS)
        assert account.cut.steps == len(LENGTHS)
        for i, episode in enumerate(episodes):
            made = columns_of(i)
            np.testing.assert_array_equal(episode.actions, np.float32(made["action"])[:-1])
            np.testing.assert_array_equal(episode.rewards, made["next.reward"][:-1])
            for part, array in episode.observations.items():
                expected = made.get(f"observation.{part.removesuffix('_')}")
                np.testing.assert_array_equal(array, np.float32(expected)[:-1])
    assert min(outcomes["read"], outcomes["refused"]) > 60, outcomes


# -- what LeRobot itself writes or takes -----------------------------------------------------------


def edit_info(path: Path, **changes: Any) -> None:
    file = path / "meta" / "info.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


def edit_data(path: Path, name: str, edit: Callable[[pa.Table], pa.Table]) -> None:
    pq.write_table(edit(pq.read_table(path / name)), path / name)


def test_terminations_and_horizons_of_one_set_come_back_apart(tmp_path: Path) -> None:
    made = [make_episode(i, 5, parts=PARTS, terminated=i == 1) for i in range(3)]
    lerobot.write_episodes(tmp_path / "set", made, fps=FPS, task="lift")
    for dones_terminate in (False, True):
        options = {"dones_terminate": dones_terminate, "last_step": "truncate"}
        with open_source(tmp_path / "set", **options) as source:
            ends = [bool(source.episodes[name].terminated[-1]) for name in source.episodes]
        assert ends == [False, True, False]


def test_arrays_of_several_dimensions_are_read_with_datasets_imported(tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets")
    path = write(tmp_path / "set", "v2.1")
    edit_info(path, features={"observation.grid": {"dtype": "float32", "shape": [2, 3]}})
    for i, steps in enumerate(LENGTHS):
        features = datasets.Features({"observation.grid": datasets.Array2D((2, 3), "float32")})
        grid = np.full((steps, 2, 3), i, "f4")
        made = datasets.Dataset.from_dict({"observation.grid": grid.tolist()}, features=features)
        column = made.data.table["observation.grid"]
        name = f"data/chunk-{i // 2:03d}/episode_{i:06d}.parquet"
        edit_data(path, name, lambda t, c=column: t.append_column("observation.grid", c))
    with open_raw(path) as episodes:
        assert episodes["episode_1"].observations["grid"].tolist() == [[[1] * 3] * 2] * LENGTHS[1]


class SeveralDimensions(pa.ExtensionType):  # type: ignore[misc]
    """As datasets registers one."""

    def __init__(self) -> None:
        super().__init__(pa.list_(pa.list_(pa.float32())), "test.several_dimensions")

    def __arrow_ext_serialize__(self) -> bytes:
        return b""

    @classmethod
    def __arrow_ext_deserialize__(cls, storage: Any, serialized: bytes) -> SeveralDimensions:
        return cls()


def test_arrays_under_a_type_of_another_package_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "set", "v2.1")
    kind = SeveralDimensions()
    pa.register_extension_type(kind)
    try:
        for i, steps in enumerate(LENGTHS):
            storage = pa.array([[[i, 1], [2, 3]]] * steps, kind.storage_type)
            column = pa.ExtensionArray.from_storage(kind, storage)
            name = f"data/chunk-{i // 2:03d}/episode_{i:06d}.parquet"
            edit_data(path, name, lambda t, c=column: t.append_column("observation.grid", c))
        with open_raw(path) as episodes:
            episode = episodes["episode_2"]
    finally:
        pa.unregister_extension_type("test.several_dimensions")
    assert episode.observations["grid"].tolist() == [[[2, 1], [2, 3]]] * LENGTHS[2]
    assert "observation.grid" not in episode.left_alone


def test_numbers_can_be_written_to(tmp_path: Path) -> None:
    with open_raw(write(tmp_path / "set", "v3.0")) as episodes:
        assert episodes["episode_0"].actions.flags.writeable


def test_lines_in_any_order_and_with_any_text_are_read(tmp_path: Path) -> None:
    path = write(tmp_path / "set", "v2.1")
    file = path / "meta" / "episodes.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    rows = [{**row, "tasks": ["pick\u2028place"]} for row in reversed(rows)]
    file.write_text("\n".join(json.dumps(row, ensure_ascii=False) for row in rows), "utf-8")
    with open_raw(path) as episodes:
        assert [len(episodes[name].actions) for name in episodes] == list(LENGTHS)
        assert episodes["episode_0"].attributes["task"] == "pick\u2028place"


FIRST = {"v2.1": "data/chunk-000/episode_000000.parquet", "v3.0": "data/chunk-000/file-000.parquet"}


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
