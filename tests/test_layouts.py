"""A file of each layout, made by hand, checked, converted to each other format and back."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("minari")
pytest.importorskip("pyarrow")
pytest.importorskip("tqdm")

import h5py

from torchrl_bmrl.data import lerobot
from torchrl_bmrl.data.__main__ import main
from torchrl_bmrl.data.convert import convert, open_source
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.episodes import Episode

EPISODES, STEPS = 3, 8
LAST = np.arange(STEPS) == STEPS - 1


def numbers(i: int) -> tuple[np.ndarray, np.ndarray]:
    """Observations ``(T + 1, 3)`` and actions ``(T, 2)`` of an episode, exact in float32."""
    rng = np.random.default_rng(i)
    x = rng.integers(-99, 99, (STEPS + 1, 3)) / 4
    return x, rng.integers(-4, 5, (STEPS, 2)) / 4


def write_demos(path: Path, edit: Callable[[Any, int], object]) -> Path:
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs["env_args"] = json.dumps(
            {"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 20}}
        )
        for i in range(EPISODES):
            demo, (x, actions) = file.create_group(f"data/demo_{i}"), numbers(i)
            demo["obs/x"], demo["actions"] = x[:-1], actions
            demo["rewards"], demo["dones"] = 1.0 * LAST, 1 * LAST
            edit(demo, i)
    return path


def robomimic_whole(folder: Path) -> Path:
    def edit(demo: Any, i: int) -> None:
        demo["next_obs/x"] = numbers(i)[0][1:]

    return write_demos(folder / "whole.hdf5", edit)


def robomimic_without_next(folder: Path) -> Path:
    return write_demos(folder / "cut.hdf5", lambda demo, i: None)


def libero(folder: Path) -> Path:
    def edit(demo: Any, i: int) -> None:
        demo["robot_states"] = np.zeros((STEPS, 9))
        demo["states"] = np.zeros((STEPS, 40))
        demo.attrs["init_state"], demo.attrs["num_samples"] = np.zeros(40), STEPS

    return write_demos(folder / "libero.hdf5", edit)


def isaac_lab(folder: Path) -> Path:
    def edit(demo: Any, i: int) -> None:
        del demo["rewards"], demo["dones"]
        demo.attrs["success"], demo.attrs["seed"] = True, i
        demo["states/articulation/robot/joint_position"] = np.zeros((STEPS, 9))
        demo["initial_state/articulation/robot/joint_position"] = np.zeros((1, 9))

    return write_demos(folder / "isaac.hdf5", edit)


def d4rl(folder: Path) -> Path:
    with h5py.File(folder / "d4rl.hdf5", "w") as file:
        whole = [numbers(i) for i in range(EPISODES)]
        file["observations"] = np.concatenate([x[:-1] for x, _ in whole]).astype("f4")
        file["next_observations"] = np.concatenate([x[1:] for x, _ in whole]).astype("f4")
        file["actions"] = np.concatenate([actions for _, actions in whole]).astype("f4")
        file["rewards"] = np.tile(1.0 * LAST, EPISODES).astype("f4")
        file["terminals"] = np.zeros(EPISODES * STEPS, bool)
        file["timeouts"] = np.tile(LAST, EPISODES)
    return folder / "d4rl.hdf5"


def minari(folder: Path) -> Path:
    from gymnasium.spaces import Box, Dict
    from minari.dataset.minari_storage import MinariStorage

    path = folder / "own" / "set-v0"
    spaces = {
        "observation_space": Dict({"x": Box(-np.inf, np.inf, (3,), np.float64)}),
        "action_space": Box(-1, 1, (2,), np.float64),
    }
    (path / "data").mkdir(parents=True)
    storage = MinariStorage.new(path.absolute() / "data", **spaces)
    with h5py.File(path / "data" / "main_data.hdf5", "w") as file:
        for i in range(EPISODES):
            group, (x, actions) = file.create_group(f"episode_{i}"), numbers(i)
            group["observations/x"], group["actions"] = x, actions
            group["rewards"], group["terminations"] = 1.0 * LAST, np.zeros(STEPS, bool)
            group["truncations"] = LAST
            group.attrs.update({"id": i, "total_steps": STEPS})
    storage.update_metadata(
        {"dataset_id": "own/set-v0", "total_episodes": EPISODES, "total_steps": EPISODES * STEPS}
    )
    return path


def lerobot_set(folder: Path) -> Path:
    def episode(i: int) -> Episode:
        x, actions = numbers(i)
        return Episode(
            observations={"x": x[:-1]},
            next_observations={"x": x[1:]},
            actions=actions,
            rewards=1.0 * LAST,
            terminated=np.zeros(STEPS, bool),
        )

    lerobot.write_episodes(folder / "le", map(episode, range(EPISODES)), fps=20, task="lift")
    return folder / "le"


LAYOUTS: dict[str, tuple[Callable[[Path], Path], dict[str, Any]]] = {
    "robomimic": (robomimic_whole, {}),
    "robomimic without next_obs": (robomimic_without_next, {"last_step": "truncate"}),
    "LIBERO": (libero, {"dones_terminate": True}),
    "Isaac Lab": (isaac_lab, {"reward": "success", "last_step": "truncate"}),
    "D4RL": (d4rl, {}),
    "Minari": (minari, {}),
    "LeRobot": (lerobot_set, {"last_step": "truncate"}),
}
KNOWS_THE_LAST = ("robomimic", "D4RL", "Minari")


def load(path: Path, **options: Any) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return RobomimicExperienceReplay(path, **options)[:]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_file_of_each_layout_passes_the_check_with_every_step_accounted_for(
    tmp_path: Path, layout: str, capsys: Any
) -> None:
    make, options = LAYOUTS[layout]
    told = []
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        told += [flag] if value is True else [flag, value]
    assert main(["check", str(make(tmp_path)), *told]) == 0
    out = capsys.readouterr().out
    total = f"{EPISODES} episodes, {EPISODES * STEPS} steps, reward {EPISODES}, "
    assert f"in the file       {total}" in out
    assert f"read              {total}" in out
    assert "left out          nothing" in out


@pytest.mark.parametrize("to", ["robomimic", "minari", "lerobot"])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_file_of_each_layout_goes_to_each_format_and_back_or_the_loss_is_named(
    tmp_path: Path, layout: str, to: str
) -> None:
    make, options = LAYOUTS[layout]
    source = make(tmp_path)
    target = tmp_path / "there" / "set-v0"
    target.parent.mkdir()
    done = convert(source, target, to=to, fps=20, **options)
    back = tmp_path / "back.hdf5"
    further: dict[str, Any] = {}
    if to == "lerobot":  # a step that terminates is kept in any case
        further = {"last_step": "truncate"}
    convert(target, back, to="robomimic", **further)
    data = load(back)
    part = "observation" if layout == "D4RL" else "x"
    for i in range(EPISODES):
        rows, (x, actions) = slice(i * STEPS, (i + 1) * STEPS), numbers(i)
        np.testing.assert_array_equal(data[part][rows], x[:-1])
        np.testing.assert_array_equal(data["action"][rows], actions)
        np.testing.assert_array_equal(data["next", part][rows][:-1], x[1:-1])
        known = layout in KNOWS_THE_LAST and to != "lerobot"
        np.testing.assert_array_equal(data["next", part][rows][-1], x[-1] if known else x[-2])
    np.testing.assert_array_equal(data["next", "reward"].squeeze(-1), np.tile(1.0 * LAST, EPISODES))
    ends = np.tile(LAST, EPISODES)
    terminates = options.get("dones_terminate", False)
    np.testing.assert_array_equal(data["next", "terminated"].squeeze(-1), ends & terminates)
    np.testing.assert_array_equal(data["next", "done"].squeeze(-1), ends)
    notes = " ".join(done.notes)
    if to == "lerobot":
        assert "observation after the last step" in notes
    if layout == "Isaac Lab":
        assert "not read in the episodes: initial_state (3x), states (3x)" in notes
    if layout == "LIBERO" and to == "lerobot":
        assert "robot_states" in notes
        assert "terminations" not in notes  # they come back


def test_dtypes_survive_where_the_format_has_them(tmp_path: Path) -> None:
    convert(robomimic_whole(tmp_path), tmp_path / "own" / "set-v1", to="minari", fps=20)
    with open_source(tmp_path / "own" / "set-v1") as source:
        (episode, *_) = source.episodes.values()
    assert episode.observations["x"].dtype == episode.actions.dtype == np.float64
    done = convert(tmp_path / "own" / "set-v1", tmp_path / "le", to="lerobot", fps=20)
    assert "float32" in " ".join(done.notes)
