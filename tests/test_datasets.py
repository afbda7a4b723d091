"""Files of demonstrations as replay buffers: converted once, whole or not at all, to the bit."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import pickle
import resource
import shutil
import signal
from collections.abc import Callable, Sequence
from copy import deepcopy
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
    TASK_PARTS,
    make_episode,
    write_file,
)
from tensordict import TensorDict
from torchrl.data import SliceSampler
from torchrl.data.datasets import load_dataset
from torchrl.envs.transforms import CatTensors, Compose, ObservationNorm, Transform

from torchrl_bmrl.data import datasets
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.demonstrations import (
    demonstration_path,
    load_transitions,
    read_demonstrations,
    read_statistics,
    write_statistics,
)
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.n_step import NStep
from torchrl_bmrl.data.replay import make_mixed_replay_buffer, make_replay_buffer, with_previous
from torchrl_bmrl.data.robomimic import write_episodes
from torchrl_bmrl.data.sampler import read_memmap
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError
from torchrl_bmrl.tasks import get_task

TOTAL = sum(LENGTHS)
SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    write_file(tmp_path / "source" / "lift.hdf5")
    return tmp_path / "source" / "lift.hdf5"


def made(lengths: Sequence[int] = LENGTHS) -> list[Episode]:
    """The episodes of :func:`write_file`."""
    return [make_episode(i, steps) for i, steps in enumerate(lengths)]


def whole(episodes: Sequence[Episode], group: str, name: str) -> torch.Tensor:
    return torch.cat([torch.as_tensor(getattr(episode, group)[name]) for episode in episodes])


def edit(path: Path, key: str, value: Any) -> None:
    with h5py.File(path, "r+") as file:
        del file[key]
        if value is not None:
            file[key] = value


def entries(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


# -- what it holds ---------------------------------------------------------------------------------


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
    data, episodes = RobomimicExperienceReplay(path)[:], made()
    for name in PARTS:
        assert torch.equal(data[name], whole(episodes, "observations", name))
        assert torch.equal(data["next", name], whole(episodes, "next_observations", name))
    actions = np.concatenate([episode.actions for episode in episodes])
    rewards = np.concatenate([episode.rewards for episode in episodes])
    assert data["action"].numpy().tobytes() == actions.tobytes()
    assert data["next", "reward"].numpy().tobytes() == rewards.astype(np.float32).tobytes()
    assert torch.equal(data["next", "success"].squeeze(-1), whole(episodes, "extras", "successes"))
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


def test_dones_terminate_where_that_is_asked_for(path: Path) -> None:
    for i in range(4):
        edit(path, f"data/demo_{i}/terminated", None)
    assert not RobomimicExperienceReplay(path)[:]["next", "terminated"].any()
    after = RobomimicExperienceReplay(path, dones_terminate=True)[:]["next"]
    assert torch.equal(after["terminated"], after["done"])
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
            assert torch.equal(data[name], whole(made(), "observations", name))
            assert torch.equal(data["next", name], whole(made(), "next_observations", name))


def test_no_part_of_the_observation_is_refused(path: Path) -> None:
    with pytest.raises(DataError, match="data/demo_0/obs: no part of the observation"):
        RobomimicExperienceReplay(path, observation_keys=[])
    with pytest.raises(DataError, match="data/demo_0/obs/velocity: missing"):
        RobomimicExperienceReplay(path, observation_keys=["velocity"])


def test_a_mask_selects_its_episodes(path: Path) -> None:
    for split, episodes in (("train", made()[:3]), ("valid", made()[3:])):
        replay = RobomimicExperienceReplay(path, split=split)
        assert torch.equal(replay[:]["object"], whole(episodes, "observations", "object"))
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


def maps_of(folder: Path) -> dict[str, str]:
    """How this process maps the files of a folder: flags by name."""
    lines = [line.split(maxsplit=5) for line in Path("/proc/self/maps").read_text().splitlines()]
    mapped = {words[5]: words[1] for words in lines if len(words) == 6}
    return {name: flags for name, flags in mapped.items() if Path(name).is_relative_to(folder)}


def test_the_data_are_memory_mapped_and_privately(path: Path) -> None:
    for options in ({}, {"split_trajs": True}):
        replay = RobomimicExperienceReplay(path, **options)
        files = {str(file) for file in replay.data_path.rglob("*.memmap")}
        assert maps_of(replay.data_path) == dict.fromkeys(files, "rw-p")


def test_the_registered_prefix_loads_a_file(path: Path, tmp_path: Path) -> None:
    replay = load_dataset(
        f"robomimic:{path}", batch_size=5, split="train", root=tmp_path, observation_keys=["object"]
    )
    assert isinstance(replay, RobomimicExperienceReplay)
    assert replay.dataset_id == str(path)
    assert replay.root == tmp_path
    assert replay.sample()["object"].shape == (5, 10)


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
    """TorchRL's own storages hand out their tensordict: each call would normalise once more."""
    loc, scale = torch.tensor(1.0), torch.tensor(2.0)
    keys = ["object", ("next", "object")]
    transform = ObservationNorm(loc=loc, scale=scale, in_keys=keys, standard_normal=True)
    replay = RobomimicExperienceReplay(path, transform=transform)
    expected = (whole(made(), "observations", "object") - 1) / 2
    for _ in range(2):
        assert torch.equal(replay[index]["object"], expected)
        assert torch.equal(replay[index]["next", "object"][:1], replay[:1]["next", "object"])
    assert torch.equal(replay[0]["object"], expected[0])
    replay[index]["next", "other"] = torch.zeros(TOTAL)
    assert "other" not in set(replay[index]["next"].keys())


