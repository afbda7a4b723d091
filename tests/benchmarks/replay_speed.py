"""Time to sample a batch, compared with the time of the update.

    python tests/benchmarks/replay_speed.py [--rows 46000] [--tasks 6] [--batch 256] [--seconds 10]

Stage 1 samples one task's transitions for BCQLoss, stage 2 those of all tasks for
MetaDistillationLoss, both with default options. The parts run in turn on one thread, so that the
caches are in the same state as in training. The table contains medians.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from resource import RUSAGE_SELF, getrusage
from statistics import median
from time import perf_counter
from typing import Any

import torch
from bcq_speed import ACTION_DIM, LR, OBSERVATION_DIM, make_batch, make_library_update, make_pair
from tensordict import TensorDict

from torchrl_bmrl.data import make_multi_task_replay_buffer, make_replay_buffer
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.objectives import MetaDistillationLoss
from torchrl_bmrl.pipeline.student import Student

HORIZON = 200
WARM_UP = 5
Update = Callable[[TensorDict], Any]


def make_data(rows: int, task: int) -> TensorDict:
    """Returns random transitions with the keys of demonstrations."""
    data, number = make_batch(rows, seed=task), torch.arange(rows)
    flags = {name: torch.zeros(rows, 1, dtype=torch.bool) for name in ("truncated", "success")}
    data["next"].update(flags)
    labels = {"task": torch.full((rows,), task), "episode": number // HORIZON}
    return data.update({**labels, "step": number % HORIZON})


def make_distillation_update(num_tasks: int) -> Update:
    """Returns the update of ``recipes/distill.py`` with untrained teachers."""
    teachers = [BCQPolicy.frozen(make_pair(seed)[1]) for seed in range(num_tasks)]
    dims = {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM}
    student = Student(num_tasks=num_tasks, latent_dim=teachers[0].latent_dim, **dims)
    loss = MetaDistillationLoss(
        student.task_encoder,
        student.task_classifier,
        student.generator,
        student.qvalue_network,
        [teacher.generator for teacher in teachers],
        [teacher.qvalue_network for teacher in teachers],
        latent_dim=teachers[0].latent_dim,
        latent_clip=teachers[0].latent_clip,
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=LR)

    def update(batch: TensorDict) -> None:
        losses = loss(batch)
        optimizer.zero_grad(set_to_none=True)
        sum(term for name, term in losses.items() if name.startswith("loss_")).backward()
        optimizer.step()

    return update


@contextmanager
def timed(times: list[float]) -> Iterator[None]:
    start = perf_counter()
    yield
    times.append(perf_counter() - start)


def measure(
    stages: dict[str, tuple[Callable[[], TensorDict], Update]], seconds: float
) -> dict[str, tuple[float, float]]:
    """Returns median seconds of a sample and of an update, by stage."""
    times: dict[str, tuple[list[float], list[float]]] = {name: ([], []) for name in stages}
    for sample, update in stages.values():
        for _ in range(WARM_UP):
            update(sample())
    end = perf_counter() + seconds
    while True:
        for name, (sample, update) in stages.items():
            with timed(times[name][0]):
                batch = sample()
            with timed(times[name][1]):
                update(batch)
        if perf_counter() > end:
            break
    return {
        name: (median(sampling), median(updates)) for name, (sampling, updates) in times.items()
    }


def main(arguments: list[str] | None = None) -> None:
    summary = "Time to sample a batch beside the time of an update, one thread."
    parser = argparse.ArgumentParser(description=summary)
    options: dict[str, dict[str, Any]] = {
        "--rows": {"type": int, "default": 46_000, "help": "transitions of each task"},
        "--tasks": {"type": int, "default": 6},
        "--batch": {"type": int, "default": 256, "help": "transitions of a task and sample"},
        "--seconds": {"type": float, "default": 10.0, "help": "how long to measure"},
    }
    for name, option in options.items():
        parser.add_argument(name, **option)
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    torch.manual_seed(0)

    datasets = [make_data(args.rows, task) for task in range(args.tasks)]
    start = perf_counter()
    multi_task = make_multi_task_replay_buffer(datasets, batch_size=args.batch)
    made = perf_counter() - start
    single = make_replay_buffer(datasets[0], batch_size=args.batch)
    stages = {
        "1, BCQLoss": (single.sample, make_library_update(make_pair()[1])),
        "2, MetaDistillationLoss": (multi_task.sample, make_distillation_update(args.tasks)),
    }
    results = measure(stages, args.seconds)
    print("| Stage | Batch | Sample (ms) | Samples/s | Update (ms) | Sample/update |")
    print("|---|---:|---:|---:|---:|---:|")
    for (name, (sampling, update)), batch in zip(
        results.items(), (f"{args.batch}", f"{args.tasks}x{args.batch}"), strict=True
    ):
        row = (name, batch, f"{1e3 * sampling:.2f}", f"{1 / sampling:.0f}")
        print("|", " | ".join((*row, f"{1e3 * update:.1f}", f"{sampling / update:.1%}")), "|")
    print(f"\nThe buffer of {args.tasks} x {args.rows} transitions was made in {made:.2f} s.")
    print(f"Most memory that the process held: {getrusage(RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB.")


if __name__ == "__main__":
    main()
