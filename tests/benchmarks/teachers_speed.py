"""Time and memory of both stages as the number of tasks grows, with the sizes of preset family.

    python tests/benchmarks/teachers_speed.py [--rounds 10] [--tasks 1 6 40 160]

Stage 1: BCQ agents as one StackedLoss, beside agents that are trained alone, one after the other.
Stage 2: MetaDistillationLoss with an encoder of sets. The variants take turns in one process; times
are medians over rounds, and ratios medians of the rounds' ratios. On the CPU the process's own time
counts, so that other work on the machine has little influence. Memory is the largest resident size
of a fresh process that makes a few updates, less that of a process that has imported everything.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

import torch
from bcq_speed import (
    ACTION_DIM,
    LR,
    OBSERVATION_DIM,
    Update,
    make_batch,
    make_library_update,
    read_options,
    wait,
)
from tensordict import TensorDict

from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.objectives import BCQLoss, StackedLoss
from torchrl_bmrl.pipeline.agents import make_bcq_loss
from torchrl_bmrl.pipeline.student import Student, make_distillation_loss
from torchrl_bmrl.training import gradient_step, keep_freed_memory, make_adam

TASKS = (1, 6, 40, 160)
ROWS, CELLS, UPDATES = 64, (128, 128), 3
ALONE, STACKED, STAGE_2 = "alone", "stacked", "stage 2"
SIZES = {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM}
Call = Callable[[], Any]


def make_agent() -> BCQLoss:
    """Returns an agent of the preset."""
    return make_bcq_loss(**SIZES, num_cells=CELLS)


def make_data(tasks: int, device: str = "cpu") -> TensorDict:
    """Returns random transitions of every task, ``[tasks, ROWS]``."""
    data = torch.stack([make_batch(ROWS, seed) for seed in range(tasks)])
    data["task"] = torch.arange(tasks).unsqueeze(-1).expand(tasks, ROWS).clone()
    return data.to(device)


def make_alone(tasks: int, device: str = "cpu") -> Call:
    """Returns an update of one agent, whatever the number of tasks: one is in memory at a time."""
    update, batch = make_library_update(make_agent().to(device), device=device), make_batch(ROWS)
    batch = batch.to(device)
    return lambda: update(batch)


def make_stacked(tasks: int, device: str = "cpu") -> Call:
    """Returns an update of all agents in one stack."""
    stack = StackedLoss([make_agent() for _ in range(tasks)]).to(device)
    update: Update = make_library_update(stack, device=device)
    data = make_data(tasks, device).select(*stack.in_keys)
    return lambda: update(data)


def make_stage_2(tasks: int, device: str = "cpu") -> Call:
    """Returns an update of the distillation of all agents into one student."""
    teachers = [BCQPolicy.frozen(make_agent()) for _ in range(tasks)]
    student = Student(
        num_tasks=tasks, task_encoder="set_attention", task_latent_dim=8, infers=True, **SIZES
    )
    loss = make_distillation_loss(
        student,
        teachers,
        classification_weight=None,
        isometry_weight=0.0,
        context="set",
        context_fraction=1.0,
        context_size=32,
    ).to(device)
    optimizer, data = make_adam(loss.parameters(), lr=LR), make_data(tasks, device)

    def update() -> None:
        losses = loss(data)
        gradient_step(
            optimizer, sum(value for name, value in losses.items() if name.startswith("loss_"))
        )

    return update


MAKERS: dict[str, Callable[[int, str], Call]] = {
    ALONE: make_alone,
    STACKED: make_stacked,
    STAGE_2: make_stage_2,
}


def measure(calls: dict[Any, Call], *, rounds: int, device: str) -> dict[Any, list[float]]:
    """Returns the seconds of each call, by name; they take turns."""
    clock = process_time if device == "cpu" else perf_counter
    for call in calls.values():
        call(), call()
    seconds: dict[Any, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            count = 10 if name == (ALONE, 1) else 1  # as exact as the longer ones
            wait(device)
            start = clock()
            for _ in range(count):
                call()
            wait(device)
            seconds[name].append((clock() - start) / count)
    return seconds


def largest_size() -> float:
    """Returns the largest resident size of this process so far [MB], on Linux."""
    # Not getrusage: a new process starts with the size of the one that started it.
    lines = Path("/proc/self/status").read_text().splitlines()
    (size,) = (line.split()[1] for line in lines if line.startswith("VmHWM"))
    return int(size) * 1024 / 1e6


def memory(name: str, tasks: int, device: str) -> float:
    """Returns what a fresh process needs for a few updates [MB]."""
    words = [sys.executable, __file__, "--only", name, "--tasks", str(tasks), "--device", device]
    return float(subprocess.run(words, check=True, capture_output=True, text=True).stdout)


def print_memory(name: str, tasks: int, device: str) -> None:
    """Prints how much the largest resident size grows with a few updates [MB]."""
    before = largest_size()
    call = MAKERS[name](tasks, device)
    for _ in range(UPDATES):
        call()
    wait(device)
    allocated = torch.cuda.max_memory_allocated() / 1e6 if device == "cuda" else None
    print(allocated or largest_size() - before)


def stage_1_rows(tasks: Iterable[int], rounds: int, device: str) -> list[str]:
    """Returns the lines of the table of stage 1."""
    calls = {(ALONE, 1): make_alone(1, device)}
    calls |= {(STACKED, n): make_stacked(n, device) for n in tasks}
    seconds = measure(calls, rounds=rounds, device=device)
    alone, least = seconds[ALONE, 1], memory(ALONE, 1, device)
    lines = []
    for n in tasks:
        stacked, held = seconds[STACKED, n], memory(STACKED, n, device)
        ratio = median(a / (n * b) for a, b in zip(stacked, alone, strict=True))
        lines.append(
            f"| {n} | {1e3 * median(stacked):.1f} | {1e3 * n * median(alone):.1f} | {ratio:.2f} "
            f"| {held:.0f} | {least:.0f} |"
        )
    return lines


def stage_2_rows(tasks: Iterable[int], rounds: int, device: str) -> list[str]:
    """Returns the lines of the table of stage 2."""
    sizes = [n for n in tasks if n > 1]
    calls = {(STAGE_2, n): make_stage_2(n, device) for n in sizes}
    seconds = measure(calls, rounds=rounds, device=device)
    first = seconds[STAGE_2, sizes[0]]
    lines = []
    for n in sizes:
        mine, held = seconds[STAGE_2, n], memory(STAGE_2, n, device)
        ratio = median(a * sizes[0] / (n * b) for a, b in zip(mine, first, strict=True))
        lines.append(
            f"| {n} | {1e3 * median(mine):.1f} | {1e3 * median(mine) / n:.2f} | {ratio:.2f} "
            f"| {held:.0f} |"
        )
    return lines


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    options: dict[str, dict[str, Any]] = {
        "--tasks": {"type": int, "nargs": "+", "default": list(TASKS), "help": "numbers of tasks"},
        "--only": {"choices": list(MAKERS), "help": "print the memory of this variant alone"},
    }
    args = read_options(__doc__, arguments, options)
    torch.set_num_threads(1)
    keep_freed_memory()  # as the recipes do
    if args.only:
        print_memory(args.only, args.tasks[0], args.device)
        return
    print("| Agents | Stacked [ms] | Alone [ms] | Ratio | Stacked [MB] | Alone [MB] |")
    print("|---:|---:|---:|---:|---:|---:|", flush=True)
    print(*stage_1_rows(args.tasks, args.rounds, args.device), sep="\n", end="\n\n", flush=True)
    print("| Tasks | Update [ms] | Per task [ms] | Ratio to the first | Memory [MB] |")
    print("|---:|---:|---:|---:|---:|", flush=True)
    print(*stage_2_rows(args.tasks, args.rounds, args.device), sep="\n", flush=True)


if __name__ == "__main__":
    main()
