#!/usr/bin/env bash
# torchrl 0.14.1: slices of RobosetExperienceReplay, whose data sets have several files, one a seed.
#
# Guess: a slice stays in one episode, with SliceSampler as with SliceSamplerWithoutReplacement, which
#        TorchRL's page on the latter shows with this data set.
# Seen:  "episode" is the number within a file, and equal numbers of different files lie side by side.
#        The samplers take them for one episode. Some slices begin in one seed's episode and go on in
#        another's, and of three files, an epoch of SliceSamplerWithoutReplacement visits a third of
#        the episodes. No warning. With end_key=("next", "done") slices are right. The last next
#        observation of every episode is zero.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 \
  h5py==3.16.0 huggingface_hub==0.36.0

RL_WARNINGS=False "$folder/venv/bin/python" - "$folder" <<'PY'
import sys
from importlib.metadata import version
from pathlib import Path

import h5py
import numpy as np
import torch
from torchrl.data import SliceSampler, SliceSamplerWithoutReplacement
from torchrl.data.datasets import RobosetExperienceReplay

folder = Path(sys.argv[1])
SEEDS, TRIALS, STEPS, SLICE = 3, 4, 10, 3
files = []
for seed in range(SEEDS):  # files as RoboSet has them: observations 1000 * seed + 100 * trial + step
    files.append(folder / f"seed{seed}.h5")
    with h5py.File(files[-1], "w") as file:
        for trial in range(TRIALS):
            episode = file.create_group(f"Trial{trial}")
            episode["observations"] = (1000.0 * seed + 100 * trial + np.arange(STEPS))[:, None]
            episode["actions"] = np.zeros((STEPS, 1))
            episode["rewards"] = np.zeros(STEPS)
            episode["done"] = np.arange(STEPS) == STEPS - 1


class Local(RobosetExperienceReplay):
    """Reads the files above in place of the download."""

    def _download_from_huggingface(self, tempdir):
        return files


def load(sampler):
    torch.manual_seed(0)
    name = RobosetExperienceReplay.available_datasets[0]
    return Local(name, 600, root=folder / "converted", sampler=sampler)


def crossing(**options):
    slices = load(SliceSampler(slice_len=SLICE, **options)).sample()["observation"].view(-1, SLICE)
    return ((slices[:, 1:] - slices[:, :-1]) != 1).any(1).float().mean().item()


def epoch(**options):
    data = load(SliceSamplerWithoutReplacement(slice_len=SLICE, **options))
    seen = torch.cat([batch["observation"] for batch in data])
    return (seen // 100).unique().numel()


BY_DONE = {"end_key": ("next", "done")}
joined, visited = crossing(), epoch()
data = load(None)[:]
last = data["next", "done"].flatten()
print(f"torchrl {version('torchrl')}: {SEEDS} files of {TRIALS} episodes,", end="")
print(f" numbered {data['episode'].unique().tolist()}")
print(f"  {joined:.0%} of the slices join two episodes, an epoch visits {visited} of {last.sum()};")
print(f"  by the done flags {crossing(**BY_DONE):.0%} and {epoch(**BY_DONE)}")
assert joined > 0.1, "slices stay in one episode now"
assert visited < SEEDS * TRIALS, "an epoch visits all episodes now"
assert crossing(**BY_DONE) == 0 and epoch(**BY_DONE) == SEEDS * TRIALS
assert (data["next", "observation"][last] == 0).all() and last.sum() == SEEDS * TRIALS
PY
