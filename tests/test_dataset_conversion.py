"""A conversion that fails, is killed or races another one leaves no half-made copy."""

from __future__ import annotations

import errno
import multiprocessing
import os
import resource
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")

from episode_files import LENGTHS, entries, file_episodes, joined, lift_file, write_file
from file_edits import edit, put, remove

from torchrl_bmrl.data import datasets
from torchrl_bmrl.data.datasets import RobomimicExperienceReplay
from torchrl_bmrl.errors import BMRLError, DataError

SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return lift_file(tmp_path / "source")


def refusal(path: Path, root: Path, **options: Any) -> DataError:
    """The error, which names the file; the file is unchanged and ``root`` is empty."""
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
    edit(path, remove(key) if value is None else put(key, value))
    error = refusal(path, tmp_path / "root")
    assert error.key == key
    assert says in str(error)


def test_a_part_named_like_a_key_of_torchrl_s_is_refused(tmp_path: Path) -> None:
    write_file(tmp_path / "a.hdf5")
    for group in ("obs", "next_obs"):
        edit(tmp_path / "a.hdf5", put(f"data/demo_0/{group}/action", np.zeros((LENGTHS[0], 2))))
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
    """Converts in a process whose files may have 1000 bytes at most, and sends the error."""
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
        # Both processes have converted, and neither has renamed its folder.
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
    assert torch.equal(replay[:]["object"], joined(file_episodes(), "observations", "object"))
    assert entries(root) == sorted([remains, replay.data_path.name])
