"""Sweeps: the launchers give what single runs give, a job that fails stops no other."""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

import yaml
from hydra.core.hydra_config import HydraConfig
from small_runs import RECIPES, configured, contents, recipe

from torchrl_bmrl.errors import ConfigError, StoppedError

SMALL = [
    "preset=smoke",
    "tasks=[reach,lift,push_up]",
    "collect.train_episodes={default:1,lift:1}",
    "bcq.epochs=1",
    "bcq.updates_per_epoch=6",
    "bcq.batch_size=8",
    "bcq.num_cells=[16,16]",
    "evaluate.num_candidates=5",
]
REACH = ["preset=smoke", "tasks=[reach]", "collect.train_episodes={default:1,lift:1}", "workers=1"]


@pytest.fixture(scope="module")
def beside() -> Iterator[None]:
    """The recipes' modules, importable as they are for a script beside them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(RECIPES))
        yield


@pytest.fixture(scope="module")
def run(beside: None) -> Callable[..., Path]:
    """Runs a recipe's function alone, in this process."""
    pytest.importorskip("robosuite", exc_type=ImportError)
    import command

    def run(folder: Path, function: Any, *overrides: str, **options: Any) -> Path:
        config = configured(*overrides, f"run_dir={folder}", "workers=1")
        command.run_recipe(config, function, **options)
        return folder

    return run


# -- what the launcher calls -----------------------------------------------------------------------


