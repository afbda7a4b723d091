#!/usr/bin/env bash
# metaworld 3.1.1: the task families of ML25's training and test sets.
#
# Guess: 25 families to train and 5 others to test, as in ML10 and ML45, none of them in both.
# Seen:  "basketball-v3" is in both: a fifth of the test measures a family that was trained. No
#        warning. CustomML with the same two lists raises an error, since a test family is trained.
#        ML10 and ML45 have no family in both.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metaworld==3.1.1 mujoco==3.3.0 gymnasium==1.4.0 \
  numpy==2.4.0 scipy==1.17.1 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import metaworld
from metaworld.env_dict import ML10_V3, ML25_V3, ML45_V3

metaworld._N_GOALS = 1  # the families are enough
benchmark = metaworld.ML25(seed=0)
assert set(benchmark.train_classes) == set(ML25_V3["train"])
assert {task.env_name for task in benchmark.test_tasks} == set(ML25_V3["test"])

both = {}
for name, families in (("ML10", ML10_V3), ("ML25", ML25_V3), ("ML45", ML45_V3)):
    both[name] = sorted(set(families["train"]) & set(families["test"]))
    print(f"metaworld {version('metaworld')}, {name}: {len(families['train'])} families to train,", end="")
    print(f" {len(families['test'])} to test, in both: {' '.join(both[name]) or 'none'}")
assert both == {"ML10": [], "ML25": ["basketball-v3"], "ML45": []}, "other families are in both now"

try:
    metaworld.CustomML(list(ML25_V3["train"]), list(ML25_V3["test"]))
except ValueError as error:
    print(f"CustomML with these lists: {error}")
else:
    raise AssertionError("CustomML accepts a family in both lists now")
PY