def test_the_buffer_refuses_to_be_written_to(path: Path) -> None:
    replay = RobomimicExperienceReplay(path)
    with pytest.raises(RuntimeError):
        replay.extend(replay[:2])
    with pytest.raises(BMRLError, match="read-only"):
        replay[0] = replay[1]


@pytest.mark.parametrize("way", ["dumps", "state_dict"])
def test_another_file_s_state_does_not_overwrite_the_data(
    path: Path, tmp_path: Path, way: str
) -> None:
    other = tmp_path / "other.hdf5"
    write_episodes(other, [make_episode(9 + i, n) for i, n in enumerate(LENGTHS)], env_args={})
    replay, foreign = RobomimicExperienceReplay(path), RobomimicExperienceReplay(other)
    before = replay[:].clone()
    if way == "dumps":
        foreign.dumps(tmp_path / "dump")
        replay.loads(tmp_path / "dump")
    else:
        replay.load_state_dict(foreign.state_dict())
    for data in (replay[:], RobomimicExperienceReplay(path)[:]):
        assert torch.equal(data["object"], before["object"])


class Executed:
    """What runs when a pickle of it is read."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)


def test_a_pickle_among_the_converted_data_is_refused_and_not_executed(
    path: Path, tmp_path: Path
) -> None:
    folder = RobomimicExperienceReplay(path).data_path
    executed = tmp_path / "executed"
    data = TensorDict.load_memmap(folder / "data").clone()
    data.set_non_tensor("x", Executed(executed))
    data.memmap(tmp_path / "changed")
    shutil.copytree(tmp_path / "changed", folder / "data", dirs_exist_ok=True)
    metadata = json.loads((folder / "metadata.json").read_text())
    metadata["crc32"] = {name: datasets._crc32(folder / name) for name in metadata["crc32"]}
    (folder / "metadata.json").write_text(json.dumps(metadata))
    (folder / "metadata.crc32").write_text(datasets._crc32(folder / "metadata.json"))
    with pytest.raises(DataError, match="pickle"):
        read_memmap(folder / "data")
    shutil.copytree(folder, tmp_path / "kept")
    assert "x" not in set(RobomimicExperienceReplay(path)[:].keys())
    assert not executed.exists()
    folder = tmp_path / "kept"
    with pytest.warns(FutureWarning, match="pickle"):  # it would have been
        TensorDict.load_memmap(folder / "data")
    assert executed.exists()


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "shortened": lambda folder: os.truncate(folder / "data/object.memmap", 16),
    "removed": lambda folder: (folder / "data/object.memmap").unlink(),
    "renamed": lambda folder: (folder / "data").rename(folder / "other"),
    "emptied": lambda folder: (shutil.rmtree(folder), folder.mkdir()),
    "no checksum": lambda folder: (folder / "metadata.crc32").unlink(),
    "no metadata": lambda folder: (folder / "metadata.json").unlink(),
    "other metadata": lambda folder: (
        (folder / "metadata.json").write_text("[]"),
        (folder / "metadata.crc32").write_text(datasets._crc32(folder / "metadata.json")),
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_cache_is_made_anew(path: Path, damage: str, converted: list[Path]) -> None:
    replay = RobomimicExperienceReplay(path)
    before, metadata = replay[:].clone(), replay.metadata
    DAMAGES[damage](replay.data_path)
    again = RobomimicExperienceReplay(path)
    assert len(converted) == 2
    assert (again[:] == before).all()
    assert again.metadata == metadata
    assert entries(path.parent) == sorted([path.name, replay.data_path.name])


@pytest.mark.parametrize("split_trajs", [False, True])
def test_a_flipped_bit_in_any_file_leads_to_a_new_conversion(
    path: Path, split_trajs: bool, converted: list[Path]
) -> None:
    replay = RobomimicExperienceReplay(path, split_trajs=split_trajs)
    before, metadata, folder = replay[:].clone(), replay.metadata, replay.data_path
    files = [file for file in sorted(folder.rglob("*")) if file.is_file()]
    assert len(files) == len(metadata["crc32"]) + 2
    for number, file in enumerate(files, start=1):
        assert len(converted) == number
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
        again = RobomimicExperienceReplay(path, split_trajs=split_trajs)
        assert len(converted) == number + 1, file
        assert (again[:] == before).all()
        assert again.metadata == metadata


def test_a_disk_that_does_not_keep_what_is_written_is_named(
    path: Path, monkeypatch: pytest.MonkeyPatch, converted: list[Path]
) -> None:
    monkeypatch.setattr(datasets, "_crc32", lambda file: os.urandom(4).hex())
    with pytest.raises(DataError, match=r"lift\.hdf5: its conversion .* is damaged as soon as"):
        RobomimicExperienceReplay(path)
    assert len(converted) == datasets.ATTEMPTS


def test_a_conversion_that_vanishes_while_it_is_read_is_made_anew(
    path: Path, monkeypatch: pytest.MonkeyPatch, converted: list[Path]
) -> None:
    folder = RobomimicExperienceReplay(path).data_path
    read = datasets.read_memmap
    memmap = folder / "data" / "object.memmap"

    def remove_first(data: Path) -> TensorDict:
        memmap.unlink()  # tensordict reads the rest, without a word
        monkeypatch.setattr(datasets, "read_memmap", read)
        return read(data)

    monkeypatch.setattr(datasets, "read_memmap", remove_first)
    assert "object" in set(RobomimicExperienceReplay(path)[:].keys())
    assert len(converted) == 2


# -- nothing reaches the files ---------------------------------------------------------------------


class AddOne(Transform):
    """Adds to what it gets, in place."""

    def __init__(self, *keys: Any) -> None:
        super().__init__(in_keys=list(keys), out_keys=list(keys))

    def _apply_transform(self, obs: torch.Tensor) -> torch.Tensor:
        return obs.add_(1)


def every_leaf(data: Any) -> None:
    for leaf in data.values(include_nested=True, leaves_only=True):
        leaf.zero_()


def add_in_a_worker(replay: Any, results: Any) -> None:
    every_leaf(replay[:])
    every_leaf(replay.sample(4))
    results.put(replay[:]["object"].sum().item())


def let_a_worker_write(replay: Any) -> None:
    results = SPAWN.Queue()
    process = SPAWN.Process(target=add_in_a_worker, args=(replay, results))
    process.start()
    assert results.get(timeout=60) == 0
    process.join(60)
    assert process.exitcode == 0


def let_a_fork_write(replay: Any) -> None:
    if child := os.fork():
        assert os.waitpid(child, 0)[1] == 0
    else:
        every_leaf(replay[:])
        os._exit(0)


def slices(replay: Any) -> Any:
    sampler = SliceSampler(num_slices=2, traj_key="episode", strict_length=False)
    again = RobomimicExperienceReplay(replay.dataset_id, batch_size=4, sampler=sampler)
    return again.sample()


def normalise(replay: Any) -> None:
    transform = AddOne("object", ("next", "reward"))
    again = RobomimicExperienceReplay(replay.dataset_id, batch_size=4, transform=transform)
    again.sample()
    again[:]
    next(iter(again))


def write_over(data: Any) -> None:
    with pytest.raises(RuntimeError):  # there is no file that it knew of
        data.memmap_refresh_()
    data.update_(data.clone().zero_())
    data.copy_(data.clone().zero_())
    data.apply_(lambda leaf: leaf.zero_())
    data[:2] = data[2:4].clone().zero_()
    data["object"].numpy()[:] = 0
    data["object"].untyped_storage().fill_(0)


WRITES: dict[str, Callable[[Any], Any]] = {
    "one entry": lambda replay: replay[:]["next", "reward"].sub_(1),
    "every entry": lambda replay: every_leaf(replay[:]),
    "rows": lambda replay: every_leaf(replay[2:5]),
    "one row": lambda replay: every_leaf(replay[3]),
    "a sample": lambda replay: every_leaf(replay.sample(4)),
    "slices": lambda replay: every_leaf(slices(replay)),
    "transforms": normalise,
    "tensordict's own": lambda replay: write_over(replay[:]),
    "the storage": lambda replay: every_leaf(replay.storage[:]),
    "shared": lambda replay: every_leaf(replay[:].share_memory_()),
    "to the CPU": lambda replay: every_leaf(replay[:].to("cpu").contiguous()),
    "memory-mapped again": lambda replay: every_leaf(replay[:].memmap_()),
    "pickled": lambda replay: every_leaf(pickle.loads(pickle.dumps(replay[:]))),
    "pickled buffer": lambda replay: every_leaf(pickle.loads(pickle.dumps(replay))[:]),
    "copied buffer": lambda replay: every_leaf(deepcopy(replay)[:]),
    "previous": lambda replay: every_leaf(with_previous(replay[:], ["object"])),
    "single buffer": lambda replay: every_leaf(make_replay_buffer(replay[:], batch_size=4)[:]),
    "mixed buffer": lambda replay: every_leaf(
        make_mixed_replay_buffer([replay[:], replay[:]], weights=[1, 1], batch_size=4)[:]
    ),
    "n-step": lambda replay: every_leaf(NStep(2, 0.9)(replay[:])),
    "another process": let_a_worker_write,
    "a fork": let_a_fork_write,
    "dumped and loaded": lambda replay: (
        every_leaf(replay[:]),
        replay.dumps(replay.data_path.parent / "dump"),
        replay.loads(replay.data_path.parent / "dump"),
    ),
    "its state": lambda replay: (
        every_leaf(replay[:]),
        replay.load_state_dict(replay.state_dict()),
    ),
}


@pytest.mark.parametrize(
    ("write", "split_trajs"),
    [*((write, False) for write in WRITES), ("every entry", True), ("tensordict's own", True)],
)
def test_nothing_that_is_done_to_the_data_reaches_the_files(
    path: Path, write: str, split_trajs: bool, converted: list[Path]
) -> None:
    replay = RobomimicExperienceReplay(path, split_trajs=split_trajs)
    files = {file: file.read_bytes() for file in replay.data_path.rglob("*") if file.is_file()}
    before = replay[:].clone()
    WRITES[write](replay)
    assert {file: file.read_bytes() for file in files} == files
    again = RobomimicExperienceReplay(path, split_trajs=split_trajs)
    assert (again[:] == before).all()
    assert len(converted) == 1


def test_what_a_process_changed_is_what_it_and_its_copies_see(path: Path) -> None:
    replay = RobomimicExperienceReplay(path)
    replay[:]["next", "reward"].fill_(7)
    for data in (replay[:], replay.sample(4), pickle.loads(pickle.dumps(replay))[:]):
        assert (data["next", "reward"] == 7).all()


def test_a_folder_that_cannot_be_written_is_read(path: Path, converted: list[Path]) -> None:
    folder = RobomimicExperienceReplay(path).data_path
    for file in [*folder.rglob("*"), folder]:
        file.chmod(0o555 if file.is_dir() else 0o444)
    try:
        every_leaf(RobomimicExperienceReplay(path)[:])
    finally:
        for file in [folder, *folder.rglob("*")]:
            file.chmod(0o755 if file.is_dir() else 0o644)
    assert len(converted) == 1


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="Linux counts what may be written")
def test_data_larger_than_memory_can_be_mapped(tmp_path: Path) -> None:
    """Sparse files: there is nothing to read."""
    size = 2 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    TensorDict({"x": torch.zeros(8, dtype=torch.uint8)}, [8]).memmap(tmp_path / "data")
    os.truncate(tmp_path / "data" / "x.memmap", size)
    meta = json.loads((tmp_path / "data" / "meta.json").read_text())
    meta["x"]["shape"] = meta["shape"] = [size]
    (tmp_path / "data" / "meta.json").write_text(json.dumps(meta))
    data = read_memmap(tmp_path / "data")
    data["x"][-1] = 3
    assert (len(data), int(data["x"][-1])) == (size, 3)
    assert int(read_memmap(tmp_path / "data")["x"][-1]) == 0


def test_a_relative_path_outlives_the_working_directory(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(path.parent)
    replay = RobomimicExperienceReplay(path.name)
    monkeypatch.chdir(tmp_path.parent)
    assert replay.metadata["episodes"][0] == "demo_0"
    replay.delete()
    assert not replay.data_path.exists()


def test_statistics_of_vectors_are_kept_with_the_data(path: Path) -> None:
    replay = RobomimicExperienceReplay(path, split="train")
    statistics = replay.metadata["statistics"]
    assert set(statistics) == {"action", "object"}  # neither images nor flags
    values = np.concatenate([e.observations["object"] for e in made()[:3]])
    np.testing.assert_allclose(statistics["object"]["loc"], values.mean(0))
    np.testing.assert_allclose(statistics["object"]["scale"], values.std(0))


def test_options_of_the_wrong_kind_are_named(path: Path) -> None:
    with pytest.raises(ConfigError, match="observation_keys is 'object'; valid: a list"):
        RobomimicExperienceReplay(path, observation_keys="object")
    with pytest.raises(ConfigError, match="split is 3; valid: the name of a mask"):
        RobomimicExperienceReplay(path, split=3)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="obs/depth: missing; valid: image, object"):
        RobomimicExperienceReplay(path, observation_keys=["object", "depth"])


def test_the_order_of_the_parts_asked_for_makes_no_other_folder(path: Path) -> None:
    first = RobomimicExperienceReplay(path, observation_keys=["object", "image"])
    second = RobomimicExperienceReplay(path, observation_keys=["image", "object", "image"])
    assert first.data_path == second.data_path


@pytest.mark.parametrize("split", [None, "train"])
def test_dones_terminate_in_a_split_too(path: Path, split: str | None) -> None:
    with h5py.File(path, "r+") as file:
        for demo in file["data"].values():
            del demo["terminated"]
    replay = RobomimicExperienceReplay(path, split=split, dones_terminate=True)
    episodes = 4 if split is None else 3
    assert replay[:]["next", "terminated"].sum() == episodes
    assert not replay[:]["next", "truncated"].any()


# -- slices and trajectories -----------------------------------------------------------------------


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


# -- where and when it is converted ----------------------------------------------------------------


@pytest.fixture
def converted(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Sources of the conversions that take place."""
    sources: list[Path] = []
    convert = datasets._convert

    def count(source: Path, *args: Any) -> None:
        sources.append(source)
        convert(source, *args)

    monkeypatch.setattr(datasets, "_convert", count)
    return sources


