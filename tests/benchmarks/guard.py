"""Compares this checkout with a given commit: the times and the memory that people wait for.

    python tests/benchmarks/guard.py 6a526b6                    # every row but the long ones
    python tests/benchmarks/guard.py 6a526b6 --rows quick       # README's run, with its memory
    python tests/benchmarks/guard.py 6a526b6 --rows paper --rounds 1

Each row runs the same command in both checkouts in turn, in an environment that both take, and
prints both medians with their ranges and the median of the rounds' ratios; stderr gets each round
as it ends. A commit that lacks a command gets no number. Linux only: memory is the sum of the
proportional set sizes of all processes (``/proc/PID/smaps_rollup``), in which memory that processes
share counts once.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median

import yaml

from torchrl_bmrl.evaluation import read_results, summarise

ROOT = Path(__file__).resolve().parents[2]
Values = dict[str, float]
SHORTENED = (
    "collect.valid_episodes",
    "bcq.updates_per_epoch",
    "bcq.eval_episodes",
    "distill.updates",
    "evaluate.episodes",
)

IMPORT = """
import sys, time
import torch, tensordict, torchrl, torchrl.data, torchrl.modules, torchrl.objectives
import torchrl.objectives.value, tensordict.nn
start = time.perf_counter()
import torchrl_bmrl.objectives
print(time.perf_counter() - start)
"""
FIRST_STEP = """
import time
import gymnasium, numpy
env = gymnasium.make("torchrl_bmrl.envs:bmrl/SawyerLift-v0")
env.reset(seed=0)
start = time.perf_counter()
env.step(numpy.zeros(7))
print(time.perf_counter() - start)
"""
WORKERS = """
import sys, time
import torchrl_bmrl.experts.collect
try:
    from torchrl_bmrl.run.workers import run_jobs
except ImportError:
    from torchrl_bmrl.parallel import run_jobs
known = run_jobs.__code__.co_varnames
options = {"preload": ["torchrl_bmrl.envs.vector"]} if "preload" in known else {}

def job(number, report):
    import torchrl_bmrl.envs.vector  # the simulator
    return time.time()

if __name__ == "__main__":
    for _ in range(2):  # those of a later stage of a run count
        start = time.time()
        ends = run_jobs(job, [0, 1], workers=2, total=2, description="", unit="", **options)
    print(max(ends) - start)
"""


def measured(command: list[str], tree: Path, **environment: str) -> tuple[str, float, float]:
    """Returns what a command prints, its seconds, and the peak memory of its processes [MB]."""
    given = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"} | environment
    with tempfile.TemporaryFile("w+") as output:
        start = time.perf_counter()
        process = subprocess.Popen(command, cwd=tree, env=given, stdout=output, stderr=output)
        peak = 0.0
        while process.poll() is None:
            peak = max(peak, sum(map(_memory, _descendants(process.pid))))
            time.sleep(1)  # a look at large processes takes a tenth of a second
        seconds = time.perf_counter() - start
        output.seek(0)
        text = output.read()
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} in {tree} ended with an error:\n{text[-2000:]}")
    return text, seconds, peak


def _descendants(root: int) -> Iterator[int]:
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(folder.name)] = int(
                (folder / "stat").read_text().rsplit(")", 1)[1].split()[1]
            )
        except (OSError, IndexError):
            continue
    todo = [root]
    while todo:
        yield (process := todo.pop())
        todo += [child for child, parent in parents.items() if parent == process]


def _memory(process: int) -> float:
    try:
        text = Path(f"/proc/{process}/smaps_rollup").read_text()
    except OSError:
        return 0.0
    found = re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)
    return int(found[1]) / 1024 if found else 0.0


def printed(script: str, tree: Path, **environment: str) -> float:
    """Returns the last number that a script prints."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "script.py")
        path.write_text(script)
        text = measured([sys.executable, str(path)], tree, **environment)[0]
    return float(text.split()[-1])


def benchmark(tree: Path, name: str, *arguments: str) -> list[list[str]]:
    """Returns the cells of the table that a benchmark prints."""
    command = [sys.executable, f"tests/benchmarks/{name}.py", *arguments]
    text = measured(command, tree)[0]
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in row] for row in rows]


def shortened(tree: Path, preset: str, part: float) -> list[str]:
    """Returns settings for a part of a preset's demonstrations, updates and episodes."""
    given = yaml.safe_load((tree / "recipes" / "config" / "preset" / f"{preset}.yaml").read_text())
    numbers = {
        f"collect.train_episodes.{k}": n for k, n in given["collect"]["train_episodes"].items()
    }
    for name in SHORTENED:
        section, _, key = name.partition(".")
        numbers[name] = given[section][key]
    return [f"{name}={max(1, round(part * number))}" for name, number in numbers.items()]


