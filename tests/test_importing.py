"""A user's file of any format becomes the file that a run trains on."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("h5py")
pytest.importorskip("tqdm")

import h5py
from episode_files import ENV_ARGS, assert_same, make_episode, write_file

from torchrl_bmrl.data import Episode, lerobot, minari, robomimic
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.importing import (
    find_action_bounds,
    import_demonstrations,
    read_original_bounds,
    read_scaled_episode,
)
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.errors import ConfigError, DataError, UnknownNameError


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


# -- formats ---------------------------------------------------------------------------------------


def test_a_file_in_range_with_both_masks_is_copied(tmp_path: Path) -> None:
    made = write_file(tmp_path / "own.hdf5")
    done = import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5")
    for ours, theirs in zip(read(tmp_path / "lift.hdf5"), made, strict=True):
        assert_same(ours, theirs)
    assert masks(tmp_path / "lift.hdf5") == masks(tmp_path / "own.hdf5")
    assert done.account.read.steps == sum(map(len, made))
    assert read_original_bounds(tmp_path / "lift.hdf5") == (-1.0, 1.0)
    assert read_original_bounds(tmp_path / "own.hdf5") is None


def test_d4rl_is_scaled_by_its_range_and_keeps_terminations(tmp_path: Path) -> None:
    actions = np.random.default_rng(1).uniform(-3, 5, (30, 2)).astype("f4")
    path = write_d4rl(tmp_path / "hopper.hdf5", actions=actions)
    options = ReadOptions(last_step="truncate")
    import_demonstrations(path, tmp_path / "hopper_run.hdf5", options=options)
    episodes = read(tmp_path / "hopper_run.hdf5")
    assert [len(episode) for episode in episodes] == [10, 10, 10]
    assert [bool(episode.terminated[-1]) for episode in episodes] == [True, False, False]
    low, high = read_original_bounds(tmp_path / "hopper_run.hdf5")
    assert_allclose((low, high), (actions.min(0), actions.max(0)))
    scaled = np.concatenate([episode.actions for episode in episodes])
    assert scaled.dtype == np.float32
    assert scaled.min() == -1
    assert scaled.max() == 1
    assert_allclose(low + (scaled + 1) / 2 * (np.array(high) - low), actions, atol=1e-6)


def test_minari_is_scaled_by_the_bounds_of_its_space(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    low, high = -0.5, (2.0,) * 6 + (1.0,)
    made = [make_episode(i) for i in range(3)]
    minari.write_episodes(
        tmp_path / "own" / "lift-v0", [in_units(x, low, high) for x in made], bounds=(low, high)
    )
    import_demonstrations(tmp_path / "own" / "lift-v0", tmp_path / "lift.hdf5")
    assert read_original_bounds(tmp_path / "lift.hdf5") == (low, high)
    for ours, theirs in zip(read(tmp_path / "lift.hdf5"), made, strict=True):
        assert_allclose(ours.actions, theirs.actions, atol=1e-6)
        assert_array_equal(ours.extras["successes"], theirs.extras["successes"])


def test_lerobot_is_imported_with_its_rewards_and_successes(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    parts = {"joints": ((4,), np.float32)}
    made = [make_episode(i, parts=parts) for i in range(3)]
    lerobot.write_episodes(tmp_path / "own", made, fps=20, task="lift")
    options = ReadOptions(last_step="truncate")
    import_demonstrations(tmp_path / "own", tmp_path / "lift.hdf5", options=options)
    for ours, theirs in zip(read(tmp_path / "lift.hdf5"), made, strict=True):
        assert_array_equal(ours.actions, theirs.actions)
        assert_allclose(ours.rewards, theirs.rewards, rtol=1e-6)
        assert_array_equal(ours.extras["successes"], theirs.extras["successes"])
    assert RobomimicExperienceReplay(tmp_path / "lift.hdf5", split="valid")[:]["episode"].numel()


def test_an_episode_is_read_as_it_would_be_imported(tmp_path: Path) -> None:
    made = write_file(tmp_path / "own.hdf5")
    with h5py.File(tmp_path / "own.hdf5", "a") as file:
        del file["mask"]
        file["mask/context"] = np.array(["demo_1"], dtype="S")
    imported, bounds = tmp_path / "lift.hdf5", (-2.0, 2.0)
    import_demonstrations(tmp_path / "own.hdf5", imported, bounds=bounds)
    expected = read(imported)
    outside = [i for i in range(len(made)) if i != 1]
    for index, position in enumerate(outside):
        episode = read_scaled_episode(tmp_path / "own.hdf5", index, bounds=bounds)
        assert_same(episode, expected[position])
    other = read_scaled_episode(tmp_path / "own.hdf5", bounds=bounds, context=True)
    assert_same(other, expected[1])
    message = rf"{len(outside)} episodes outside mask/context; valid: at least {len(made)}"
    with pytest.raises(DataError, match=message):
        read_scaled_episode(tmp_path / "own.hdf5", len(outside))
    with pytest.raises(DataError, match="1 episodes in mask/context; valid: at least 2"):
        read_scaled_episode(tmp_path / "own.hdf5", 1, context=True)


def test_a_folder_of_files_becomes_one_file(tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    made = [write_file(tmp_path / "own" / f"{name}.hdf5", (5, 6), train=1) for name in "ab"]
    import_demonstrations(tmp_path / "own", tmp_path / "lift.hdf5")
    for ours, theirs in zip(read(tmp_path / "lift.hdf5"), made[0] + made[1], strict=True):
        assert_same(ours, theirs)
    assert masks(tmp_path / "lift.hdf5") == {
        "train": ["demo_0", "demo_2"],
        "valid": ["demo_1", "demo_3"],
    }


# -- masks -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "share", "valid"),
    [
        (2, 0.1, [1]),
        (20, 0.1, [9, 19]),
        (15, 0.1, [6, 14]),
        (20, 0.35, [1, 4, 7, 10, 13, 16, 19]),
        (3, 0.9, [0, 2]),
    ],
)
def test_episodes_are_held_out_at_equal_distances(
    tmp_path: Path, count: int, share: float, valid: list[int]
) -> None:
    episodes = [make_episode(i) for i in range(count)]
    robomimic.write_episodes(tmp_path / "own.hdf5", episodes, env_args=ENV_ARGS)
    import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5", valid_share=share)
    assert masks(tmp_path / "lift.hdf5") == {
        "train": [f"demo_{i}" for i in range(count) if i not in valid],
        "valid": [f"demo_{i}" for i in valid],
    }


def test_a_mask_that_lost_all_of_its_episodes_is_chosen_anew(tmp_path: Path) -> None:
    write_file(tmp_path / "own.hdf5")
    options = ReadOptions(split="train")
    import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5", options=options)
    assert masks(tmp_path / "lift.hdf5") == {"train": ["demo_0", "demo_1"], "valid": ["demo_2"]}


def test_masks_of_one_of_two_files_do_not_decide_what_is_held_out(tmp_path: Path) -> None:
    write_file(tmp_path / "a.hdf5", (5, 6), train=1)
    robomimic.write_episodes(
        tmp_path / "b.hdf5", [make_episode(i) for i in range(2)], env_args=ENV_ARGS
    )
    sources = [tmp_path / "a.hdf5", tmp_path / "b.hdf5"]
    import_demonstrations(sources, tmp_path / "lift.hdf5")
    assert masks(tmp_path / "lift.hdf5") == {
        "train": ["demo_0", "demo_1", "demo_2"],
        "valid": ["demo_3"],
    }


def test_other_masks_of_the_source_stay(tmp_path: Path) -> None:
    episodes = [make_episode(i) for i in range(3)]
    robomimic.write_episodes(
        tmp_path / "own.hdf5", episodes, env_args=ENV_ARGS, masks={"better": [0, 2]}
    )
    import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5")
    assert masks(tmp_path / "lift.hdf5")["better"] == ["demo_0", "demo_2"]


def test_episodes_of_another_behaviour_are_neither_trained_on_nor_held_out(tmp_path: Path) -> None:
    episodes, others = [make_episode(seed=i) for i in range(8)], {"context": [1, 4, 7]}
    robomimic.write_episodes(tmp_path / "own.hdf5", episodes, env_args=ENV_ARGS, masks=others)
    import_demonstrations(
        tmp_path / "own.hdf5", tmp_path / "lift.hdf5", valid_share=0.4, context=True
    )
    assert masks(tmp_path / "lift.hdf5") == {
        "train": ["demo_0", "demo_3", "demo_5"],
        "valid": ["demo_2", "demo_6"],
        "context": ["demo_1", "demo_4", "demo_7"],
    }


# -- what is refused, and what is said -------------------------------------------------------------


@pytest.mark.parametrize("stated", [{}, {"context": []}, {"train": [0], "valid": [1]}])
def test_missing_episodes_of_another_behaviour_are_refused_before_anything_is_written(
    tmp_path: Path, stated: dict[str, list[int]]
) -> None:
    episodes = [make_episode(seed=i) for i in range(2)]
    robomimic.write_episodes(tmp_path / "own.hdf5", episodes, env_args=ENV_ARGS, masks=stated)
    with pytest.raises(DataError, match=r"own.hdf5.*mask/context.*names no episode; valid"):
        import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5", context=True)
    assert not (tmp_path / "lift.hdf5").exists()


def test_too_few_episodes_beside_those_of_another_behaviour_are_refused(tmp_path: Path) -> None:
    episodes = [make_episode(seed=i) for i in range(3)]
    robomimic.write_episodes(
        tmp_path / "own.hdf5", episodes, env_args=ENV_ARGS, masks={"context": [0, 1]}
    )
    with pytest.raises(DataError, match="one episode outside mask/context; valid: at least two"):
        import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5")


@pytest.mark.parametrize("masks", [{}, {"train": [0], "valid": [0]}])
def test_a_single_episode_is_refused(tmp_path: Path, masks: dict[str, list[int]]) -> None:
    robomimic.write_episodes(tmp_path / "own.hdf5", [make_episode()], env_args={}, masks=masks)
    with pytest.raises(DataError, match="one episode; valid: at least two"):
        import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5")


def test_discrete_actions_are_refused(tmp_path: Path) -> None:
    path = write_d4rl(tmp_path / "own.hdf5", actions=np.arange(30) % 4)
    for refuse in (find_action_bounds, lambda x: import_demonstrations(x, tmp_path / "a.hdf5")):
        with pytest.raises(DataError, match="stage 1 needs continuous actions"):
            refuse(path)


def test_missing_rewards_are_refused_until_an_option_says_them(tmp_path: Path) -> None:
    path = tmp_path / "own.hdf5"
    write_file(path)
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            del demo["rewards"]
    with pytest.raises(DataError, match=r"demo_0/rewards: missing; valid: .*option reward"):
        import_demonstrations(path, tmp_path / "lift.hdf5")
    options = ReadOptions(reward="success")
    import_demonstrations(path, tmp_path / "lift.hdf5", options=options)
    for episode in read(tmp_path / "lift.hdf5"):
        assert_array_equal(episode.rewards, episode.extras["successes"])


@pytest.mark.parametrize("share", [0, 1, -0.1, True])
def test_a_share_that_leaves_a_mask_empty_is_refused(tmp_path: Path, share: float) -> None:
    with pytest.raises(ConfigError, match="valid_share"):
        import_demonstrations(tmp_path / "own.hdf5", tmp_path / "a.hdf5", valid_share=share)


def test_a_target_that_exists_is_kept(tmp_path: Path) -> None:
    write_file(tmp_path / "own.hdf5")
    (tmp_path / "lift.hdf5").write_text("mine")
    with pytest.raises(DataError, match="exists"):
        import_demonstrations(tmp_path / "own.hdf5", tmp_path / "lift.hdf5")
    assert (tmp_path / "lift.hdf5").read_text() == "mine"


def test_what_is_left_out_or_changed_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_d4rl(tmp_path / "own.hdf5", actions=np.linspace(-2, 2, 60).reshape(30, 2))
    with caplog.at_level(logging.INFO, "torchrl_bmrl"):
        done = import_demonstrations(path, tmp_path / "lift.hdf5")
    assert all(note in caplog.text for note in done.notes)
    assert "left out: 2 last steps" in caplog.text
    assert "actions were scaled from" in caplog.text
    assert "2 episodes to train on, 1 held out (1 of 3, evenly spread)" in caplog.text


# -- options from a mapping ------------------------------------------------------------------------


def test_options_are_read_from_a_mapping() -> None:
    options = ReadOptions.from_mapping(
        {"observation_keys": ["x"], "bounds": [[-1, -2], 2], "last_step": "truncate"}
    )
    assert options == ReadOptions(
        observation_keys=["x"], bounds=((-1, -2), 2), last_step="truncate"
    )
    assert ReadOptions.from_mapping(None) == ReadOptions.from_mapping({}) == ReadOptions()


def test_a_key_that_is_no_option_is_refused_with_those_that_are() -> None:
    with pytest.raises(
        UnknownNameError, match=r"unknown option 'rewards'; valid options: .*reward"
    ):
        ReadOptions.from_mapping({"rewards": "last"})
    with pytest.raises(ConfigError, match="a mapping"):
        ReadOptions.from_mapping(["reward"])
    with pytest.raises(ConfigError, match="reward is 'end'"):
        ReadOptions.from_mapping({"reward": "end"})
