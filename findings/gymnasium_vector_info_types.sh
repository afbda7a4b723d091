#!/usr/bin/env bash
# gymnasium 1.4.0: numbers in the infos of a vector environment, here FrozenLake's "prob".
#
# Guess: the number of each environment, as it is without the vector: 1/3 for a step on slippery ice.
# Seen:  the array has the type of the first environment's number, and the others are cast to it. When the
#        first environment has just been reset, FrozenLake gives the integer 1, and the 1/3 of the others
#        become 0. Infos that are whole numbers in one environment lose the fractions of all. No warning.
#        (VectorEnv._add_info in vector/vector_env.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet gymnasium==1.4.0 numpy==2.2.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import numpy as np

print(f"gymnasium {version('gymnasium')}: prob of three environments of FrozenLake")
for mode in ("sync", "async"):
    environments = gym.make_vec("FrozenLake-v1", num_envs=3, vectorization_mode=mode)
    environments.reset(seed=0)
    environments.action_space.seed(0)
    done, found, usual = np.zeros(3, bool), [], []
    for _ in range(100):
        _, _, terminated, truncated, info = environments.step(environments.action_space.sample())
        (found if done[0] and not done[1:].any() else usual).append(info["prob"])
        done = terminated | truncated
    environments.close()
    odd = found[0]
    print(f"  {mode}: {np.round(usual[0], 2)}; after a reset of the first one {odd} ({odd.dtype})")
    assert odd.dtype.kind == "i" and odd.tolist() == [1, 0, 0], odd
    assert np.allclose(usual[0], 1 / 3), usual[0]
PY
