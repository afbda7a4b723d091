#!/usr/bin/env bash
# metaworld 3.1.1: the held-out goals of ML1(seed) for seeds that lie side by side.
#
# Guess: goals of different seeds are different draws. A policy that was trained with seed 1 has not
#        seen the held-out goals of seed 0.
# Seen:  held-out goals are drawn with seed + 1, as training goals of seed + 1 are: the 50 held-out
#        goals of seed 0 are the 50 training goals of seed 1. Among seeds 0 to 4, four of five test sets
#        are another run's training set. Demonstrations of several seeds that are put together, or a
#        model of one seed that is tested with the seed before, are tested on what was trained. No
#        warning. Within one seed the two sets are disjoint. Seeds two apart share nothing.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metaworld==3.1.1 mujoco==3.3.0 gymnasium==1.4.0 \
  numpy==2.4.0 scipy==1.17.1 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
import pickle
from importlib.metadata import version

import metaworld

SEEDS = range(4)


def goals(tasks):
    return {tuple(pickle.loads(task.data)["rand_vec"]) for task in tasks}


training, held_out = {}, {}
for seed in SEEDS:
    benchmark = metaworld.ML1("push-v3", seed=seed)
    training[seed], held_out[seed] = goals(benchmark.train_tasks), goals(benchmark.test_tasks)
for seed in SEEDS:
    shared = [len(held_out[seed] & training[other]) for other in SEEDS]
    print(f"metaworld {version('metaworld')}, seed {seed}: {len(held_out[seed])} held-out goals, of which", end="")
    print(f" training goals of seeds 0 to 3: {shared}")
    expected = [50 if other == seed + 1 else 0 for other in SEEDS]
    assert shared == expected, "neighbouring seeds share other goals now"
PY
