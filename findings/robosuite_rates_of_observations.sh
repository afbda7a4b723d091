#!/usr/bin/env bash
# robosuite 1.5.2, mujoco 3.8.1: control_freq of 15, 30 or 60 Hz, the rates of cameras and real robots.
#
# Guess: step() returns the state that its action has reached, at the end of the control period, as with
#        20 Hz, and simulates 1/30 s.
# Seen:  a period that is no multiple of 2 ms is cut off to one, but observations are sampled at the exact
#        rate. The two drift apart: at 30 Hz an observation is 0 to 32 ms old, a whole period, and the age
#        changes from step to step; every 25 steps the observation before is returned again. At 15 Hz it
#        is up to 66 ms old. Rewards are of the last state, so that the two do not belong together.
#        Simulated time falls up to 4 % behind env.cur_time. No warning. 20, 25 and 50 Hz are right.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" - <<'PY' 2>"$folder/log" | grep '^robosuite' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import numpy as np
import robosuite


def play(rate, steps=75):
    """The ages of the observations [ms], how many repeat the last one, and the times at the end [s]."""
    env = robosuite.make(
        "Lift", robots="Panda", use_camera_obs=False, has_offscreen_renderer=False, control_freq=rate,
    )
    env.reset()
    joints = env.robots[0]._ref_joint_pos_indexes
    history, step2 = [env.sim.data.qpos[joints].copy()], env.sim.step2

    def recorded():
        step2()
        history.append(env.sim.data.qpos[joints].copy())

    env.sim.step2 = recorded
    ages, seen = [], []
    for step in range(steps):
        action = np.zeros(env.action_dim)
        action[0] = np.sin(step)
        seen.append(env.step(action)[0]["robot0_joint_pos"])
        found = max(i for i, past in enumerate(history) if np.array_equal(past, seen[-1]))
        ages.append(round(1000 * env.model_timestep * (len(history) - 1 - found)))
    repeated = sum(np.array_equal(a, b) for a, b in zip(seen, seen[1:]))
    times = env.sim.data.time, env.cur_time
    env.close()
    return ages, repeated, times


for rate in (15, 20, 25, 30, 50, 60):
    ages, repeated, (simulated, counted) = play(rate)
    print(f"robosuite {version('robosuite')}, {rate} Hz: observations", end=" ")
    print(f"are {min(ages)} to {max(ages)} ms old, {repeated} are those of the step before; {simulated:.2f} s simulated, cur_time {counted:.2f} s")
    if rate in (20, 25, 50):
        assert set(ages) == {0} and repeated == 0 and np.isclose(simulated, counted)
    else:
        assert max(ages) >= 2 * int(500 / rate) and len(set(ages)) > 5, "fresh now"
        assert simulated < 0.995 * counted, "the simulated time is right now"
    if rate == 30:
        assert repeated >= 2
PY
