"""A buffer of a file holds its keys, dtypes, values and metadata, as its options choose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")

import h5py
from episode_files import (
    ENV_ARGS,
    LENGTHS,
    PARTS,
    file_episodes,
    joined,
    lift_file,
    make_episode,
    write_file,
)
from file_edits import edit, remove
from torchrl.data import SliceSampler
from torchrl.data.datasets import load_dataset
from torchrl.envs.transforms import CatTensors, Compose, ObservationNorm

from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.robomimic import write_episodes
from torchrl_bmrl.errors import ConfigError, DataError

TOTAL = sum(LENGTHS)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return lift_file(tmp_path / "source")


def test_the_keys_shapes_and_dtypes_are_torchrl_s(path: Path) -> None:
    data = RobomimicExperienceReplay(path)[:]
    assert data.batch_size == (TOTAL,)
    expected = {
        "object": ((10,), torch.float64),
        "image": ((8, 8, 3), torch.uint8),
        "action": ((7,), torch.float32),
        "episode": ((), torch.int64),
        "step": ((), torch.int64),
        ("next", "object"): ((10,), torch.float64),
        ("next", "image"): ((8, 8, 3), torch.uint8),
        ("next", "reward"): ((1,), torch.float32),
        ("next", "done"): ((1,), torch.bool),
        ("next", "terminated"): ((1,), torch.bool),
        ("next", "truncated"): ((1,), torch.bool),
        ("next", "success"): ((1,), torch.bool),
    }
    assert set(data.keys(include_nested=True, leaves_only=True)) == set(expected)
    for key, (shape, dtype) in expected.items():
        assert (data[key].shape, data[key].dtype) == ((TOTAL, *shape), dtype), key


def test_every_value_is_the_file_s_to_the_bit(path: Path) -> None:
    data, episodes = RobomimicExperienceReplay(path)[:], file_episodes()
    for name in PARTS:
        assert torch.equal(data[name], joined(episodes, "observations", name))
        assert torch.equal(data["next", name], joined(episodes, "next_observations", name))
    actions = np.concatenate([episode.actions for episode in episodes])
    rewards = np.concatenate([episode.rewards for episode in episodes])
    assert data["action"].numpy().tobytes() == actions.tobytes()
    assert data["next", "reward"].numpy().tobytes() == rewards.astype(np.float32).tobytes()
    assert torch.equal(data["next", "success"].squeeze(-1), joined(episodes, "extras", "successes"))
    steps = torch.tensor(LENGTHS)
    assert torch.equal(data["episode"], torch.arange(4).repeat_interleave(steps))
    assert data["step"].tolist() == [t for length in LENGTHS for t in range(length)]
    last = [t == length - 1 for length in LENGTHS for t in range(length)]
    for key, expected in (("done", last), ("truncated", last), ("terminated", [False] * TOTAL)):
        assert data["next", key].squeeze(-1).tolist() == expected


def test_the_last_step_is_truncated_unless_it_terminates(tmp_path: Path) -> None:
    episodes = [make_episode(i, terminated=i == 1) for i in range(2)]
    write_episodes(tmp_path / "a.hdf5", episodes, env_args={})
    after = RobomimicExperienceReplay(tmp_path / "a.hdf5")[:]["next"]
    assert after["done"].flatten().nonzero().flatten().tolist() == [4, 9]
    assert after["terminated"].flatten().nonzero().flatten().tolist() == [9]
    assert after["truncated"].flatten().nonzero().flatten().tolist() == [4]


@pytest.mark.parametrize("split", [None, "train"])
def test_dones_terminate_where_that_is_asked_for(path: Path, split: str | None) -> None:
    edit(path, remove(*(f"data/demo_{i}/terminated" for i in range(4))))
    assert not RobomimicExperienceReplay(path, split=split)[:]["next", "terminated"].any()
    after = RobomimicExperienceReplay(path, split=split, dones_terminate=True)[:]["next"]
    assert torch.equal(after["terminated"], after["done"])
    assert after["terminated"].sum() == (4 if split is None else 3)
    assert not after["truncated"].any()


def test_whole_numbers_stay_actions_of_whole_numbers(tmp_path: Path) -> None:
    episode = replace(make_episode(), actions=np.arange(5) + 3)
    write_episodes(tmp_path / "a.hdf5", [episode], env_args={})
    action = RobomimicExperienceReplay(tmp_path / "a.hdf5")[:]["action"]
    assert (action.dtype, action.tolist()) == (torch.int64, [3, 4, 5, 6, 7])


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", "u1", "i1", "i2", "u2", "i4", "i8", "?"])
def test_observations_keep_their_dtype(tmp_path: Path, dtype: str) -> None:
    episode = make_episode(parts={"x": ((3,), dtype)})
    write_episodes(tmp_path / "a.hdf5", [episode], env_args={})
    replay = RobomimicExperienceReplay(tmp_path / "a.hdf5", batch_size=4)
    np.testing.assert_array_equal(replay[:]["x"].numpy(), episode.observations["x"], strict=True)
    assert replay.sample()["x"].shape == (4, 3)


def test_parts_may_be_scalars(tmp_path: Path) -> None:
    episode = make_episode(parts={"x": ((), "f8")})
    write_episodes(tmp_path / "a.hdf5", [episode], env_args={})
    data = RobomimicExperienceReplay(tmp_path / "a.hdf5")[:]
    assert torch.equal(data["x"], torch.as_tensor(episode.observations["x"]))


def test_any_subset_of_the_observation_can_be_asked_for(path: Path) -> None:
    for keys in (["object"], ["image"], ["image", "object"]):
        data = RobomimicExperienceReplay(path, observation_keys=keys)[:]
        assert set(data.keys()) == {*keys, "action", "episode", "step", "next"}
        for name in keys:
            assert torch.equal(data[name], joined(file_episodes(), "observations", name))
            assert torch.equal(
                data["next", name], joined(file_episodes(), "next_observations", name)
            )


def test_no_part_of_the_observation_is_refused(path: Path) -> None:
    with pytest.raises(DataError, match="data/demo_0/obs: no part of the observation"):
        RobomimicExperienceReplay(path, observation_keys=[])
    with pytest.raises(DataError, match="data/demo_0/obs/depth: missing; valid: image, object"):
        RobomimicExperienceReplay(path, observation_keys=["object", "depth"])


def test_options_of_the_wrong_kind_are_named(path: Path) -> None:
    with pytest.raises(ConfigError, match="observation_keys is 'object'; valid: a list"):
        RobomimicExperienceReplay(path, observation_keys="object")
    with pytest.raises(ConfigError, match="split is 3; valid: the name of a mask"):
        RobomimicExperienceReplay(path, split=3)  # type: ignore[arg-type]


def test_a_mask_selects_its_episodes(path: Path) -> None:
    for split, episodes in (("train", file_episodes()[:3]), ("valid", file_episodes()[3:])):
        replay = RobomimicExperienceReplay(path, split=split)
        assert torch.equal(replay[:]["object"], joined(episodes, "observations", "object"))
        assert replay[:]["episode"].unique().tolist() == list(range(len(episodes)))
        assert len(replay.metadata["episodes"]) == len(episodes)
    with pytest.raises(DataError, match="mask/test: missing; valid masks: train, valid"):
        RobomimicExperienceReplay(path, split="test")


def test_the_file_s_metadata_are_kept(path: Path) -> None:
    metadata = RobomimicExperienceReplay(path).metadata
    assert metadata["episodes"] == [f"demo_{i}" for i in range(4)]
    assert metadata["env_args"] == ENV_ARGS
    assert (metadata["task"], metadata["action_noise"]) == ("lift", 0.2)


def test_attributes_that_json_does_not_know_are_kept_as_text(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["data"].attrs["complex"] = 1j
        file["data"].attrs["empty"] = h5py.Empty("f8")
    assert RobomimicExperienceReplay(path).metadata["complex"] == "1j"


def test_statistics_of_vectors_are_kept_with_the_data(path: Path) -> None:
    replay = RobomimicExperienceReplay(path, split="train")
    statistics = replay.metadata["statistics"]
    assert set(statistics) == {"action", "object"}  # neither images nor flags
    values = np.concatenate([e.observations["object"] for e in file_episodes()[:3]])
    np.testing.assert_allclose(statistics["object"]["loc"], values.mean(0))
    np.testing.assert_allclose(statistics["object"]["scale"], values.std(0))


def test_the_registered_prefix_loads_a_file(path: Path, tmp_path: Path) -> None:
    replay = load_dataset(
        f"robomimic:{path}", batch_size=5, split="train", root=tmp_path, observation_keys=["object"]
    )
    assert isinstance(replay, RobomimicExperienceReplay)
    assert replay.dataset_id == str(path)
    assert replay.root == tmp_path
    assert replay.sample()["object"].shape == (5, 10)


# -- transforms, slices and trajectories -----------------------------------------------------------


def test_a_transform_applies_to_samples(path: Path) -> None:
    transform = Compose(
        CatTensors(["object"], "observation"),
        CatTensors([("next", "object")], ("next", "observation")),
    )
    replay = RobomimicExperienceReplay(path, batch_size=6, transform=transform)
    sample = replay.sample()
    assert sample["observation"].shape == sample["next", "observation"].shape == (6, 10)
    assert "object" not in set(sample.keys())


@pytest.mark.parametrize("index", [slice(None), ..., slice(0, None)])
def test_a_transform_of_all_rows_leaves_the_stored_ones_as_they_are(path: Path, index: Any) -> None:
    """TorchRL's own storages return the stored tensordict, so each call would normalise again."""
    loc, scale = torch.tensor(1.0), torch.tensor(2.0)
    keys = ["object", ("next", "object")]
    transform = ObservationNorm(loc=loc, scale=scale, in_keys=keys, standard_normal=True)
    replay = RobomimicExperienceReplay(path, transform=transform)
    expected = (joined(file_episodes(), "observations", "object") - 1) / 2
    for _ in range(2):
        assert torch.equal(replay[index]["object"], expected)
        assert torch.equal(replay[index]["next", "object"][:1], replay[:1]["next", "object"])
    assert torch.equal(replay[0]["object"], expected[0])
    replay[index]["next", "other"] = torch.zeros(TOTAL)
    assert "other" not in set(replay[index]["next"].keys())


