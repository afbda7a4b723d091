#!/usr/bin/env bash
# metaworld 3.1.1: the observation space of the multi-task environments, MT1, MT10 and MT50.
#
# Guess: observations lie in observation_space. The goal, the last three elements, has the bounds of the
#        task's goals.
# Seen:  the space says that the goal is exactly zero, low = high = 0, in all tasks. Wrappers and vector
#        environments copy the space while the environment is still the one with a hidden goal, and it
#        stays so after set_task. What projects observations into the space removes the goal. No warning.
#        With use_one_hot it is the same. Only env.unwrapped.sawyer_observation_space is right, and only
#        once a task is set.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metaworld==3.1.1 mujoco==3.3.0 gymnasium==1.4.0 \
  numpy==2.4.0 scipy==1.17.1 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import metaworld
import numpy as np

one = metaworld.make_mt_envs("push-v3", seed=0)
several = metaworld.make_mt_envs("MT10", seed=0, use_one_hot=True)
inside = {}
for name, envs in (("MT1 push-v3", one), ("MT10 with one-hot numbers", several)):
    observation, _ = envs.reset()
    observation, *_ = envs.step(envs.action_space.sample())
    space = getattr(envs, "single_observation_space", envs.observation_space)
    row = observation.reshape(-1, space.shape[0])[-1]
    inside[name] = envs.observation_space.contains(observation)
    print(f"metaworld {version('metaworld')}, {name}: goal {row[36:39].round(2)}, bounds", end="")
    print(f" {space.low[36:39]} to {space.high[36:39]}, inside the space: {inside[name]}")
    assert row[36:39].any() and not space.low[36:39].any() and not space.high[36:39].any()
assert not any(inside.values()), "observations lie in the space now"

observation, *_ = one.step(one.action_space.sample())
right = one.unwrapped.sawyer_observation_space
assert right.contains(observation) and right.high[36:39].any()
projected = np.clip(observation, one.observation_space.low, one.observation_space.high)
changed = np.flatnonzero(projected != observation)
print(f"projected into the space, elements {changed.tolist()} change: the goal is {projected[36:39]}")
assert set(changed) == {36, 37, 38}
PY
