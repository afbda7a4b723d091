"""Workers that are copies of a server: what they share with it and what is their own."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("tqdm")

from torchrl_bmrl.run.forked import FOR_THE_RUN, METHOD, held_signals

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(METHOD != "forkserver", reason="workers are copies on Linux only"),
]

SCRIPT = """
import json, os, signal, sys, time
from multiprocessing import forkserver
from torchrl_bmrl.run.workers import run_jobs

OPTIONS = {"workers": 2, "total": 2, "description": "working", "unit": "job"}

def before(job, report):
    return {"modules": [name for name in ("wave", "broken") if name in sys.modules],
            "said": os.environ.get("SAID"),
            "of_the_server": "TORCHRL_BMRL_SERVER_IMPORTS" in os.environ,
            "handler": str(signal.getsignal(signal.SIGTERM))}

def draw(job, report):
    import numpy
    time.sleep(0.5)
    return numpy.random.rand()

def server():
    return forkserver._forkserver._forkserver_pid
"""


def run(folder: Path, *lines: str) -> list[Any]:
    """Runs lines of a script with the functions above; returns what they print, as JSON."""
    (folder / "broken.py").write_text("raise ValueError('no import')\n")
    script = folder / "script.py"
    body = "\n".join(f"    {line}" for line in lines)
    script.write_text(f'{SCRIPT}\nif __name__ == "__main__":\n{body}\n')
    done = subprocess.run(
        [sys.executable, str(script)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_workers_have_imported_what_their_server_has_and_an_import_that_fails_stops_no_worker(
    tmp_path: Path,
) -> None:
    (found,) = run(
        tmp_path,
        'preload = ["broken", "no_such_module", "wave"]',
        "print(json.dumps(run_jobs(before, [0, 1], preload=preload, **OPTIONS)))",
    )
    assert [each["modules"] for each in found] == [["wave"], ["wave"]]
    assert not any(each["of_the_server"] for each in found)


def test_a_worker_has_the_environment_of_the_moment_and_handles_its_own_signals(
    tmp_path: Path,
) -> None:
    first, second, third = run(
        tmp_path,
        'os.environ["SAID"] = "first"',
        "print(json.dumps(run_jobs(before, [0, 1], **OPTIONS)))",
        'os.environ["SAID"] = "later"',
        "print(json.dumps(run_jobs(before, [0, 1], **OPTIONS)))",
        'del os.environ["SAID"]',
        "print(json.dumps(run_jobs(before, [0, 1], **OPTIONS)))",
    )
    said = [each["said"] for each in first + second + third]
    assert said == ["first", "first", "later", "later", None, None]
    assert all("note" in each["handler"] for each in first + second + third)


def test_workers_do_not_draw_the_same_without_a_seed(tmp_path: Path) -> None:
    (found,) = run(tmp_path, "print(json.dumps(run_jobs(draw, [0, 1], **OPTIONS)))")
    assert found[0] != found[1]


def test_a_killed_server_is_replaced(tmp_path: Path) -> None:
    first, second, pids = run(
        tmp_path,
        "print(json.dumps(run_jobs(before, [0, 1], **OPTIONS)))",
        "pids = [server()]",
        "os.kill(pids[0], signal.SIGKILL)",
        "time.sleep(0.5)",
        "print(json.dumps(run_jobs(before, [0, 1], **OPTIONS)))",
        "print(json.dumps([*pids, server()]))",
    )
    assert len(first) == len(second) == 2
    assert pids[0] != pids[1]


def test_signals_to_all_processes_leave_the_server_to_its_workers(tmp_path: Path) -> None:
    (alive,) = run(
        tmp_path,
        "run_jobs(before, [0, 1], **OPTIONS)",
        "for name in ('SIGINT', 'SIGTERM', 'SIGHUP'):",
        "    os.kill(server(), getattr(signal, name))",
        "time.sleep(0.5)",
        "print(json.dumps(os.waitpid(server(), os.WNOHANG)[0] == 0))",
    )
    assert alive


def test_a_worker_without_a_handler_of_its_own_is_ended_by_its_parent(tmp_path: Path) -> None:
    (code,) = run(
        tmp_path,
        "import multiprocessing",
        "from torchrl_bmrl.run.forked import METHOD, start_server",
        "start_server()",
        "context = multiprocessing.get_context(METHOD)",
        "process = context.Process(target=time.sleep, args=(60,), daemon=True)",
        "process.start()",
        "time.sleep(2)",
        "process.terminate()",
        "process.join(20)",
        "print(json.dumps(process.exitcode))",
    )
    assert code == -15


STARTING = """
import os, signal, sys, time
from multiprocessing import forkserver
from torchrl_bmrl.run.forked import start_server

start_server()
server = forkserver._forkserver._forkserver_pid
os.kill(server, getattr(signal, sys.argv[1]))
time.sleep(1.0)
print(os.waitpid(server, os.WNOHANG)[0] == 0)
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_signals_to_all_processes_leave_alone_a_server_that_starts(name: str) -> None:
    command = [sys.executable, "-c", STARTING, name]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("True\n", "")


def test_a_process_that_starts_gets_its_signals_when_it_is_ready() -> None:
    script = "import time; print('ready', flush=True); time.sleep(0.3); print('done')"
    with held_signals():
        process = subprocess.Popen(
            [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, []) & set(FOR_THE_RUN)
    for number in FOR_THE_RUN:
        process.send_signal(number)
    assert process.communicate() == (b"ready\ndone\n", b"")


@pytest.mark.parametrize(
    ("arguments", "beside", "imports"),
    [
        ([], "command.py", ["torchrl_bmrl.pipeline", "torchrl_bmrl.envs.vector"]),
        (["preset=smoke", "tasks=[reach]"], "command.py", ["torchrl_bmrl.pipeline"]),
        (["--help"], "command.py", None),
        (["preset=smoke", "workers=1"], "command.py", None),
        ([], "other.py", None),
    ],
)
def test_a_recipe_starts_its_server_before_it_imports_torch(
    tmp_path: Path, arguments: list[str], beside: str, imports: list[str] | None
) -> None:
    (tmp_path / beside).touch()
    script = tmp_path / "recipe.py"
    script.write_text(
        "import json, sys\n"
        "from multiprocessing import forkserver\n"
        "from torchrl_bmrl.run import forked\n"
        "start, given = forked.start_server, []\n"
        "forked.start_server = lambda *names: [given.append(names), start(*names)]\n"
        "import torchrl_bmrl.run.early_server\n"
        "server = forkserver._forkserver._forkserver_pid\n"
        "print(json.dumps([server is not None, given, 'torch' in sys.modules]))\n"
    )
    done = subprocess.run(
        [sys.executable, str(script), *arguments], capture_output=True, text=True, check=True
    )
    given = [] if imports is None else [imports]
    assert json.loads(done.stdout) == [imports is not None, given, False]


@pytest.mark.robosuite
def test_the_simulator_of_a_task_is_all_that_its_environment_imports(tmp_path: Path) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    before, after = run(
        tmp_path,
        "import importlib, torchrl_bmrl.pipeline",
        "from torchrl_bmrl.envs.transforms import make_env",
        "from torchrl_bmrl.tasks import get_task",
        "importlib.import_module(get_task('lift').simulator)",
        "count = lambda: sorted(n for n in sys.modules if n.startswith(('robosuite', 'mujoco')))",
        "print(json.dumps(count()))",
        "make_env('lift', num_envs=2).rollout(2)",
        "print(json.dumps(count()))",
    )
    assert before == after
    assert len(before) > 100
