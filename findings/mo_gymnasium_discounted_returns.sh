#!/usr/bin/env bash
# mo-gymnasium 1.3.2: the discounted return that the vector wrapper MORecordEpisodeStatistics reports.
#
# Guess: that of the episode, as its neighbour, the return.
# Seen:  the sum over all episodes so far: it is never set back. The returns of three equal episodes are
#        equal, their discounted returns grow. (wrappers/vector/wrappers.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mo-gymnasium==1.3.2 gymnasium==1.4.0 numpy==2.4.6

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import mo_gymnasium
from mo_gymnasium.wrappers.vector import MORecordEpisodeStatistics, MOSyncVectorEnv

env = MORecordEpisodeStatistics(MOSyncVectorEnv([lambda: mo_gymnasium.make("deep-sea-treasure-v0")]), gamma=1.0)
env.reset(seed=0)
found = []
while len(found) < 3:
    info = env.step([1])[4]
    if "episode" in info:
        found.append([[round(float(x), 2) for x in info["episode"][name][0]] for name in ("r", "dr")])
        print(f"mo-gymnasium {version('mo-gymnasium')}, gamma 1, episode {len(found)}: return {found[-1][0]}, discounted return {found[-1][1]}")
assert found[0][0] == found[0][1] and found[2][0] == found[0][0], found
assert found[2][1] == [round(3 * x, 2) for x in found[0][0]], found
PY
