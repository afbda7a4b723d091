"""Times an update and an action of BCQ with each generator, and an action of a distilled student.

    python tests/benchmarks/generator_speed.py [--rounds 40] [--device cuda]

The variants run in turn in one process. Times are medians over the rounds; ratios are medians of
each round's ratio to the autoencoder. On the CPU the process's own time is counted, so that other
work on the machine has little influence; on a GPU it is the time until the GPU has finished.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

from collections.abc import Callable
from itertools import product
from statistics import median
from time import perf_counter, process_time
from typing import Any

import torch
from bcq_speed import (
    ACTION_DIM,
    OBSERVATION_DIM,
    make_batch,
    make_library_update,
    read_options,
    wait,
    warmed_up,
)
from tensordict import TensorDict
from torch import Tensor

from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.objectives import BCQLoss
from torchrl_bmrl.pipeline.agents import GENERATORS, make_bcq_loss
from torchrl_bmrl.pipeline.student import Student
from torchrl_bmrl.training import keep_freed_memory

BATCH_SIZES, CRITICS, TARGET_CANDIDATES = (128, 256), (2, 4), (4, 10)
STATES, CANDIDATES = (1, 50), (8, 100)
FIRST = "autoencoder"
STUDENT = "student of a flow"
Medians = dict[str, tuple[float, float]]


def make_loss(generator: str, device: str = "cpu", **options: Any) -> BCQLoss:
    """Returns an agent of 256x256 networks whose critics have normalised layers."""
    torch.manual_seed(0)
    sizes = {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM}
    return make_bcq_loss(**sizes, generator=generator, layer_norm=True, **options).to(device)


def updates(
    rows: int, num_qvalue_nets: int, num_candidates: int, device: str = "cpu"
) -> dict[str, Callable[[], Any]]:
    """Returns one update of an agent for each generator."""
    batch, made = make_batch(rows).to(device), {}
    for name in GENERATORS:
        options = {"num_qvalue_nets": num_qvalue_nets, "num_candidates": num_candidates}
        loss = make_loss(name, device, **options)
        made[name] = warmed_up(make_library_update(loss), [batch])
    return {name: lambda update=update: update(batch) for name, update in made.items()}


def policies(num_candidates: int, device: str = "cpu") -> dict[str, BCQPolicy]:
    """Returns policies that value by one critic, those that value by four, and a student."""
    made = {
        f"{name}{note}": BCQPolicy.frozen(
            make_loss(name, device, **options), num_candidates=num_candidates
        )
        for note, options in (
            ("", {}),
            (", mean of 4 critics", {"num_qvalue_nets": 4, "acting_rule": "mean"}),
        )
        for name in GENERATORS
    }
    student = Student(
        num_tasks=6,
        observation_dim=OBSERVATION_DIM,
        action_dim=ACTION_DIM,
        latent_dim=ACTION_DIM,  # the flow's
    ).to(device)
    made[STUDENT] = student.policy(num_candidates=num_candidates, latent_clip=None)
    return made


def acting(
    states: int, num_candidates: int, device: str = "cpu"
) -> dict[str, Callable[[], Tensor]]:
    """Returns one call of each policy, all for the same states."""
    state = {
        "observation": torch.randn(states, OBSERVATION_DIM, device=device),
        "task_latent": torch.randn(states, 2, device=device),
    }
    return {
        name: lambda policy=policy: policy(TensorDict(state, [states]))["action"]
        for name, policy in policies(num_candidates, device).items()
    }


def measure(ways: dict[str, Callable[[], Any]], *, rounds: int, calls: int, device: str) -> Medians:
    """Returns each way's median milliseconds of a call, and its median ratio to the first way."""
    clock = process_time if device == "cpu" else perf_counter
    seconds: list[dict[str, float]] = []
    for number in range(rounds + 2):
        spent = {}
        for name in list(ways) if number % 2 == 0 else reversed(ways):
            wait(device)
            start = clock()
            for _ in range(calls):
                ways[name]()
            wait(device)
            spent[name] = (clock() - start) / calls
        seconds.append(spent)
    counted = seconds[2:]  # the first rounds fill the caches
    return {
        name: (
            1000 * median(spent[name] for spent in counted),
            median(spent[name] / spent[FIRST] for spent in counted),
        )
        for name in ways
    }


def print_table(title: str, columns: dict[str, Medians]) -> None:
    """Prints a row for each way, and in each column its milliseconds and its ratio."""
    print(f"| {title} | {' | '.join(columns)} |\n|---|{'---:|' * len(columns)}")
    for name in next(iter(columns.values())):
        cells = [f"{column[name][0]:.2f} ({column[name][1]:.2f})" for column in columns.values()]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    args = read_options(__doc__, arguments)
    torch.set_num_threads(1)
    keep_freed_memory()  # as the recipes do
    options = {"rounds": args.rounds, "device": args.device}
    for rows in BATCH_SIZES:
        columns = {
            f"{critics} critics, {candidates} candidates": measure(
                updates(rows, critics, candidates, args.device), calls=2, **options
            )
            for critics, candidates in product(CRITICS, TARGET_CANDIDATES)
        }
        print_table(f"Update, batch {rows}", columns)
        print()
    columns = {
        f"{states} state{'s' * (states > 1)}, N = {candidates}": measure(
            acting(states, candidates, args.device), calls=5, **options
        )
        for states, candidates in product(STATES, CANDIDATES)
    }
    print_table("Action", columns)


if __name__ == "__main__":
    main()
