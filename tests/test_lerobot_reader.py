"""LeRobot data sets of three versions give back their numbers, as LeRobot and others write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("pyarrow")
pytest.importorskip("tqdm")

import pyarrow as pa
from episode_files import make_episode
from lerobot_files import (
    FPS,
    LENGTHS,
    VERSIONS,
    columns_of,
    edit_data,
    edit_info,
    find_oddities,
    open_raw,
    read_metadata,
    write,
)

from torchrl_bmrl.data import lerobot
from torchrl_bmrl.data.convert import open_source

PARTS = {"goal": ((3,), np.float64), "joints": ((4,), np.float64), "opening": ((), np.float64)}


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
    # The episodes have several tasks, so that the set states none.
    assert read_metadata(path) == {"dataset_id": "set", "fps": FPS}
    pictures = "pictures are not read: observation.images.top, observation.images.wrist"
    tasks = "2 tasks are read as one: 'task 0', 'task 1'"
    assert find_oddities(path) == [tasks, pictures]
    edit_info(path, total_frames=16)
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


def test_terminations_and_horizons_of_one_set_come_back_apart(tmp_path: Path) -> None:
    made = [make_episode(i, 5, parts=PARTS, terminated=i == 1) for i in range(3)]
    lerobot.write_episodes(tmp_path / "set", made, fps=FPS, task="lift")
    for dones_terminate in (False, True):
        options = {"dones_terminate": dones_terminate, "last_step": "truncate"}
        with open_source(tmp_path / "set", **options) as source:
            ends = [bool(source.episodes[name].terminated[-1]) for name in source.episodes]
        assert ends == [False, True, False]


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
    features = json.loads((path / "meta/info.json").read_text())["features"]
    features["observation.state"]["names"] = names
    edit_info(path, features=features)
    with open_raw(path) as episodes:
        parts = episodes["episode_0"].observations
    assert list(parts) == ["state", "environment_state"]
    assert parts["state"].shape == (4, 3)


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


# -- arrays of several dimensions ------------------------------------------------------------------


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
    """An extension type as the package datasets registers one."""

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
