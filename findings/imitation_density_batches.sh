#!/usr/bin/env bash
# imitation 1.0.1: demonstrations for DensityAlgorithm that come in batches, as from a data loader.
#
# Guess: its page allows "an iterable of transition batches". The density is that of all demonstrations,
#        as when the same rows are given as one Transitions object.
# Seen:  it is that of the last batch alone: each batch replaces the one before. Of 320 rows in ten
#        batches, 32 are fitted. Rewards of demonstrated steps that lie in other batches are low, with a
#        shuffled loader which ones they are changes from run to run, and one last incomplete batch of a
#        few rows is all that is fitted. No warning. (set_demonstrations in algorithms/density.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet imitation==1.0.1 stable-baselines3==2.2.1 torch==2.13.0 \
    numpy==1.26.4 gymnasium==0.29.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
from imitation.algorithms.base import make_data_loader
from imitation.algorithms.density import DensityAlgorithm
from imitation.data.types import Transitions
from stable_baselines3.common.vec_env import DummyVecEnv

ROWS, BATCH = 320, 32
rng = np.random.default_rng(0)
first = np.linspace(-1, 1, ROWS, dtype=np.float32)  # moves from -1 to 1 during the demonstrations
observations = np.stack([first, np.zeros(ROWS), np.zeros(ROWS)], axis=1).astype(np.float32)
actions = rng.uniform(-2, 2, (ROWS, 1)).astype(np.float32)
whole = Transitions(
    obs=observations, acts=actions, infos=np.array([{}] * ROWS), next_obs=observations,
    dones=np.zeros(ROWS, bool),
)
venv = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")])


def fit(demonstrations):
    algorithm = DensityAlgorithm(demonstrations=demonstrations, venv=venv, rng=rng)
    algorithm.train()
    rewards = algorithm(observations, actions, observations, np.zeros(ROWS, bool))
    return len(algorithm.transitions[None]), rewards[:BATCH].mean(), rewards[-BATCH:].mean()


print(f"imitation {version('imitation')}, DensityAlgorithm: rows fitted, mean reward of the first")
print(f"  {BATCH} and of the last {BATCH} demonstrated steps of {ROWS}")
ways = {
    "one object": whole,
    "batches": list(make_data_loader(whole, BATCH, {"shuffle": False})),
}
found = {name: fit(demonstrations) for name, demonstrations in ways.items()}
for name, (rows, early, late) in found.items():
    print(f"  {name}: {rows} rows, {early:.1f} and {late:.1f}")
assert found["one object"][0] == ROWS
assert found["batches"][0] == BATCH, "all batches are fitted now"
assert found["batches"][1] < found["batches"][2] - 10
PY
