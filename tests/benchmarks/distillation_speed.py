"""Updates per second of stage 2, with teachers in a loop or stacked, eager or compiled.

    python tests/benchmarks/distillation_speed.py [--rounds 40] [--device cuda]

Six teachers, 64 transitions of each task, the recipe's loss, without sampling the batch.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported

from collections.abc import Callable
from statistics import median
from time import perf_counter
from typing import Any

import torch
from bcq_speed import ACTION_DIM, LR, OBSERVATION_DIM, make_batch, read_options, wait, warmed_up
from tensordict import TensorDict

from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.agents import make_bcq_loss
from torchrl_bmrl.pipeline.student import Student, make_distillation_loss
from torchrl_bmrl.training import accelerate, gradient_step, keep_freed_memory, make_adam

TASKS, ROWS = 6, 64


def make_data(device: str = "cpu") -> TensorDict:
    """Returns random transitions of every task."""
    data = torch.stack([make_batch(ROWS, seed) for seed in range(TASKS)])
    data["task"] = torch.arange(TASKS).unsqueeze(-1).expand(TASKS, ROWS).clone()
    return data.to(device)


def make_update(
    device: str = "cpu", *, in_sequence: bool = False, optimizer: str = "step", **options: Any
) -> Callable[[TensorDict], Any]:
    """Returns an update; ``optimizer`` is the recipe's ``"step"`` or PyTorch's ``"backward"``."""
    torch.manual_seed(0)
    losses = [make_bcq_loss(observation_dim=OBSERVATION_DIM, action_dim=ACTION_DIM)] * TASKS
    teachers = [BCQPolicy.frozen(loss) for loss in losses]
    student = Student(num_tasks=TASKS, observation_dim=OBSERVATION_DIM, action_dim=ACTION_DIM)
    loss = make_distillation_loss(student, teachers, deactivate_vmap=in_sequence).to(device)
    ours = make_adam(loss.parameters(), lr=LR)
    theirs = torch.optim.Adam(loss.parameters(), lr=LR)

    def update(batch: TensorDict) -> Any:
        losses = loss(batch)
        total = sum(value for name, value in losses.items() if name.startswith("loss_"))
        if optimizer == "step":
            gradient_step(ours, total)
        else:
            theirs.zero_grad()
            total.backward()
            theirs.step()
        return {name: value.detach() for name, value in losses.items()}

    return accelerate(update, device=device, **options)


def variants(device: str) -> dict[str, Callable[[TensorDict], Any]]:
    """Returns updates by name."""
    made = {
        "teachers in sequence, torch.optim": make_update(
            device, in_sequence=True, optimizer="backward"
        ),
        "teachers in sequence": make_update(device, in_sequence=True),
        "teachers stacked": make_update(device),
        "teachers stacked, compiled": make_update(device, compiled=True),
    }
    if device == "cuda":
        made["teachers stacked, captured"] = make_update(device, captured=True)
    return made


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    args = read_options(__doc__, arguments)
    torch.set_num_threads(1)
    keep_freed_memory()  # as the recipes do
    data = make_data(args.device)
    updates = {name: warmed_up(update, [data]) for name, update in variants(args.device).items()}
    speeds: dict[str, list[float]] = {name: [] for name in updates}
    for _ in range(args.rounds):
        for name, update in updates.items():
            wait(args.device)
            start = perf_counter()
            for _ in range(5):
                update(data)
            wait(args.device)
            speeds[name].append(5 / (perf_counter() - start))
    first = next(iter(speeds.values()))
    print("| Stage 2 | Updates/s | Ratio to the first |\n|---|---:|---:|")
    for name, values in speeds.items():
        ratio = median(a / b for a, b in zip(values, first, strict=True))
        print(f"| {name} | {median(values):.1f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
