"""Time and memory from demonstration files to the first sample, at the paper's size.

    python tests/benchmarks/data_loading.py                  # 1,400 episodes of 200 steps
    python tests/benchmarks/data_loading.py --share 0.1

First it writes files of random numbers in the layout of recipes/collect.py. Then one new process
converts them and another loads them; both print time and memory.
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import argparse
import resource
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import torch

from torchrl_bmrl.data import Episode, make_multi_task_replay_buffer
from torchrl_bmrl.data.demonstrations import (
    demonstration_path,
    load_transitions,
    read_statistics,
    write_statistics,
)
from torchrl_bmrl.data.robomimic import write_episodes
from torchrl_bmrl.tasks import DemonstrationFiles, Task

HORIZON = 200
PAPER = {"reach": 500, "lift": 500} | {f"push_{i}": 100 for i in range(4)}
TASKS = [Task(name=name, files=DemonstrationFiles(path=f"{name}.hdf5")) for name in PAPER]
SIZES = {
    **{"robot0_joint_pos": 7, "robot0_gripper_qpos": 2, "robot0_joint_vel": 7},
    **{"robot0_eef_pos": 3, "robot0_eef_quat": 4, "goal_pos": 3},
}


def random_episode(rng: np.random.Generator) -> Episode:
    """Returns an episode as large as a recorded one, including model and states."""
    parts = {name: rng.standard_normal((HORIZON + 1, size)) for name, size in SIZES.items()}
    return Episode(
        observations={name: part[:-1] for name, part in parts.items()},
        next_observations={name: part[1:] for name, part in parts.items()},
        actions=rng.uniform(-1, 1, (HORIZON, 7)).astype(np.float32),
        rewards=rng.random(HORIZON),
        terminated=np.zeros(HORIZON, bool),
        extras={
            "successes": rng.random(HORIZON) < 0.1,
            "phases": np.zeros(HORIZON, np.int8),
            "states": rng.standard_normal((HORIZON, 34)),
        },
        attributes={"seed": 0, "model_file": "x" * 41_000},
    )


def write(folder: Path, share: float) -> float:
    """Writes files of all tasks; returns the seconds."""
    start = time.perf_counter()
    rng = np.random.default_rng(0)
    for task, episodes in PAPER.items():
        count = max(1, round(share * episodes))
        write_episodes(
            demonstration_path(folder, task),
            (random_episode(rng) for _ in range(count)),
            env_args={},
            masks={"train": range(count)},
        )
    return time.perf_counter() - start


@contextmanager
def timed(name: str, seconds: dict[str, float]) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start


def load(folder: Path, batch_size: int) -> tuple[dict[str, float], int, float, float]:
    """Returns seconds by stage, transitions, milliseconds per sample, peak memory [GB]."""
    torch.set_num_threads(1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds: dict[str, float] = {}
    with timed("statistics, converting what is new", seconds):
        write_statistics(folder, TASKS)
    statistics = read_statistics(folder)
    with timed("transitions, normalised", seconds):
        data = [
            load_transitions(folder, task, statistics, split="train", index=i)
            for i, task in enumerate(TASKS)
        ]
    with timed("multi-task buffer", seconds):
        buffer = make_multi_task_replay_buffer(data, batch_size=batch_size)
    for _ in range(20):
        buffer.sample()
    start, count = time.perf_counter(), 200
    for _ in range(count):
        buffer.sample()
    sample = 1000 * (time.perf_counter() - start) / count
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"  (imports alone: {before / 1e6:.2f} GB)")
    return seconds, sum(map(len, data)), sample, peak / 1e6


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of the paper's episodes")
    parser.add_argument("--batch-size", type=int, default=256, help="of each task")
    options = parser.parse_args()
    context = get_context("spawn")  # a fresh process: its peak memory is its own
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with context.Pool(1) as pool:
            seconds = pool.apply(write, (folder, options.share))
            pool.close()
            pool.join()
        size = sum(path.stat().st_size for path in folder.glob("*.hdf5"))
        print(f"files: {size / 1e6:.0f} MB, written in {seconds:.1f} s")
        for round_name in ("first time", "again"):
            with context.Pool(1) as pool:
                seconds, transitions, sample, peak = pool.apply(load, (folder, options.batch_size))
                pool.close()
                pool.join()
            print(f"{round_name}: {transitions:,} transitions, peak memory {peak:.2f} GB")
            for stage, value in seconds.items():
                print(f"  {stage:<36} {value:6.2f} s")
            print(f"  a sample of {len(PAPER)} x {options.batch_size:<21} {sample:6.2f} ms")


if __name__ == "__main__":
    main()
