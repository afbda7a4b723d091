#!/usr/bin/env bash
# robosuite 1.5.2, mujoco 3.8.1: the delay of a sensor, create_deterministic_delayer(0.03).
#
# Guess: the delayer's result is "the number of seconds to delay the measurement by". The joint positions
#        that step() returns were measured 30 ms before, so that a policy learns to cope with it.
# Seen:  they are those of this moment, to the last bit, for every delay below the control period (40 of
#        50 ms here). A sample is taken in the first substep of a sampling period in which period -
#        delay >= time since the period began, and this holds at once, whatever the delay. Random
#        delays that stay below the period do nothing, either. No warning.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" - <<'PY' 2>"$folder/log" | grep '^robosuite' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import numpy as np
import robosuite
from robosuite.utils.observables import create_deterministic_delayer, create_uniform_sampled_delayer

DELAYERS = {
    "none": None,
    "30 ms": create_deterministic_delayer(0.03),
    "40 ms": create_deterministic_delayer(0.04),
    "10 to 40 ms": create_uniform_sampled_delayer(0.01, 0.04),
}
env = robosuite.make("Lift", robots="Panda", use_camera_obs=False, has_offscreen_renderer=False)
for name, delayer in DELAYERS.items():
    env.modify_observable("robot0_joint_pos", "delayer", delayer)
    env.reset()
    joints = env.robots[0]._ref_joint_pos_indexes
    differences, speeds = [], []
    for step in range(40):
        action = np.zeros(env.action_dim)
        action[0] = np.sin(0.3 * step)
        observation = env.step(action)[0]
        now = env.sim.data.qpos[joints]
        differences.append(np.abs(observation["robot0_joint_pos"] - now).max())
        speeds.append(np.abs(observation["robot0_joint_vel"]).max())
    print(f"robosuite {version('robosuite')}, delay {name}: joint positions differ", end=" ")
    print(f"from the present ones by {max(differences)} rad,", end=" ")
    print(f"while joints move by up to {0.03 * max(speeds):.3f} rad in 30 ms")
    assert max(differences) == 0 and 0.03 * max(speeds) > 0.005, "delayed now"
PY
