"""Time of one control step of each of the six tasks, and of its bare physics.

    python tests/benchmarks/control_step.py [--rounds 12]

An episode of a noisy expert, and 25 bare ``mj_step1`` and ``mj_step2`` from the same states on the
same model, take turns; the fastest round of each counts. Prints the task, the step [ms], and the
physics' share of it. It also runs on other commits (``guard.py``).
"""

from __future__ import annotations

import argparse
import inspect
from time import perf_counter
from typing import Any

import gymnasium
import mujoco
import numpy as np

import torchrl_bmrl.envs  # noqa: F401 (registers the environments)
from torchrl_bmrl.experts.controllers import make_expert

TASKS = ("Reach", "Lift", "PushRight", "PushLeft", "PushUp", "PushDown")
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
STEPS = 100


def episode(env: Any, steps: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Returns actions of a noisy expert, and the states before them."""
    env.reset(seed=0)
    scene, rng = env.robosuite_env, np.random.default_rng(0)
    # Earlier commits ask for the task's name, too.
    named = "task" in inspect.signature(make_expert).parameters
    expert = make_expert(env.task, scene) if named else make_expert(scene)
    actions, states = [], []
    for _ in range(steps):
        states.append(env.get_state()["physics"])
        actions.append(np.clip(expert() + 0.2 * rng.standard_normal(7), -1, 1))
        env.step(actions[-1])
    return actions, states


def play(env: Any, actions: list[np.ndarray]) -> float:
    """Returns the seconds of an episode's steps."""
    env.reset(seed=0)
    start = perf_counter()
    for action in actions:
        env.step(action)
    return perf_counter() - start


def bare(env: Any, states: list[np.ndarray]) -> list[float]:
    """Returns the seconds of robosuite's physics alone, from each state."""
    model, data = env.sim.model._model, env.sim.data._data
    substeps, seconds = int(0.05 / model.opt.timestep), []
    for state in states:
        mujoco.mj_setState(model, data, state, STATE)
        start = perf_counter()
        for _ in range(substeps):
            mujoco.mj_step1(model, data)
            mujoco.mj_step2(model, data)
        seconds.append(perf_counter() - start)
    return seconds


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=12)
    rounds = parser.parse_args().rounds
    for task in TASKS:
        env = gymnasium.make(f"bmrl/Sawyer{task}-v0").unwrapped
        actions, states = episode(env, STEPS)
        times = [(play(env, actions), sum(bare(env.robosuite_env, states))) for _ in range(rounds)]
        step, alone = (min(column) / STEPS * 1000 for column in zip(*times, strict=True))
        print(f"{task} {step:.3f} {alone / step:.3f}", flush=True)
        env.close()


if __name__ == "__main__":
    main()
