"""Minari's layout: kept to the bit, read alike by Minari and TorchRL, and refused when damaged."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
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
from minari.data_collector import EpisodeBuffer
from tensordict import TensorDict
from torchrl.data.datasets.minari_data import MinariExperienceReplay

from torchrl_bmrl.data.episodes import Episode, as_tensordict, stack_episodes
from torchrl_bmrl.data.minari import join_observations, new_folder, open_episodes, write_episodes
from torchrl_bmrl.errors import BMRLError, DataError

ID = "sawyer/lift-v0"
Damage = Callable[[Path], None]

# Minari recommends to name an author, an environment, ...
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


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
    "no metadata": (overwrite("metadata.json", None), "metadata.json: unreadable .No such file"),
    "empty file": (overwrite("main_data.hdf5", b""), "main_data.hdf5: not a whole HDF5 file"),
    "truncated file": (truncate, "main_data.hdf5: not a whole HDF5 file"),
    "pointer": (overwrite("main_data.hdf5", POINTER), "main_data.hdf5: a git-LFS pointer"),
    "pointer of metadata": (overwrite("metadata.json", POINTER), "metadata.json: a git-LFS"),
    "half metadata": (overwrite("metadata.json", b'{"total'), "metadata.json: not Minari's"),
    "a list": (overwrite("metadata.json", b"[]"), "metadata.json: not Minari's metadata"),
    "no space": (change_metadata(observation_space=None), "observation_space: missing"),
    "no count": (change_metadata(total_episodes=None), "total_episodes: missing"),
    "count of 0": (change_metadata(total_episodes=0), "total_episodes: 0; valid: 1 and more"),
    "another count": (change_metadata(total_episodes=2), "valid: episode_0 to episode_1"),
    "Arrow": (change_metadata(data_format="arrow"), "data_format: 'arrow'; valid: 'hdf5'"),
    "no episode": (remove("episode_1"), "valid: episode_0 to episode_2"),
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
    "no step": (replace("episode_1/actions", np.zeros((0, 7))), "actions: .*at least one row"),
    "a number": (replace("episode_1/actions", 3.0), "actions: .*at least one row"),
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


def test_a_flipped_bit_never_becomes_another_number(root: Path) -> None:
    # Strings of any length have no checksums in HDF5: attributes are numbers here.
    made = [with_parts(episode, attributes={"seed": 3}) for episode in make_episodes()]
    write_episodes(root / ID, made)
    file = root / ID / "data" / "main_data.hdf5"
    whole = file.read_bytes()
    refused = 0
    for place in np.linspace(0, len(whole) - 1, 60).astype(int):
        flipped = bytearray(whole)
        flipped[place] ^= 16
        file.write_bytes(flipped)
        try:
            episodes = read(root / ID)
        except DataError:
            refused += 1
            continue
        for ours, theirs in zip(episodes, made, strict=True):
            assert_same_episodes(ours, theirs)
    assert refused > 40
