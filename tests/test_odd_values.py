"""Odd values in files and settings are refused with a typed error, or read; none is a traceback."""

from __future__ import annotations

import io
import json
import zlib
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

import h5py
import numpy as np
import torch

from torchrl_bmrl.data import __main__ as command
from torchrl_bmrl.data.convert import convert
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.demonstrations import read_phases, read_statistics
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.robomimic import read_metadata, write_episodes
from torchrl_bmrl.data.sampler import TaskSampler
from torchrl_bmrl.data.schema import check_fps
from torchrl_bmrl.data.sources import Source
from torchrl_bmrl.errors import BMRLError, CheckpointError, ConfigError, DataError
from torchrl_bmrl.files import parse_json
from torchrl_bmrl.pipeline.evaluate import held_out_episode
from torchrl_bmrl.pipeline.settings import BCQSettings
from torchrl_bmrl.pipeline.student import Student, load_student
from torchrl_bmrl.rows import check_rows, read_rows, whole, write_rows
from torchrl_bmrl.run.folder import read_yaml
from torchrl_bmrl.run.settings import check_settings
from torchrl_bmrl.studies.interpolation import POSITIONS, read_episodes
from torchrl_bmrl.training.checkpoint import save_checkpoint

HUGE = 10**400
DEEP = "[" * 5000 + "]" * 5000
TEXT = h5py.string_dtype("utf-8")


@pytest.fixture
def lift(tmp_path: Path) -> Path:
    """A file of two episodes."""
    x = np.random.default_rng(0).normal(size=(6, 3))
    episode = Episode(
        observations={"x": x[:5]},
        next_observations={"x": x[1:]},
        actions=np.zeros((5, 2), np.float32),
        rewards=np.ones(5),
        terminated=np.zeros(5, bool),
        extras={"successes": np.ones(5, bool), "phases": np.zeros(5, np.int8)},
        attributes={"phase_names": ["all"]},
    )
    path = tmp_path / "lift.hdf5"
    masks = {"train": [0], "valid": [1]}
    write_episodes(path, [episode] * 2, env_args={"env_kwargs": {}}, masks=masks)
    return path


def with_attribute(path: Path, key: str, name: str, value: Any, dtype: Any = None) -> None:
    with h5py.File(path, "a") as file:
        file[key].attrs.create(name, value, dtype=dtype)


# -- attributes ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("env_args", DEEP),
        ("env_args", '{"env_name": "\\ud800"}'),
        ("action_bounds", json.dumps({"low": -HUGE, "high": HUGE})),
        ("action_bounds", f'{{"low": {DEEP}, "high": 1}}'),
    ],
)
def test_odd_json_in_an_attribute_is_named(lift: Path, name: str, text: str) -> None:
    with_attribute(lift, "data", name, text, TEXT)
    with pytest.raises(DataError, match=name):
        read_metadata(lift)


@pytest.mark.parametrize("rate", [HUGE, -HUGE, 1e10, 0, "20", [20], None])
def test_a_rate_that_no_simulator_has_is_no_rate(rate: Any) -> None:
    metadata = {"env_args": {"env_kwargs": {"control_freq": rate}}}
    assert Source(path=Path("a"), format="robomimic", episodes={}, metadata=metadata).fps is None
    if isinstance(rate, int | float):
        with pytest.raises(ConfigError, match="fps"):
            check_fps(rate)


def test_text_that_is_not_utf_8_can_be_shown_and_written(lift: Path, tmp_path: Path) -> None:
    for key, name in (("data", "total"), ("data", "operator"), ("data/demo_0", "operator")):
        with_attribute(lift, key, name, b"\xff\xfe", TEXT)
    with redirect_stdout(io.TextIOWrapper(io.BytesIO(), encoding="utf-8")):
        command.main(["check", str(lift)])
    convert(lift, tmp_path / "out.hdf5", to="robomimic")
    assert read_metadata(tmp_path / "out.hdf5")["operator"] == "\ufffd\ufffd"


