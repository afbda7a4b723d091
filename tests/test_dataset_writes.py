"""Nothing that a process does to the data of a buffer reaches the converted files."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")

from episode_files import LENGTHS, lift_file, make_episode
from tensordict import TensorDict
from torchrl.data import SliceSampler
from torchrl.envs.transforms import Transform

from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.data.n_step import NStep
from torchrl_bmrl.data.replay import make_mixed_replay_buffer, make_replay_buffer, with_previous
from torchrl_bmrl.data.robomimic import write_episodes
from torchrl_bmrl.data.sampler import read_memmap
from torchrl_bmrl.errors import BMRLError

SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return lift_file(tmp_path / "source")


def maps_of(folder: Path) -> dict[str, str]:
    """Flags with which this process maps the files of a folder, by name."""
    lines = [line.split(maxsplit=5) for line in Path("/proc/self/maps").read_text().splitlines()]
    mapped = {words[5]: words[1] for words in lines if len(words) == 6}
    return {name: flags for name, flags in mapped.items() if Path(name).is_relative_to(folder)}


def test_the_data_are_memory_mapped_and_privately(path: Path) -> None:
    for options in ({}, {"split_trajs": True}):
        replay = RobomimicExperienceReplay(path, **options)
        files = {str(file) for file in replay.data_path.rglob("*.memmap")}
        assert maps_of(replay.data_path) == dict.fromkeys(files, "rw-p")


def test_the_buffer_refuses_to_be_written_to(path: Path) -> None:
    replay = RobomimicExperienceReplay(path)
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
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


class AddOne(Transform):
    """Adds 1 to its inputs in place."""

    def __init__(self, *keys: Any) -> None:
        super().__init__(in_keys=list(keys), out_keys=list(keys))

    def _apply_transform(self, obs: torch.Tensor) -> torch.Tensor:
        return obs.add_(1)


def set_to_zero(data: Any) -> None:
    """Sets every tensor of the data to zero in place."""
    for leaf in data.values(include_nested=True, leaves_only=True):
        leaf.zero_()


def write_in_a_worker(replay: Any, results: Any) -> None:
    set_to_zero(replay[:])
    set_to_zero(replay.sample(4))
    results.put(replay[:]["object"].sum().item())


def let_a_worker_write(replay: Any) -> None:
    results = SPAWN.Queue()
    process = SPAWN.Process(target=write_in_a_worker, args=(replay, results))
    process.start()
    assert results.get(timeout=60) == 0
    process.join(60)
    assert process.exitcode == 0


def let_a_fork_write(replay: Any) -> None:
    if child := os.fork():
        assert os.waitpid(child, 0)[1] == 0
    else:
        set_to_zero(replay[:])
        os._exit(0)


def slices(replay: Any) -> Any:
    sampler = SliceSampler(num_slices=2, traj_key="episode", strict_length=False)
    again = RobomimicExperienceReplay(replay.dataset_id, batch_size=4, sampler=sampler)
    return again.sample()


def transform_rows(replay: Any) -> None:
    transform = AddOne("object", ("next", "reward"))
    again = RobomimicExperienceReplay(replay.dataset_id, batch_size=4, transform=transform)
    again.sample()
    again[:]
    next(iter(again))


def write_over(data: Any) -> None:
    with pytest.raises(RuntimeError, match="no path associated"):
        data.memmap_refresh_()
    data.update_(data.clone().zero_())
    data.copy_(data.clone().zero_())
    data.apply_(lambda leaf: leaf.zero_())
    data[:2] = data[2:4].clone().zero_()
    data["object"].numpy()[:] = 0
    data["object"].untyped_storage().fill_(0)


WRITES: dict[str, Callable[[Any], Any]] = {
    "one entry": lambda replay: replay[:]["next", "reward"].sub_(1),
    "every entry": lambda replay: set_to_zero(replay[:]),
    "rows": lambda replay: set_to_zero(replay[2:5]),
    "one row": lambda replay: set_to_zero(replay[3]),
    "a sample": lambda replay: set_to_zero(replay.sample(4)),
    "slices": lambda replay: set_to_zero(slices(replay)),
    "transforms": transform_rows,
    "tensordict's own": lambda replay: write_over(replay[:]),
    "the storage": lambda replay: set_to_zero(replay.storage[:]),
    "shared": lambda replay: set_to_zero(replay[:].share_memory_()),
    "to the CPU": lambda replay: set_to_zero(replay[:].to("cpu").contiguous()),
    "memory-mapped again": lambda replay: set_to_zero(replay[:].memmap_()),
    "pickled": lambda replay: set_to_zero(pickle.loads(pickle.dumps(replay[:]))),
    "pickled buffer": lambda replay: set_to_zero(pickle.loads(pickle.dumps(replay))[:]),
    "copied buffer": lambda replay: set_to_zero(deepcopy(replay)[:]),
    "previous": lambda replay: set_to_zero(with_previous(replay[:], ["object"])),
    "single buffer": lambda replay: set_to_zero(make_replay_buffer(replay[:], batch_size=4)[:]),
    "mixed buffer": lambda replay: set_to_zero(
        make_mixed_replay_buffer([replay[:], replay[:]], weights=[1, 1], batch_size=4)[:]
    ),
    "n-step": lambda replay: set_to_zero(NStep(2, 0.9)(replay[:])),
    "another process": let_a_worker_write,
    "a fork": let_a_fork_write,
    "dumped and loaded": lambda replay: (
        set_to_zero(replay[:]),
        replay.dumps(replay.data_path.parent / "dump"),
        replay.loads(replay.data_path.parent / "dump"),
    ),
    "its state": lambda replay: (
        set_to_zero(replay[:]),
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
        set_to_zero(RobomimicExperienceReplay(path)[:])
    finally:
        for file in [folder, *folder.rglob("*")]:
            file.chmod(0o755 if file.is_dir() else 0o644)
    assert len(converted) == 1


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="Linux counts what may be written")
def test_data_larger_than_memory_can_be_mapped(tmp_path: Path) -> None:
    """The files are sparse, so that they take no space on the disk."""
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
