#!/usr/bin/env bash
# lerobot 0.4.4: modify_tasks with the new task of one episode, in a data set where another episode has
# two tasks.
#
# Guess: the named episode changes and no other: the page says that episode_tasks sets "specific tasks
#        for specific episodes", and that others keep their task.
# Seen:  every step of the other episode gets one of its two tasks, and the steps of the other task are
#        lost, in the files themselves, which are changed in place. Which one is kept is decided by the
#        order of a set of texts: it differs between processes that recorded. No warning.
#        (modify_tasks in datasets/dataset_tools.py, save_episode in datasets/lerobot_dataset.py)
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
from lerobot.datasets.dataset_tools import modify_tasks
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


both = ["reach", "reach", "lift", "lift"]
data = record("tasks", [range(4), range(4)], [["reach"] * 4, both])


def tasks_of(data):
    return [data[i]["task"] for i in range(len(data))]


print(f"lerobot {version('lerobot')}, before: {tasks_of(data)}")
assert tasks_of(data) == ["reach"] * 4 + both
modify_tasks(data, episode_tasks={0: "push"})
after = tasks_of(LeRobotDataset("me/tasks", root=folder / "tasks"))
print(f"after modify_tasks(data, episode_tasks={{0: 'push'}}): {after}")
assert after[:4] == ["push"] * 4
assert after[4:] in (["reach"] * 4, ["lift"] * 4), "the other episode is left alone now"
PY
