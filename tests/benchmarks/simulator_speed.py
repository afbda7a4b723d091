"""Compares robosuite's own step with the fast one: speed, workers, memory, batched policies.

    python tests/benchmarks/simulator_speed.py [--rounds 5] [--episodes 60]

First come stock robosuite's environments, accelerated and not. Both play the same episodes of
random, saturated and still actions in turn, with shaped rewards and all observations. All returned
numbers and MuJoCo's state are compared, and the fastest round counts of each step.

Then come this package's tasks. The ceiling is 25 bare ``mj_step1`` and ``mj_step2``, from the
states of the same episode, on robosuite's model and on the one without pictures. Variants take
turns on one thread, an expert's episode each. The tables show the fastest round of each variant and
the median of the rounds' ratios. Memory is resident, of a process of its own.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy and torch are imported
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple

import mujoco
import numpy as np
import robosuite
import torch
from control_step import STATE, bare, episode, play

from torchrl_bmrl.envs.acceleration import accelerate_robosuite
from torchrl_bmrl.envs.skills import SKILLS
from torchrl_bmrl.envs.tabletop import STEPPERS, TabletopEnv
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.evaluation.rollout import evaluate_policy
from torchrl_bmrl.experts.collect import collect_demonstrations
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline.agents import make_bcq_loss
from torchrl_bmrl.tasks import get_task

STOCK = ("Lift", "Stack", "Door", "NutAssemblySquare", "PickPlaceCan", "Wipe")
ARMS = ("Panda", "Sawyer", "UR5e")


def seconds(call: Callable[[], object]) -> float:
    """Returns the time of one call."""
    start = perf_counter()
    call()
    return perf_counter() - start


def stock_table(rounds: int, steps: int = 25) -> None:
    """Control steps per second of robosuite's environments, stock and accelerated.

    All rounds are the same episodes, and the fastest round counts of each step: that is its time
    while nobody else uses the machine. The ceiling is what infinitely fast Python would reach.
    """
    print("\n| Environment | arm | stock | fast | fast / stock | ceiling | equal to the bit |\n"
          "|---|---|---:|---:|---:|---:|---|")  # fmt: skip
    for task in STOCK:
        for arm in ARMS:
            envs = [stock_environment(task, arm) for _ in range(2)]
            accelerate_robosuite(envs[1])
            for env in envs:
                play_stock(env, 2)  # compiled, and in the caches
            times: list[list[np.ndarray]] = [[], [], []]
            equal = True
            for _ in range(rounds):
                theirs, ours = (play_stock(env, steps) for env in envs)
                equal = equal and theirs.outcome == ours.outcome
                physics = np.array(bare(envs[0], theirs.states))
                for each, found in zip(times, (theirs.times, ours.times, physics), strict=True):
                    each.append(found)
            stock, fast, physics = (np.min(each, axis=0).mean() for each in times)
            print(f"| {task} | {arm} | {1 / stock:.0f} | {1 / fast:.0f} | {stock / fast:.2f} | "
                  f"{stock / physics:.1f} | {'yes' if equal else 'no'} |", flush=True)  # fmt: skip


def stock_environment(task: str, arm: str) -> Any:
    """Returns robosuite's environment without pictures, with its defaults and shaped rewards."""
    env = robosuite.make(
        task, robots=arm, use_camera_obs=False, has_offscreen_renderer=False, reward_shaping=True,
        ignore_done=True, hard_reset=False, seed=0,
    )  # fmt: skip
    env.early_terminations = False  # Wipe ends at the first collision otherwise
    return env


class Played(NamedTuple):
    """Three episodes: each step's time and initial state, and all results."""

    times: np.ndarray
    states: list[np.ndarray]
    outcome: list[bytes]


def play_stock(env: Any, steps: int) -> Played:
    """Plays an episode each of random, saturated and still actions; every call plays the same."""
    rng = np.random.default_rng(1)
    env.rng.bit_generator.state = rng.bit_generator.state
    held = np.sign(rng.standard_normal(env.action_dim))
    played = Played(np.empty(3 * steps), [], [])
    for number, actions in enumerate(
        (
            rng.uniform(-1, 1, (steps, env.action_dim)),
            np.tile(held, (steps, 1)),
            np.zeros((steps, env.action_dim)),
        )
    ):
        env.reset()
        for step, action in enumerate(actions):
            model, data = env.sim.model._model, env.sim.data._data
            state = np.empty(mujoco.mj_stateSize(model, STATE))
            mujoco.mj_getState(model, data, state, STATE)
            start = perf_counter()
            observation, reward, done, info = env.step(action)
            played.times[number * steps + step] = perf_counter() - start
            played.states.append(state)
            arrays = [*observation.values(), data.qpos, data.qvel, data.act, data.ctrl, reward]
            played.outcome.extend(np.asarray(array).tobytes() for array in arrays)
            played.outcome.append(repr((done, info)).encode())
    return played