def test_a_file_is_converted_once_beside_itself(path: Path, converted: list[Path]) -> None:
    first = RobomimicExperienceReplay(path)
    again = RobomimicExperienceReplay(str(path))
    assert converted == [path]
    assert first.data_path == again.data_path == first.data_path_root
    assert first.data_path.parent == path.parent
    assert entries(path.parent) == sorted([path.name, first.data_path.name])
    assert first.data_path.name.startswith("lift-")
    os.utime(path)
    RobomimicExperienceReplay(path)
    assert converted == [path]  # what counts is the content


def test_it_is_converted_under_the_root_that_is_given(path: Path, tmp_path: Path) -> None:
    root = tmp_path / "elsewhere" / "deep"
    replay = RobomimicExperienceReplay(path, root=root)
    assert replay.data_path.parent == replay.root == root
    assert entries(root) == [replay.data_path.name]
    assert entries(path.parent) == [path.name]


def test_a_changed_file_is_converted_anew(path: Path, converted: list[Path]) -> None:
    old = RobomimicExperienceReplay(path)
    before = old[:]["next", "reward"].clone()
    edit(path, "data/demo_0/rewards", np.full(LENGTHS[0], 9.0))
    new = RobomimicExperienceReplay(path)
    assert len(converted) == 2
    assert new.data_path != old.data_path
    assert (new[:]["next", "reward"][: LENGTHS[0]] == 9).all()
    assert torch.equal(old[:]["next", "reward"], before)


