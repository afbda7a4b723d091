"""Collections do not depend on the number of workers, and lose no finished episode."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from multiprocessing.forkserver import _forkserver
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)
pytest.importorskip("h5py")

import h5py
from observations import OBSERVATION_SHAPES

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robomimic import open_episodes, read_kept_episode
from torchrl_bmrl.envs.skills import SKILLS
from torchrl_bmrl.errors import ConfigError, DataError, FolderInUseError, UnknownNameError
from torchrl_bmrl.experts import collect
from torchrl_bmrl.experts.collect import _EpisodeJob, collect_demonstrations
from torchrl_bmrl.experts.controllers import EXPERTS
from torchrl_bmrl.experts.tabletop import make_task
from torchrl_bmrl.run.locks import lock
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.tasks import DemonstrationFiles, Task

pytestmark = pytest.mark.robosuite

EPISODES = {"reach": 2, "lift": 1}
HORIZON = 10


class Killed(BaseException):
    """Like a signal: no ``except Exception`` stops it."""


def short(name: str, **options: object) -> Task:
    task = make_task(SKILLS[name], EXPERTS[type(SKILLS[name])], horizon=HORIZON)
    return task.with_options(**options)


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A collection by one worker."""
    return run(tmp_path_factory.mktemp("collected"))


def run(
    directory: Path,
    episodes: dict[str, int] = EPISODES,
    *,
    seed: int = 3,
    workers: int = 1,
    stepper: str = "fast",
    after: dict[str, list[str]] | None = None,
) -> dict[str, Path]:
    return collect_demonstrations(
        directory,
        [short(name, stepper=stepper) for name in episodes],
        episodes,
        valid_episodes=1,
        noise=0.2,
        seed=seed,
        workers=workers,
        after=after,
    )


def read(path: Path) -> list[Episode]:
    with open_episodes(path) as episodes:
        return list(episodes.values())


def files(directory: Path) -> list[str]:
    every = [path.relative_to(directory) for path in directory.rglob("*") if path.is_file()]
    return sorted(str(path) for path in every if ".locks" not in path.parts)


def test_a_collection_is_one_file_per_task(collected: dict[str, Path]) -> None:
    directory = collected["reach"].parent
    assert collected == {task: directory / f"{task}.hdf5" for task in EPISODES}
    assert files(directory) == ["lift.hdf5", "reach.hdf5"]


def test_the_file_has_the_layout_of_robomimic(collected: dict[str, Path]) -> None:
    for task, train in EPISODES.items():
        with h5py.File(collected[task]) as file:
            data = file["data"]
            names = [f"demo_{i}" for i in range(train + 1)]
            assert sorted(data) == names
            assert data.attrs["total"] == (train + 1) * HORIZON
            env_args = json.loads(data.attrs["env_args"])
            assert env_args["type"] == 1
            assert env_args["env_name"] == f"BMRLSawyer{task.title()}"
            assert env_args["env_kwargs"]["robots"] == "Sawyer"
            assert (data.attrs["task"], data.attrs["seed"]) == (task.encode(), 3)
            assert data.attrs["action_noise"] == 0.2
            for name in names:
                demo = data[name]
                assert demo.attrs["num_samples"] == HORIZON
                assert demo["actions"].shape == (HORIZON, 7)
                assert np.abs(demo["actions"][:]).max() <= 1
                assert demo["states"].shape[0] == HORIZON
                assert demo["dones"][:].tolist() == [0] * (HORIZON - 1) + [1]
                for part, size in OBSERVATION_SHAPES.items():
                    assert demo[f"obs/{part}"].shape == (HORIZON, size)
                    np.testing.assert_array_equal(
                        demo[f"next_obs/{part}"][:-1], demo[f"obs/{part}"][1:]
                    )
            assert file["mask/train"][:].tolist() == [n.encode() for n in names[:train]]
            assert file["mask/valid"][:].tolist() == [names[train].encode()]


def test_the_episodes_start_differently(collected: dict[str, Path]) -> None:
    goals = [demo.observations["goal_pos"][0] for demo in read(collected["reach"])]
    assert len(np.unique(np.round(goals, 6), axis=0)) == 3