def test_a_job_returns_what_went_wrong_and_starts_where_the_sweep_was_started(
    beside: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from hydra_plugins.reporting_sweeper import run_job

    monkeypatch.chdir(tmp_path)  # puts the folder back afterwards
    (tmp_path / "sweep").mkdir()
    notes = tmp_path / "notes"
    number = iter(range(4))
    monkeypatch.setattr(
        HydraConfig, "get", lambda: SimpleNamespace(job=SimpleNamespace(num=next(number)))
    )

    def well(config: Any) -> None:
        Path("here").touch()

    def expected(config: Any) -> None:
        raise SystemExit(1) from ConfigError("seed is -1")

    def unexpected(config: Any) -> None:
        raise KeyError("robot")

    assert run_job(well, str(tmp_path / "sweep"), str(notes), {}) is None
    assert (tmp_path / "sweep" / "here").exists()
    assert run_job(expected, str(tmp_path), str(notes), {}) == "error: seed is -1"
    report = run_job(unexpected, str(tmp_path), str(notes), {})
    assert "in unexpected" in report
    assert "KeyError: 'robot'" in report
    missing = run_job(well, str(tmp_path / "elsewhere"), str(notes), {})
    assert "FileNotFoundError" in missing
    kept = [(notes / str(number)).read_text() for number in range(4)]
    assert kept == ["", "error: seed is -1", report, missing]


@pytest.mark.parametrize("cause", [StoppedError(signal.SIGTERM), KeyboardInterrupt()])
def test_a_job_that_is_asked_to_stop_stops_the_sweep(
    beside: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cause: BaseException
) -> None:
    from hydra_plugins.reporting_sweeper import run_job

    monkeypatch.chdir(tmp_path)

    def stopped(config: Any) -> None:
        raise SystemExit(143) from cause

    with pytest.raises(SystemExit) as end:
        run_job(stopped, str(tmp_path), str(tmp_path), {})
    assert end.value.code == 143
    assert list(tmp_path.iterdir()) == []


# -- sweeps whose jobs fail ------------------------------------------------------------------------

RECIPE = f"""
import os, signal, time
import hydra, command
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.run.logs import write_line

@hydra.main(version_base="1.3", config_path={str(RECIPES / "config")!r}, config_name="recipe")
def main(config):
    with exit_codes():
        if config.seed == 1:
            raise ConfigError("no seed for me")
        if config.seed == 3:
            raise KeyError("robot")
        if config.seed == 5:
            time.sleep(3)  # the others are done by then
            os.kill(os.getpid(), signal.SIGKILL)
        with open(f"{{config.run_dir}}-{{config.seed}}", "x"):
            pass

if __name__ == "__main__":
    main()
"""
"""Fails in ways that its seed decides."""


def sweep(cwd: Path, *overrides: str, **variables: str) -> tuple[int, str, set[str]]:
    """Exit code of a sweep, what it says, and the files of the jobs that went well."""
    (cwd / "failing.py").write_text(RECIPE)
    path = os.pathsep.join(filter(None, [str(RECIPES), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "failing.py", "--multirun", *overrides],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"} | variables,
        capture_output=True,
        text=True,
        timeout=600,
    )
    (cwd / "failing.py").unlink()
    for left in cwd.glob("runs/multirun/*/*"):
        assert left.name == "multirun.yaml"
    return done.returncode, done.stderr, {path.name for path in cwd.iterdir() if path.is_file()}


LAUNCHERS = {
    "basic": [],
    "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    "ray": ["hydra/launcher=cluster", "+hydra.launcher.ray.init.num_cpus=2"],
}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_job_that_fails_is_named_and_the_others_are_done(
    tmp_path: Path, launcher: str
) -> None:
    if launcher != "basic":
        pytest.importorskip(f"hydra_plugins.hydra_{launcher}_launcher")
    options = ["seed=0,1,2,3,4", "run_dir=1.10", *LAUNCHERS[launcher]]
    code, said, files = sweep(tmp_path, *options)
    assert code == 1
    assert files == {"1.10-0", "1.10-2", "1.10-4"}, said
    lines = said.partition("2 of 5 jobs failed; the others are done:\n")[2].splitlines()
    assert lines[:2] == ["seed=1 run_dir='1.10'", "    error: no seed for me"]
    assert lines[2:4] == ["seed=3 run_dir='1.10'", "    Traceback (most recent call last):"]
    assert lines[-1] == "KeyError: 'robot'"


@pytest.mark.slow
def test_every_job_of_a_sweep_resolves_references_itself(tmp_path: Path) -> None:
    code, said, files = sweep(tmp_path, "seed=0,2", "run_dir=y${seed}")
    assert (code, files) == (0, {"y0-0", "y2-2"}), said


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["joblib", "ray"])
def test_jobs_that_failed_are_named_though_another_ones_process_was_killed(
    tmp_path: Path, launcher: str
) -> None:
    pytest.importorskip(f"hydra_plugins.hydra_{launcher}_launcher")
    options = ["seed=0,1,5", "run_dir=x", *LAUNCHERS[launcher]]
    code, said, files = sweep(tmp_path, *options)
    assert (code, files) == (1, {"x-0"}), said
    lines = said.partition("2 of 3 jobs failed; the others are done:\n")[2].splitlines()
    assert lines[:3] == ["seed=1 run_dir=x", "    error: no seed for me", "seed=5 run_dir=x"]
    assert lines[3].startswith("    not finished: ")
    assert "Traceback" not in said


@pytest.mark.slow
def test_ray_starts_on_this_machine_whatever_address_a_killed_cluster_left(tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_ray_launcher")
    with tempfile.TemporaryDirectory(prefix="ray-", dir="/tmp") as folder:  # a short path
        (Path(folder) / "ray").mkdir()
        (Path(folder) / "ray" / "ray_current_cluster").write_text("127.0.0.1:9")
        options = ["seed=0,2", "run_dir=x", *LAUNCHERS["ray"]]
        code, said, files = sweep(tmp_path, *options, RAY_TMPDIR=folder)
    assert (code, files) == (0, {"x-0", "x-2"}), said


@pytest.mark.slow
def test_jobs_that_are_not_valid_are_all_named_before_anything_is_done(tmp_path: Path) -> None:
    options = ["bcq.lr=abc,1e-3,def", "run_dir=x", "hydra.sweeper.max_batch_size=1"]
    code, said, _ = sweep(tmp_path, *options)
    assert code == 1
    assert list(tmp_path.iterdir()) == []
    lines = said.partition("2 of 3 jobs are not valid; none was started:\n")[2].splitlines()
    assert [line for line in lines if not line.startswith(" ")] == [
        "bcq.lr=abc run_dir=x",
        "bcq.lr=def run_dir=x",
    ]
    assert "Error merging override bcq.lr=abc; Value 'abc' of type 'str' could not be" in lines[1]


@pytest.mark.slow
def test_a_batch_goes_on_after_one_whose_jobs_failed(tmp_path: Path) -> None:
    options = ["seed=1,3,2", "run_dir=x", "hydra.sweeper.max_batch_size=1"]
    code, said, files = sweep(tmp_path, *options)
    assert (code, files) == (1, {"x-2"})
    assert "2 of 3 jobs failed; the others are done:\nseed=1 run_dir=x\n" in said
    assert "\nseed=3 run_dir=x\n" in said


# -- sweeps ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alone(run: Any, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, bytes]]:
    """The data of seeds 0 and 2, each collected by a run of its own."""
    from torchrl_bmrl.pipeline import collect

    folders = [tmp_path_factory.mktemp("alone") for _ in range(2)]
    for folder, seed in zip(folders, (0, 2), strict=True):
        run(folder, collect, *REACH, f"seed={seed}")
    return [contents(folder, "data/**/*") for folder in folders]


@pytest.fixture
def cluster() -> Iterator[str]:
    """Address of a Ray cluster of two nodes with one core each, which started elsewhere."""
    utils = pytest.importorskip("ray.cluster_utils")
    folder = tempfile.mkdtemp(prefix="ray-", dir="/tmp")  # sockets' paths must be short
    # Ray notes a cluster's address in its usual folder, which is not there before its first use.
    Path(importlib.import_module("ray._private.utils").get_ray_address_file(None)).parent.mkdir(
        parents=True, exist_ok=True
    )
    options = {"num_cpus": 1, "include_dashboard": False, "temp_dir": folder}
    for left in reversed(range(3)):  # Ray gives a node 30 s to start, whatever else runs
        nodes = utils.Cluster()
        try:
            nodes.add_node(**options)
            nodes.add_node(num_cpus=1)
            break
        except Exception:
            nodes.shutdown()
            if not left:
                raise
    try:
        yield nodes.address
    finally:
        nodes.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


def check_sweep_of_three_seeds(cwd: Path, alone: list[dict[str, bytes]], *launcher: str) -> None:
    """Seeds 0 and 2 give what they give alone; seed 1 finds its folder taken and is reported."""
    taken = cwd / "runs" / "collect-smoke-seed1"
    taken.mkdir(parents=True)
    (taken / "config.yaml").write_text(yaml.safe_dump({"seed": 7}))
    done = recipe("collect", "--multirun", *REACH, "seed=0,1,2", *launcher, cwd=cwd)
    assert done.returncode == 1
    _, message = done.stderr.split("1 of 3 jobs failed; the others are done:\n")
    names, problem = message.splitlines()
    assert set(REACH) | {"seed=1"} <= set(names.split())
    assert problem.startswith("    error: runs/collect-smoke-seed1: ")
    assert problem.endswith("use the same settings to continue, or another run_dir")
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    for seed, expected in zip((0, 2), alone, strict=True):
        assert len(expected) > 3
        assert contents(cwd / "runs" / f"collect-smoke-seed{seed}", "data/**/*") == expected
    assert [path.name for path in taken.iterdir()] == ["config.yaml"]
    assert [path.name for path in cwd.iterdir()] == ["runs"]
    assert [path.name for path in cwd.glob("runs/multirun/*/*")] == ["multirun.yaml"]


@pytest.mark.robosuite
@pytest.mark.slow
def test_jobs_one_after_the_other_are_single_runs(alone: Any, tmp_path: Path) -> None:
    check_sweep_of_three_seeds(tmp_path, alone)


@pytest.mark.robosuite
@pytest.mark.slow
def test_jobs_in_processes_are_single_runs(alone: Any, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    check_sweep_of_three_seeds(tmp_path, alone, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")


@pytest.mark.robosuite
@pytest.mark.slow
def test_jobs_on_a_cluster_are_single_runs(alone: Any, tmp_path: Path, cluster: str) -> None:
    pytest.importorskip("hydra_plugins.hydra_ray_launcher")
    address = f"hydra.launcher.ray.init.address='{cluster}'"
    check_sweep_of_three_seeds(tmp_path, alone, "hydra/launcher=cluster", address)


@pytest.mark.robosuite
@pytest.mark.slow
def test_agents_spread_over_jobs_are_those_of_one_run(run: Any, tmp_path: Path) -> None:
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher")
    from torchrl_bmrl.pipeline import collect, stage1

    one = run(tmp_path / "one", collect, *SMALL)
    spread = tmp_path / "spread"
    shutil.copytree(one / "data", spread / "data")
    run(one, stage1, *SMALL)
    # Two agents in a job: its workers are processes of a process.
    options = ["run_dir=spread", "workers=2", "only=[reach,lift],[push_up]", "logger=none"]
    launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    done = recipe("train_bcq", "--multirun", *SMALL, *options, *launcher, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    expected = contents(one, "bcq/**/*")
    assert len(expected) == 12  # checkpoint, best networks, rollouts and diagnostics of each
    assert contents(spread, "bcq/**/*") == expected


@pytest.mark.robosuite
def test_a_recipe_that_does_not_split_refuses_only_some_tasks(
    run: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import stage2

    with pytest.raises(SystemExit):
        run(tmp_path / "run", stage2, *SMALL, "only=[reach]")
    assert "error: only is ['reach']; valid: null, except with" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
