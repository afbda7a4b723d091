#!/usr/bin/env bash
# dm_control 1.0.50: noises.Additive(BiasedRandomWalk(0.1)) on an observation of three numbers.
#
# Guess: each number has a noise of its own, as with Additive(Normal(...)).
# Seen:  all three get the same number, so differences between sensors stay exact.
#        (composer/variation)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet dm_control==1.0.50 mujoco==4.0.0 numpy==2.4.6

MUJOCO_GL=disable "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import numpy as np
from dm_control.composer.variation import distributions, noises

zeros, seen = np.zeros(3), {}
for name, distribution in {
    "Normal": distributions.Normal(scale=0.1),
    "BiasedRandomWalk": distributions.BiasedRandomWalk(stdev=0.1, timescale=10),
}.items():
    state = np.random.RandomState(0)
    noise = noises.Additive(distribution)
    for _ in range(3):
        values = noise(initial_value=zeros, current_value=zeros, random_state=state)
    seen[name] = len(set(np.asarray(values).tolist()))
    print(f"dm_control {version('dm_control')}, {name}: {np.round(values, 4).tolist()}")
assert seen == {"Normal": 3, "BiasedRandomWalk": 1}, seen
PY
