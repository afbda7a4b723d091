"""From any format to any other, on the command line: whole or not at all, and told in full."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("tqdm")

import h5py
from episode_files import TASK_PARTS, assert_same, make_episode, write_file

from torchrl_bmrl.data import lerobot, minari, robomimic, stack_episodes
from torchrl_bmrl.data.__main__ import main
from torchrl_bmrl.data.convert import convert, find_format, open_source
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError, UnknownNameError
from torchrl_bmrl.run.progress import Lines

HUMAN = Path(__file__).parents[2] / "shared/data/human_sawyer_lift/demo.hdf5"
FLOAT32 = {name: (shape, np.float32) for name, (shape, _) in TASK_PARTS.items()}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_file(tmp_path / "lift.hdf5", parts=TASK_PARTS)
    return tmp_path / "lift.hdf5"


@pytest.mark.usefixtures("signals_not_ignored")
@pytest.mark.parametrize("command", ["check", "convert"])
def test_a_signal_ends_a_command_at_once_and_leaves_nothing(
    path: Path, command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    read: list[float] = []

    class Bar(Lines):
        def update(self, n: float = 1) -> None:
            read.append(n)
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("torchrl_bmrl.data.__main__.progress", lambda *args, **_: Bar(*args))
    out = [str(path.with_name("out.hdf5")), "--to", "robomimic"] if command == "convert" else []
    with pytest.raises(SystemExit) as end:
        main([command, str(path), *out])
    assert end.value.code == 128 + signal.SIGTERM
    assert len(read) == 1
    assert "saved" not in capsys.readouterr().err
    assert list(path.parent.iterdir()) == [path]


def spoil(path: Path) -> None:
    """Two things wrong in the third episode, one in the last."""
    with h5py.File(path, "r+") as file:
        file["data/demo_2/actions"][3, 1] = 7.0
        file["data/demo_2/rewards"][1] = np.nan
        file["data/demo_3/obs/goal_pos"][0, 0] = np.inf


# -- formats ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [TASK_PARTS, FLOAT32], ids=["float64", "float32"])
def test_a_data_set_goes_through_torchrl_and_minari_and_comes_back_to_the_bit(
    tmp_path: Path, parts: Any
) -> None:
    pytest.importorskip("minari")
    made = write_file(tmp_path / "lift.hdf5", parts=parts)
    first = RobomimicExperienceReplay(tmp_path / "lift.hdf5")[:]
    convert(tmp_path / "lift.hdf5", tmp_path / "sawyer" / "lift-v0", to="minari")
    with open_source(tmp_path / "sawyer" / "lift-v0") as source:
        assert source.format == "minari"
        for read, episode in zip(source.episodes.values(), made, strict=True):
            assert_same(read, episode)
        through = stack_episodes(source.episodes.values(), task=0)
    for key in first.keys(include_nested=True, leaves_only=True):
        assert first[key].dtype == through[key].dtype
        assert torch.equal(first[key], through[key]), key
    convert(tmp_path / "sawyer" / "lift-v0", tmp_path / "back.hdf5", to="robomimic")
    last = RobomimicExperienceReplay(tmp_path / "back.hdf5")[:]
    for key in first.keys(include_nested=True, leaves_only=True):
        assert torch.equal(first[key], last[key]), key


def test_a_file_in_robomimics_layout_keeps_masks_and_attributes(path: Path, tmp_path: Path) -> None:
    convert(path, tmp_path / "copy.hdf5", to="robomimic")
    assert robomimic.read_metadata(tmp_path / "copy.hdf5") == robomimic.read_metadata(path)
    with (
        robomimic.open_episodes(path) as ours,
        robomimic.open_episodes(tmp_path / "copy.hdf5") as theirs,
    ):
        for name, episode in ours.items():
            assert_same(theirs[name], episode)


def test_one_masks_episodes_can_be_taken(path: Path, tmp_path: Path) -> None:
    convert(path, tmp_path / "valid.hdf5", to="robomimic", split="valid")
    with robomimic.open_episodes(tmp_path / "valid.hdf5") as episodes:
        assert_same(episodes["demo_0"], make_episode(3, 8, parts=TASK_PARTS))
        assert len(episodes) == 1
    assert robomimic.read_metadata(tmp_path / "valid.hdf5")["masks"] == {
        "train": [],
        "valid": ["demo_0"],
    }


def test_lerobot_gets_the_control_rate_and_the_task_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: dict[str, Any] = {}

    def write(target: Path, episodes: Any, **options: Any) -> None:
        told.update(options, count=len(list(episodes)))

    monkeypatch.setattr(lerobot, "write_episodes", write)
    episodes = [make_episode()]
    args = {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 50}}
    robomimic.write_episodes(tmp_path / "a.hdf5", episodes, env_args=args)
    convert(tmp_path / "a.hdf5", tmp_path / "le", to="lerobot")
    assert told == {"fps": 50.0, "task": "Lift", "count": 1}
    robomimic.write_episodes(
        tmp_path / "b.hdf5", episodes, env_args=args, attributes={"task": "lift a cube"}
    )
    convert(tmp_path / "b.hdf5", tmp_path / "le", to="lerobot")
    assert told["task"] == "lift a cube"


def test_a_control_rate_that_nobody_tells_is_asked_for(path: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    pytest.importorskip("minari")
    with pytest.raises(ConfigError, match="--fps"):
        convert(path, tmp_path / "le", to="lerobot")
    convert(path, tmp_path / "le", to="lerobot", fps=10)
    assert json.loads((tmp_path / "le" / "meta" / "info.json").read_text())["fps"] == 10
    convert(path, tmp_path / "sawyer" / "a-v0", to="minari")
    with minari.open_data(tmp_path / "sawyer" / "a-v0") as opened:
        assert "fps" not in opened.metadata


def test_the_control_rate_survives_minari(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    minari.write_episodes(tmp_path / "sawyer" / "a-v0", [make_episode()], fps=25.0)
    with open_source(tmp_path / "sawyer" / "a-v0") as source:
        assert source.fps == 25.0


def test_a_relative_path_is_as_good_as_an_absolute_one(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    convert("lift.hdf5", "sawyer/lift-v0", to="minari")
    convert("sawyer/lift-v0", "back.hdf5", to="robomimic")
    assert find_format(Path("sawyer/lift-v0")) == "minari"
    assert find_format(Path("back.hdf5")) == "robomimic"


# -- what is refused -------------------------------------------------------------------------------


@pytest.mark.parametrize("to", ["robomimic", "minari", "lerobot"])
def test_a_bad_episode_stops_a_conversion_and_leaves_nothing(
    path: Path, tmp_path: Path, to: str
) -> None:
    pytest.importorskip({"robomimic": "h5py", "lerobot": "pyarrow"}.get(to, to))
    spoil(path)
    before = path.read_bytes()
    target = tmp_path / "out" / "a-v0"
    with pytest.raises(DataError) as caught:
        convert(path, target, to=to, fps=20)
    assert str(caught.value).startswith(f"{path}: data/demo_2/")
    assert list(target.parent.glob("*")) + list(target.parent.glob(".*")) == []
    assert path.read_bytes() == before


def test_a_target_that_exists_is_left_alone(path: Path, tmp_path: Path) -> None:
    (tmp_path / "there").write_text("mine")
    with pytest.raises(DataError, match="there: exists"):
        convert(path, tmp_path / "there", to="robomimic")
    assert (tmp_path / "there").read_text() == "mine"


def test_a_full_disk_is_a_typed_error(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*args: Any, **options: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(robomimic, "_write_episode", full)
    with pytest.raises(DataError, match=r"out\.hdf5: cannot be written .*No space left"):
        convert(path, tmp_path / "out.hdf5", to="robomimic")
    assert sorted(file.name for file in tmp_path.iterdir()) == ["lift.hdf5"]


def test_unknown_formats_and_options_that_do_not_fit_are_named(path: Path, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"'hdf5'.*robomimic, minari, lerobot"):
        convert(path, tmp_path / "a", to="hdf5")
    with pytest.raises(DataError, match="valid masks: train, valid"):
        convert(path, tmp_path / "a", to="robomimic", split="test")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"empty: a folder without data/main_data\.hdf5"):
        convert(tmp_path / "empty", tmp_path / "a", to="robomimic")
    with pytest.raises(ConfigError, match=r"task and tracking are for .* has the format robomimic"):
        convert(path, tmp_path / "a", to="robomimic", task="lift")
    with h5py.File(tmp_path / "other.hdf5", "w") as file:
        file["data/demo_0/actions"] = np.zeros((3, 7))
    with pytest.raises(DataError, match=r"no demonstration with obs .* or states"):
        convert(tmp_path / "other.hdf5", tmp_path / "a", to="robomimic")


def test_states_alone_need_a_task(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        file["data/demo_1/states"] = np.zeros((3, 34))
    with pytest.raises(ConfigError, match="--task"), open_source(tmp_path / "demo.hdf5"):
        pass


def test_a_faulty_mask_is_told_by_the_check_and_stops_a_conversion(
    path: Path, tmp_path: Path, capsys: Any
) -> None:
    with h5py.File(path, "r+") as file:
        del file["mask/valid"]
        file["mask/valid"] = np.array([b"demo_9"])
    assert main(["check", str(path)]) == 1
    message = f"{path}: mask/valid: row 0 names 'demo_9', which is not in the file"
    assert message in capsys.readouterr().err
    with pytest.raises(DataError, match="names 'demo_9'"):
        convert(path, tmp_path / "a.hdf5", to="robomimic")
    assert not (tmp_path / "a.hdf5").exists()


# -- the command line ------------------------------------------------------------------------------


def test_check_tells_what_a_whole_file_holds(path: Path, capsys: Any) -> None:
    assert main(["check", str(path)]) == 0
    told = capsys.readouterr().out
    assert f"{path}: robomimic, 4 episodes, 26 steps" in told
    assert "5 to 8" in told
    assert "4 truncated, 0 terminated" in told
    assert "train        3 episodes" in told
    for name, ((size,), _) in TASK_PARTS.items():
        (line,) = (line for line in told.splitlines() if line.split()[:1] == [name])
        assert line.split()[1:3] == ["float64", str(size)]


def test_check_lists_everything_that_is_wrong_and_fails(path: Path, capsys: Any) -> None:
    spoil(path)
    assert main(["check", str(path)]) == 1
    told = capsys.readouterr()
    assert "2 episodes" in told.out
    for message in (
        "data/demo_2/actions: 7.0 in row 3 is outside [-1.0, 1.0]",
        "data/demo_2/rewards: a value that is not finite in row 1",
        "data/demo_3/obs/goal_pos: a value that is not finite in row 0",
        "wrong: 3",
    ):
        assert message in told.err


def test_the_command_converts_and_says_so(path: Path, tmp_path: Path, capsys: Any) -> None:
    assert main(["convert", str(path), str(tmp_path / "b.hdf5"), "--to", "robomimic"]) == 0
    assert "b.hdf5: robomimic, 4 episodes" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="1"):
        main(["convert", str(path), str(tmp_path / "b.hdf5"), "--to", "robomimic"])
    assert capsys.readouterr().err == f"error: {tmp_path / 'b.hdf5'}: exists; valid: a new name\n"


def test_a_missing_package_is_named_with_the_extra_that_brings_it(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    for package, to in (("minari", "minari"), ("pyarrow.parquet", "lerobot")):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(BMRLError, match=r"torchrl_bmrl\[data\]"):
            convert(path, tmp_path / "out" / "a-v0", to=to, fps=20)
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


@pytest.mark.robosuite
@pytest.mark.skipif(not HUMAN.exists(), reason=f"{HUMAN.name} of human_sawyer_lift is not there")
def test_human_recordings_are_checked_converted_and_loaded(tmp_path: Path, capsys: Any) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    assert main(["check", str(HUMAN), "--task", "lift"]) == 0
    told = capsys.readouterr().out
    assert "robosuite, 2 episodes, 421 steps" in told
    assert "0 of 2" in told
    for row in (
        "demo_1           233  1058   11.67 s   2.9 cm          yes",
        "demo_2           188",
    ):
        assert row in told
    target = tmp_path / "human.hdf5"
    assert main(["convert", str(HUMAN), str(target), "--to", "robomimic", "--task", "lift"]) == 0
    data = RobomimicExperienceReplay(target)[:]
    assert len(data) == 421
    assert data["next", "truncated"].sum() == 2
    assert not data["next", "success"].any()
    assert data["robot0_eef_pos"].shape == (421, 3)


def test_steps_per_second_that_are_told_are_kept_and_checked(path: Path, tmp_path: Path) -> None:
    convert(path, tmp_path / "a.hdf5", to="robomimic", fps=30)
    with open_source(tmp_path / "a.hdf5") as source:
        assert source.fps == 30
    with pytest.raises(ConfigError, match="fps is -1"):
        convert(path, tmp_path / "b.hdf5", to="robomimic", fps=-1)


@pytest.mark.parametrize("kwargs", [[1], "x", {"control_freq": True}, None])
def test_odd_env_kwargs_tell_no_control_rate(path: Path, kwargs: Any) -> None:
    with h5py.File(path, "r+") as file:
        file["data"].attrs["env_args"] = json.dumps({"env_kwargs": kwargs})
    with open_source(path) as source:
        assert source.fps is None


def test_what_other_formats_say_of_a_data_set_is_kept_or_named(tmp_path: Path) -> None:
    flat = tmp_path / "flat.hdf5"
    with h5py.File(flat, "w") as file:
        file["observations"], file["actions"] = np.zeros((9, 3)), np.zeros((9, 2))
        file["rewards"], file["terminals"] = np.ones(9), np.arange(9) == 8
        file["timeouts"] = np.zeros(9)
        file.attrs["author"], file["metadata/algorithm"] = "me", "SAC"
    convert(flat, tmp_path / "a.hdf5", to="robomimic")
    told = robomimic.read_metadata(tmp_path / "a.hdf5")
    assert (told["author"], told["algorithm"]) == ("me", "SAC")
    notes = convert(flat, tmp_path / "own" / "flat-v0", to="minari").notes
    assert any("no place for it: author, algorithm" in note for note in notes)


def test_whole_numbers_that_become_floats_are_named(path: Path, tmp_path: Path) -> None:
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            actions = np.zeros(demo["actions"].shape, np.int8)
            del demo["actions"]
            demo["actions"] = actions
    notes = convert(path, tmp_path / "a", to="lerobot", fps=20).notes
    assert "whole numbers become float32" in notes


@pytest.mark.parametrize("in_place", [False, True])
def test_a_source_that_changes_while_it_is_converted_leaves_no_file(
    path: Path, tmp_path: Path, in_place: bool
) -> None:
    other = Path(shutil.copy(path, tmp_path / "other.hdf5"))

    def change(_: int) -> None:
        if in_place:
            path.write_bytes(path.read_bytes())  # by another writer: as long, and later
        elif other.exists():
            os.replace(other, path)

    with pytest.raises(DataError, match=r"lift\.hdf5: changed while it was read; valid: a file"):
        convert(path, tmp_path / "new.hdf5", to="robomimic", report=change)
    assert not (tmp_path / "new.hdf5").exists()