def test_a_stored_seed_reproduces_its_episode(collected: dict[str, Path]) -> None:
    with h5py.File(collected["lift"]) as file:
        demo = file["data/demo_1"]
        lift = short("lift")
        assert lift.record is not None
        again = lift.record(int(demo.attrs["seed"]), noise=0.2, **lift.options)
        np.testing.assert_array_equal(again.actions, demo["actions"][:])
        np.testing.assert_array_equal(again.extras["states"], demo["states"][:])
        np.testing.assert_array_equal(again.rewards, demo["rewards"][:])


@pytest.fixture
def patch_workers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str], None]]:
    """Code that worker processes run when they start, and the processes that they start do not.

    Importing TorchRL imports mujoco, whose glfw asks another Python for its version; with the code
    in that one, too, each process would start the next.
    """

    def patch(code: str) -> None:
        monkeypatch.setenv("PYTHONPATH", str(tmp_path / "patch"), prepend=os.pathsep)
        _forkserver._stop()  # a new one starts with the code
        (tmp_path / "patch").mkdir()
        (tmp_path / "patch" / "sitecustomize.py").write_text(
            f"import os\nos.environ.pop('PYTHONPATH')\n{code}"
        )

    yield patch
    _forkserver._stop()


def test_two_workers_write_the_same_bytes_as_one(
    tmp_path: Path, collected: dict[str, Path]
) -> None:
    again = run(tmp_path / "two", workers=2)
    for task, path in collected.items():
        assert again[task].read_bytes() == path.read_bytes()


KILL_THE_FIRST = """
import os, pathlib, signal
from torchrl_bmrl.data import robomimic
keep = robomimic.keep_episode
def keep_episode(path, episode):
    try:
        pathlib.Path({flag!r}).touch(exist_ok=False)
    except FileExistsError:
        return keep(path, episode)
    os.kill(os.getpid(), signal.SIGKILL)
robomimic.keep_episode = keep_episode
"""


@pytest.mark.slow
def test_a_worker_killed_in_an_episode_changes_no_byte(
    tmp_path: Path,
    collected: dict[str, Path],
    patch_workers: Callable[..., None],
    caplog: pytest.LogCaptureFixture,
) -> None:
    patch_workers(KILL_THE_FIRST.format(flag=str(tmp_path / "killed")))
    again = run(tmp_path / "two", workers=2)
    assert (tmp_path / "killed").exists()
    said = [message for message in caplog.messages if "by signal" in message]
    assert len(said) == 1
    assert said[0].startswith("collecting demonstrations: a worker was killed by signal 9")
    for task, path in collected.items():
        assert again[task].read_bytes() == path.read_bytes()


def test_robosuites_own_steps_write_the_same_bytes(
    tmp_path: Path, collected: dict[str, Path]
) -> None:
    stock = run(tmp_path, stepper="robosuite")
    for task, path in collected.items():
        assert stock[task].read_bytes() == path.read_bytes()


def test_episodes_do_not_depend_on_how_many_are_asked_for(
    tmp_path: Path, collected: dict[str, Path]
) -> None:
    more = run(tmp_path, {"reach": 4})
    first, longer = (read(path) for path in (collected["reach"], more["reach"]))
    for ours, theirs in zip(first, longer, strict=False):
        np.testing.assert_array_equal(ours.actions, theirs.actions)
    assert len(longer) == 5


def test_another_seed_gives_other_episodes(tmp_path: Path, collected: dict[str, Path]) -> None:
    other = run(tmp_path, {"lift": 1}, seed=4)["lift"]
    ours, theirs = (read(path)[0] for path in (collected["lift"], other))
    assert not np.array_equal(ours.actions, theirs.actions)


