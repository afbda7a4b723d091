"""LeRobot's v3.0 layout: numbers to the bit in float32, and the metadata that readers need."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("h5py")
pytest.importorskip("pyarrow")

import pyarrow as pa
import pyarrow.parquet as pq

from torchrl_bmrl.data import lerobot
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.lerobot import write_episodes
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError

FPS = 20
TASK = "lift the cube"
LENGTHS = [5, 1, 7, 4]


def make_episode(seed: int = 0, steps: int = 5, **changes: Any) -> Episode:
    rng = np.random.default_rng(seed)
    whole = {
        "goal_pos": rng.standard_normal((steps + 1, 3)),
        "opening": rng.random(steps + 1).astype(np.float32),
        "joints": rng.standard_normal((steps + 1, 7)).astype(np.float32),
    }
    fields = {
        "observations": {name: part[:-1] for name, part in whole.items()},
        "next_observations": {name: part[1:] for name, part in whole.items()},
        "actions": rng.uniform(-1, 1, (steps, 7)),
        "rewards": rng.random(steps),
        "terminated": np.zeros(steps, bool),
        "extras": {"successes": rng.random(steps) < 0.5, "states": rng.random((steps, 9))},
        "attributes": {"seed": seed},
    }
    return Episode(**{**fields, **changes})


def make_episodes() -> list[Episode]:
    return [make_episode(i, steps) for i, steps in enumerate(LENGTHS)]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_episodes(tmp_path / "lift", iter(make_episodes()), fps=FPS, task=TASK)
    return tmp_path / "lift"


def read(path: Path) -> dict[str, np.ndarray]:
    """All data files of a data set, one after the other."""
    tables = [pq.read_table(file) for file in sorted((path / "data").rglob("*.parquet"))]
    table = pa.concat_tables(tables)
    columns = {}
    for name in table.column_names:
        column = table[name].combine_chunks()
        columns[name] = column.to_numpy(zero_copy_only=False)
        if pa.types.is_fixed_size_list(column.type):
            columns[name] = column.flatten().to_numpy().reshape(len(table), -1)
    return columns


def expected_columns() -> dict[str, np.ndarray]:
    episodes = make_episodes()
    state = [
        np.column_stack([e.observations[part] for part in ("goal_pos", "opening", "joints")])
        for e in episodes
    ]
    return {
        "observation.state": np.concatenate(state).astype(np.float32),
        "action": np.concatenate([e.actions for e in episodes]).astype(np.float32),
        "next.reward": np.concatenate([e.rewards for e in episodes]).astype(np.float32),
        "next.success": np.concatenate([e.extras["successes"] for e in episodes]),
        "next.done": np.concatenate([np.arange(steps) == steps - 1 for steps in LENGTHS]),
        "next.terminated": np.zeros(sum(LENGTHS), bool),
        "timestamp": np.concatenate([np.arange(steps) / FPS for steps in LENGTHS]).astype("f4"),
        "frame_index": np.concatenate([np.arange(steps) for steps in LENGTHS]),
        "episode_index": np.repeat(np.arange(len(LENGTHS)), LENGTHS),
        "index": np.arange(sum(LENGTHS)),
        "task_index": np.zeros(sum(LENGTHS), np.int64),
    }


def test_the_numbers_are_kept_to_the_bit_in_float32(path: Path) -> None:
    columns = read(path)
    expected = expected_columns()
    assert set(columns) == set(expected)
    for name, array in expected.items():
        assert (columns[name].dtype, columns[name].shape) == (array.dtype, array.shape)
        assert columns[name].tobytes() == array.tobytes()


def test_the_features_describe_the_columns(path: Path) -> None:
    info = json.loads((path / "meta" / "info.json").read_text())
    columns = read(path)
    assert list(info["features"]) == list(columns)
    for name, feature in info["features"].items():
        assert feature["dtype"] == str(columns[name].dtype)
        assert feature["shape"] == (list(columns[name].shape[1:]) or [1])
    names = [f"goal_pos.{i}" for i in range(3)] + ["opening"] + [f"joints.{i}" for i in range(7)]
    assert info["features"]["observation.state"]["names"] == names
    assert info["features"]["action"]["names"] == [f"action.{i}" for i in range(7)]
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", FPS, None)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (4, 17, 1)
    assert info["splits"] == {"train": "0:4"}


def test_each_episode_is_found_by_its_row(path: Path) -> None:
    columns = read(path)
    rows = pq.read_table(path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["length"] for row in rows] == LENGTHS
    for i, row in enumerate(rows):
        frames = slice(row["dataset_from_index"], row["dataset_to_index"])
        assert_array_equal(columns["episode_index"][frames], np.full(LENGTHS[i], i))
        assert row["tasks"] == [TASK]
        action = columns["action"][frames]
        assert_array_equal(row["stats/action/min"], action.min(axis=0))
        assert_allclose(row["stats/action/mean"], action.mean(axis=0), rtol=1e-5)
        assert row["stats/next.done/max"] == [True]


def test_the_statistics_are_those_of_all_steps_together(path: Path) -> None:
    total = json.loads((path / "meta" / "stats.json").read_text())
    columns = read(path)
    assert set(total) == set(columns)
    for name, array in columns.items():
        exact = array.reshape(len(array), -1).astype(np.float64)
        stats = total[name]
        assert stats["count"] == [len(array)]
        assert_array_equal(stats["min"], exact.min(axis=0))
        assert_array_equal(stats["max"], exact.max(axis=0))
        assert_allclose(stats["mean"], exact.mean(axis=0), rtol=1e-12)
        assert_allclose(stats["std"], exact.std(axis=0), rtol=1e-9, atol=1e-12)
        for share in (0.01, 0.1, 0.5, 0.9, 0.99):  # not the means of the episodes', as LeRobot's
            assert_allclose(stats[f"q{round(100 * share):02d}"], np.quantile(exact, share, axis=0))


def test_the_text_of_the_task_is_the_index_of_a_data_frame(path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    tasks = pandas.read_parquet(path / "meta" / "tasks.parquet")
    assert tasks.index.tolist() == [TASK]
    assert tasks.loc[TASK].task_index == 0


def test_a_full_file_is_followed_by_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot, "FILE_SIZE", 0)
    monkeypatch.setattr(lerobot, "FILES_PER_CHUNK", 3)
    write_episodes(tmp_path / "lift", make_episodes(), fps=FPS, task=TASK)
    rows = pq.read_table(tmp_path / "lift/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    places = [(row["data/chunk_index"], row["data/file_index"]) for row in rows]
    assert places == [(0, 0), (0, 1), (0, 2), (1, 0)]
    for i, (chunk, file) in enumerate(places):
        table = pq.read_table(tmp_path / f"lift/data/chunk-{chunk:03d}/file-{file:03d}.parquet")
        assert set(table["episode_index"].to_pylist()) == {i}
    total = json.loads((tmp_path / "lift/meta/stats.json").read_text())
    for name, array in expected_columns().items():
        assert_array_equal(read(tmp_path / "lift")[name], array)
        assert total[name]["count"] == [len(array)]
        rows = array.reshape(len(array), -1).astype(np.float64)
        assert_allclose(total[name]["q50"], np.median(rows, axis=0))


def test_one_number_a_step_is_no_list(tmp_path: Path) -> None:
    part = np.arange(4.0)[:, None]
    episode = make_episode(
        steps=3,
        observations={"x": part[:-1]},
        next_observations={"x": part[1:]},
        actions=np.ones((3, 1)),
        extras={},
    )
    write_episodes(tmp_path / "lift", [episode], fps=12.5, task=TASK)
    schema = pq.read_schema(tmp_path / "lift/data/chunk-000/file-000.parquet")
    assert schema.field("action").type == schema.field("observation.state").type == pa.float32()
    info = json.loads((tmp_path / "lift/meta/info.json").read_text())
    assert info["features"]["action"]["shape"] == [1]
    assert info["fps"] == 12.5
    assert "next.success" not in info["features"]


# -- refused ---------------------------------------------------------------------------------------


def with_image() -> Episode:
    image = np.zeros((6, 8, 8, 3), np.uint8)
    return make_episode(observations={"camera": image[1:]}, next_observations={"camera": image[1:]})


def with_jump() -> Episode:
    episode = make_episode()
    parts = {**episode.next_observations, "opening": np.zeros(5, np.float32)}
    return make_episode(next_observations=parts)


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([], "no episodes; valid: at least one"),
        ([with_image()], r"episode_0/obs/camera: .*images are not exported; valid: one number"),
        ([make_episode(1), with_jump()], "episode_1/next_obs/opening: row 0 differs from row 1"),
        ([make_episode(), make_episode(extras={})], "episode_1/successes: missing"),
        ([make_episode(actions=np.zeros((5, 2, 2)))], "episode_0/actions: .*valid: one number"),
    ],
)
def test_what_cannot_be_kept_leaves_nothing(
    tmp_path: Path, episodes: list[Episode], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        write_episodes(tmp_path / "lift", episodes, fps=FPS, task=TASK)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_seen_before_all_is_written(tmp_path: Path) -> None:
    def episodes() -> Iterator[Episode]:
        yield make_episode()
        assert not (tmp_path / "lift").exists()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_episodes(tmp_path / "lift", episodes(), fps=FPS, task=TASK)
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_refused(path: Path) -> None:
    with pytest.raises(DataError, match="exists already"):
        write_episodes(path, make_episodes(), fps=FPS, task=TASK)


@pytest.mark.parametrize("options", [{"fps": 0}, {"fps": float("nan")}, {"task": ""}])
def test_options_without_meaning_are_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="valid"):
        write_episodes(tmp_path / "lift", make_episodes(), **{"fps": FPS, "task": TASK, **options})


def test_without_pyarrow_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(BMRLError, match=r'valid: pip install "torchrl_bmrl\[data\]"'):
        write_episodes(tmp_path / "lift", make_episodes(), fps=FPS, task=TASK)


# -- other readers ---------------------------------------------------------------------------------


def test_torchrl_reads_the_same_steps(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    datasets = pytest.importorskip("datasets")
    hub = pytest.importorskip("huggingface_hub")
    from torchrl.data.datasets.lerobot import LeRobotExperienceReplay

    monkeypatch.setattr(hub, "snapshot_download", lambda *_, **__: str(path))
    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    replay = LeRobotExperienceReplay("local/lift", root=tmp_path / "torchrl", batch_size=4)
    data, columns = replay[:], expected_columns()
    for key, name in {
        ("observation", "state"): "observation.state",
        "action": "action",
        "episode": "episode_index",
        "frame": "frame_index",
    }.items():
        assert_array_equal(data[key].numpy(), columns[name])
    for name in ("reward", "done", "success"):
        assert_array_equal(data["next", name].squeeze(-1).numpy(), columns[f"next.{name}"])
    assert set(data["language_instruction"]) == {TASK}
