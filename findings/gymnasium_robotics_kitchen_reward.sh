#!/usr/bin/env bash
# gymnasium-robotics 1.4.2: compute_reward of FrankaKitchen, by which goals are relabelled.
#
# Guess: a function of the achieved goal, the desired goal and the info, as GoalEnv says: "the following
#        should always hold true", reward == env.compute_reward(achieved_goal, desired_goal, info).
# Seen:  it counts only tasks that the environment's episode has not completed yet. Right after a step
#        with reward 1, compute_reward gives 0 for the same goals and info, and after the next reset it
#        gives 1. Transitions that are relabelled during an episode lose the rewards of what the
#        agent has just learned to do. It also writes into the environment. No warning. With
#        remove_task_when_completed=False it is a function of its arguments.
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
from gymnasium_robotics.envs.franka_kitchen.kitchen_env import OBS_ELEMENT_GOALS, OBS_ELEMENT_INDICES

gym.register_envs(gymnasium_robotics)
TASK = "microwave"


def rewards(**options):
    """Reward of the step that opens the microwave, and its relabelled one now and after a reset."""
    env = gym.make("FrankaKitchen-v1", tasks_to_complete=[TASK, "kettle"], **options).unwrapped
    env.reset(seed=0)
    positions = env.data.qpos.copy()
    positions[OBS_ELEMENT_INDICES[TASK]] = OBS_ELEMENT_GOALS[TASK]
    env.robot_env.set_state(positions, env.data.qvel * 0)
    observation, reward, *_, info = env.step(np.zeros(env.action_space.shape))

    def relabel():
        return env.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)

    during = relabel()
    env.reset()
    return float(reward), during, relabel()


default, kept = rewards(), rewards(remove_task_when_completed=False)
for name, (reward, during, after) in (("by default", default), ("tasks not removed", kept)):
    print(f"gymnasium-robotics {version('gymnasium-robotics')}, {name}: reward {reward},", end="")
    print(f" compute_reward of the same goals {during}, after the next reset {after}")
assert default == (1.0, 0.0, 1.0), "compute_reward is a function of its arguments now"
assert kept == (1.0, 1.0, 1.0)
PY