def test_an_attribute_that_cannot_be_written_is_named(lift: Path, tmp_path: Path) -> None:
    ragged = np.array([np.arange(2), np.arange(1)], dtype=object)
    with_attribute(lift, "data/demo_1", "odd", ragged, h5py.vlen_dtype(np.int32))
    with pytest.raises(BMRLError, match="odd"):
        convert(lift, tmp_path / "out.hdf5", to="robomimic")
    assert not (tmp_path / "out.hdf5").exists()


@pytest.mark.parametrize("names", [5, h5py.Empty("f"), []])
def test_names_of_phases_that_are_not_a_list_are_refused(lift: Path, names: Any) -> None:
    for demo in ("demo_0", "demo_1"):
        with_attribute(lift, f"data/{demo}", "phase_names", names)
    if names == []:
        assert read_phases(lift, split="train")[1] == ()
    else:
        with pytest.raises(DataError, match="phase_names"):
            read_phases(lift, split="train")


@pytest.mark.parametrize("bounds", [(-HUGE, HUGE), (0, [HUGE])])
def test_bounds_beyond_all_floats_are_refused(bounds: Any) -> None:
    with pytest.raises(ConfigError, match="bounds"):
        ReadOptions(bounds=bounds)


# -- statistics, policies --------------------------------------------------------------------------

SIZES = {"num_tasks": 1, "observation_dim": 3, "action_dim": 2, "num_cells": [8]}


def statistics(size: int = 3, scale: Any = 1.0, loc: Any = 0.0) -> dict[str, Any]:
    return {"loc": [loc] * size, "scale": [scale] * size}


def saved(path: Path, demonstrations: Any = None, **changes: Any) -> Path:
    metadata = {"kind": "student", "student": SIZES, "tasks": ["lift"], "accuracy": None}
    metadata |= {"latent_clip": 0.5, "statistics": statistics(), **changes}
    state = {"module": Student(**SIZES).state_dict(), "demonstrations": demonstrations}
    save_checkpoint(path, state, metadata)
    return path


@pytest.mark.parametrize(
    "changes",
    [
        {"statistics": statistics(4)},
        {"statistics": statistics(scale=1e-60)},
        {"statistics": statistics(loc=1e60)},
        {"statistics": statistics(loc=HUGE)},
        {"statistics": {"loc": [0.0] * 3}},
        {"accuracy": HUGE},
        {"latent_clip": HUGE},
    ],
)
def test_a_policy_with_odd_numbers_is_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    assert load_student(saved(tmp_path / "good.safetensors"))
    with pytest.raises(CheckpointError, match=next(iter(changes))):
        load_student(saved(tmp_path / "odd.safetensors", **changes))


def demonstration(size: int = 3) -> dict[str, Any]:
    after = {"reward": torch.zeros(4, 1), "observation": torch.zeros(4, size)}
    return {"observation": torch.zeros(4, size), "action": torch.zeros(4, 2), "next": after}


@pytest.mark.parametrize(
    "held", [None, {}, {"lift": 3}, {"lift": {"action": 1}}, {"lift": demonstration(4)}]
)
def test_a_policy_without_its_demonstration_is_refused(tmp_path: Path, held: Any) -> None:
    def run_of(path: Path) -> Any:
        settings = SimpleNamespace(evaluate=SimpleNamespace(policy=str(path)))
        return SimpleNamespace(
            settings=settings, student_path=path, policy=lambda: load_student(path)
        )

    good = saved(tmp_path / "good.safetensors", {"lift": demonstration()})
    assert len(held_out_episode(run_of(good), "lift")) == 4
    with pytest.raises(CheckpointError, match="demonstration of lift"):
        held_out_episode(run_of(saved(tmp_path / "odd.safetensors", held)), "lift")


@pytest.mark.parametrize(
    "content",
    [
        statistics(scale=1e-60),
        statistics(loc=HUGE),
        statistics() | {"parts": 5},
        statistics() | {"parts": [["x"]]},
        [],
        {"loc": 1.0, "scale": 1.0},
    ],
)
def test_odd_statistics_of_a_data_set_are_refused(tmp_path: Path, content: Any) -> None:
    (tmp_path / "statistics.json").write_text(json.dumps(content))
    with pytest.raises(DataError, match="statistics"):
        read_statistics(tmp_path)