def step_table(rounds: int, steps: int = 200) -> None:
    """Prints control steps per second of one process, per task."""
    print("\n| Task | robosuite | fast | bare, robosuite's model | bare, lean | fast / robosuite |"
          " fast / bare (robosuite's, lean) |\n|---|---:|---:|---:|---:|---:|---:|")  # fmt: skip
    for task in SKILLS:
        stock, fast = (TabletopEnv(task, stepper=name) for name in reversed(STEPPERS))
        actions, states = episode(fast, steps)
        play(stock, actions[:3])  # compiled, and in the caches
        times = [
            (
                play(stock, actions),
                play(fast, actions),
                *(sum(bare(env.robosuite_env, states)) for env in (stock, fast)),
            )
            for _ in range(rounds)
        ]
        speeds = [steps / min(column) for column in zip(*times, strict=True)]
        gain, full, lean = (median(time[i] / time[1] for time in times) for i in (0, 2, 3))
        print(f"| {task} | " + " | ".join(f"{speed:.0f}" for speed in speeds)
              + f" | {gain:.2f} | {full:.0%}, {lean:.0%} |", flush=True)  # fmt: skip
        stock.close()
        fast.close()


def worker_table(episodes: int) -> None:
    """Prints the time of a collection, including the start of the processes."""
    print("\n| Stepper | workers | episodes | seconds | episodes / s |\n|---|---:|---:|---:|---:|")
    for stepper in STEPPERS:
        for workers in (1, 2):
            with tempfile.TemporaryDirectory() as folder:
                task = get_task("lift").with_options(stepper=stepper)
                time = seconds(
                    lambda: collect_demonstrations(
                        Path(folder),
                        [task],  # noqa: B023
                        {"lift": episodes - 1},
                        valid_episodes=1,
                        noise=0.2,
                        seed=0,
                        workers=workers,  # noqa: B023
                    )
                )
            print(f"| {stepper} | {workers} | {episodes} | {time:.1f} | {episodes / time:.2f} |",
                  flush=True)  # fmt: skip


def policy_table(steps: int = 50) -> None:
    """Prints the time of a step of one episode, including a policy with 100 candidates."""
    policy = BCQPolicy.frozen(make_bcq_loss(observation_dim=33, action_dim=7))
    print("\n| Stepper | episodes side by side | ms per step of an episode |\n|---|---:|---:|")
    for stepper in STEPPERS:
        for number in (None, 1, 4, 20):
            with closing(make_env("lift", num_envs=number, stepper=stepper)) as env:
                seeds = range(number or 1)
                evaluate_policy(env, policy, seeds, max_steps=3)
                time = seconds(lambda: evaluate_policy(env, policy, seeds, max_steps=steps))  # noqa: B023
            name = "no batch" if number is None else number
            print(f"| {stepper} | {name} | {1e3 * time / steps / len(seeds):.2f} |", flush=True)


MEMORY = """
import sys
from pathlib import Path
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4 / 1024
from torchrl_bmrl.envs.tabletop import TabletopEnv
import torchrl.envs
stepper, number = sys.argv[1], int(sys.argv[2])
before, envs = resident(), []
for _ in range(number):
    envs.append(TabletopEnv("lift", stepper=stepper))
    envs[-1].reset(seed=0)
    envs[-1].step(envs[-1].action_space.sample())
print(f"{before:.0f} | {resident():.0f}")
"""
WORKER = """
import sys
from pathlib import Path
def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4 / 1024
from torchrl_bmrl.tasks import get_task
before = resident()
for name in ("lift", "push_left"):
    task = get_task(name).with_options(stepper=sys.argv[1])
    task.record(0, noise=0.2, **task.options)
print(f"{before:.0f} | {resident():.0f}")
"""


def memory_table() -> None:
    """Prints the memory of a process after steps of environments, and of one that collects."""
    print("\n| Stepper | process | MB of imports | MB in all |\n|---|---|---:|---:|")
    for stepper in STEPPERS:
        for name, *arguments in (
            ("1 environment", MEMORY, stepper, "1"),
            ("2 environments", MEMORY, stepper, "2"),
            ("4 environments", MEMORY, stepper, "4"),
            ("a worker that collects", WORKER, stepper),
        ):
            command = [sys.executable, "-c", *arguments]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            print(f"| {stepper} | {name} | {done.stdout.strip()} |", flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=60)
    options = parser.parse_args()
    torch.set_num_threads(1)
    stock_table(options.rounds)
    step_table(options.rounds)
    policy_table()
    memory_table()
    worker_table(options.episodes)


if __name__ == "__main__":
    main()
