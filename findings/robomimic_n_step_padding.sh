#!/usr/bin/env bash
# robomimic 0.3.0: n_step of TD3_BC, BCQ and CQL, at the end of a demonstration.
#
# Guess: the last n - 1 rows of a demonstration sum up the rewards that are left. With a reward of 1 at
#        the last step, where done is 1, too, that row has a target of 1.
# Seen:  sequences that reach past the end repeat the last row, with its reward, and the sum takes the
#        repeated rewards for real ones. With n_step = 5 and a discount of 0.9 the last row has 1 + 0.9 +
#        ... = 4.1, the one before 3.1 in place of 0.9, so that values of success are up to n times too
#        high. The earlier row that is a whole 5 steps from the end has 0.66, as it should. No warning;
#        pad_seq_length is on by default, and the mask of the padding is not asked for.
#        (process_batch_for_training of the three, SequenceDataset.get_sequence_from_demo)
#
# torchvision, which only networks for images use, is replaced by a stand-in, to save its installation.
# Here: torchrl_bmrl.data.n_step stops at each termination and at the end of each episode.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-deps robomimic==0.3.0
"$folder/venv/bin/pip" install --quiet torch==2.13.0 numpy==1.26.4 h5py==3.16.0 six==1.17.0 \
    tqdm==4.70.1 termcolor==3.3.0 psutil==7.2.2 imageio==2.38.1 imageio-ffmpeg==0.8.1 matplotlib==3.11.2 \
    tensorboardX==2.6.5

export FILE="$folder/demo.hdf5"
"$folder/venv/bin/python" -W ignore - <<'PY' >"$folder/log" 2>&1 || { cat "$folder/log" && exit 1; }
import contextlib
import io
import os
import sys
from importlib.metadata import version
from unittest.mock import MagicMock

for name in ("torchvision", "torchvision.models", "torchvision.transforms"):
    sys.modules[name] = MagicMock()
sys.modules["torchvision.transforms.functional"] = MagicMock()

import h5py
import numpy as np
import torch
from robomimic.algo import algo_factory
from robomimic.config import config_factory
from robomimic.utils.obs_utils import initialize_obs_utils_with_config
from robomimic.utils.train_utils import dataset_factory

STEPS, N, GAMMA = 12, 5, 0.9
path = os.environ["FILE"]
last = np.arange(STEPS) == STEPS - 1
state = np.arange(STEPS + 1, dtype=np.float32)[:, None]
with h5py.File(path, "w") as file:
    demo = file.create_group("data/demo_0")
    demo.attrs["num_samples"] = STEPS
    demo["obs/state"], demo["next_obs/state"] = state[:-1], state[1:]
    demo["actions"] = np.zeros((STEPS, 1), np.float32)
    demo["rewards"], demo["dones"] = last.astype(np.float32), last.astype(np.int64)

left = STEPS - 1 - np.arange(STEPS)  # steps to the rewarded one
true = np.where(left < N, GAMMA**left, 0.0)
print(f"robomimic {version('robomimic')}: sums of {N} rewards, the last {N + 1} rows of a demonstration")
print(f"  of the data: {true[-N - 1 :].round(2)}")
for name in ("td3_bc", "bcq", "cql"):
    config = config_factory(name)
    config.observation.modalities.obs.low_dim = ["state"]
    config.train.data = path
    config.train.hdf5_normalize_obs = False
    config.train.seq_length = config.algo.n_step = N
    config.algo.discount = GAMMA
    config.lock()
    assert config.train.pad_seq_length
    with contextlib.redirect_stdout(io.StringIO()):
        initialize_obs_utils_with_config(config)
        dataset = dataset_factory(config, obs_keys=["state"])
        algorithm = algo_factory(name, config, {"state": [1]}, ac_dim=1, device="cpu")
    batch = next(iter(torch.utils.data.DataLoader(dataset, batch_size=STEPS)))
    batch = algorithm.process_batch_for_training(batch)
    rewards, dones = (batch[key].flatten().numpy() for key in ("rewards", "dones"))
    print(f"  {name}: {rewards[-N - 1 :].round(2)}, done {dones[-N - 1 :].astype(int)}")
    assert (dones == (left < N)).all()
    assert np.allclose(rewards[: -N + 1], true[: -N + 1], atol=1e-6)
    repeated = sum(GAMMA**k for k in range(N))
    assert abs(rewards[-1] - repeated) < 1e-5, "repeated rewards are left out now"
PY
# The library's own messages are left out.
grep -E '^(robomimic |  (of the data|td3_bc|bcq|cql):)' "$folder/log"
