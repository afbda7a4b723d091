"""Hundreds of odd recordings: each is refused by name or gives a step for each interval."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)
pytest.importorskip("h5py")

import h5py
from file_edits import put
from recordings import read, record

from torchrl_bmrl.data.robosuite import Relabelling
from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.errors import DataError

pytestmark = pytest.mark.robosuite


def fewer_rows(demo: Any, rng: np.random.Generator) -> bool:
    states = demo["states"][()]
    keep = np.sort(rng.choice(len(states), rng.integers(3, len(states)), replace=False))
    put("states", states[keep])(demo)
    return bool((np.diff(states[keep, 0]) <= 0.1 + 1e-9).all())


def other_times(demo: Any, rng: np.random.Generator) -> bool:
    """Gives rows other rates and equal times, as recordings of 2018 have them."""
    states = demo["states"][()]
    gaps = rng.choice([0.0, 0.01, 0.024, 0.05, 0.09], len(states) - 1)
    gaps[0] = 0.09
    states[1:, 0] = states[0, 0] + np.cumsum(gaps)
    put("states", states)(demo)
    return True


def backwards(demo: Any, rng: np.random.Generator) -> bool:
    states = demo["states"][()]
    row = int(rng.integers(1, len(states)))
    states[row:, 0] -= 0.07
    put("states", states)(demo)
    return False


def not_finite(demo: Any, rng: np.random.Generator) -> bool:
    states = demo["states"][()]
    states[rng.integers(len(states)), rng.integers(states.shape[1])] = rng.choice([np.nan, np.inf])
    put("states", states)(demo)
    return False


def another_width(demo: Any, rng: np.random.Generator) -> bool:
    states = demo["states"][()]
    put("states", states[:, : -int(rng.integers(1, 8))])(demo)
    return False


def another_dtype(demo: Any, rng: np.random.Generator) -> bool:
    kind = str(rng.choice(["f4", ">f8", "S8", "c16"]))
    put("states", demo["states"][()].astype(kind))(demo)
    return kind in ("f4", ">f8")


def more_beside(demo: Any, rng: np.random.Generator) -> bool:
    """Adds what other versions and tools store beside the states."""
    demo["actions_abs"] = rng.random((3, 7))
    demo["notes"] = "a person's first try"
    demo.create_group("obs_raw")["x"] = rng.random(4)
    demo.attrs["success"] = str(rng.choice(["yes", "no"]))
    demo.parent.attrs["total"] = int(rng.integers(100))
    return True


def another_joint(demo: Any, rng: np.random.Generator) -> bool:
    joint = f"robot0_right_j{rng.integers(7)}"
    demo.attrs["model_file"] = demo.attrs["model_file"].replace(f'"{joint}"', '"elbow"')
    return False


# Each changes a demonstration and returns whether it can still be read.
ODD = (
    fewer_rows,
    other_times,
    backwards,
    not_finite,
    another_width,
    another_dtype,
    more_beside,
    another_joint,
)


def test_every_odd_recording_is_refused_by_name_or_gives_a_step_for_each_interval(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchrl_bmrl.envs import scene

    whole = record(tmp_path / "whole.hdf5", "lift", 12)
    env = TabletopScene("lift", use_object_obs=False)
    monkeypatch.setattr(env, "close", lambda: None)
    # One environment serves all files.
    monkeypatch.setattr(scene, "TabletopScene", lambda *_, **__: env)
    outcomes = {True: 0, False: 0}
    for number in range(208):
        change = ODD[number % len(ODD)]
        path = Path(shutil.copy(whole.path, tmp_path / f"{number}.hdf5"))
        with h5py.File(path, "r+") as file:
            valid = change(file["data/demo_1"], np.random.default_rng(number))
            states = file["data/demo_1/states"][()]
        outcomes[valid] += 1
        if not valid:
            with pytest.raises(DataError, match=f"{path}: data/demo_1"):
                read(path)
            continue
        times = states[:, 0].astype(np.float64)
        episode = read(path)
        assert len(episode) == int((times[-1] - times[0]) * env.control_freq + 1e-6), number
        assert len(episode.rewards) == len(episode.extras["successes"]) == len(episode)
        assert episode.left_out.steps == 0
        assert Relabelling.of("demo_1", episode).recorded_rows == len(states)
    assert min(outcomes.values()) >= 70, outcomes