def test_each_set_of_options_has_its_folder(path: Path, converted: list[Path]) -> None:
    options: list[dict[str, Any]] = [
        {},
        {"split": "train"},
        {"split": "valid"},
        {"observation_keys": ["object"]},
        {"observation_keys": ["object", "image"]},
        {"dones_terminate": True},
        {"split_trajs": True},
    ]
    for _ in range(2):
        folders = {RobomimicExperienceReplay(path, **option).data_path for option in options}
        assert len(folders) == len(converted) == len(options)


def test_files_of_equal_content_and_name_share_a_folder(
    path: Path, tmp_path: Path, converted: list[Path]
) -> None:
    copy = tmp_path / path.name
    copy.write_bytes(path.read_bytes())
    paths = {RobomimicExperienceReplay(p, root=tmp_path / "r").data_path for p in (path, copy)}
    assert len(paths) == len(converted) == 1


def test_deleting_removes_the_folder_and_not_the_file(path: Path) -> None:
    train = RobomimicExperienceReplay(path, split="train")
    valid = RobomimicExperienceReplay(path, split="valid")
    train.delete()
    assert entries(path.parent) == sorted([path.name, valid.data_path.name])
    assert len(RobomimicExperienceReplay(path, split="train")) == sum(LENGTHS[:3])


