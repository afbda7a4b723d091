"""robosuite's own step beside the fast one: speed, workers, memory, policies in a batch.

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
from typing import Any

import mujoco
import numpy as np
import robosuite
import torch

from torchrl_bmrl.envs.acceleration import accelerate_robosuite
from torchrl_bmrl.envs.sawyer import SawyerEnv
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.evaluation.rollout import evaluate_policy
from torchrl_bmrl.experts.collect import collect_demonstrations
from torchrl_bmrl.experts.controllers import make_expert
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.names import HORIZON, STEPPERS, TASKS
from torchrl_bmrl.pipeline.agents import make_bcq_loss

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
STOCK = ("Lift", "Stack", "Door", "NutAssemblySquare", "PickPlaceCan", "Wipe")
ARMS = ("Panda", "Sawyer", "UR5e")


def seconds(call: Callable[[], object]) -> float:
    """Time of one call."""
    start = perf_counter()
    call()
    return perf_counter() - start


def stock_table(rounds: int, steps: int = 25) -> None:
    """Control steps per second of robosuite's environments, stock and accelerated.

    All rounds are the same episodes, and the fastest round counts of each step: that is the time on
    a machine which nobody else uses at that moment.
    """
    print("\n| Environment | arm | stock | fast | fast / stock | equal to the bit |\n"
          "|---|---|---:|---:|---:|---|")  # fmt: skip
    for task in STOCK:
        for arm in ARMS:
            stock, fast = envs = [stock_environment(task, arm) for _ in range(2)]
            accelerate_robosuite(fast)
            for env in envs:
                play_stock(env, 0, 2)  # compiled, and in the caches
            times: list[list[np.ndarray]] = [[], []]
            equal = True
            for _ in range(rounds):
                results = [play_stock(env, 1, steps) for env in envs]
                for each, (seconds_of_steps, _) in zip(times, results, strict=True):
                    each.append(seconds_of_steps)
                equal = equal and results[0][1] == results[1][1]
            theirs, ours = (float(np.min(each, axis=0).mean()) for each in times)
            print(f"| {task} | {arm} | {1 / theirs:.0f} | {1 / ours:.0f} | {theirs / ours:.2f} | "
                  f"{'yes' if equal else 'no'} |", flush=True)  # fmt: skip
            del stock, fast, envs


def stock_environment(task: str, arm: str) -> Any:
    """robosuite's environment without pictures, otherwise with its defaults and shaped rewards."""
    env = robosuite.make(
        task, robots=arm, use_camera_obs=False, has_offscreen_renderer=False, reward_shaping=True,
        ignore_done=True, seed=0,
    )  # fmt: skip
    env.early_terminations = False  # Wipe ends at the first collision otherwise
    return env


def play_stock(env: Any, seed: int, steps: int) -> tuple[np.ndarray, list[bytes]]:
    """Times of the steps of three episodes, and all that came out of them."""
    rng, outcome, times = np.random.default_rng(seed), [], []
    env.rng.bit_generator.state = rng.bit_generator.state
    held = np.sign(rng.standard_normal(env.action_dim))
    for actions in (
        rng.uniform(-1, 1, (steps, env.action_dim)),
        np.tile(held, (steps, 1)),
        np.zeros((steps, env.action_dim)),
    ):
        env.reset()
        for action in actions:
            start = perf_counter()
            observation, reward, done, info = env.step(action)
            times.append(perf_counter() - start)
            data = env.sim.data._data
            arrays = [*observation.values(), data.qpos, data.qvel, data.act, data.ctrl, reward]
            outcome += [np.asarray(array).tobytes() for array in arrays]
            outcome.append(repr((done, info)).encode())
    return np.array(times), outcome


def episode(env: SawyerEnv, steps: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Actions of a noisy expert, and the states in which they were taken."""
    env.reset(seed=0)
    expert, rng = make_expert(env.robosuite_env), np.random.default_rng(0)
    actions, states = [], []
    for _ in range(steps):
        states.append(env.get_state()["physics"])
        actions.append(np.clip(expert() + 0.2 * rng.standard_normal(7), -1, 1))
        env.step(actions[-1])
    return actions, states


def play(env: TabletopEnv, actions: list[np.ndarray]) -> float:
    """Time of an episode's steps."""
    env.reset(seed=0)
    return sum(seconds(lambda: env.step(action)) for action in actions)  # noqa: B023


def bare(env: TabletopEnv, states: list[np.ndarray]) -> float:
    """Time of the physics alone from the same states."""
    model, data = env.robosuite_env.sim.model._model, env.robosuite_env.sim.data._data
    substeps, total = int(0.05 / model.opt.timestep), 0.0

    def advance() -> None:
        for _ in range(substeps):
            mujoco.mj_step1(model, data)
            mujoco.mj_step2(model, data)

    for state in states:
        mujoco.mj_setState(model, data, state, STATE)
        total += seconds(advance)
    return total


def step_table(rounds: int, steps: int = HORIZON) -> None:
    """Control steps per second of one process, per task."""
    print("\n| Task | robosuite | fast | bare, robosuite's model | bare, lean | fast / robosuite |"
          " fast / bare (robosuite's, lean) |\n|---|---:|---:|---:|---:|---:|---:|")  # fmt: skip
    for task in TASKS:
        stock, fast = (TabletopEnv(task, stepper=name) for name in reversed(STEPPERS))
        actions, states = episode(fast, steps)
        play(stock, actions[:3])  # compiled, and in the caches
        times = [
            (play(stock, actions), play(fast, actions), bare(stock, states), bare(fast, states))
            for _ in range(rounds)
        ]
        speeds = [steps / min(column) for column in zip(*times, strict=True)]
        gain, full, lean = (median(time[i] / time[1] for time in times) for i in (0, 2, 3))
        print(f"| {task} | " + " | ".join(f"{speed:.0f}" for speed in speeds)
              + f" | {gain:.2f} | {full:.0%}, {lean:.0%} |", flush=True)  # fmt: skip
        stock.close()
        fast.close()


def worker_table(episodes: int) -> None:
    """Time of a collection, start of the processes included."""
    print("\n| Stepper | workers | episodes | seconds | episodes / s |\n|---|---:|---:|---:|---:|")
    for stepper in STEPPERS:
        for workers in (1, 2):
            with tempfile.TemporaryDirectory() as folder:
                options = {"noise": 0.2, "seed": 0, "workers": workers, "stepper": stepper}
                time = seconds(
                    lambda: collect_demonstrations(
                        Path(folder),
                        {"lift": episodes - 1},
                        valid_episodes=1,
                        **options,  # noqa: B023
                    )
                )
            print(f"| {stepper} | {workers} | {episodes} | {time:.1f} | {episodes / time:.2f} |",
                  flush=True)  # fmt: skip


def policy_table(steps: int = 50) -> None:
    """Time of a step of one episode, a policy of 100 candidates included."""
    policy = BCQPolicy.frozen(make_bcq_loss())
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
from torchrl_bmrl.experts import collect
from torchrl_bmrl.experts.controllers import ExpertGains
before = resident()
for task in ("lift", "push_left"):
    collect.collect_episode(task, 0, noise=0.2, gains=ExpertGains(), stepper=sys.argv[1])
print(f"{before:.0f} | {resident():.0f}")
"""


def memory_table() -> None:
    """Resident memory of a process with environments that have acted, and of one that collects."""
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
