"""Demonstration files: kept to the bit, and refused with file, key and reason when damaged."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

import h5py

from torchrl_bmrl.data.robomimic import (
    Episode,
    count_episodes,
    read_demonstrations,
    read_episode,
    write_demonstrations,
    write_episode,
)
from torchrl_bmrl.data.schema import OBSERVATION_SHAPES, check_episode
from torchrl_bmrl.errors import BMRLError, DataError

STEPS = 5
ENV_ARGS = {"env_name": "BMRLSawyerLift", "type": 1, "env_version": "1", "env_kwargs": {"a": 1}}
Damage = Callable[[Any], None]


def make_episode(seed: int = 0, steps: int = STEPS) -> Episode:
    rng = np.random.default_rng(seed)
    return Episode(
        observations={
            name: rng.standard_normal((steps + 1, size))
            for name, size in OBSERVATION_SHAPES.items()
        },
        actions=rng.uniform(-1, 1, (steps, 7)).astype(np.float32),
        rewards=rng.random(steps),
        successes=rng.random(steps) < 0.5,
        phases=rng.integers(0, 3, steps).astype(np.int8),
        states=rng.standard_normal((steps + 1, 11)),
        seed=2**32 - 1 - seed,
        phase_names=("descend", "grasp", "lift"),
    )


def write(path: Path, episodes: int = 4, train: int = 3) -> list[Episode]:
    made = [make_episode(i, STEPS + i) for i in range(episodes)]
    write_demonstrations(
        path,
        iter(made),
        train_episodes=train,
        env_args=ENV_ARGS,
        attributes={"task": "lift", "action_noise": 0.2},
    )
    return made


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write(tmp_path / "lift.hdf5")
    return tmp_path / "lift.hdf5"


def replace(key: str, value: Any) -> Damage:
    def damage(file: Any) -> None:
        del file[key]
        file[key] = value

    return damage


def change(key: str, index: Any, value: float) -> Damage:
    def damage(file: Any) -> None:
        file[key][index] = value

    return damage


def remove(key: str) -> Damage:
    def damage(file: Any) -> None:
        del file[key]

    return damage


# -- round trips -----------------------------------------------------------------------------------


def test_an_episode_comes_back_to_the_bit(tmp_path: Path) -> None:
    episode = make_episode()
    write_episode(tmp_path / "0.npz", episode)
    read = read_episode(tmp_path / "0.npz")
    assert (read.seed, read.phase_names) == (episode.seed, episode.phase_names)
    assert list(read.observations) == list(episode.observations)
    for name, part in episode.observations.items():
        np.testing.assert_array_equal(read.observations[name], part)
    for name in ("actions", "rewards", "successes", "phases", "states"):
        ours, theirs = getattr(read, name), getattr(episode, name)
        np.testing.assert_array_equal(ours, theirs)
        assert ours.dtype == theirs.dtype


def test_demonstrations_come_back_to_the_bit(path: Path) -> None:
    made = [make_episode(i, STEPS + i) for i in range(4)]
    read = read_demonstrations(path)
    assert [demo["name"] for demo in read] == [f"demo_{i}" for i in range(4)]
    for demo, episode in zip(read, made, strict=True):
        assert set(demo["obs"]) == set(demo["next_obs"]) == set(OBSERVATION_SHAPES)
        for name, part in episode.observations.items():
            np.testing.assert_array_equal(demo["obs"][name], part[:-1])
            np.testing.assert_array_equal(demo["next_obs"][name], part[1:])
            assert demo["obs"][name].dtype == part.dtype
        for name in ("actions", "rewards", "successes"):
            np.testing.assert_array_equal(demo[name], getattr(episode, name))
            assert demo[name].dtype == getattr(episode, name).dtype


def test_more_than_ten_demonstrations_keep_their_order(tmp_path: Path) -> None:
    made = write(tmp_path / "a.hdf5", episodes=12, train=11)
    for split, expected in ((None, made), ("train", made[:11]), ("valid", made[11:])):
        read = read_demonstrations(tmp_path / "a.hdf5", split=split)
        assert len(read) == len(expected)
        for demo, episode in zip(read, expected, strict=True):
            np.testing.assert_array_equal(demo["actions"], episode.actions)
    assert count_episodes(tmp_path / "a.hdf5") == 12


def test_only_the_parts_asked_for_are_read(path: Path) -> None:
    (demo, *_) = read_demonstrations(path, observation_keys=["goal_pos"])
    assert list(demo["obs"]) == list(demo["next_obs"]) == ["goal_pos"]


def test_the_layout_is_robomimics(path: Path) -> None:
    with h5py.File(path) as file:
        data = file["data"]
        assert set(data) == {f"demo_{i}" for i in range(4)}
        assert data.attrs["total"] == sum(STEPS + i for i in range(4))
        assert json.loads(data.attrs["env_args"]) == ENV_ARGS
        assert (data.attrs["task"], data.attrs["action_noise"]) == ("lift", 0.2)
        for i in range(4):
            demo = data[f"demo_{i}"]
            assert demo.attrs["num_samples"] == STEPS + i
            assert demo.attrs["seed"] == 2**32 - 1 - i
            assert demo["dones"][:].tolist() == [0] * (STEPS + i - 1) + [1]
            assert demo["states"].shape == (STEPS + i, 11)
            assert list(demo["phases"].attrs["names"]) == ["descend", "grasp", "lift"]
            for name in OBSERVATION_SHAPES:
                np.testing.assert_array_equal(
                    demo[f"obs/{name}"][1:], demo[f"next_obs/{name}"][:-1]
                )
        for split, names in (("train", [b"demo_0", b"demo_1", b"demo_2"]), ("valid", [b"demo_3"])):
            assert file[f"mask/{split}"].dtype.kind == "S"
            assert file[f"mask/{split}"][:].tolist() == names


def test_the_same_episodes_give_the_same_bytes(path: Path, tmp_path: Path) -> None:
    write(tmp_path / "again.hdf5")
    assert (tmp_path / "again.hdf5").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("existing", [True, False])
def test_a_failed_write_leaves_nothing_behind(tmp_path: Path, existing: bool) -> None:
    path = tmp_path / "data" / "lift.hdf5"
    if existing:
        write(path)
    before = path.read_bytes() if existing else b""

    def broken() -> Iterator[Episode]:
        yield make_episode()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_demonstrations(path, broken(), train_episodes=1, env_args={}, attributes={})
    assert list(path.parent.iterdir()) == ([path] if existing else [])
    if existing:
        assert path.read_bytes() == before


# -- damaged files ---------------------------------------------------------------------------------


def refusal(path: Path, **options: Any) -> DataError:
    """The error that reading gives, which names the file first."""
    with pytest.raises(DataError) as caught:
        read_demonstrations(path, **options)
    assert isinstance(caught.value, BMRLError)
    assert str(caught.value).startswith(f"{path}: ")
    return caught.value


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "no such file" in str(refusal(tmp_path / "lift.hdf5"))
    with pytest.raises(DataError, match=r"lift\.hdf5: no such file"):
        count_episodes(tmp_path / "lift.hdf5")


def test_a_folder_is_not_a_file(tmp_path: Path) -> None:
    (tmp_path / "lift.hdf5").mkdir()
    assert "no such file" in str(refusal(tmp_path / "lift.hdf5"))


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all\n" * 100], ids=["empty", "text"])
def test_another_format_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "lift.hdf5"
    path.write_bytes(content)
    assert "not a whole HDF5 file" in str(refusal(path))


@pytest.mark.parametrize("share", [0.05, 0.5, 0.99])
def test_a_truncated_file_is_refused(path: Path, share: float) -> None:
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert "not a whole HDF5 file" in str(refusal(path))
    with pytest.raises(DataError, match="not a whole HDF5 file"):
        count_episodes(path)


def test_overwritten_blocks_never_surface_as_another_error(path: Path) -> None:
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    refused = []
    for start in rng.integers(0, len(whole) - 64, 80):
        path.write_bytes(whole[:start] + rng.bytes(64) + whole[start + 64 :])
        for read in (read_demonstrations, count_episodes):
            try:
                read(path)
            except DataError as error:
                refused.append(str(error))
    assert all(message.startswith(f"{path}: ") for message in refused)
    assert len(refused) > 10  # otherwise the damage missed everything that is checked


DEMO = "data/demo_1"
ROWS = STEPS + 1  # of demo_1
DAMAGES: dict[str, tuple[Damage, str, str]] = {
    # name: damage, key, what the message says
    "no data": (remove("data"), "data", "missing"),
    "data is an array": (replace("data", np.zeros(3)), "data", "group"),
    "demo is an array": (replace(DEMO, np.zeros(3)), f"{DEMO}/actions", "missing"),
    "no actions": (remove(f"{DEMO}/actions"), f"{DEMO}/actions", "missing"),
    "no rewards": (remove(f"{DEMO}/rewards"), f"{DEMO}/rewards", "missing"),
    "no successes": (remove(f"{DEMO}/successes"), f"{DEMO}/successes", "missing"),
    "no obs": (remove(f"{DEMO}/obs"), f"{DEMO}/obs/robot0_joint_pos", "missing"),
    "no goal": (remove(f"{DEMO}/next_obs/goal_pos"), f"{DEMO}/next_obs/goal_pos", "missing"),
    "six joints": (
        replace(f"{DEMO}/obs/robot0_joint_pos", np.zeros((ROWS, 6))),
        f"{DEMO}/obs/robot0_joint_pos",
        f"shape ({ROWS}, 6); valid: ({ROWS}, 7)",
    ),
    "six actions": (
        replace(f"{DEMO}/actions", np.zeros((ROWS, 6))),
        f"{DEMO}/actions",
        f"shape ({ROWS}, 6); valid: ({ROWS}, 7)",
    ),
    "short rewards": (
        replace(f"{DEMO}/rewards", np.zeros(ROWS - 1)),
        f"{DEMO}/rewards",
        f"shape ({ROWS - 1},); valid: ({ROWS},)",
    ),
    "rewards in a column": (
        replace(f"{DEMO}/rewards", np.zeros((ROWS, 1))),
        f"{DEMO}/rewards",
        f"shape ({ROWS}, 1); valid: ({ROWS},)",
    ),
    "flat observation": (
        replace(f"{DEMO}/obs/goal_pos", np.zeros(ROWS)),
        f"{DEMO}/obs/goal_pos",
        f"shape ({ROWS},); valid: ({ROWS}, 3)",
    ),
    "scalar actions": (replace(f"{DEMO}/actions", 0.5), f"{DEMO}/actions", "valid: "),
    "scalar rewards": (replace(f"{DEMO}/rewards", 0.5), f"{DEMO}/rewards", f"valid: ({ROWS},)"),
    "group of actions": (
        replace(f"{DEMO}/actions", {}),
        f"{DEMO}/actions",
        "dataset",
    ),
    "no steps": (
        replace(f"{DEMO}/actions", np.zeros((0, 7))),
        f"{DEMO}/actions",
        "at least one",
    ),
    "NaN in obs": (
        change(f"{DEMO}/obs/goal_pos", (2, 0), np.nan),
        f"{DEMO}/obs/goal_pos",
        "not finite in row 2",
    ),
    "inf in next_obs": (
        change(f"{DEMO}/next_obs/robot0_joint_vel", (4, 6), np.inf),
        f"{DEMO}/next_obs/robot0_joint_vel",
        "not finite in row 4",
    ),
    "NaN reward": (
        change(f"{DEMO}/rewards", 3, np.nan),
        f"{DEMO}/rewards",
        "not finite in row 3",
    ),
    "inf action": (
        change(f"{DEMO}/actions", (1, 0), -np.inf),
        f"{DEMO}/actions",
        "not finite in row 1",
    ),
    "large action": (
        change(f"{DEMO}/actions", (3, 2), 1.5),
        f"{DEMO}/actions",
        "1.5 in row 3 is outside [-1, 1]",
    ),
    "strings": (
        replace(f"{DEMO}/actions", np.full((ROWS, 7), "a", dtype=h5py.string_dtype())),
        f"{DEMO}/actions",
        "valid: numbers",
    ),
    "bytes": (
        replace(f"{DEMO}/rewards", np.full(ROWS, b"a", dtype="S1")),
        f"{DEMO}/rewards",
        "valid: numbers",
    ),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damage_is_answered_with_file_key_and_what_is_valid(path: Path, name: str) -> None:
    damage, key, says = DAMAGES[name]
    with h5py.File(path, "r+") as file:
        if name == "group of actions":
            del file[key]
            file.create_group(key)
        else:
            damage(file)
    error = refusal(path)
    assert error.key == key
    assert f"{path}: {key}: " in str(error)
    assert says in str(error)


@pytest.mark.parametrize("damage", [remove("data"), replace("data", np.zeros(3))])
def test_episodes_cannot_be_counted_without_their_group(path: Path, damage: Damage) -> None:
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(DataError, match=r"lift\.hdf5: data: "):
        count_episodes(path)


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (remove("mask/valid"), "missing"),
        (replace("mask/valid", np.array([b"demo_3", b"demo_9"])), "demo_9"),
        (replace("mask/valid", np.array([], dtype="S6")), "no demonstrations"),
        (replace("mask/valid", np.array([3])), "'3'"),
    ],
    ids=["missing", "unknown demo", "empty", "numbers"],
)
def test_a_bad_split_is_named(path: Path, damage: Damage, says: str) -> None:
    with h5py.File(path, "r+") as file:
        damage(file)
    error = refusal(path, split="valid")
    assert error.key == "mask/valid"
    assert says in str(error)
    assert len(read_demonstrations(path, split="train")) == 3  # the other split is whole


def test_a_file_without_demonstrations_is_refused(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        for name in list(file["data"]):
            del file["data"][name]
    error = refusal(path)
    assert error.key == "data"
    assert "no demonstrations" in str(error)


def test_names_in_a_mask_may_be_text(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        del file["mask/valid"]
        file["mask/valid"] = np.array(["demo_3"], dtype=h5py.string_dtype())
    assert [demo["name"] for demo in read_demonstrations(path, split="valid")] == ["demo_3"]


# -- schema ----------------------------------------------------------------------------------------


def whole_arrays() -> dict[str, np.ndarray]:
    return {
        "actions": np.zeros((STEPS, 7), np.float32),
        "rewards": np.zeros(STEPS),
        "successes": np.zeros(STEPS, bool),
        **{
            f"{group}/{name}": np.zeros((STEPS, size))
            for group in ("obs", "next_obs")
            for name, size in OBSERVATION_SHAPES.items()
        },
    }


def check(arrays: dict[str, np.ndarray]) -> None:
    check_episode(Path("a.hdf5"), "data/demo_0", arrays)


def test_a_whole_episode_passes() -> None:
    arrays = whole_arrays()
    check(arrays)
    arrays["actions"][0] = 1.0
    arrays["actions"][1] = -1.0
    arrays["rewards"] = np.arange(STEPS)  # whole numbers are numbers
    check(arrays)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", [key for key in whole_arrays() if key != "successes"])
def test_every_array_must_be_finite(key: str, value: float) -> None:
    arrays = whole_arrays()
    arrays[key][2] = value
    with pytest.raises(DataError, match=rf"^a\.hdf5: data/demo_0/{key}: .*not finite in row 2"):
        check(arrays)


@pytest.mark.parametrize("key", list(whole_arrays()))
def test_every_array_must_have_as_many_steps_as_actions(key: str) -> None:
    arrays = whole_arrays()
    arrays[key] = np.concatenate([arrays[key]] * 2)
    with pytest.raises(DataError, match=r"valid: \(\d+"):
        check(arrays)


@pytest.mark.parametrize("key", [key for key in whole_arrays() if "/" in key or key == "actions"])
def test_every_part_must_have_its_size(key: str) -> None:
    arrays = whole_arrays()
    size = arrays[key].shape[1]
    arrays[key] = arrays[key][:, :-1]
    with pytest.raises(DataError, match=rf"{key}: shape .*; valid: \({STEPS}, {size}\)"):
        check(arrays)


@pytest.mark.parametrize("dtype", [object, "U3", "S3", "datetime64[s]", complex])
@pytest.mark.parametrize("key", ["actions", "rewards", "obs/goal_pos"])
def test_every_array_must_hold_numbers(key: str, dtype: Any) -> None:
    arrays = whole_arrays()
    arrays[key] = arrays[key].astype(int).astype(dtype)
    with pytest.raises(DataError, match=rf"{key}: dtype .*; valid: numbers"):
        check(arrays)


@pytest.mark.parametrize("value", [1.5, -1.5, 1.001])
def test_actions_must_lie_in_their_bounds(value: float) -> None:
    arrays = whole_arrays()
    arrays["actions"][3, 6] = value
    with pytest.raises(DataError, match=rf"{value}.* in row 3 is outside \[-1, 1\]"):
        check(arrays)
