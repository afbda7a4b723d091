"""Data sets that Minari itself wrote are read in full, its JPEG images included."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")
pytest.importorskip("minari")

import gymnasium.spaces as gym
import h5py
import minari
from episode_files import assert_identical
from file_edits import edit, put
from minari_files import (
    BOXES,
    COMPRESSES_ALL,
    ID,
    NUMBERS,
    find_oddities,
    make_buffer,
    open_raw,
    read,
    smooth,
    write_with_minari,
)

from torchrl_bmrl.data.episodes import Episode, as_tensordict
from torchrl_bmrl.errors import DataError

# Minari warns of data sets that name no author, environment or code.
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


def test_unnamed_observations_without_infos_are_read(minari_root: Path) -> None:
    buffers = [make_buffer(4, end="terminations"), make_buffer(3), make_buffer(5, end="cut")]
    write_with_minari(*BOXES, *buffers)
    ends = []
    for ours, theirs in zip(read(minari_root / ID), buffers, strict=True):
        assert_identical(ours.observations["observation"], theirs["observations"][:-1])
        assert_identical(ours.next_observations["observation"], theirs["observations"][1:])
        assert_identical(ours.actions, theirs["actions"])
        assert_identical(ours.rewards, theirs["rewards"])
        assert (ours.extras, ours.attributes) == ({}, {})
        data = as_tensordict(Episode(**{**vars(ours), "observations": {}, "next_observations": {}}))
        ends.append((data["next", "terminated"].any(), data["next", "truncated"][-1]))
    assert ends == [(True, False), (False, True), (False, True)]


def test_infos_of_either_length_are_read_and_what_is_no_number_is_left_out(
    minari_root: Path,
) -> None:
    infos = {
        "success": np.array([False, True, False, True]),
        "qpos": np.arange(8.0).reshape(4, 2),
        "reward_parts": np.arange(3.0),
        "note": ["a", "b", "c", "d"],
        "nested": {"x": np.arange(4)},
    }
    write_with_minari(*BOXES, make_buffer(3, infos=infos, seed=7))
    (episode,) = read(minari_root / ID)
    assert set(episode.extras) == {"successes", "qpos", "reward_parts"}
    assert_identical(episode.extras["successes"], infos["success"][1:])
    assert_identical(episode.extras["qpos"], infos["qpos"][:-1])
    assert_identical(episode.extras["reward_parts"], infos["reward_parts"])
    assert episode.attributes == {"seed": 7}


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
    minari_root: Path, space: gym.Space, observations: Any
) -> None:
    write_with_minari(space, BOXES[1], make_buffer(3, observations=observations))
    with pytest.raises(DataError, match=r"observations.*valid: Box, Discrete"):
        read(minari_root / ID)


def test_parts_that_are_no_arrays_are_left_alone_where_others_are(minari_root: Path) -> None:
    space = gym.Dict(a=gym.Text(3), b=BOXES[0], c=gym.Dict(d=BOXES[0]))
    x = np.random.default_rng(0).random((4, 4))
    observations = {"a": ["abc"] * 4, "b": x, "c": {"d": x}}
    write_with_minari(space, BOXES[1], make_buffer(3, observations=observations))
    with open_raw(minari_root / ID) as episodes:
        raw = episodes["episode_0"]
        assert list(raw.observations) == ["b"]
        assert_identical(raw.observations["b"], x)
        assert raw.left_alone == ("observations/a", "observations/c")


# -- JPEG ------------------------------------------------------------------------------------------


def test_images_that_minari_compressed_are_read_as_it_reads_them(minari_root: Path) -> None:
    images = np.random.default_rng(0).integers(0, 256, (4, 32, 40, 3)).astype(np.uint8)
    space = gym.Dict(image=gym.Box(0, 255, (32, 40, 3), np.uint8), other=BOXES[0])
    observations = {"image": images, "other": np.zeros((4, 4))}
    buffer = make_buffer(3, observations=observations, actions=np.array([0, 2, 1]))
    write_with_minari(space, gym.Discrete(3), buffer)
    (episode,) = read(minari_root / ID)
    theirs = next(iter(minari.load_dataset(ID)))
    assert_identical(episode.observations["image"], theirs.observations["image"][:-1])
    assert_identical(episode.actions, np.array([0, 2, 1]))


SHAPES = {
    "a vector": (5,),
    "a small picture": (8, 9),
    "a small picture in colours": (8, 8, 3),
    "a picture": (40, 36, 3),
}


@pytest.mark.skipif(not COMPRESSES_ALL, reason="Minari 0.5.3 alone compresses all of them")
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_bytes_that_minari_made_jpeg_of_are_images_again(
    minari_root: Path, shape: tuple[int, ...]
) -> None:
    pixels = smooth(4, *shape)
    space = gym.Dict(pixels=gym.Box(0, 255, shape, np.uint8), other=BOXES[0])
    buffer = make_buffer(3, observations={"pixels": pixels, "other": np.zeros((4, 4))})
    write_with_minari(space, BOXES[1], buffer)
    with h5py.File(minari_root / ID / NUMBERS) as file:
        assert file["episode_0/observations/pixels"].shape[1:] != shape  # encoded bytes
    (episode,) = read(minari_root / ID)
    ours = episode.observations["pixels"]
    assert (ours.dtype, ours.shape) == (np.uint8, (3, *shape))
    # JPEG stores colours at half the resolution.
    assert np.abs(ours.astype(int) - pixels[:-1]).mean() < (25 if len(shape) == 3 else 3)
    assert find_oddities(minari_root / ID) == [
        "observations/pixels: stored as JPEG, which loses bits in 1 episodes, such as episode_0"
    ]
    minaris = next(iter(minari.load_dataset(ID))).observations["pixels"]
    assert (minaris.shape == pixels.shape) == (min(shape[:2]) >= 32)


@pytest.mark.skipif(not COMPRESSES_ALL, reason="Minari 0.5.3 alone compresses small ones")
def test_pictures_of_any_length_in_bytes_are_read(minari_root: Path) -> None:
    rng = np.random.default_rng(0)
    pixels = (rng.integers(0, 256, (4, 8, 9)) * np.arange(4)[:, None, None] / 3).astype(np.uint8)
    space = gym.Dict(pixels=gym.Box(0, 255, (8, 9), np.uint8))
    write_with_minari(space, BOXES[1], make_buffer(3, observations={"pixels": pixels}))
    with h5py.File(minari_root / ID / NUMBERS) as file:
        assert file["episode_0/observations/pixels"].dtype == object
    (episode,) = read(minari_root / ID)
    assert episode.observations["pixels"].shape == (3, 8, 9)
    assert not episode.observations["pixels"][0].any()


@pytest.mark.skipif(not COMPRESSES_ALL, reason="Minari 0.5.3 alone compresses small ones")
def test_jpeg_of_another_shape_than_the_space_is_refused(minari_root: Path) -> None:
    space = gym.Dict(pixels=gym.Box(0, 255, (8, 9), np.uint8))
    buffer = make_buffer(3, observations={"pixels": smooth(4, 9, 8)})
    write_with_minari(space, BOXES[1], buffer)
    message = (
        r"episode_0/observations/pixels: JPEG of shape \(9, 8\) in row 0; valid: \(8, 9\), as "
        "metadata.json says"
    )
    with pytest.raises(DataError, match=message):
        read(minari_root / ID)


def test_jpeg_that_is_cut_off_is_refused(minari_root: Path) -> None:
    space = gym.Dict(pixels=gym.Box(0, 255, (40, 40), np.uint8))
    write_with_minari(space, BOXES[1], make_buffer(3, observations={"pixels": smooth(4, 40, 40)}))
    key = "episode_0/observations/pixels"
    with h5py.File(minari_root / ID / NUMBERS) as file:
        rows = [row[: len(row) // 2] for row in file[key][()]]
    pixels = np.empty(4, object)
    pixels[:] = rows
    with h5py.File(minari_root / ID / NUMBERS, "r+") as file:
        del file[key]
        file.create_dataset(key, data=pixels, dtype=h5py.vlen_dtype(np.uint8))
    with pytest.raises(DataError, match=f"{key}: no JPEG in row 0"):
        read(minari_root / ID)


def test_bytes_that_were_meant_as_bytes_stay_what_they_are(minari_root: Path) -> None:
    from minari.dataset._storages.hdf5_storage import encode_frame

    space = gym.Dict(a=gym.Box(0, 255, (423,), np.uint8))
    buffer = make_buffer(3, observations={"a": np.zeros((4, 423))})
    write_with_minari(space, BOXES[1], buffer)
    # Each row begins with a whole JPEG of 8 by 9 pixels, which is not the space's shape.
    content = np.zeros((4, 423), np.uint8)
    jpeg = encode_frame(smooth(8, 9))
    content[:, : len(jpeg)] = jpeg
    edit(minari_root / ID / NUMBERS, put("episode_0/observations/a", content))
    (episode,) = read(minari_root / ID)
    assert_identical(episode.observations["a"], content[:-1])


def test_an_info_that_minari_made_jpeg_of_is_left_alone(minari_root: Path) -> None:
    infos = {"mask": smooth(4, 5), "success": np.zeros(4, bool)}
    write_with_minari(*BOXES, make_buffer(3, infos=infos))
    with open_raw(minari_root / ID) as episodes:
        left_alone = ("infos/mask",) if COMPRESSES_ALL else ()
        assert episodes["episode_0"].left_alone == left_alone
    assert [line.partition(" in")[0] for line in find_oddities(minari_root / ID)] == [
        f"{key}: stored as JPEG, and not read" for key in left_alone
    ]
