#!/usr/bin/env bash
# gym-xarm 0.1.1: how much simulated time a control step takes, and where agent_pos is measured from.
#
# Guess: a control step takes env.dt, 0.04 s, as render_fps = 25 says and the constructor asserts; and
#        agent_pos is the end-effector's position relative to the table's centre, as eef is.
# Seen:  a step runs 2 of the 20 substeps and takes 0.004 s: an episode of 50 steps is 0.2 s long, and
#        films and data at 25 frames a second play ten times too slowly. agent_pos has the table's
#        centre subtracted twice. No warning.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-deps gym-xarm==0.1.1 gymnasium-robotics==1.4.2
"$folder/venv/bin/pip" install --quiet gymnasium==1.4.0 mujoco==3.8.1 numpy==1.26.4 imageio==2.38.1 \
    pettingzoo==1.27.0 jinja2==3.1.6 packaging==26.3

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gym_xarm
import gymnasium
import numpy as np

env = gymnasium.make("gym_xarm/XarmLift-v0", obs_type="state")
env.reset(seed=0)
inner = env.unwrapped
before = inner.data.time
for _ in range(25):
    env.step(np.zeros(4, np.float32))
passed = inner.data.time - before
print(f"gym-xarm {version('gym-xarm')}: env.dt {inner.dt:.3f} s, render_fps 25")
print(f"  25 steps take {passed:.3f} s of simulated time")
assert abs(inner.dt - 0.04) < 1e-9
assert abs(passed - 0.1) < 1e-6, "the length of a step has changed"

centre = inner.center_of_table
site = inner._utils.get_site_xpos(inner.model, inner.data, "grasp")
agent = inner.robot_state[:3]  # what obs_type="pixels_agent_pos" returns
print(f"  end-effector {site.round(3)}, table {centre.round(3)}, agent_pos {agent.round(3)}")
assert np.allclose(inner.eef, site - centre)
assert np.allclose(agent, site - 2 * centre), "agent_pos has changed"
PY
