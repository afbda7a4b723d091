#!/usr/bin/env bash
# lerobot 0.4.4: quantiles in stats.json of a data set of several episodes.
#
# Guess: q01 and q99 are what 1% and 99% of all steps lie below, as min, max, mean and std are of all
#        steps.
# Seen:  they are the means of the episodes' own quantiles, weighted by steps. Three episodes around 10,
#        20 and 30, each within 1, give q01 = 19.0 and q99 = 21.0; of all steps they are 9.1 and 30.9.
#        NormalizationMode.QUANTILES, which pi0.5 has by default for states and actions, then maps the
#        data to -11.1 ... 11.1 where [-1, 1] is promised. No warning. Each file of statistics of a data
#        set that grew by save_episode(), or was merged, split or cut, is made so.
#        (aggregate_feature_stats in datasets/compute_stats.py)
#
# Here: `convert --to lerobot` writes the quantiles of all steps.
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
from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.processor import TransitionKey
from lerobot.processor.normalize_processor import NormalizerProcessorStep

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


around = np.linspace(-1, 1, 100)
data = record("quantiles", [10 + around, 20 + around, 30 + around], [["reach"] * 100] * 3)
x, stats = states(data), data.meta.stats["observation.state"]
for name in ("q01", "q10", "q90", "q99"):
    of_all = np.quantile(x, int(name[1:]) / 100)
    print(f"lerobot {version('lerobot')}, {name}: {stats[name][0]:.2f}; of all steps {of_all:.2f}")
assert abs(stats["min"][0] - x.min()) < 1e-5 and abs(stats["std"][0] - x.std()) < 1e-3

normalise = NormalizerProcessorStep(
    {"observation.state": PolicyFeature(FeatureType.STATE, (1,))},
    {FeatureType.STATE: NormalizationMode.QUANTILES},
    data.meta.stats,
)
step = {TransitionKey.OBSERVATION: {"observation.state": torch.tensor(x)[:, None]}}
ends = normalise(step)[TransitionKey.OBSERVATION]["observation.state"].aminmax()
print(f"normalised by them: {ends.min:.1f} to {ends.max:.1f}")
assert abs(stats["q01"][0] - 19.0) < 0.1 and abs(stats["q99"][0] - 21.0) < 0.1, "other quantiles now"
assert ends.min < -11 and ends.max > 11
PY