def test_the_source_is_only_read(path: Path) -> None:
    before, stat = path.read_bytes(), path.stat()
    path.chmod(0o444)
    for options in ({}, {"split": "train"}, {"split_trajs": True}):
        RobomimicExperienceReplay(path, **options)
    assert path.read_bytes() == before
    assert path.stat().st_mtime_ns == stat.st_mtime_ns


# -- when it cannot be converted -------------------------------------------------------------------


def refusal(path: Path, root: Path, **options: Any) -> DataError:
    """The error, which names the file; nothing is left under ``root``."""
    before = path.read_bytes() if path.is_file() else None
    with pytest.raises(DataError) as caught:
        RobomimicExperienceReplay(path, root=root, **options)
    assert str(caught.value).startswith(f"{path}: ")
    assert not root.exists() or entries(root) == []
    assert (path.read_bytes() if path.is_file() else None) == before
    return caught.value


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert "no such file" in str(refusal(tmp_path / "a.hdf5", tmp_path / "root"))
    assert "no such file" in str(refusal(tmp_path, tmp_path / "root"))


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("data/demo_2/actions", np.zeros((7, 6), np.float32), "shape (7, 6); valid: (7, 7)"),
        ("data/demo_3/rewards", np.array([0.0] * 7 + [np.nan]), "not finite in row 7"),
        ("data/demo_3/actions", np.full((8, 7), 2, np.float32), "2.0 in row 0 is outside"),
        ("data/demo_1/next_obs/object", None, "missing"),
    ],
)
def test_a_later_episode_s_fault_leaves_nothing_behind(
    path: Path, tmp_path: Path, key: str, value: Any, says: str
) -> None:
    edit(path, key, value)
    error = refusal(path, tmp_path / "root")
    assert error.key == key
    assert says in str(error)


