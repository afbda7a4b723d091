"""Files of demonstrations give back their episodes, masks and attributes to the bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py
from episode_files import (
    ENV_ARGS,
    LENGTHS,
    PARTS,
    assert_identical,
    assert_same,
    lift_file,
    make_episode,
    read_file,
    write_file,
)
from file_edits import change, edit, put, remove

from torchrl_bmrl.data.robomimic import (
    count_episodes,
    count_steps,
    keep_episode,
    open_episodes,
    read_kept_episode,
    read_metadata,
    write_episodes,
)
from torchrl_bmrl.data.schema import find_problems
from torchrl_bmrl.data.sources import Source, open_source
from torchrl_bmrl.errors import DataError

DEMO = "data/demo_1"
ROWS = LENGTHS[1]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return lift_file(tmp_path)


def opened(path: Path) -> Source:
    with open_source(path) as source:
        return source


def test_a_kept_episode_comes_back_to_the_bit(tmp_path: Path) -> None:
    episode = make_episode(terminated=True)
    keep_episode(tmp_path / "0.npz", episode)
    kept = read_kept_episode(tmp_path / "0.npz")
    assert_same(kept, episode)
    assert list(kept.observations) == list(episode.observations)


def test_episodes_come_back_to_the_bit(tmp_path: Path) -> None:
    made = write_file(tmp_path / "a.hdf5")
    episodes = read_file(tmp_path / "a.hdf5")
    assert list(episodes) == [f"demo_{i}" for i in range(len(LENGTHS))]
    for episode, original in zip(episodes.values(), made, strict=True):
        assert_same(episode, original)


def test_an_episode_is_read_when_it_is_asked_for_and_only_then(path: Path) -> None:
    edit(path, remove(f"{DEMO}/actions"))
    with open_episodes(path) as episodes:
        assert len(episodes) == len(LENGTHS)
        assert len(episodes["demo_0"]) == LENGTHS[0]
        with pytest.raises(DataError, match=f"{DEMO}/actions: missing"):
            episodes["demo_1"]
        with pytest.raises(KeyError):
            episodes["demo_9"]


def test_more_than_ten_episodes_keep_their_order(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    made = write_file(path, [2] * 12, train=11)
    for split, expected in ((None, made), ("train", made[:11]), ("valid", made[11:])):
        episodes = list(read_file(path, split=split).values())
        assert len(episodes) == len(expected)
        for episode, original in zip(episodes, expected, strict=True):
            assert_identical(episode.actions, original.actions)
    assert count_episodes(path) == 12


def test_only_the_parts_asked_for_are_read(path: Path) -> None:
    edit(path, put(f"{DEMO}/obs/image", "not even an image"))
    for episode in read_file(path, observation_keys=["object"]).values():
        assert list(episode.observations) == list(episode.next_observations) == ["object"]


def test_no_part_asked_for_is_not_every_part(path: Path) -> None:
    assert read_file(path, observation_keys=[])["demo_0"].observations == {}


def test_only_the_extras_asked_for_are_read(path: Path) -> None:
    edit(path, put(f"{DEMO}/states", "not even an array"))
    wanted = ["successes", "phases", "absent"]
    assert set(read_file(path, extras=wanted)["demo_1"].extras) == {"successes", "phases"}
    assert read_file(path, extras=[])["demo_1"].extras == {}


def test_what_other_tools_keep_beside_the_steps_is_left_alone(path: Path) -> None:
    edit(
        path,
        remove(f"{DEMO}/states"),
        put(f"{DEMO}/datagen_info/target", np.zeros((3, 4, 4))),
        put(f"{DEMO}/src_demo_inds", np.zeros(2)),
        put(f"{DEMO}/text", "words"),
    )
    assert set(read_file(path)["demo_1"].extras) == {"successes", "phases"}
    edit(path, put(f"{DEMO}/successes", "words"))  # this library's own array is read
    with pytest.raises(DataError, match=f"{DEMO}/successes: "):
        read_file(path)
    edit(path, put(f"{DEMO}/successes", np.zeros(2)))
    assert next(find_problems(read_file(path)["demo_1"]))[0] == "successes"


def test_a_file_of_another_writer_needs_neither_masks_nor_attributes(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    made = make_episode()
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo["obs/x"], demo["next_obs/x"] = made.observations["object"], np.ones((5, 10))
        demo["actions"], demo["rewards"] = made.actions, made.rewards
    (episode,) = read_file(path).values()
    assert (dict(episode.extras), dict(episode.attributes)) == ({}, {})
    assert not episode.terminated.any()
    assert_identical(episode.observations["x"], made.observations["object"])
    assert read_metadata(path) == {"env_args": {}, "masks": {}}


def test_numbers_of_another_byte_order_become_the_machine_s(path: Path) -> None:
    before = read_file(path)["demo_1"].rewards
    edit(path, put(f"{DEMO}/rewards", before.astype(">f8")))
    assert_identical(read_file(path)["demo_1"].rewards, before)


def test_steps_are_counted_over_the_episodes_named(path: Path) -> None:
    episodes = read_file(path)
    some = {name: episodes[name] for name in ("demo_0", "demo_2")}
    assert count_steps(path, some) == LENGTHS[0] + LENGTHS[2]
    assert count_steps(path, {}) == 0
    with pytest.raises(DataError, match=r"lift\.hdf5: data/demo_9/actions: missing"):
        count_steps(path, {"demo_9": make_episode()})


# -- attributes and masks --------------------------------------------------------------------------


def test_attributes_come_back_as_python_s_own_types(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    attributes = {
        "model_file": "<mujoco>" + "é<body name='x'/>" * 3500 + "</mujoco>",
        "seed": 7,
        "noise": 0.25,
        "solved": True,
        "phase_names": ["a", "bc"],
    }
    assert len(attributes["model_file"].encode()) > 50_000  # type: ignore[attr-defined]
    write_episodes(path, [replace(make_episode(), attributes=attributes)], env_args={})
    came_back = dict(read_file(path)["demo_0"].attributes)
    assert came_back == attributes
    assert {k: type(v) for k, v in came_back.items()} == {k: type(v) for k, v in attributes.items()}
    with h5py.File(path) as file:  # a text of fixed length, which other tools read
        assert file["data/demo_0"].attrs["model_file"].decode() == attributes["model_file"]


def test_texts_of_any_length_come_back(tmp_path: Path) -> None:
    attributes = {"none": "", "long": "<geom/>" * 30_000, "names": [], "mixed": ["", "é" * 9]}
    episode = replace(make_episode(), attributes=attributes)
    write_episodes(tmp_path / "a.hdf5", [episode], env_args={})
    assert dict(read_file(tmp_path / "a.hdf5")["demo_0"].attributes) == attributes


def test_a_file_s_attributes_and_masks_come_back(path: Path) -> None:
    assert read_metadata(path) == {
        "total": sum(LENGTHS),
        "env_args": ENV_ARGS,
        "task": "lift",
        "action_noise": 0.2,
        "masks": {"train": ["demo_0", "demo_1", "demo_2"], "valid": ["demo_3"]},
    }


def test_a_mask_keeps_its_own_order(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    write_episodes(
        path, [make_episode(i) for i in range(3)], env_args={}, masks={"mine": [2, 0], "no": []}
    )
    assert list(read_file(path, split="mine")) == ["demo_2", "demo_0"]
    assert read_metadata(path)["masks"] == {"mine": ["demo_2", "demo_0"], "no": []}


def test_names_in_a_mask_may_be_text(path: Path) -> None:
    edit(path, put("mask/valid", np.array(["demo_3"], dtype=h5py.string_dtype())))
    assert list(read_file(path, split="valid")) == ["demo_3"]


def test_every_faulty_mask_is_told(path: Path) -> None:
    assert opened(path).problems == opened(path).oddities == []
    edit(
        path,
        put("mask/train", np.array([b"demo_0", b"demo_7"])),
        put("mask/valid", np.array([b"demo_1", b"demo_1"])),
    )
    assert opened(path).problems == [
        ("mask/train", "row 1 names 'demo_7', which is not in the file"),
        ("mask/valid", "row 1 names 'demo_1', again"),
    ]


def test_an_episode_to_train_on_and_to_hold_out_deserves_a_look(path: Path) -> None:
    edit(path, put("mask/valid", np.array([b"demo_3", b"demo_1"])))
    assert opened(path).oddities == ["1 episodes are in train and in valid, such as demo_1"]


# -- how an episode ends ---------------------------------------------------------------------------


def test_a_termination_comes_back_whatever_dones_say(tmp_path: Path) -> None:
    made = [make_episode(i, 5, terminated=i == 1) for i in range(2)]
    write_episodes(tmp_path / "a.hdf5", made, env_args={})
    for option in (False, True):
        episodes = read_file(tmp_path / "a.hdf5", dones_terminate=option)
        assert [e.terminated.tolist() for e in episodes.values()] == [
            [False] * 5,
            [False] * 4 + [True],
        ]


def test_dones_terminate_only_where_that_is_asked_for(path: Path) -> None:
    edit(path, remove(f"{DEMO}/terminated"))
    assert not read_file(path)["demo_1"].terminated.any()
    terminated = read_file(path, dones_terminate=True)["demo_1"].terminated
    assert terminated.tolist() == [False] * (ROWS - 1) + [True]
    edit(path, change(f"{DEMO}/dones", -1, 0))
    assert not read_file(path, dones_terminate=True)["demo_1"].terminated.any()


def test_dones_at_solved_steps_do_not_terminate_the_episode_there(path: Path) -> None:
    edit(path, remove(f"{DEMO}/terminated"), change(f"{DEMO}/dones", 2, 1))
    terminated = read_file(path, dones_terminate=True)["demo_1"].terminated
    assert terminated.tolist() == [False] * (ROWS - 1) + [True]


def test_without_next_observations_the_last_step_is_lost(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    made = write_file(path)
    edit(path, remove(*(f"data/demo_{i}/next_obs" for i in range(4))))
    for episode, original in zip(read_file(path).values(), made, strict=True):
        assert len(episode) == len(original) - 1
        for name in PARTS:
            assert_identical(episode.observations[name], original.observations[name][:-1])
            assert_identical(episode.next_observations[name], original.observations[name][1:])
        assert_identical(episode.actions, original.actions[:-1])
        assert_identical(episode.rewards, original.rewards[:-1])
        assert_identical(episode.extras["states"], original.extras["states"][:-1])
        assert episode.terminated.tolist() == [False] * len(episode)
    assert count_steps(path, read_file(path)) == sum(LENGTHS) - 4
    (told,) = opened(path).oddities
    assert "4 episodes have no next_obs, such as demo_0" in told


def test_without_next_observations_a_step_that_terminates_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    original = make_episode(terminated=True)
    write_episodes(path, [original], env_args={})
    edit(path, remove("data/demo_0/next_obs"))
    episode = read_file(path)["demo_0"]
    assert_identical(episode.rewards, original.rewards)
    assert episode.terminated[-1]
    for name in PARTS:
        assert_identical(episode.observations[name], original.observations[name])
        after = np.append(original.observations[name][1:], original.observations[name][-1:], axis=0)
        assert_identical(episode.next_observations[name], after)
    assert count_steps(path, read_file(path)) == len(original)
