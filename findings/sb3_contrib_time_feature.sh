#!/usr/bin/env bash
# sb3-contrib 2.9.2: TimeFeatureWrapper(env, test_mode=True).
#
# Guess: the time feature is 'constant, equal to zero', as the documentation says.
# Seen:  it is 1.0, which in training means that the whole episode is left. Without test_mode it goes down
#        to 0 at the end. (common/wrappers/time_feature.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==2.4.6 sb3-contrib==2.9.2 stable-baselines3==2.9.2 gymnasium==1.4.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
from sb3_contrib.common.wrappers import TimeFeatureWrapper

found = {}
for test_mode in (False, True):
    env = TimeFeatureWrapper(gymnasium.make("Pendulum-v1"), max_steps=200, test_mode=test_mode)
    env.reset(seed=0)
    found[test_mode] = [float(env.step(env.action_space.sample())[0][-1]) for _ in range(200)]
    print(f"sb3-contrib {version('sb3-contrib')}, test_mode={test_mode}: {found[test_mode][0]:.3f} at first, {found[test_mode][-1]:.3f} at the end")
assert found[False][-1] == 0.0 and set(found[True]) == {1.0}
PY
