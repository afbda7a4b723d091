#!/usr/bin/env bash
# gym-aloha 0.1.5: bounds of the actions, which are absolute joint positions.
#
# Guess: action_space contains the pose in which every episode starts, and the joints' ranges.
# Seen:  action_space is [-1, 1] in all 14 entries. An elbow starts at 1.16 rad: the action that holds
#        the arms where they are is not in the space, and a policy whose actions are clipped to the
#        space, or squashed into it, moves both elbows from the first step on. All twelve joints
#        of the arms move further than it in both directions. The environment neither clips nor warns.
#
# Here: find_action_bounds takes the range of the demonstrated actions, if no environment is named.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gym-aloha==0.1.5 dm-control==1.0.41 mujoco==3.8.1

MUJOCO_GL=disable "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gym_aloha
import gymnasium
import numpy as np
from gym_aloha.constants import ACTIONS, START_ARM_POSE

env = gymnasium.make("gym_aloha/AlohaTransferCube-v0", obs_type="pixels_agent_pos")
space = env.action_space
# Of each arm: six joints, a gripper in [0, 1] (0 is closed), and the finger that mirrors it.
arms = [START_ARM_POSE[:6], START_ARM_POSE[8:14]]
hold = np.array([*arms[0], 0.0, *arms[1], 0.0], np.float32)
print(f"gym-aloha {version('gym-aloha')}: action_space [{space.low.min()}, {space.high.max()}]")
outside = [name for name, at in zip(ACTIONS, hold) if abs(at) > 1]
print(f"  outside it where every episode starts: {outside}")
assert (space.low == -1).all() and (space.high == 1).all()
assert not space.contains(hold), "the start is in the space now"
assert len(outside) == 2 and all("elbow" in name for name in outside), outside

model = env.unwrapped._env.physics.model
ranges = model.jnt_range[:16][[*range(6), *range(8, 14)]]
wide = int(((ranges[:, 0] < -1) & (ranges[:, 1] > 1)).sum())
print(f"  joints of the arms that move further in both directions: {wide} of 12")
assert wide == 12, ranges
PY
