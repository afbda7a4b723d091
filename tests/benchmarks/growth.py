"""How time grows with tasks, seeds, data, candidates, environments and cores; with a picture.

    python tests/benchmarks/growth.py [--rounds 8] [--picture docs/images/growth.png]

Each line of the table is the median of rounds in which the sizes of one quantity take turns, and
the ratio of its growth to what it should be (linear, constant or, for cores, inverse). Data are
random, of the sizes of the six Sawyer tasks.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import argparse
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

import torch
from bcq_speed import ACTION_DIM, OBSERVATION_DIM, make_batch, make_stack
from replay_speed import HORIZON, make_data, make_distillation_update
from tensordict import TensorDict

from torchrl_bmrl.data import make_multi_task_replay_buffer, make_replay_buffer
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.agents import make_bcq_loss
from torchrl_bmrl.training import keep_freed_memory

Call = Callable[[], object]
BATCH = 64

COLLECT = """
import sys, tempfile
from pathlib import Path
from torchrl_bmrl.experts.collect import collect_demonstrations
from torchrl_bmrl.tasks import get_task
if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        collect_demonstrations(Path(folder), [get_task("lift")], {"lift": 119}, valid_episodes=1,
                               noise=0.2, seed=0, workers=int(sys.argv[1]))
"""


def tasks(stack: ExitStack) -> Iterator[tuple[int, Call]]:
    """An update of stage 2."""
    for count in (6, 12, 48):
        update = make_distillation_update(count)
        batch = torch.stack([make_batch(BATCH, seed) for seed in range(count)])
        batch["task"] = torch.arange(count).unsqueeze(-1).expand(count, BATCH).clone()
        yield count, lambda update=update, batch=batch: update(batch)


def seeds(stack: ExitStack) -> Iterator[tuple[int, Call]]:
    """An update of all agents of a stack."""
    batch = make_batch(BATCH)
    for count in (1, 2, 4, 8, 16):
        update = make_stack(count)
        yield count, lambda update=update: update(batch)


def demonstrations(stack: ExitStack) -> Iterator[tuple[int, Call]]:
    """Ten batches of one task's demonstrations, from a memory map."""
    for count in (60, 500, 5000):
        buffer = make_replay_buffer(make_data(count * HORIZON, 0), batch_size=BATCH)
        yield count, lambda buffer=buffer: [buffer.sample() for _ in range(10)]


def six_tasks(stack: ExitStack) -> Iterator[tuple[int, Call]]:
    """Ten batches of the demonstrations of six tasks, from memory maps."""
    for count in (60, 500, 2000):
        data = [make_data(count * HORIZON, task) for task in range(6)]
        buffer = make_multi_task_replay_buffer(data, batch_size=BATCH)
        yield count, lambda buffer=buffer: [buffer.sample() for _ in range(10)]


def candidates(stack: ExitStack) -> Iterator[tuple[int, Call]]:
    """Actions for 20 states, the best of so many candidates."""
    loss = make_bcq_loss(observation_dim=OBSERVATION_DIM, action_dim=ACTION_DIM)
    states = TensorDict({"observation": torch.randn(20, OBSERVATION_DIM)}, [20])
    for count in (1, 10, 100, 1000):
        policy = BCQPolicy.frozen(loss, num_candidates=count)
        yield count, lambda policy=policy: policy(states.copy())


def environments(stack: ExitStack) -> Iterator[tuple[int, Call]]:
    """A step of all environments of a batch."""
    for count in (1, 4, 16, 64):
        env = make_env("lift", num_envs=count)
        stack.callback(env.close)
        now = env.reset(seed=list(range(count)))
        action = torch.zeros(count, ACTION_DIM)
        yield count, lambda env=env, now=now, action=action: env.step(now.set("action", action))


def cores(stack: ExitStack) -> Iterator[tuple[int, Call]]:
    """120 episodes of lift in a new process; with two cores it starts a server of workers too."""
    for count in (1, 2):
        script = [sys.executable, "-c", COLLECT, str(count)]
        yield count, lambda script=script: subprocess.run(script, check=True, capture_output=True)


QUANTITIES = {
    "tasks": (tasks, "linear"),
    "agents of a stack": (seeds, "linear"),
    "demonstrations of a task": (demonstrations, "constant"),
    "demonstrations of each of six tasks": (six_tasks, "constant"),
    "candidates": (candidates, "linear"),
    "environments side by side": (environments, "linear"),
    "cores": (cores, "inverse"),
}
Measured = dict[str, list[tuple[int, float]]]


def measure(rounds: int, chosen: list[str]) -> Measured:
    """Returns the milliseconds of each size of each quantity."""
    found: Measured = {}
    for name in chosen:
        with ExitStack() as stack:
            calls = dict(QUANTITIES[name][0](stack))
            outside = name == "cores"
            clock = perf_counter if outside else process_time
            times: dict[int, list[float]] = {size: [] for size in calls}
            for call in () if outside else calls.values():  # a new process is never warm
                call()
            for _ in range(3 if outside else rounds):
                for size, call in calls.items():
                    start = clock()
                    call()
                    times[size].append(1000 * (clock() - start))
        found[name] = [(size, median(values)) for size, values in times.items()]
        first_size, first = found[name][0]
        for size, value in found[name]:
            power = {"linear": 1, "constant": 0, "inverse": -1}[QUANTITIES[name][1]]
            ratio = value / first / (size / first_size) ** power
            print(f"| {name} | {size} | {value:.2f} | {ratio:.2f} |", flush=True)
    return found


def draw(found: Measured, path: Path) -> None:
    """Draws the times over the sizes, with what they should be."""
    from matplotlib.figure import Figure

    rows = 2
    columns = -(-len(found) // rows)
    figure = Figure(figsize=(3.2 * columns, 2.8 * rows), layout="constrained")
    for number, (name, points) in enumerate(found.items(), 1):
        axes = figure.add_subplot(rows, columns, number)
        sizes, values = zip(*points, strict=True)
        power = {"linear": 1, "constant": 0, "inverse": -1}[QUANTITIES[name][1]]
        expected = [values[0] * (size / sizes[0]) ** power for size in sizes]
        axes.loglog(sizes, expected, "--", color="0.6", label=QUANTITIES[name][1])
        axes.loglog(sizes, values, "o-", label="measured")
        axes.set_xticks(sizes, [f"{size:,}" for size in sizes], minor=False)
        axes.minorticks_off()
        shown = [*values, *expected]
        axes.set_ylim(min(shown) / 3, 3 * max(shown))  # a change of a fifth should look like one
        axes.set(xlabel=name, ylabel="ms")
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--only", nargs="+", choices=list(QUANTITIES), default=list(QUANTITIES))
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    keep_freed_memory()  # as the recipes do
    print("| Quantity | Size | Time [ms] | Time over what it should be |\n|---|---:|---:|---:|")
    found = measure(options.rounds, options.only)
    if options.picture:
        draw(found, options.picture)


if __name__ == "__main__":
    main()