def run(preset: str, part: float = 1.0) -> Callable[[Path], Values]:
    """Returns a row: a run of a preset, or of a part of it."""

    def row(tree: Path) -> Values:
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "recipes/two_stage.py", f"preset={preset}"]
            command += shortened(tree, preset, part) if part < 1 else []
            _, seconds, peak = measured([*command, f"run_dir={folder}/run"], tree)
            stages = json.loads(Path(folder, "run", "seconds.json").read_text())
            rows = read_results(Path(folder, "run", "results.csv"))
        of = {
            (x.policy, x.task): x for x in summarise(rows) if x.latent_source in ("", "prototype")
        }
        of = {key: each for key, each in of.items() if key[0] in ("bcq", "distilled")}
        returns = {key: each.mean_return for key, each in sorted(of.items())}
        shares = [returns[key] / returns["bcq", key[1]] for key in returns if key[0] != "bcq"]
        return {
            f"{preset}: wall time [s]": seconds,
            **{f"{preset}: {stage} [s]": float(each) for stage, each in stages.items()},
            f"{preset}: peak memory of all processes [MB]": peak,
            f"{preset}: lowest success [%]": 100 * min(x.success_rate or 0.0 for x in of.values()),
            f"{preset}: lowest distilled / BCQ": min(shares),
            **{
                f"{preset}: return of {policy}, {task}": returns[policy, task]
                for policy, task in of
            },
        }

    return row


def updates(tree: Path) -> Values:
    """BCQ's updates, of a compiled stack, as shares of the limit."""
    cells = benchmark(tree, "bcq_speed", "--rounds", "10")
    chosen = [row for row in cells if len(row) == 5 and row[1].startswith("StackedLoss of 6, comp")]
    return {f"BCQ update, batch {row[0]}: share of the limit": float(row[4]) for row in chosen}


def control(tree: Path) -> Values:
    """Control steps per second of the six tasks, and their share of bare physics."""
    from_here = ROOT / "tests/benchmarks/control_step.py"
    text = measured([sys.executable, str(from_here)], tree)[0]
    found = re.findall(r"^(\w+) (\S+) (\S+)$", text, re.MULTILINE)
    return {f"control step, {name} [ms]": float(step) for name, step, _ in found} | {
        f"control step, {name}: bare physics / step": float(share) for name, _, share in found
    }


def acting(tree: Path) -> Values:
    """The best of 100 candidates for 20 states."""
    cells = benchmark(tree, "acting_speed")
    (row,) = [row for row in cells if row[:2] == ["20", "BCQPolicy"]]
    return {"100 candidates, 20 states [ms]": float(row[2])}


def imports(tree: Path) -> Values:
    """The import of the losses, beyond torch and torchrl."""
    return {"import of the losses [s]": printed(IMPORT, tree)}


def first_step(tree: Path) -> Values:
    """The first step of a user, which compiles."""
    with tempfile.TemporaryDirectory() as cache:
        return {"first step of a user [s]": printed(FIRST_STEP, tree, XDG_CACHE_HOME=cache)}


def workers(tree: Path) -> Values:
    """The start of two workers with the simulator."""
    return {"start of a worker [s]": printed(WORKERS, tree)}


ROWS: dict[str, Callable[[Path], Values]] = {
    "import": imports,
    "first_step": first_step,
    "workers": workers,
    "control": control,
    "acting": acting,
    "updates": updates,
    "quick": run("quick"),
    "paper": run("paper"),
    "paper_tenth": run("paper", part=0.1),  # where whole ones take hours
}
LONG = ("quick", "paper", "paper_tenth")


@contextmanager
def checkout(commit: str) -> Iterator[Path]:
    """A worktree of a commit."""
    folder = Path(tempfile.mkdtemp(prefix="guard-"))
    tree = folder / "tree"
    git = ["git", "-C", str(ROOT), "worktree"]
    try:
        subprocess.run([*git, "add", "--quiet", "--detach", str(tree), commit], check=True)
        yield tree
    finally:
        subprocess.run([*git, "remove", "--force", str(tree)], check=False)
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("commit", help="that this checkout is compared with")
    parser.add_argument("--rounds", type=int, default=3)
    short = [name for name in ROWS if name not in LONG]
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=short)
    options = parser.parse_args()
    print(f"| What | {options.commit} | now | now / {options.commit} |\n|---|---:|---:|---:|")
    with checkout(options.commit) as before:
        for name in options.rows:
            rounds: list[tuple[Values, Values]] = []
            for number in range(options.rounds):
                of: dict[Path, Values] = {}
                # Each is first in every other round, so a machine that slows down favours neither.
                for tree in (ROOT, before) if number % 2 == 0 else (before, ROOT):
                    of[tree] = ROWS[name](tree)
                    print(name, number, tree, of[tree], file=sys.stderr, flush=True)
                rounds.append((of[before], of[ROOT]))
            for what in rounds[0][1]:
                pairs = [(old[what], new[what]) for old, new in rounds if what in old]
                old, new = ([pair[i] for pair in pairs] for i in range(2))
                ratio = median(b / a for a, b in pairs)
                print(f"| {what} | {_range(old)} | {_range(new)} | {ratio:.2f} |", flush=True)


def _range(values: list[float]) -> str:
    return f"{median(values):.4g} [{min(values):.4g}, {max(values):.4g}]"


if __name__ == "__main__":
    main()