# -- the cache -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda told: [],
        lambda told: told | {"crc32": ["x"]},
        lambda told: {key: x for key, x in told.items() if key != "warnings"},
        lambda told: told | {"warnings": 3},
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_a_conversion_with_odd_metadata_is_made_again(
    lift: Path, tmp_path: Path, change: Callable[[Any], Any], encoding: str
) -> None:
    made = RobomimicExperienceReplay(lift, root=tmp_path / "cache", batch_size=2)
    file = made.data_path / "metadata.json"
    content = json.dumps(change(json.loads(file.read_text()))).encode(encoding)
    file.write_bytes(content)
    file.with_suffix(".crc32").write_text(f"{zlib.crc32(content):08x}")
    again = RobomimicExperienceReplay(lift, root=tmp_path / "cache", batch_size=2)
    assert again.metadata == made.metadata


def test_an_odd_state_of_a_sampler_is_refused(tmp_path: Path) -> None:
    for content in ("[]", "{}", DEEP):
        (tmp_path / "sampler_metadata.json").write_text(content)
        with pytest.raises(DataError, match="sampler_metadata"):
            TaskSampler([2]).loads(tmp_path)


# -- tables, settings ------------------------------------------------------------------------------


def test_rows_that_a_study_did_not_write_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    known = [{"task": "lift", "episode": i} for i in range(2)]
    columns = {"task": str, "episode": whole}
    write_rows(path, known)
    assert read_rows(path, columns, known) == known
    odd = {"episode": [known[1], known[0]], "3 rows": [*known, known[0]], "1 rows": known[:1]}
    odd["task"] = [{"task": "reach", "episode": 0}, known[1]]
    for said, rows in odd.items():
        with pytest.raises(DataError, match=said):
            check_rows(path, rows, known)


@pytest.mark.parametrize("text", ["1" * 400, str(2**63), "1.5", ""])
def test_whole_numbers_are_of_64_bits(text: str) -> None:
    with pytest.raises(ValueError, match="a whole number"):
        whole(text)


def test_episodes_of_interpolation_with_odd_rows_are_refused(tmp_path: Path) -> None:
    names = [*(name for part in POSITIONS.values() for name in part), "deviation"]
    places = [(i, t) for i in range(2) for t in range(3)]
    rest = {"along": "nan", "success": 0} | dict.fromkeys(names, 0.5)
    rows: list[dict[str, Any]] = [
        {"episode": i, "label": "lift", "step": t} | rest for i, t in places
    ]
    path = tmp_path / "tasks.csv"

    def read(changed: list[dict[str, Any]]) -> Any:
        write_rows(path, changed)
        return read_episodes(path, ["lift"])

    assert read(rows)["eef"].shape == (2, 3, 3)
    for changed in (
        rows[:-1],
        rows[::-1],
        [*rows, rows[0]],
        [row | {"label": "reach"} for row in rows],
        [row | {names[0]: "nan"} for row in rows],
        [rows[0] | {"episode": 2**62}],
    ):
        with pytest.raises(DataError, match=r"tasks\.csv"):
            read(changed)
    path.write_text(path.read_text().partition("\n")[0] + "\n")
    with pytest.raises(DataError, match="0 rows"):
        read_episodes(path, ["lift"])


@pytest.mark.parametrize("text", ["a: !!bool x", "a: !!timestamp x", "a: !!int ''", DEEP])
def test_yaml_with_an_odd_tag_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(DataError, match="not YAML"):
        read_yaml(tmp_path / "a.yaml")


def test_a_setting_of_hundreds_of_digits_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="batch_size"):
        check_settings(BCQSettings(batch_size=HUGE), "bcq.")


@pytest.mark.parametrize("text", [DEEP, '"\\ud800"', "{"])
def test_json_that_cannot_be_written_again_is_no_json(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        parse_json(text)
    assert parse_json('"\\ud83d\\ude00"') == "\N{GRINNING FACE}"