def test_a_part_named_like_a_key_of_torchrl_s_is_refused(tmp_path: Path) -> None:
    write_file(tmp_path / "a.hdf5")
    with h5py.File(tmp_path / "a.hdf5", "r+") as file:
        for group in ("obs", "next_obs"):
            file[f"data/demo_0/{group}/action"] = np.zeros((LENGTHS[0], 2))
    error = refusal(tmp_path / "a.hdf5", tmp_path / "root")
    assert error.key == "data/demo_0/obs/action"


@pytest.mark.parametrize("method", ["mkdir", "rename"])
def test_a_folder_that_cannot_be_written_is_answered_with_the_remedy(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    (tmp_path / "root").mkdir()
    monkeypatch.setattr(Path, method, refuse)
    error = refusal(path, tmp_path / "root")
    assert "Read-only file system" in str(error)
    assert "valid: root=, a folder with space" in str(error)


@pytest.mark.parametrize("split_trajs", [False, True])
def test_a_full_disk_is_answered_with_the_remedy(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, split_trajs: bool
) -> None:
    calls = []

    def refuse(*args: Any) -> None:
        calls.append(args)
        # With split_trajs the first round of tensors fits.
        if len(calls) > 15 * split_trajs:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    error = refusal(path, tmp_path / "root", split_trajs=split_trajs)
    assert "No space left on device" in str(error)
    assert "valid: root=, a folder with space" in str(error)


def test_the_disk_space_is_reserved_before_anything_is_written(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reserved: list[int] = []
    reserve = os.posix_fallocate

    def count(descriptor: int, offset: int, size: int) -> None:
        reserved.append(size)
        reserve(descriptor, offset, size)

    monkeypatch.setattr(os, "posix_fallocate", count)
    replay = RobomimicExperienceReplay(path, root=tmp_path)
    sizes = [file.stat().st_size for file in replay.data_path.rglob("*.memmap")]
    assert sorted(reserved) == sorted(sizes)


def convert_under_limit(path: str, root: str, connection: Any) -> None:
    """Converts where no file may be larger than 1000 bytes."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
    try:
        RobomimicExperienceReplay(path, root=root)
    except BMRLError as error:
        connection.send((type(error).__name__, str(error)))


def test_a_file_system_s_limit_is_answered_with_the_remedy(path: Path, tmp_path: Path) -> None:
    ours, theirs = SPAWN.Pipe()
    root = tmp_path / "root"
    process = SPAWN.Process(target=convert_under_limit, args=(str(path), str(root), theirs))
    process.start()
    process.join(60)
    assert process.exitcode == 0
    name, message = ours.recv()
    assert name == "DataError"
    assert message.startswith(f"{path}: ")
    assert "valid: root=, a folder with space" in message
    assert entries(root) == []


def test_an_interrupt_leaves_nothing_behind(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*args: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(datasets, "_statistics", interrupt)
    with pytest.raises(KeyboardInterrupt):
        RobomimicExperienceReplay(path, root=tmp_path / "root")
    assert entries(tmp_path / "root") == []


# -- several processes -----------------------------------------------------------------------------


def convert_together(path: str, root: str, barrier: Any, results: Any) -> None:
    rename = Path.rename

    def rename_together(self: Path, target: Path) -> Path:
        # Both have converted by now, and neither is done.
        if self.name.endswith(".tmp"):
            barrier.wait(60)
        return rename(self, target)

    Path.rename = rename_together  # type: ignore[method-assign, assignment]
    replay = RobomimicExperienceReplay(path, root=root)
    results.put((str(replay.data_path), replay[:]["object"].sum().item()))


@pytest.mark.parametrize("damaged", [False, True])
def test_two_processes_may_convert_at_once(path: Path, tmp_path: Path, damaged: bool) -> None:
    root = tmp_path / "root"
    if damaged:
        folder = RobomimicExperienceReplay(path, root=root).data_path
        os.truncate(folder / "data" / "object.memmap", 16)
    barrier, results = SPAWN.Barrier(2), SPAWN.Queue()
    args = (str(path), str(root), barrier, results)
    processes = [SPAWN.Process(target=convert_together, args=args) for _ in range(2)]
    for process in processes:
        process.start()
    first, second = results.get(timeout=120), results.get(timeout=120)
    for process in processes:
        process.join(60)
    assert [process.exitcode for process in processes] == [0, 0]
    assert first == second
    assert entries(root) == [Path(first[0]).name]


def convert_and_stop(path: str, root: str, ready: Any) -> None:
    def stop(*args: Any) -> None:
        ready.set()
        signal.pause()

    datasets._statistics = stop
    RobomimicExperienceReplay(path, root=root)


def test_a_killed_process_leaves_nothing_under_the_final_name(path: Path, tmp_path: Path) -> None:
    root, ready = tmp_path / "root", SPAWN.Event()
    process = SPAWN.Process(target=convert_and_stop, args=(str(path), str(root), ready))
    process.start()
    assert ready.wait(120)
    process.kill()
    process.join(60)
    assert process.exitcode == -signal.SIGKILL
    (remains,) = entries(root)
    assert remains.startswith(".lift-")
    assert remains.endswith(".tmp")
    replay = RobomimicExperienceReplay(path, root=root)
    assert torch.equal(replay[:]["object"], whole(made(), "observations", "object"))
    assert entries(root) == sorted([remains, replay.data_path.name])


# -- demonstrations of a run -----------------------------------------------------------------------

REACH, LIFT = get_task("reach"), get_task("lift")


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A folder of two tasks' demonstrations."""
    write_file(tmp_path / "reach.hdf5", [5, 6, 4], train=2, parts=TASK_PARTS)
    write_file(tmp_path / "lift.hdf5", [9, 8, 7], train=2, parts=TASK_PARTS)
    return tmp_path


def test_demonstrations_know_their_task(runs: Path) -> None:
    path = demonstration_path(runs, "lift")
    data = read_demonstrations(path, LIFT, index=1)
    assert isinstance(data, TensorDict)
    assert data["task"].tolist() == [1] * 24
    assert set(data.keys()) == {*TASK_PARTS, "action", "episode", "step", "next", "task"}
    assert len(read_demonstrations(path, LIFT, split="valid", index=1)) == 7


def test_parts_that_the_tasks_do_not_have_are_left_out(tmp_path: Path) -> None:
    write_file(tmp_path / "lift.hdf5", parts={**TASK_PARTS, **PARTS})
    data = read_demonstrations(tmp_path / "lift.hdf5", LIFT, index=1)
    assert not set(PARTS) & set(data.keys())


@pytest.mark.parametrize("name", TASK_PARTS)
def test_a_part_that_is_missing_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / "lift.hdf5"
    write_file(path, parts={part: kind for part, kind in TASK_PARTS.items() if part != name})
    with pytest.raises(DataError, match=rf"lift\.hdf5: data/demo_0/obs/{name}: missing"):
        read_demonstrations(path, LIFT, index=1)


@pytest.mark.parametrize("name", TASK_PARTS)
def test_tasks_whose_parts_have_other_sizes_are_refused_together(runs: Path, name: str) -> None:
    (size,), dtype = TASK_PARTS[name]
    path = runs / "lift.hdf5"
    write_file(path, train=2, parts={**TASK_PARTS, name: ((size + 1,), dtype)})
    with pytest.raises(
        DataError, match=rf"lift\.hdf5: .*{name} \({size + 1},\).*valid: .*of reach"
    ):
        write_statistics(runs, [REACH, LIFT])
    assert not (runs / "statistics.json").exists()


def rewrite(path: Path, **changes: Any) -> None:
    episode = replace(make_episode(parts=TASK_PARTS), **changes)
    write_episodes(path, [episode, episode], env_args={}, masks={"train": [0]})


def test_tasks_whose_actions_have_other_sizes_are_refused_together(runs: Path) -> None:
    rewrite(runs / "lift.hdf5", actions=np.zeros((5, 6)))
    with pytest.raises(DataError, match=r"lift\.hdf5: .*action \(6,\); valid: .*action \(7,\)"):
        write_statistics(runs, [REACH, LIFT])


def test_demonstrations_without_successes_are_refused(tmp_path: Path) -> None:
    rewrite(tmp_path / "lift.hdf5", extras={})
    with pytest.raises(DataError, match=r"lift\.hdf5: .*no successes; valid: successes \(T,\)"):
        read_demonstrations(tmp_path / "lift.hdf5", LIFT, index=1)


def test_demonstrations_that_terminate_are_refused(tmp_path: Path) -> None:
    rewrite(tmp_path / "lift.hdf5", terminated=np.arange(5) == 4)
    with pytest.raises(DataError, match=r"lift\.hdf5: .*terminate"):
        read_demonstrations(tmp_path / "lift.hdf5", LIFT, index=1)


def observations(lengths: Sequence[int], count: int) -> np.ndarray:
    """The tasks' observation, computed from the episodes that the files were written from."""
    rows = []
    for i, steps in enumerate(lengths[:count]):
        parts = make_episode(i, steps, parts=TASK_PARTS).observations
        q = parts["robot0_joint_pos"]
        names = ("gripper_qpos", "joint_vel", "eef_pos", "eef_quat")
        others = [parts[f"robot0_{name}"] for name in names]
        rows.append(np.concatenate([np.sin(q), np.cos(q), *others, parts["goal_pos"]], axis=1))
    return np.concatenate(rows)


def test_statistics_are_kept_for_each_task_and_over_all(runs: Path) -> None:
    statistics = write_statistics(runs, [REACH, LIFT])
    reach, lift = observations([5, 6], 2), observations([9, 8], 2)  # what is trained on
    # Each task has the same weight, however many steps it has.
    loc = (reach.mean(0) + lift.mean(0)) / 2
    second = (((reach - loc) ** 2).mean(0) + ((lift - loc) ** 2).mean(0)) / 2
    expected = [
        (None, loc, np.sqrt(second)),
        (REACH, reach.mean(0), reach.std(0)),
        (LIFT, lift.mean(0), lift.std(0)),
    ]
    for task, mean, scale in expected:
        read = read_statistics(runs, task)
        np.testing.assert_allclose(read.loc.numpy(), mean, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(read.scale.numpy(), scale, rtol=1e-5, atol=1e-5)
    assert torch.equal(read_statistics(runs).loc, statistics.loc)
    assert torch.equal(read_statistics(runs).scale, statistics.scale)
    tasks = json.loads((runs / "statistics.json").read_text())["tasks"]
    assert {task: tasks[task]["transitions"] for task in tasks} == {"reach": 11, "lift": 17}


@pytest.mark.parametrize(
    "content",
    [None, "", "[]", "{}", '{"loc": [1.0], "scale": [0.0]}', '{"loc": [1.0], "scale": [1.0, 2.0]}'],
)
def test_damaged_statistics_are_named(tmp_path: Path, content: str | None) -> None:
    if content is not None:
        (tmp_path / "statistics.json").write_text(content)
    with pytest.raises(DataError, match=r"statistics\.json: "):
        read_statistics(tmp_path)


def test_statistics_of_a_task_that_has_none_are_refused(runs: Path) -> None:
    write_statistics(runs, [REACH])
    with pytest.raises(DataError, match=r"statistics\.json: lift: "):
        read_statistics(runs, LIFT)


def test_transitions_are_normalised(runs: Path) -> None:
    statistics = write_statistics(runs, [REACH, LIFT])
    data = load_transitions(runs, LIFT, statistics, split="valid", index=1)
    episode = make_episode(2, 7, parts=TASK_PARTS)
    assert data["observation"].shape == data["next", "observation"].shape == (7, 33)
    goal = (episode.next_observations["goal_pos"] - statistics.loc[-3:].numpy()) / (
        statistics.scale[-3:].numpy()
    )
    np.testing.assert_allclose(data["next", "observation"][:, -3:].numpy(), goal, rtol=1e-4)
    assert torch.equal(data["observation"][1:], data["next", "observation"][:-1])
    # Normalising does not change what is stored.
    raw = read_demonstrations(demonstration_path(runs, "lift"), LIFT, split="valid", index=1)
    np.testing.assert_array_equal(raw["goal_pos"].numpy(), episode.observations["goal_pos"])
