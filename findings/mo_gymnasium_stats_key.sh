#!/usr/bin/env bash
# mo-gymnasium 1.3.2: MORecordEpisodeStatistics(env, stats_key='mine').
#
# Guess: the statistics are in info['mine'], so that two wrappers with two discounts can stand beside each
#        other.
# Seen:  they are in info['episode'], whatever the key. The outer wrapper replaces the numbers of the inner
#        one. (wrappers/wrappers.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mo-gymnasium==1.3.2 gymnasium==1.4.0 numpy==2.4.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import mo_gymnasium
from mo_gymnasium.wrappers import MORecordEpisodeStatistics

env = mo_gymnasium.make("deep-sea-treasure-v0")
for key, gamma in (("inner", 0.5), ("outer", 1.0)):
    env = MORecordEpisodeStatistics(env, gamma=gamma, stats_key=key)
env.reset(seed=0)
ended = False
while not ended:
    _, _, terminated, truncated, info = env.step(1)
    ended = terminated or truncated
keys = [key for key in ("inner", "outer", "episode") if key in info]
print(f"mo-gymnasium {version('mo-gymnasium')}, stats_key 'inner' and 'outer': info has {keys}")
assert keys == ["episode"], keys
PY
