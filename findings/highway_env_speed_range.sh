#!/usr/bin/env bash
# highway-env 1.12.1: action {'type': 'DiscreteAction', 'speed_range': [0, 10]}.
#
# Guess: the vehicle keeps to the range, as with ContinuousAction.
# Seen:  DiscreteAction drops the setting without a word, and the vehicle reaches the default limit, 40
#        m/s. (envs/common/action.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet highway-env==1.12.1 gymnasium==1.4.0 numpy==2.4.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import highway_env  # noqa: F401

found = {}
for kind, throttle in (("ContinuousAction", [1.0, 0.0]), ("DiscreteAction", None)):
    action = {"type": kind, "speed_range": [0, 10]}
    env = gymnasium.make("highway-v0", config={"vehicles_count": 0, "action": action, "duration": 40})
    env.reset(seed=0)
    if throttle is None:
        per_axis = env.unwrapped.action_type.actions_per_axis
        throttle = per_axis * (per_axis - 1) + per_axis // 2  # full throttle, straight on
    for _ in range(20):
        if env.step(throttle)[2]:
            break
    found[kind] = float(env.unwrapped.vehicle.speed)
    print(f"highway-env {version('highway-env')}, {kind}, speed_range [0, 10]: {found[kind]:.1f} m/s")
assert found["ContinuousAction"] < 10.1 and found["DiscreteAction"] > 20, found
PY
