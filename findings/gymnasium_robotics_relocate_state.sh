#!/usr/bin/env bash
# gymnasium-robotics 1.4.2: a state of AdroitHandRelocate that is saved and restored.
#
# Guess: reset(options={"initial_state_dict": ...}) with what get_env_state returned puts the ball where it
#        was.
# Seen:  only at the start of an episode. A ball that the hand has moved by 10 cm is restored 10 cm farther
#        on, and again 10 cm with each restore: the saved position contains what the ball's joints have
#        moved, and these are restored, too. What is played from the middle of an episode, and whether it is
#        solved, are those of another state. No warning. (get_env_state and set_env_state in
#        envs/adroit_hand/adroit_relocate.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gymnasium-robotics==1.4.2 gymnasium==1.4.0 mujoco==3.3.0 \
  numpy==2.4.0 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import gymnasium_robotics
import numpy as np

gym.register_envs(gymnasium_robotics)
env = gym.make("AdroitHandRelocate-v1").unwrapped
DOCUMENTED = ("qpos", "qvel", "obj_pos", "target_pos")


def saved():
    state = env.get_env_state()
    return {key: state[key] for key in DOCUMENTED}


def ball():
    return env.data.xpos[env.obj_body_id].copy()


env.reset(seed=0)
start = saved()
env.reset(options={"initial_state_dict": start})
assert np.allclose(ball(), start["obj_pos"])

positions = env.data.qpos.copy()
positions[30] += 0.1  # x of the ball
env.set_state(positions, env.data.qvel.copy())
found = [ball()[0]]
for _ in range(3):
    env.reset(options={"initial_state_dict": saved()})
    found.append(ball()[0])
print(f"gymnasium-robotics {version('gymnasium-robotics')}, AdroitHandRelocate-v1: x of the ball")
print(f"  saved, and after each of three restores: {np.round(found, 3).tolist()}")
assert np.allclose(np.diff(found), 0.1), found
PY
