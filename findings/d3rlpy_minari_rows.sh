#!/usr/bin/env bash
# d3rlpy 2.8.1: the episodes that d3rlpy.datasets.get_minari makes of a Minari data set.
#
# Guess: each step has its observation, action and reward, as in the file.
# Seen:  so it is in the first episode only. Minari has one observation more than actions in each
#        episode, the last one. get_minari joins all arrays as they are and cuts all of them at the same
#        rows. In the second episode observations are one row late, in the k-th one k - 1 rows, and its
#        first steps are the end of the episode before. In a data set of 1,000 episodes nearly all
#        actions belong to other observations. No warning, no error: shapes are right, and the surplus
#        rows at the end are dropped. Episodes made of ep.observations[:-1] are right.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 d3rlpy==2.8.1 "minari[hdf5]==0.5.4" pillow==12.0.0

MINARI_DATASETS_PATH="$folder/datasets" "$folder/venv/bin/python" -W ignore - 2>"$folder/log" <<'PY' \
  | grep '^d3rlpy\|^  ' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import gymnasium as gym
import minari
import numpy as np
from d3rlpy.datasets import get_minari
from minari.data_collector import EpisodeBuffer

EPISODES, STEPS = 4, 5


def number(episode, rows):
    """100 * episode + step, as observations of Pendulum, whose other two parts are zero."""
    return 100.0 * episode + np.arange(rows)


buffers = [
    EpisodeBuffer(
        observations=np.pad(number(i, STEPS + 1)[:, None], ((0, 0), (0, 2))).astype("f4"),
        actions=(number(i, STEPS)[:, None] / 1000).astype("f4"),
        rewards=number(i, STEPS),
        terminations=np.zeros(STEPS, bool),
        truncations=np.arange(STEPS) == STEPS - 1,
    )
    for i in range(EPISODES)
]
name = "own/pendulum-v0"
data = minari.create_dataset_from_buffers(name, buffers, env=gym.make("Pendulum-v1"))
for episode in data:
    assert np.allclose(episode.observations[:-1, 0], episode.actions[:, 0] * 1000, atol=0.01)

dataset, _ = get_minari(name)
late = []
for i, episode in enumerate(dataset.episodes):
    seen = episode.observations[:, 0].astype(int).tolist()
    acted = (episode.actions[:, 0] * 1000).round().astype(int).tolist()
    assert episode.rewards[:, 0].astype(int).tolist() == acted
    late.append(seen.index(100 * i))
    print(f"d3rlpy {version('d3rlpy')}, minari {version('minari')}, episode {i}:", flush=True)
    print(f"  observations {seen}, actions {acted}")
assert late == list(range(EPISODES)), "observations are at their actions now"
PY
