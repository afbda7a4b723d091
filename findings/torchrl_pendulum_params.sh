#!/usr/bin/env bash
# torchrl 0.14.1: PendulumEnv(td_params=...) with another gravity and torque.
#
# Guess: the environment has them.
# Seen:  they only size the specs. A reset without parameters takes the default ones: gravity 10, and
#        actions are clipped at 2 although action_spec allows 20. reset(td_params) has them. (_reset in
#        envs/custom/pendulum.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

from torchrl.envs import PendulumEnv

wanted = PendulumEnv.gen_params(g=1.0)
wanted["params", "max_torque"].fill_(20.0)
env = PendulumEnv(td_params=wanted)
high = env.action_spec.space.high.max().item()
made, given = (state["params"] for state in (env.reset(), env.reset(wanted)))
seen = [round(each[name].item(), 1) for each in (made, given) for name in ("g", "max_torque")]
print(f"torchrl {version('torchrl')}: gravity 1 and torque 20 wanted; actions up to {high:.0f}")
print(f"  after reset(): gravity {seen[0]}, torque {seen[1]}; after reset(td_params): {seen[2]}, {seen[3]}")
assert high == 20 and seen == [10.0, 2.0, 1.0, 20.0], (high, seen)
PY
