#!/usr/bin/env bash
# minari 0.5.4: combine_datasets with data sets that are filtered or split.
#
# Guess: the combined data set has the episodes of the data sets that were given to it.
# Seen:  it has all episodes of the files that these point to. Successful episodes, picked with
#        filter_episodes, come back together with the failures; the training parts of split_dataset
#        come back together with the held-out parts. No warning. The same data sets iterate, sample
#        and count only their own episodes. Both storage formats, HDF5 and Arrow, behave so.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet "minari[hdf5,arrow]==0.5.4" pillow==12.0.0

MINARI_DATASETS_PATH="$folder/datasets" "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer

BOX = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)


def make(name, first, data_format):
    """Four episodes, whose observations are their numbers; every second one has a reward."""
    buffers = [
        EpisodeBuffer(
            observations=np.full((4, 1), first + number, np.float32),
            actions=np.zeros((3, 1), np.float32),
            rewards=np.array([0.0, 0.0, number % 2]),
            terminations=np.array([False, False, True]),
            truncations=np.zeros(3, bool),
        )
        for number in range(4)
    ]
    return minari.create_dataset_from_buffers(
        name, buffers, observation_space=BOX, action_space=BOX, data_format=data_format
    )


def numbers(dataset):
    return sorted(int(episode.observations[0, 0]) for episode in dataset)


for data_format in ("hdf5", "arrow"):
    first = make(f"{data_format}/first-v0", 0, data_format)
    second = make(f"{data_format}/second-v0", 10, data_format)
    successful = first.filter_episodes(lambda episode: episode.rewards.sum() > 0)
    training, held_out = minari.split_dataset(second, [3, 1], seed=0)
    combined = minari.combine_datasets([successful, training], f"{data_format}/both-v0")
    given = numbers(successful) + numbers(training)
    print(f"minari {version('minari')}, {data_format}: given episodes {given}, combined {numbers(combined)}")
    assert len(given) == successful.total_episodes + training.total_episodes == 5
    assert numbers(combined) == [0, 1, 2, 3, 10, 11, 12, 13], "only given episodes are combined now"
    assert set(numbers(held_out)) < set(numbers(combined))
PY
