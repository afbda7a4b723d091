"""Bounds of the actions of a user's files: which they are, and in which units."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("h5py")
pytest.importorskip("tqdm")

import h5py
from episode_files import assert_same, make_episode, write_file

from torchrl_bmrl.data import Episode, robomimic
from torchrl_bmrl.data.importing import (
    copy_scaled,
    find_action_bounds,
    import_demonstrations,
    read_original_bounds,
    read_scaled_episode,
)
from torchrl_bmrl.data.options import ReadOptions, join_bounds
from torchrl_bmrl.errors import ConfigError, DataError


def read(path: Path) -> list[Episode]:
    with robomimic.open_episodes(path) as episodes:
        return list(episodes.values())


def masks(path: Path) -> dict[str, list[str]]:
    return robomimic.read_metadata(path)["masks"]


def in_units(episode: Episode, low: Any, high: Any) -> Episode:
    """The same episode whose actions in [-1, 1] are stretched to other bounds."""
    low, high = np.asarray(low), np.asarray(high)
    actions = low + (episode.actions.astype(np.float64) + 1) / 2 * (high - low)
    return replace(episode, actions=actions)


def write_d4rl(path: Path, *, ends: tuple[int, ...] = (9, 19, 29), **changes: Any) -> Path:
    rng, rows = np.random.default_rng(0), np.arange(30)
    arrays = {
        "observations": rng.standard_normal((30, 3)).astype("f4"),
        "actions": rng.uniform(-1, 1, (30, 2)).astype("f4"),
        "rewards": rng.random(30).astype("f4"),
        "terminals": rows == 9,
        "timeouts": np.isin(rows, ends) & (rows != 9),
    } | changes
    with h5py.File(path, "w") as file:
        for key, array in arrays.items():
            file[key] = array
    return path


def test_several_tasks_are_scaled_by_their_joint_bounds(tmp_path: Path) -> None:
    bounds = []
    for name, end in (("lift", 2.0), ("reach", 4.0)):
        episodes = [in_units(make_episode(i), -end, end / 2) for i in range(2)]
        robomimic.write_episodes(
            tmp_path / f"{name}.hdf5", episodes, env_args={}, bounds=(-end, end / 2)
        )
        bounds.append(find_action_bounds(tmp_path / f"{name}.hdf5"))
    assert bounds == [(-2.0, 1.0), (-4.0, 2.0)]
    joint = join_bounds(bounds)
    assert joint == (-4.0, 2.0)
    import_demonstrations(tmp_path / "lift.hdf5", tmp_path / "run.hdf5", bounds=joint)
    before, after = read(tmp_path / "lift.hdf5")[0], read(tmp_path / "run.hdf5")[0]
    assert_allclose((before.actions + 1) / 3, after.actions, atol=1e-9)
    assert read_original_bounds(tmp_path / "run.hdf5") == joint


def test_actions_outside_the_given_bounds_are_refused(tmp_path: Path) -> None:
    write_file(tmp_path / "own.hdf5")
    with pytest.raises(DataError, match="outside"):
        import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5", bounds=(-0.1, 0.1))
    assert not (tmp_path / "lift.hdf5").exists()


def test_a_file_that_was_imported_before_keeps_its_first_units(tmp_path: Path) -> None:
    made = [in_units(make_episode(i), 0.0, 4.0) for i in range(2)]
    robomimic.write_episodes(tmp_path / "own.hdf5", made, env_args={}, bounds=(0, 4))
    import_demonstrations(tmp_path / "own.hdf5", tmp_path / "one.hdf5")
    import_demonstrations(tmp_path / "one.hdf5", tmp_path / "two.hdf5")
    assert read_original_bounds(tmp_path / "two.hdf5") == (0.0, 4.0)
    for one, two in zip(read(tmp_path / "one.hdf5"), read(tmp_path / "two.hdf5"), strict=True):
        assert_same(one, two)


def test_bounds_are_in_the_units_before_any_import(tmp_path: Path) -> None:
    """Such as those of an environment: they mean the same of a file that was imported."""
    made = [in_units(make_episode(i), 0.0, 4.0) for i in range(2)]
    robomimic.write_episodes(tmp_path / "own.hdf5", made, env_args={}, bounds=(0, 4))
    import_demonstrations(tmp_path / "own.hdf5", tmp_path / "one.hdf5")
    results = []
    for source in ("own", "one"):
        path = tmp_path / f"from_{source}.hdf5"
        import_demonstrations(tmp_path / f"{source}.hdf5", path, bounds=(-4, 8))
        assert read_original_bounds(path) == (-4.0, 8.0)
        episode = read_scaled_episode(tmp_path / f"{source}.hdf5", bounds=(-4, 8))
        results += [read(path)[0].actions, episode.actions]
    assert find_action_bounds(tmp_path / "one.hdf5") == (0.0, 4.0)
    for actions in results:
        assert_allclose(actions, (made[0].actions - 2) / 6, atol=1e-6)


def test_files_that_were_imported_from_other_bounds_get_common_units(tmp_path: Path) -> None:
    made = {}
    for name, end in (("narrow", 0.5), ("wide", 2.0), ("raw", 2.0)):
        made[name] = [in_units(make_episode(i), -end, end) for i in range(2)]
        source = tmp_path / f"{name}-own.hdf5"
        robomimic.write_episodes(source, made[name], env_args={}, bounds=(-end, end))
        if name == "raw":
            source.rename(tmp_path / "raw.hdf5")
        else:
            import_demonstrations(source, tmp_path / f"{name}.hdf5")
    import_demonstrations([tmp_path / f"{name}.hdf5" for name in made], tmp_path / "all.hdf5")
    assert read_original_bounds(tmp_path / "all.hdf5") == (-2.0, 2.0)
    written = read(tmp_path / "all.hdf5")
    for episode, before in zip(written, chain.from_iterable(made.values()), strict=True):
        assert_allclose(episode.actions, before.actions / 2, atol=1e-6)


def test_a_copy_is_scaled_and_needs_no_second_episode(tmp_path: Path) -> None:
    made = in_units(make_episode(0), -2.0, 2.0)
    robomimic.write_episodes(tmp_path / "own.hdf5", [made], env_args={}, bounds=(-2, 2))
    copy_scaled(tmp_path / "own.hdf5", tmp_path / "copy.hdf5", bounds=(-4, 4))
    assert_allclose(read(tmp_path / "copy.hdf5")[0].actions, made.actions / 4, atol=1e-6)


def test_a_range_that_leaves_the_usual_one_on_either_side_is_the_bounds(tmp_path: Path) -> None:
    for number, actions in enumerate((-3.0, 3.0)):
        values = np.linspace(0, actions, 60).reshape(30, 2)
        path = write_d4rl(tmp_path / f"{number}.hdf5", actions=values)
        options = ReadOptions(last_step="truncate")
        ends = values.min(0), values.max(0)
        assert_allclose(find_action_bounds(path, options=options), ends)


def test_bounds_of_other_sizes_are_not_joined() -> None:
    with pytest.raises(ConfigError, match=r"\[2, 3\] dimensions"):
        join_bounds([((0, 0), (1, 1)), ((0, 0, 0), (1, 1, 1))])
