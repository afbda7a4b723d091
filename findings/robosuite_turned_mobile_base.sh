#!/usr/bin/env bash
# robosuite 1.5.2: "forward" of a mobile base that has turned, and the array given to step().
#
# Guess: the base moves the way it faces, as the comment in the source says, and step() leaves the action as
#        it is.
# Seen:  the action is turned the wrong way round: after a quarter turn, "forward" moves the base backwards.
#        At the start it is right. The turned action is also written into the caller's array: a demonstration
#        that stores the action after step() stores another one than was given, as DataCollectionWrapper does.
#        No warning. (controllers/parts/mobile_base/joint_vel.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
import robosuite

environment = robosuite.make(
    "Lift",
    robots="PandaOmron",
    has_renderer=False,
    has_offscreen_renderer=False,
    use_camera_obs=False,
    initialization_noise=None,
    ignore_done=True,
)
environment.reset()
robot = environment.robots[0]
low, _ = robot.composite_controller._action_split_indexes["base"]
site = environment.sim.model.site_name2id(robot.robot_model.base.correct_naming("center"))


def step(forward=0.0, turn=0.0):
    """Returns the caller's array after the step: forward, sideways."""
    action = np.zeros(environment.action_dim)
    action[low], action[low + 2] = forward, turn
    environment.step(action)
    return action[low : low + 2]


def heading():
    return environment.sim.data.site_xmat[site].reshape(3, 3)[:2, 0].copy()


def drive():
    """Returns how far "forward" leads along the heading, as a share of the way, and the array after it."""
    for _ in range(10):
        step()
    way, start = heading(), environment.sim.data.site_xpos[site][:2].copy()
    after = step(1.0)
    for _ in range(19):
        step(1.0)
    moved = environment.sim.data.site_xpos[site][:2] - start
    return float(moved @ way / np.linalg.norm(moved)), after


for _ in range(40):  # away from the table
    step(-1.0)
straight, unchanged = drive()
for _ in range(20):
    step(-1.0)
for _ in range(300):
    if heading()[0] < 0.05:
        break
    step(turn=0.5)
turned, changed = drive()
print(f"robosuite {version('robosuite')}: cosine of the way of \"forward\" with the heading, and the action after step")
print(f"  not turned: {straight:+.2f}, {unchanged.round(2).tolist()}")
print(f"  after a quarter turn: {turned:+.2f}, {changed.round(2).tolist()}; given was [1.0, 0.0]")
assert straight > 0.9, straight
assert turned < -0.8, turned
assert abs(changed[0]) < 0.3 and abs(changed[1]) > 0.9, changed
PY