@pytest.mark.parametrize(
    "options",
    [
        {"traj_key": "episode"},
        {"end_key": ("next", "done")},
        {"end_key": ("next", "truncated")},
    ],
)
def test_slices_never_cross_an_episode(path: Path, options: dict[str, Any]) -> None:
    sampler = SliceSampler(num_slices=4, cache_values=True, **options)
    replay = RobomimicExperienceReplay(path, batch_size=16, sampler=sampler)
    seen = set()
    for _ in range(50):
        slices = replay.sample().reshape(4, 4)
        assert (slices["episode"] == slices["episode"][:, :1]).all()
        assert (slices["step"].diff(dim=1) == 1).all()
        assert torch.equal(slices["object"][:, 1:], slices["next", "object"][:, :-1])
        firsts = slices[:, 0]
        seen.update(zip(firsts["episode"].tolist(), firsts["step"].tolist(), strict=True))
    assert seen == {(i, t) for i, length in enumerate(LENGTHS) for t in range(length - 3)}


def test_trajectories_are_rows_padded_with_zeros(path: Path) -> None:
    data = RobomimicExperienceReplay(path, split_trajs=True)[:]
    assert data.batch_size == (4, max(LENGTHS))
    expected = [[t < length for t in range(max(LENGTHS))] for length in LENGTHS]
    assert data["mask"].tolist() == expected
    flat = RobomimicExperienceReplay(path)[:].to_tensordict()
    for key in flat.keys(include_nested=True, leaves_only=True):
        assert torch.equal(data[key][data["mask"]], flat[key]), key
        assert not data[key][~data["mask"]].any(), key


@pytest.mark.parametrize("lengths", [[4], [4, 4], [1, 3]])
def test_trajectories_of_any_lengths_become_rows(tmp_path: Path, lengths: list[int]) -> None:
    write_file(tmp_path / "a.hdf5", lengths, train=1)
    replay = RobomimicExperienceReplay(tmp_path / "a.hdf5", batch_size=2, split_trajs=True)
    data = replay[:]
    assert data.batch_size == (len(lengths), max(lengths))
    assert data["mask"].sum(1).tolist() == lengths
    assert replay.sample().shape == (2, max(lengths))