def test_what_was_finished_before_a_kill_is_kept_and_not_redone(
    tmp_path: Path, collected: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    real, calls = collect._collect_job, []

    def killed_at_the_fourth(job: _EpisodeJob, report: Report) -> None:
        if len(calls) == 3:
            raise Killed
        calls.append((job.task.name, job.seed))
        real(job, report)

    monkeypatch.setattr(collect, "_collect_job", killed_at_the_fourth)
    with pytest.raises(Killed):
        run(tmp_path)
    kept = files(tmp_path)
    assert kept == [f".episodes/reach/0000{i}.npz" for i in range(3)]
    for name in kept:
        assert len(read_kept_episode(tmp_path / name)) == HORIZON
    times = {name: (tmp_path / name).stat().st_mtime_ns for name in kept}
    (tmp_path / ".episodes" / "reach" / ".00003.npz.0123.tmp").write_text("half of an epis")

    redone = []

    def counted(job: _EpisodeJob, report: Report) -> None:
        assert times == {name: (tmp_path / name).stat().st_mtime_ns for name in kept}
        redone.append((job.task.name, job.seed))
        real(job, report)

    monkeypatch.setattr(collect, "_collect_job", counted)
    again = run(tmp_path)
    assert [task for task, _ in redone] == ["lift", "lift"]
    assert not set(redone) & set(calls)
    assert files(tmp_path) == ["lift.hdf5", "reach.hdf5"]
    for task, path in collected.items():
        assert again[task].read_bytes() == path.read_bytes()


def test_a_complete_collection_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = run(tmp_path, {"lift": 1})["lift"]
    before = (first.stat().st_mtime_ns, first.read_bytes())
    monkeypatch.setattr(collect, "_collect_job", None)  # whoever calls it fails
    assert run(tmp_path, {"lift": 1}) == {"lift": first}
    assert (first.stat().st_mtime_ns, first.read_bytes()) == before


def test_a_file_with_another_number_of_episodes_is_refused(collected: dict[str, Path]) -> None:
    before = collected["reach"].read_bytes()
    with pytest.raises(DataError) as caught:
        run(collected["reach"].parent, {"reach": 4})
    assert caught.value.path == collected["reach"]
    assert "contains 3 episodes; valid: 5" in str(caught.value)
    assert collected["reach"].read_bytes() == before


def test_a_file_of_another_seed_is_refused(collected: dict[str, Path]) -> None:
    with pytest.raises(DataError, match=r"recorded with seed .*; valid: 77, or another folder"):
        run(collected["reach"].parent, {"reach": 2}, seed=77)


def test_fewer_episodes_than_a_killed_run_had_finished_are_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = collect.write_episodes

    def killed(*args: object, **options: object) -> None:
        raise Killed

    monkeypatch.setattr(collect, "write_episodes", killed)
    with pytest.raises(Killed):
        run(tmp_path, {"lift": 2})
    monkeypatch.setattr(collect, "write_episodes", real)
    assert len(read(run(tmp_path, {"lift": 1})["lift"])) == 2


def test_what_cannot_be_recorded_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"'lfit'.*reach, lift"):
        run(tmp_path, after={"reach": ["lfit"]})
    door = Task(name="door", files=DemonstrationFiles(path="door.hdf5"))
    with pytest.raises(ConfigError, match="door has no expert"):
        collect_demonstrations(
            tmp_path, [door], {"door": 1}, valid_episodes=1, noise=0.0, seed=0, workers=1
        )
    assert files(tmp_path) == []


def test_what_another_process_records_is_refused_and_nothing_else(
    tmp_path: Path, collected: dict[str, Path]
) -> None:
    with lock(tmp_path / ".episodes", ["lift"]):
        with pytest.raises(FolderInUseError):
            run(tmp_path)
        assert files(tmp_path) == []
        assert run(tmp_path, {"reach": 2})["reach"].exists()
    run(collected["lift"].parent)  # complete: without a lock


@pytest.mark.parametrize("linked", [".episodes", ".episodes/lift"])
def test_no_folder_is_removed_through_a_link(tmp_path: Path, linked: str) -> None:
    agent = tmp_path / "bcq" / "lift" / "checkpoint.safetensors"
    agent.parent.mkdir(parents=True)
    agent.touch()
    (tmp_path / "data" / linked).parent.mkdir(parents=True)
    (tmp_path / "data" / linked).symlink_to(tmp_path / "bcq")
    with pytest.raises(DataError, match=r"is a link to .*bcq"):
        run(tmp_path / "data", {"lift": 1})
    assert agent.exists()
