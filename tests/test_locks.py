"""One run at a time in a folder."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import Mock

import pytest

pytest.importorskip("filelock")
pytest.importorskip("yaml")

from torchrl_bmrl.errors import DataError, FolderInUseError
from torchrl_bmrl.run.locks import WHOLE_RUN, lock, lock_run

HOLDING = """
import sys
from pathlib import Path
from torchrl_bmrl.run.locks import lock
with lock(Path(sys.argv[1]), sys.argv[2:]):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def held(folder: Path, *names: str) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds parts of a folder, and ends at the end."""
    command = [sys.executable, "-c", HOLDING, str(folder), *names]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as process:  # type: ignore[call-overload]
        assert process.stdout.readline() == "held\n"
        yield process
        process.stdin.close()


def test_a_folder_in_use_is_refused_with_the_owners_process_and_host(tmp_path: Path) -> None:
    with held(tmp_path, WHOLE_RUN) as owner:
        with pytest.raises(FolderInUseError) as caught, lock(tmp_path):
            pass
        assert (caught.value.process, caught.value.host) == (str(owner.pid), socket.gethostname())
        assert f"{tmp_path}: in use by process {owner.pid} on" in str(caught.value)
    with lock(tmp_path):
        pass


def test_what_a_killed_process_held_is_taken_over(tmp_path: Path) -> None:
    with held(tmp_path, WHOLE_RUN, "lift") as owner:
        owner.send_signal(signal.SIGKILL)
        owner.wait()
    with lock(tmp_path, ["lift", WHOLE_RUN]):
        said = (tmp_path / ".locks" / f"{WHOLE_RUN}.json").read_text()
    assert f'"process": {os.getpid()}' in said


def test_parts_are_held_each_for_itself_and_none_when_one_is_refused(tmp_path: Path) -> None:
    with held(tmp_path, "lift"):
        with lock(tmp_path, ["reach"]):
            pass
        with pytest.raises(FolderInUseError), lock(tmp_path, ["a", "lift", "reach"]):
            pass
        with lock(tmp_path, ["reach", "a"]):  # they were given back
            pass


def test_a_damaged_note_of_the_owner_still_refuses(tmp_path: Path) -> None:
    with held(tmp_path, WHOLE_RUN):
        (tmp_path / ".locks" / f"{WHOLE_RUN}.json").write_text("{")
        with pytest.raises(FolderInUseError, match="process unknown"), lock(tmp_path):
            pass


# -- links -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("linked", ["data", "data/.episodes", "bcq/lift", ".locks", "logs"])
def test_a_run_that_would_change_another_folder_through_a_link_is_refused(
    tmp_path: Path, linked: str
) -> None:
    other, run = tmp_path / "other", tmp_path / "run"
    (other / "lift").mkdir(parents=True)
    (run / linked).parent.mkdir(parents=True, exist_ok=True)
    (run / linked).symlink_to(other, target_is_directory=True)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DataError, match="is a link to ") as caught, lock_run(run, {"seed": 0}):
        pass
    assert caught.value.path == run / linked
    assert sorted(tmp_path.rglob("*")) == before


def test_links_that_no_file_is_changed_through_stay(tmp_path: Path) -> None:
    (tmp_path / "real" / "wandb" / "offline-run-1").mkdir(parents=True)
    (tmp_path / "real" / "wandb" / "latest-run").symlink_to("offline-run-1")
    (tmp_path / "stored").write_text("seed: 0\n")  # as a cache of downloads does
    (tmp_path / "real" / "config.yaml").symlink_to(tmp_path / "stored")
    (tmp_path / "run").symlink_to(tmp_path / "real")
    with lock_run(tmp_path / "run", {"seed": 0}):
        pass


def test_a_lock_empties_no_file_that_it_is_a_link_to(tmp_path: Path) -> None:
    (tmp_path / ".locks").mkdir()
    (tmp_path / "other").write_text("content")
    (tmp_path / ".locks" / f"{WHOLE_RUN}.lock").symlink_to(tmp_path / "other")
    with pytest.raises(OSError, match=r"run\.lock"), lock(tmp_path):
        pass
    assert (tmp_path / "other").read_text() == "content"


@pytest.mark.filterwarnings("ignore:flock not supported")
def test_a_disk_without_flock_has_locks_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fcntl = pytest.importorskip("fcntl")
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(errno.ENOSYS, "no flock")))
    with lock(tmp_path / "new"), pytest.raises(FolderInUseError), lock(tmp_path / "new"):
        pass
    with lock(tmp_path / "new"):  # it was given back
        pass
