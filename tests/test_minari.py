"""Minari's layout: kept to the bit, read alike by Minari and TorchRL, and refused when damaged."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

pytest.importorskip("h5py")
pytest.importorskip("minari")

import gymnasium.spaces as gym
import h5py
import minari
from episode_files import readers
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDict
from torchrl.data.datasets.minari_data import MinariExperienceReplay

from torchrl_bmrl.data.episodes import Episode, LazyEpisodes, as_tensordict, stack_episodes
from torchrl_bmrl.data.minari import join_observations, new_folder, open_data, write_episodes
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import complete
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError

open_raw, read_metadata, find_oddities = readers(open_data)
ID = "sawyer/lift-v0"
Damage = Callable[[Path], None]

# Minari recommends to name an author, an environment, ...
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


@contextmanager
def open_episodes(path: Path) -> Iterator[dict[str, Episode]]:
    file = path / "data" / "main_data.hdf5"
    with open_raw(path) as raws:
        yield LazyEpisodes(raws, lambda name: complete(file, name, raws[name], ReadOptions()))


def make_episode(seed: int = 0, steps: int = 5, *, terminates: bool = False) -> Episode:
    rng = np.random.default_rng(seed)
    whole = {
        "wrist": rng.integers(0, 256, (steps + 1, 34, 36, 3)).astype(np.uint8),
        "touch": rng.integers(0, 256, (steps + 1, 4)).astype(np.uint8),
        "eef_pos": rng.standard_normal((steps + 1, 3)),
        "joints": rng.standard_normal((steps + 1, 7)).astype(np.float32),
    }
    return Episode(
        observations={name: part[:-1] for name, part in whole.items()},
        next_observations={name: part[1:] for name, part in whole.items()},
        actions=rng.uniform(-1, 1, (steps, 7)).astype(np.float32),
        rewards=rng.random(steps),
        terminated=(np.arange(steps) == steps - 1) & terminates,
        extras={
            "successes": rng.random(steps) < 0.5,
            "phases": rng.integers(0, 3, steps).astype(np.int8),
            "states": rng.standard_normal((steps, 11)),
        },
        attributes={
            "seed": 2**32 - 1 - seed,
            "scale": 0.1,
            "phase_names": ("descend", "grasp"),
            "model_file": "<mujoco>" + "x" * 100_000,
        },
    )


def make_episodes() -> list[Episode]:
    return [make_episode(0, 5), make_episode(1, 7, terminates=True), make_episode(2, 4)]


def with_parts(episode: Episode, **changes: Any) -> Episode:
    return Episode(**{**vars(episode), **changes})


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where Minari and TorchRL look for data sets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


@pytest.fixture
def path(root: Path) -> Path:
    write_episodes(root / ID, iter(make_episodes()), fps=20, description="lifts")
    return root / ID


def assert_same(ours: Any, theirs: Any) -> None:
    """Equal to the bit, in dtype and shape as well."""
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape)
    assert ours.tobytes() == theirs.tobytes()


def assert_same_episodes(ours: Episode, theirs: Episode) -> None:
    for field in ("observations", "next_observations", "extras"):
        assert set(getattr(ours, field)) == set(getattr(theirs, field))
        for name, array in getattr(theirs, field).items():
            assert_same(getattr(ours, field)[name], array)
    for field in ("actions", "rewards", "terminated"):
        assert_same(getattr(ours, field), getattr(theirs, field))


def read(path: Path) -> list[Episode]:
    with open_episodes(path) as episodes:
        return list(episodes.values())


# -- round trip ------------------------------------------------------------------------------------


def test_episodes_come_back_to_the_bit(path: Path) -> None:
    made = make_episodes()
    with open_episodes(path) as episodes:
        assert list(episodes) == ["episode_0", "episode_1", "episode_2"]
        for ours, theirs in zip(episodes.values(), made, strict=True):
            assert_same_episodes(ours, theirs)
            assert list(ours.observations) == list(theirs.observations)
            expected = {**theirs.attributes, "phase_names": ["descend", "grasp"]}
            assert ours.attributes == expected


def test_what_was_read_is_written_again_to_the_byte(path: Path, root: Path) -> None:
    with open_episodes(path) as episodes:
        write_episodes(root / "copies/lift-v0", episodes.values(), fps=20, description="lifts")
    file = "data/main_data.hdf5"
    with h5py.File(path / file) as ours, h5py.File(root / "copies/lift-v0" / file) as theirs:
        keys: list[str] = []
        ours.visit(keys.append)
        for key in keys:
            assert set(ours[key].attrs) == set(theirs[key].attrs)
            if isinstance(ours[key], h5py.Dataset):
                assert_same(ours[key][()], theirs[key][()])
    write_episodes(root / "again/lift-v0", make_episodes())
    # Nothing in the file tells the time of day.
    assert (root / "again/lift-v0" / file).read_bytes() == (path / file).read_bytes()


def test_more_than_ten_episodes_keep_their_order(root: Path) -> None:
    made = [make_episode(i, 2 + i) for i in range(12)]
    write_episodes(root / ID, made)
    assert [len(episode) for episode in read(root / ID)] == [len(episode) for episode in made]


def test_rows_are_where_the_layout_says(path: Path) -> None:
    episode = make_episodes()[1]
    with h5py.File(path / "data" / "main_data.hdf5") as file:
        group = file["episode_1"]
        assert_array_equal(group["infos/success"][1:], episode.extras["successes"])
        assert not group["infos/success"][0]
        assert_array_equal(group["infos/states"][:-1], episode.extras["states"])
        assert_array_equal(group["infos/states"][-1], episode.extras["states"][-1])
        assert group["terminations"][()].tolist() == [False] * 6 + [True]
        assert not group["truncations"][()].any()
        assert file["episode_0/truncations"][()].tolist() == [False] * 4 + [True]


def test_neither_the_users_data_sets_nor_a_rest_of_the_writing_are_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MINARI_DATASETS_PATH", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    write_episodes(tmp_path / "a" / ID, make_episodes())
    assert os.environ.get("MINARI_DATASETS_PATH") is None
    assert not (tmp_path / "home").exists()
    assert [file.name for file in (tmp_path / "a" / "sawyer").iterdir()] == ["lift-v0"]


# -- other readers ---------------------------------------------------------------------------------


def test_minari_iterates_over_the_same_episodes(path: Path) -> None:
    dataset = minari.load_dataset(ID)
    made = make_episodes()
    assert (dataset.id, dataset.total_steps) == (ID, 16)
    assert list(minari.list_local_datasets()) == [ID]
    assert dataset.storage.metadata["description"] == "lifts"
    assert dataset.storage.metadata["fps"] == 20
    seeds = [data["seed"] for data in dataset.storage.get_episode_metadata(range(3))]
    assert seeds == [episode.attributes["seed"] for episode in made]
    for i, (ours, theirs) in enumerate(zip(dataset, made, strict=True)):
        for part, array in join_observations(path, "", theirs).items():
            assert_same(ours.observations[part], array)
        assert_same(ours.actions, theirs.actions)
        assert_same(ours.rewards, theirs.rewards)
        assert_same(ours.terminations, theirs.terminated)
        assert ours.truncations[-1] == (i != 1)
        assert_same(ours.infos["success"][1:], theirs.extras["successes"])
        for row in range(len(theirs)):
            observation = {part: array[row] for part, array in ours.observations.items()}
            assert dataset.observation_space.contains(observation)
            assert dataset.action_space.contains(ours.actions[row])


def read_with_torchrl(tmp_path: Path) -> TensorDict:
    return MinariExperienceReplay(
        ID, batch_size=None, root=tmp_path / "torchrl", load_from_local_minari=True
    )[:]


def test_torchrl_reads_the_same_transitions(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # See the next test: what TorchRL means is memmap, which keeps the values.
    monkeypatch.setattr(TensorDict, "memmap_like", TensorDict.memmap)
    made = make_episodes()
    ours, expected = read_with_torchrl(tmp_path), stack_episodes(made, task=0)
    for part in made[0].observations:
        assert_same(ours["observation", part], expected[part])
        assert_same(ours["next", "observation", part], expected["next", part])
    for key in ("action", "episode", ("next", "done"), ("next", "terminated")):
        assert_same(ours[key], expected[key])
    assert_same(ours["next", "truncated"], expected["next", "truncated"])
    rewards = np.concatenate([episode.rewards for episode in made])
    assert_same(ours["next", "reward"].squeeze(-1), rewards)
    assert_same(ours["next", "info", "success"], expected["next", "success"].squeeze(-1))
    for extra in ("phases", "states"):
        assert_same(ours["info", extra], np.concatenate([e.extras[extra] for e in made]))


@pytest.mark.xfail(
    strict=True,
    reason="TorchRL 0.14.1 reads every Minari data set as zeros: it stores what it has read with "
    "memmap_like, which keeps shapes alone",
)
def test_torchrl_as_it_is_reads_values(root: Path, tmp_path: Path) -> None:
    write_with_minari(*BOXES, make_buffer(4), make_buffer(3))
    assert read_with_torchrl(tmp_path)["action"].any()


# -- what Minari wrote -----------------------------------------------------------------------------


def write_with_minari(
    observation_space: gym.Space, action_space: gym.Space, *buffers: dict[str, Any]
) -> None:
    minari.create_dataset_from_buffers(
        ID,
        [EpisodeBuffer(id=i, **buffer) for i, buffer in enumerate(buffers)],
        observation_space=observation_space,
        action_space=action_space,
    )


def make_buffer(steps: int, *, end: str = "truncations", **changes: Any) -> dict[str, Any]:
    rng = np.random.default_rng(steps)
    flags = {name: [False] * steps for name in ("terminations", "truncations")}
    if end in flags:
        flags[end][-1] = True
    return {
        "observations": rng.random((steps + 1, 4)),
        "actions": rng.random((steps, 2)).astype(np.float32),
        "rewards": rng.random(steps),
        **flags,
        **changes,
    }


BOXES = (gym.Box(-1, 1, (4,), np.float64), gym.Box(-1, 1, (2,), np.float32))


def test_unnamed_observations_without_infos_are_read(root: Path) -> None:
    buffers = [make_buffer(4, end="terminations"), make_buffer(3), make_buffer(5, end="cut")]
    write_with_minari(*BOXES, *buffers)
    ends = []
    for ours, theirs in zip(read(root / ID), buffers, strict=True):
        assert_same(ours.observations["observation"], theirs["observations"][:-1])
        assert_same(ours.next_observations["observation"], theirs["observations"][1:])
        assert_same(ours.actions, theirs["actions"])
        assert_same(ours.rewards, theirs["rewards"])
        assert (ours.extras, ours.attributes) == ({}, {})
        data = as_tensordict(Episode(**{**vars(ours), "observations": {}, "next_observations": {}}))
        ends.append((data["next", "terminated"].any(), data["next", "truncated"][-1]))
    assert ends == [(True, False), (False, True), (False, True)]


def test_infos_of_either_length_are_read_and_what_is_no_number_is_left_out(root: Path) -> None:
    infos = {
        "success": np.array([False, True, False, True]),
        "qpos": np.arange(8.0).reshape(4, 2),
        "reward_parts": np.arange(3.0),
        "note": ["a", "b", "c", "d"],
        "nested": {"x": np.arange(4)},
    }
    write_with_minari(*BOXES, make_buffer(3, infos=infos, seed=7))
    (episode,) = read(root / ID)
    assert set(episode.extras) == {"successes", "qpos", "reward_parts"}
    assert_same(episode.extras["successes"], infos["success"][1:])
    assert_same(episode.extras["qpos"], infos["qpos"][:-1])
    assert_same(episode.extras["reward_parts"], infos["reward_parts"])
    assert episode.attributes == {"seed": 7}


def test_images_that_minari_compressed_are_read_as_it_reads_them(root: Path) -> None:
    images = np.random.default_rng(0).integers(0, 256, (4, 32, 40, 3)).astype(np.uint8)
    space = gym.Dict(image=gym.Box(0, 255, (32, 40, 3), np.uint8), other=BOXES[0])
    observations = {"image": images, "other": np.zeros((4, 4))}
    buffer = make_buffer(3, observations=observations, actions=np.array([0, 2, 1]))
    write_with_minari(space, gym.Discrete(3), buffer)
    (episode,) = read(root / ID)
    theirs = next(iter(minari.load_dataset(ID)))
    assert_same(episode.observations["image"], theirs.observations["image"][:-1])
    assert_same(episode.actions, np.array([0, 2, 1]))


@pytest.mark.parametrize(
    ("space", "observations"),
    [
        (gym.Tuple(BOXES), (np.zeros((4, 4)), np.zeros((4, 2), np.float32))),
        (gym.Dict(a=gym.Text(3)), {"a": ["abc"] * 4}),
        (gym.Dict(a=gym.Dict(b=BOXES[0])), {"a": {"b": np.zeros((4, 4))}}),
    ],
    ids=["tuple", "text", "nested"],
)
def test_spaces_without_named_arrays_are_refused(
    root: Path, space: gym.Space, observations: Any
) -> None:
    write_with_minari(space, BOXES[1], make_buffer(3, observations=observations))
    with pytest.raises(DataError, match=r"observations.*valid: Box, Discrete"):
        read(root / ID)


# -- Minari's JPEG ---------------------------------------------------------------------------------


def smooth(*shape: int) -> np.ndarray:
    """Images that JPEG keeps to a few bits."""
    return (np.arange(np.prod(shape)) // 3 % 200).astype(np.uint8).reshape(shape)


SHAPES = {
    "a vector": (5,),
    "a small picture": (8, 9),
    "a small picture in colours": (8, 8, 3),
    "a picture": (40, 36, 3),
}
COMPRESSES_ALL = minari.__version__ == "0.5.3"


@pytest.mark.skipif(not COMPRESSES_ALL, reason="Minari 0.5.3 alone compresses all of them")
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_bytes_that_minari_made_jpeg_of_are_images_again(
    root: Path, shape: tuple[int, ...]
) -> None:
    pixels = smooth(4, *shape)
    space = gym.Dict(pixels=gym.Box(0, 255, shape, np.uint8), other=BOXES[0])
    buffer = make_buffer(3, observations={"pixels": pixels, "other": np.zeros((4, 4))})
    write_with_minari(space, BOXES[1], buffer)
    with h5py.File(root / ID / "data" / "main_data.hdf5") as file:
        assert file["episode_0/observations/pixels"].shape[1:] != shape  # of bytes
    (episode,) = read(root / ID)
    ours = episode.observations["pixels"]
    assert (ours.dtype, ours.shape) == (np.uint8, (3, *shape))
    # Colours are kept at half the resolution.
    assert np.abs(ours.astype(int) - pixels[:-1]).mean() < (25 if len(shape) == 3 else 3)
    assert find_oddities(root / ID) == [
        "observations/pixels: stored as JPEG, which loses bits in 1 episodes, such as episode_0"
    ]
    minaris = next(iter(minari.load_dataset(ID))).observations["pixels"]
    assert (minaris.shape == pixels.shape) == (min(shape[:2]) >= 32)


@pytest.mark.skipif(not COMPRESSES_ALL, reason="Minari 0.5.3 alone compresses small ones")
def test_pictures_of_any_length_in_bytes_are_read(root: Path) -> None:
    rng = np.random.default_rng(0)
    pixels = (rng.integers(0, 256, (4, 8, 9)) * np.arange(4)[:, None, None] / 3).astype(np.uint8)
    space = gym.Dict(pixels=gym.Box(0, 255, (8, 9), np.uint8))
    write_with_minari(space, BOXES[1], make_buffer(3, observations={"pixels": pixels}))
    with h5py.File(root / ID / "data" / "main_data.hdf5") as file:
        assert file["episode_0/observations/pixels"].dtype == object
    (episode,) = read(root / ID)
    assert episode.observations["pixels"].shape == (3, 8, 9)
    assert not episode.observations["pixels"][0].any()


@pytest.mark.skipif(not COMPRESSES_ALL, reason="Minari 0.5.3 alone compresses small ones")
def test_jpeg_of_another_shape_than_the_space_is_refused(root: Path) -> None:
    space = gym.Dict(pixels=gym.Box(0, 255, (8, 9), np.uint8))
    buffer = make_buffer(3, observations={"pixels": smooth(4, 9, 8)})
    write_with_minari(space, BOXES[1], buffer)
    message = (
        r"episode_0/observations/pixels: JPEG of shape \(9, 8\) in row 0; valid: \(8, 9\), as "
        "metadata.json says"
    )
    with pytest.raises(DataError, match=message):
        read(root / ID)


def test_jpeg_that_is_cut_off_is_refused(root: Path) -> None:
    space = gym.Dict(pixels=gym.Box(0, 255, (40, 40), np.uint8))
    write_with_minari(space, BOXES[1], make_buffer(3, observations={"pixels": smooth(4, 40, 40)}))
    key = "episode_0/observations/pixels"
    with h5py.File(root / ID / "data" / "main_data.hdf5") as file:
        rows = [row[: len(row) // 2] for row in file[key][()]]
    pixels = np.empty(4, object)
    pixels[:] = rows
    with h5py.File(root / ID / "data" / "main_data.hdf5", "r+") as file:
        del file[key]
        file.create_dataset(key, data=pixels, dtype=h5py.vlen_dtype(np.uint8))
    with pytest.raises(DataError, match=f"{key}: no JPEG in row 0"):
        read(root / ID)


def test_bytes_that_were_meant_as_bytes_stay_what_they_are(root: Path) -> None:
    space = gym.Dict(a=gym.Box(0, 255, (423,), np.uint8))
    buffer = make_buffer(3, observations={"a": np.zeros((4, 423))})
    write_with_minari(space, BOXES[1], buffer)
    content = np.zeros((4, 423), np.uint8)
    content[:, :3] = 0xFF, 0xD8, 0xFF  # as a JPEG begins
    # A whole JPEG of 8 by 9 pixels in as many bytes: not the space's shape.
    with h5py.File(root / ID / "data" / "main_data.hdf5", "r+") as file:
        from minari.dataset._storages.hdf5_storage import encode_frame

        jpeg = encode_frame(smooth(8, 9))
        content[:, : len(jpeg)] = jpeg
        del file["episode_0/observations/a"]
        file["episode_0/observations/a"] = content
    (episode,) = read(root / ID)
    assert_same(episode.observations["a"], content[:-1])


# -- spaces and bounds -----------------------------------------------------------------------------


def write_actions(space: gym.Space, actions: np.ndarray) -> None:
    write_with_minari(BOXES[0], space, make_buffer(3, actions=actions))


@pytest.mark.parametrize(
    ("space", "actions", "message"),
    [
        (gym.Discrete(3), np.array([0, 3, 1]), r"actions: 3 in row 1 is outside \[0, 2\], its"),
        (gym.Discrete(3, start=1), np.array([1, 3, 0]), r"0 in row 2 is outside \[1, 3\]"),
        (gym.Discrete(3), np.zeros(3), "actions: dtype float64; valid: int64, as metadata.json"),
        (gym.Discrete(3), np.zeros((3, 1), int), r"shape \(3, 1\); valid: \(T\)"),
        (gym.MultiDiscrete([2, 3]), np.array([[1, 2], [2, 0], [0, 0]]), r"2 in row 1 .*\[0, 1\]"),
        (gym.MultiBinary(2), np.full((3, 2), 2, np.int8), r"2 in row 0 is outside \[0, 1\]"),
        (
            gym.Box(np.array([-np.inf, 0]), np.array([np.inf, 1]), dtype=np.float64),
            np.array([[5, 0.5], [5, 1.5], [0, 0]]),
            r"1.5 in row 1 is outside \[0.0, 1.0\]",
        ),
        (gym.Box(-3, 3, (2,), int), np.full((3, 2), 4), r"4 in row 0 is outside \[-3, 3\]"),
    ],
    ids=["n", "start", "floats", "a column", "several", "binary", "half a box", "integers"],
)
def test_actions_that_are_not_of_their_space_are_refused(
    root: Path, space: gym.Space, actions: np.ndarray, message: str
) -> None:
    write_actions(space, actions)
    with pytest.raises(DataError, match=message):
        read(root / ID)


@pytest.mark.parametrize(
    ("space", "actions"),
    [
        (gym.Discrete(3), np.array([0, 2, 1])),
        (gym.MultiDiscrete([2, 3]), np.array([[1, 2], [0, 0], [1, 1]])),
        (gym.MultiBinary(2), np.ones((3, 2), np.int8)),
    ],
    ids=["discrete", "several", "binary"],
)
def test_actions_of_any_space_come_back_and_state_no_bounds(
    root: Path, space: gym.Space, actions: np.ndarray
) -> None:
    write_actions(space, actions)
    (episode,) = read(root / ID)
    assert_same(episode.actions, actions)
    assert "action_bounds" not in read_metadata(root / ID)


def test_matrices_state_one_range_or_none(root: Path) -> None:
    write_actions(gym.Box(-3, 3, (2, 2)), np.full((3, 2, 2), 3, np.float32))
    assert read_metadata(root / ID)["action_bounds"] == {"low": -3.0, "high": 3.0}


@pytest.mark.parametrize(
    ("low", "high", "stated"),
    [
        (-2, 2, {"low": -2.0, "high": 2.0}),
        ([-2, -1], [2, 0.5], {"low": [-2.0, -1.0], "high": [2.0, 0.5]}),
        ([-2, -1], 3, {"low": [-2.0, -1.0], "high": 3.0}),
        (-np.inf, 2, None),
        ([-1, -1], [1, np.inf], None),
        (-float(np.finfo(np.float32).max), float(np.finfo(np.float32).max), None),
        (-1, [1, -1], None),  # one action alone
    ],
)
def test_a_finite_box_states_the_bounds_of_actions(
    root: Path, low: Any, high: Any, stated: dict[str, Any] | None
) -> None:
    ends = [np.broadcast_to(np.float32(end), 2) for end in (low, high)]
    write_actions(gym.Box(*ends, dtype=np.float32), np.full((3, 2), -1, np.float32))
    assert read_metadata(root / ID).get("action_bounds") == stated


def test_bounds_are_written_as_the_space_and_read_again(root: Path) -> None:
    bounds = ([-2.0] * 7, [3.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    write_episodes(root / ID, make_episodes(), bounds=bounds)
    space = minari.load_dataset(ID).action_space
    assert space == gym.Box(np.float32(bounds[0]), np.float32(bounds[1]), dtype=np.float32)
    assert read_metadata(root / ID)["action_bounds"] == {"low": -2.0, "high": bounds[1]}


def test_without_bounds_the_space_has_none(path: Path) -> None:
    assert not minari.load_dataset(ID).action_space.is_bounded()
    assert "action_bounds" not in read_metadata(path)


def test_bounds_that_do_not_fit_are_refused(root: Path) -> None:
    with pytest.raises(DataError, match=r"episode_0/actions: .* is outside \[-0.1, 0.1\]"):
        write_episodes(root / ID, make_episodes(), bounds=(-0.1, 0.1))
    with pytest.raises(ConfigError, match=r"bounds is .*; valid: two finite numbers"):
        write_episodes(root / ID, make_episodes(), bounds=(1, -1))
    with pytest.raises(DataError, match=r"episode_0/actions: shape \(5, 7\); valid: \(T, 2\)"):
        write_episodes(root / ID, make_episodes(), bounds=([-1, -1], 1))
    assert list((root / "sawyer").iterdir()) == []


# -- refused when writing --------------------------------------------------------------------------


def jump(episode: Episode) -> Episode:
    parts = dict(episode.next_observations)
    parts["joints"] = parts["joints"] + (np.arange(len(episode)) == 2)[:, None].astype(np.float32)
    return with_parts(episode, next_observations=parts)


REFUSED: dict[str, tuple[Callable[[Episode], Episode], str]] = {
    "a jump": (jump, r"episode_1/next_obs/joints: row 2 differs from row 3.*valid: one sequence"),
    "other dtypes": (
        lambda e: with_parts(e, rewards=e.rewards.astype(np.float32)),
        "episode_1/rewards: dtype float32",
    ),
    "missing extras": (
        lambda e: with_parts(e, extras={"successes": e.extras["successes"]}),
        "episode_1/phases: missing",
    ),
    "too few rows": (lambda e: with_parts(e, rewards=e.rewards[:-1]), "episode_1/rewards: shape"),
    "a dictionary": (
        lambda e: with_parts(e, attributes={"a": {"b": 1}}),
        "episode_1, attribute 'a': dict; valid: numbers, strings",
    ),
    "Minari's attribute": (lambda e: with_parts(e, attributes={"id": 3}), "attribute 'id'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_an_episode_that_cannot_be_kept_leaves_nothing(root: Path, case: str) -> None:
    change, message = REFUSED[case]
    with pytest.raises(DataError, match=message):
        write_episodes(root / ID, [make_episode(0), change(make_episode(1))])
    assert list((root / "sawyer").iterdir()) == []


@pytest.mark.parametrize(
    ("extras", "message"),
    [
        ({"success": np.zeros(5, bool)}, "episode_0/success: .*'successes'"),
        ({"big": np.zeros(5, np.uint64)}, "episode_0/infos/big: uint64"),
        ({"a/b": np.zeros(5)}, "episode_0/infos/a/b: valid: names without '/'"),
        ({"text": np.array(list("abcde"))}, "episode_0/text: dtype <U1"),
    ],
)
def test_an_extra_that_cannot_be_kept_is_refused(
    root: Path, extras: dict[str, np.ndarray], message: str
) -> None:
    with pytest.raises(DataError, match=message):
        write_episodes(root / ID, [with_parts(make_episode(), extras=extras)])


@pytest.mark.parametrize("name", ["sawyer/lift", "sawyer/lift-v", "sawyer/a b-v0", "s.x/lift-v0"])
def test_a_name_that_is_no_id_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match=r"valid: <namespace>/<name>-v<number>"):
        write_episodes(tmp_path / name, make_episodes())
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_and_no_episodes_are_refused(path: Path) -> None:
    with pytest.raises(DataError, match="exists already"):
        write_episodes(path, make_episodes())
    assert len(read(path)) == 3
    with pytest.raises(DataError, match="no episodes; valid: at least one"):
        write_episodes(path.with_name("empty-v0"), [])
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_nothing_is_seen_before_all_is_written(root: Path) -> None:
    def episodes() -> Iterator[Episode]:
        yield make_episode()
        assert not (root / ID).exists()
        assert minari.list_local_datasets() == {}
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_episodes(root / ID, episodes())
    assert list((root / "sawyer").iterdir()) == []


def test_a_folder_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    target = tmp_path / "new"

    def write() -> None:
        with new_folder(target) as temporary:
            (temporary / "ours").touch()
            target.mkdir()
            (target / "theirs").touch()

    with pytest.raises(OSError, match="not empty"):
        write()
    assert [file.name for file in target.iterdir()] == ["theirs"]
    assert list(tmp_path.iterdir()) == [target]


def test_without_minari_writing_says_what_to_install_and_reading_works(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "minari"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(BMRLError, match=r'valid: pip install "torchrl_bmrl\[data\]"'):
        write_episodes(path.with_name("other-v0"), make_episodes())
    assert len(read(path)) == 3


# -- refused when reading --------------------------------------------------------------------------


def change_file(change: Callable[[Any], None]) -> Damage:
    def damage(path: Path) -> None:
        with h5py.File(path / "data" / "main_data.hdf5", "r+") as file:
            change(file)

    return damage


def remove(key: str) -> Damage:
    return change_file(lambda file: file.__delitem__(key))


def replace(key: str, value: Any) -> Damage:
    def change(file: Any) -> None:
        del file[key]
        file[key] = value

    return change_file(change)


def overwrite(name: str, content: bytes | None) -> Damage:
    def damage(path: Path) -> None:
        file = path / "data" / name
        if content is None:
            file.unlink()
        else:
            file.write_bytes(content)

    return damage


def change_metadata(**changes: Any) -> Damage:
    def damage(path: Path) -> None:
        file = path / "data" / "metadata.json"
        metadata = {**json.loads(file.read_text()), **changes}
        file.write_text(json.dumps({key: x for key, x in metadata.items() if x is not None}))

    return damage


def truncate(path: Path) -> None:
    file = path / "data" / "main_data.hdf5"
    file.write_bytes(file.read_bytes()[:-100])


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"
DAMAGES: dict[str, tuple[Damage, str]] = {
    "no numbers": (overwrite("main_data.hdf5", None), "main_data.hdf5: no such file"),
    "no metadata": (overwrite("metadata.json", None), "metadata.json: no such file"),
    "empty file": (overwrite("main_data.hdf5", b""), "main_data.hdf5: not a complete HDF5 file"),
    "truncated file": (truncate, "main_data.hdf5: not a complete HDF5 file"),
    "pointer": (overwrite("main_data.hdf5", POINTER), "main_data.hdf5: a git-LFS pointer"),
    "pointer of metadata": (overwrite("metadata.json", POINTER), "metadata.json: a git-LFS"),
    "half metadata": (overwrite("metadata.json", b'{"total'), "metadata.json: not Minari's"),
    "a list": (overwrite("metadata.json", b"[]"), "metadata.json: not Minari's metadata"),
    "no space": (change_metadata(observation_space=None), "observation_space: missing"),
    "no part in the space": (
        change_metadata(observation_space='{"type": "Dict", "subspaces": {}}'),
        "observation_space: no part; valid: at least one",
    ),
    "Arrow": (change_metadata(data_format="arrow"), "data_format: 'arrow'; valid: 'hdf5'"),
    "no episodes": (
        change_file(lambda file: file.clear()),
        "main_data.hdf5: no episodes; valid: at least episode_0",
    ),
    "no rewards": (remove("episode_1/rewards"), "episode_1/rewards: missing"),
    "no part": (remove("episode_1/observations/joints"), "observations/joints: missing"),
    "no flags": (remove("episode_1/truncations"), "episode_1/truncations: missing"),
    "T observations": (
        replace("episode_1/observations/joints", np.zeros((7, 7))),
        r"episode_1/observations/joints: shape \(7, 7\); valid: 8 rows",
    ),
    "T - 1 rewards": (replace("episode_1/rewards", np.zeros(6)), "rewards: shape .*valid: 7 rows"),
    "infos of 3": (
        replace("episode_1/infos/success", np.zeros(3)),
        "success: .*valid: 7 or 8 rows",
    ),
    "no action": (
        replace("episode_1/actions", np.zeros((0, 7))),
        r"episode_1/actions: shape \(0, 7\); valid: 7 rows, since most arrays have 7 steps",
    ),
    "a number": (replace("episode_1/actions", 3.0), "actions: one number; valid: a row for each"),
    "half an action more": (
        replace("episode_1/actions", np.zeros((7, 8), np.float32)),
        r"episode_1/actions: shape \(7, 8\); valid: \(T, 7\), as metadata.json says",
    ),
    "actions of integers": (
        replace("episode_1/actions", np.zeros((7, 7), int)),
        "episode_1/actions: dtype int64; valid: float32, as metadata.json says",
    ),
    "a part of other rows": (
        replace("episode_1/observations/joints", np.zeros((8, 3), np.float32)),
        r"observations/joints: shape \(8, 3\); valid: \(T, 7\), as metadata.json says",
    ),
    "a part of floats": (
        replace("episode_1/observations/touch", np.zeros((8, 4))),
        "observations/touch: dtype float64; valid: int32, as metadata.json says",
    ),
    "half an end": (
        replace("episode_1/terminations", np.linspace(0, 0.5, 7)),
        "episode_1/terminations: 0.083.* in row 1; valid: 0 or 1",
    ),
    "text": (replace("episode_1/rewards", b"abc"), "episode_1/rewards: dtype"),
    "infos are an array": (replace("episode_1/infos", np.zeros(7)), "episode_1/infos: not a group"),
    "an early end": (
        replace("episode_1/truncations", np.arange(7) == 3),
        "episode_1/truncations: set in row 3 of 7; valid: in the last only",
    ),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damage_is_refused_with_file_and_key(path: Path, case: str) -> None:
    damage, message = DAMAGES[case]
    damage(path)
    with pytest.raises(DataError, match=message):
        read(path)


def test_one_damaged_episode_leaves_the_others_readable(path: Path) -> None:
    remove("episode_1/rewards")(path)
    with open_episodes(path) as episodes:
        assert_same_episodes(episodes["episode_2"], make_episodes()[2])
        with pytest.raises(DataError, match="episode_1/rewards"):
            episodes["episode_1"]


def test_a_hole_in_the_file_is_found(path: Path) -> None:
    file = path / "data" / "main_data.hdf5"
    with h5py.File(file) as opened:
        chunk = opened["episode_1/observations/eef_pos"].id.get_chunk_info(0)
    content = bytearray(file.read_bytes())
    content[chunk.byte_offset : chunk.byte_offset + chunk.size] = bytes(chunk.size)
    file.write_bytes(content)
    with pytest.raises(DataError, match="episode_1/observations/eef_pos: unreadable"):
        read(path)


def layout_version(content: bytes, address: int) -> int:
    """Version of the layout message of a dataset, whose header is there, as HDF5 specifies it."""
    assert content[address : address + 5] == b"OHDR\x02"
    flags = content[address + 5]
    place = address + 6 + 16 * bool(flags & 32) + 4 * bool(flags & 16)
    width = 1 << (flags & 3)
    stop = place + width + int.from_bytes(content[place : place + width], "little")
    place += width
    while place < stop:
        kind, size = content[place], int.from_bytes(content[place + 1 : place + 3], "little")
        place += 4 + 2 * bool(flags & 4)
        if kind == 8:
            return content[place]
        place += size
    raise AssertionError("no layout message")


def test_files_are_written_as_older_versions_of_hdf5_read_them(path: Path) -> None:
    # HDF5 1.10 to 1.14 know versions up to 4, and call 5 a "bad version number for layout message".
    file = path / "data" / "main_data.hdf5"
    versions = set()
    with h5py.File(file) as opened:
        for key in ("actions", "observations/wrist", "infos/success"):
            info = h5py.h5o.get_info(opened[f"episode_1/{key}"].id)
            versions.add(layout_version(file.read_bytes(), info.addr))
    assert versions == {4}


# -- what is beside, and what contradicts ----------------------------------------------------------


def test_what_is_not_read_is_named(path: Path) -> None:
    with h5py.File(path / "data" / "main_data.hdf5", "r+") as file:
        group = file["episode_1"]
        group["camera"] = np.zeros(7)
        group["observations/video"] = np.zeros((8, 3))
        group["infos/nested/x"] = np.zeros(8)
        group["infos/note"] = [b"a"] * 8
        group["infos/other"] = np.zeros(3)
        group["infos/number"] = 3.0
        group["infos/rewards"] = np.zeros(8)  # a name of robomimic's layout
        group["infos/successes"] = np.zeros(8)  # success is there as well
        file["notes/x"] = np.zeros(3)
        file["episode_01"] = 3.0
    with open_raw(path) as episodes:
        assert list(episodes) == ["episode_0", "episode_1", "episode_2"]
        assert episodes["episode_0"].left_alone == ()
        assert set(episodes["episode_1"].extras) == {"successes", "phases", "states"}
        assert episodes["episode_1"].left_alone == (
            "camera",
            *(f"infos/{name}" for name in ("nested", "note", "number", "other", "rewards")),
            "infos/successes",
            "observations/video",
        )
    with open_episodes(path) as episodes:
        assert episodes["episode_1"].left_out.arrays[0] == "camera"
        assert_same_episodes(episodes["episode_1"], make_episodes()[1])
    assert find_oddities(path) == ["beside the episodes, not read: 'episode_01', 'notes'"]


def test_parts_that_are_no_arrays_are_left_alone_where_others_are(root: Path) -> None:
    space = gym.Dict(a=gym.Text(3), b=BOXES[0], c=gym.Dict(d=BOXES[0]))
    x = np.random.default_rng(0).random((4, 4))
    observations = {"a": ["abc"] * 4, "b": x, "c": {"d": x}}
    write_with_minari(space, BOXES[1], make_buffer(3, observations=observations))
    with open_raw(root / ID) as episodes:
        raw = episodes["episode_0"]
        assert list(raw.observations) == ["b"]
        assert_same(raw.observations["b"], x)
        assert raw.left_alone == ("observations/a", "observations/c")


def change_attribute(name: str, key: str, value: Any) -> Damage:
    return change_file(lambda file: file[name].attrs.__setitem__(key, value))


CONTRADICTIONS: dict[str, tuple[Damage, list[str]]] = {
    "total_steps of an episode": (
        change_attribute("episode_1", "total_steps", 9),
        [
            "the attribute total_steps contradicts name and arrays in 1 episodes, such as "
            "episode_1 (9, not 7)"
        ],
    ),
    "id": (
        change_attribute("episode_2", "id", 0),
        [
            "the attribute id contradicts name and arrays in 1 episodes, such as episode_2 "
            "(0, not 2)"
        ],
    ),
    "total_steps": (
        change_metadata(total_steps=15),
        ["total_steps is 15 in metadata.json, the arrays have 16"],
    ),
    "total_episodes": (
        change_metadata(total_episodes="four"),
        ["total_episodes is 'four' in metadata.json, the arrays have 3"],
    ),
    "a missing episode": (
        remove("episode_1"),
        [
            "1 episodes are missing, such as episode_1",
            "total_episodes is 3 in metadata.json, the arrays have 2",
            "total_steps is 16 in metadata.json, the arrays have 9",
        ],
    ),
    "integers in a box of floats": (
        replace("episode_0/observations/joints", np.zeros((6, 7), np.int16)),
        [
            "observations/joints: int16, though its space is of float32 in 1 episodes, such as "
            "episode_0"
        ],
    ),
    "no totals": (change_metadata(total_steps=None, total_episodes=None), []),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_what_contradicts_the_arrays_is_said_and_the_arrays_are_read(path: Path, case: str) -> None:
    damage, oddities = CONTRADICTIONS[case]
    assert find_oddities(path) == []
    damage(path)
    assert find_oddities(path) == oddities
    lengths = [len(episode) for episode in read(path)]
    assert lengths == ([5, 4] if case == "a missing episode" else [5, 7, 4])


def test_an_info_that_minari_made_jpeg_of_is_left_alone(root: Path) -> None:
    infos = {"mask": smooth(4, 5), "success": np.zeros(4, bool)}
    write_with_minari(*BOXES, make_buffer(3, infos=infos))
    with open_raw(root / ID) as episodes:
        left_alone = ("infos/mask",) if COMPRESSES_ALL else ()
        assert episodes["episode_0"].left_alone == left_alone
    assert [line.partition(" in")[0] for line in find_oddities(root / ID)] == [
        f"{key}: stored as JPEG, and not read" for key in left_alone
    ]


def test_a_reward_of_another_layout_is_asked_for(path: Path) -> None:
    remove("episode_1/rewards")(path)
    with open_raw(path) as episodes:
        assert episodes["episode_1"].rewards is None


@pytest.mark.parametrize(
    ("key", "row", "says"),
    [
        ("observations/x", -1, "a value that is not finite in row 5"),
        ("infos/success", 2, "nan in row 2; valid: 0 or 1"),
    ],
)
def test_what_is_not_finite_is_named_as_the_file_has_it(
    tmp_path: Path, key: str, row: int, says: str
) -> None:
    x = np.zeros((6, 3))
    episode = Episode(
        observations={"x": x[:-1]},
        next_observations={"x": x[1:]},
        actions=np.zeros((5, 2)),
        rewards=np.zeros(5),
        terminated=np.zeros(5, bool),
        extras={"successes": np.zeros(5)},
    )
    path = tmp_path / "own" / "lift-v0"
    write_episodes(path, [episode])
    with h5py.File(path / "data" / "main_data.hdf5", "r+") as file:
        file[f"episode_0/{key}"][row] = np.nan
    with open_raw(path) as episodes, pytest.raises(DataError) as caught:
        episodes["episode_0"]
    assert (caught.value.key, caught.value.message) == (f"episode_0/{key}", says)
