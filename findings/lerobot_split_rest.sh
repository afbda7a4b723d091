#!/usr/bin/env bash
# lerobot 0.4.4: split_dataset by fractions that leave a rest.
#
# Guess: {"train": 0.5, "valid": 0.1} of ten episodes gives five and one, since fractions "must sum to
#        <= 1.0"; and episodes are drawn, so that both parts hold all tasks.
# Seen:  the last part takes all that is left: five, not one. With {"train": 0.5, "valid": 0.1,
#        "test": 0.1} it is five, one and four. And parts are runs of neighbours in the order of
#        recording: of a data set with one task after the other, training holds the first task alone and
#        validation the second. No warning. Lists of episodes give what they say.
#        (_fractions_to_episode_indices in datasets/dataset_tools.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
# Without lerobot's parts for cameras and motors, and without CUDA, which torchvision's operators need.
"$folder/venv/bin/pip" install --quiet torch==2.13.0 datasets==4.4.1 huggingface_hub==0.35.3 \
  av==15.1.0 jsonlines==4.0.0 packaging==25.0 deepdiff==9.1.0 draccus==0.10.0 termcolor==3.3.0 \
  pyserial==3.5 accelerate==1.12.0 pandas==2.3.3 numpy==2.2.6 pillow==12.0.0 einops==0.8.2 pyarrow==26.0.1
"$folder/venv/bin/pip" install --quiet --no-deps lerobot==0.4.4 torchvision==0.25.0

TQDM_DISABLE=1 HF_HUB_OFFLINE=1 HF_HOME="$folder/cache" "$folder/venv/bin/python" -W ignore - "$folder" <<'PY'
import logging
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

# torchvision is imported for images, of which there are none here.
operators = torch.library.Library("torchvision", "DEF")
operators.define("nms(Tensor boxes, Tensor scores, float threshold) -> Tensor")

from datasets import disable_progress_bars
from lerobot.datasets.dataset_tools import split_dataset
from lerobot.datasets.lerobot_dataset import LeRobotDataset

logging.disable(logging.WARNING)
disable_progress_bars()
folder = Path(sys.argv[1])


def record(name, episodes, tasks):
    """A data set of one number a step."""
    feature = {"dtype": "float32", "shape": (1,), "names": ["x"]}
    features = {"observation.state": feature, "action": feature}
    data = LeRobotDataset.create(f"me/{name}", 10, features, root=folder / name, use_videos=False)
    for episode, names in zip(episodes, tasks, strict=True):
        for value, task in zip(episode, names, strict=True):
            x = np.array([value], np.float32)
            data.add_frame({"observation.state": x, "action": x, "task": task})
        data.save_episode()
    data.finalize()
    return LeRobotDataset(f"me/{name}", root=folder / name)


def states(data):
    return np.array(data.hf_dataset["observation.state"]).reshape(-1)


tasks = [["reach"] * 3] * 5 + [["lift"] * 3] * 5
data = record("whole", [np.full(3, i) for i in range(10)], tasks)
seen = []
for number, fractions in enumerate(
    ({"train": 0.5, "valid": 0.1}, {"train": 0.5, "valid": 0.1, "test": 0.1})
):
    parts = split_dataset(data, fractions, output_dir=folder / f"parts{number}")
    print(f"lerobot {version('lerobot')}, of 10 episodes {fractions}:")
    for name, part in parts.items():
        held = sorted({int(x) for x in states(part)})
        print(f"  {name}: episodes {held}, tasks {sorted({part[i]['task'] for i in range(len(part))})}")
        seen.append(held)
first, rest = [0, 1, 2, 3, 4], [5, 6, 7, 8, 9]
assert seen == [first, rest, first, [5], [6, 7, 8, 9]], "episodes are split in another way now"
PY
