#!/usr/bin/env bash
# gymnasium-robotics 1.4.2: FrankaKitchen's info["episode_task_completions"], from which success is read.
#
# Guess: an info that was returned stays as it is. The last one of an episode lists the tasks that were
#        completed in it, also in a vector environment, whose infos["final_info"] is made for this.
# Seen:  it is the environment's own list, which the next reset clears. A vector environment that resets
#        in the same step returns an empty list in final_info at the end of each episode, whatever was
#        completed: success is 0. Infos that are collected for later are all empty. Within an episode, all
#        of them show the latest state. No warning. info["step_task_completions"] is a copy.
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
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import OBS_ELEMENT_GOALS, OBS_ELEMENT_INDICES

gym.register_envs(gymnasium_robotics)
TASK = "microwave"


def make():
    return gym.make("FrankaKitchen-v1", tasks_to_complete=[TASK])


def solve(env):
    """Opens the microwave by hand."""
    positions = env.unwrapped.data.qpos.copy()
    positions[OBS_ELEMENT_INDICES[TASK]] = OBS_ELEMENT_GOALS[TASK]
    env.unwrapped.robot_env.set_state(positions, env.unwrapped.data.qvel * 0)


env = make()
env.reset(seed=0)
solve(env)
*_, terminated, _, info = env.step(np.zeros(env.action_space.shape))
before = list(info["episode_task_completions"]), list(info["step_task_completions"])
env.reset()
after = list(info["episode_task_completions"]), list(info["step_task_completions"])
print(f"gymnasium-robotics {version('gymnasium-robotics')}: the last info, before and after the next reset:")
print(f"  episode_task_completions {before[0]} {after[0]}, step_task_completions {before[1]} {after[1]}")
assert terminated and before == ([TASK], [TASK])
assert after == ([], [TASK]), "an info stays as it was returned now"

envs = SyncVectorEnv([make], autoreset_mode=AutoresetMode.SAME_STEP)
envs.reset(seed=0)
solve(envs.envs[0])
_, reward, terminated, _, infos = envs.step(np.zeros(envs.action_space.shape))
final = infos["final_info"]["episode_task_completions"][0], infos["final_info"]["step_task_completions"][0]
print(f"vector environment, the episode ended with reward {reward[0]}: in final_info the episode's", end="")
print(f" completions are {final[0]}, the step's {final[1]}")
assert terminated[0] and reward[0] == 1
assert list(final[0]) == [] and list(final[1]) == [TASK], "final_info lists the completed tasks now"
PY
