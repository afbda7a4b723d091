#!/usr/bin/env bash
# torchrl 0.14.1: a trainer of DDPG with a replay buffer and init_random_frames=250.
#
# Guess: the 250 frames of random actions fill the buffer before the first update, as is usual.
# Seen:  they are thrown away. The buffer is filled only before updates, and there are none until 250 frames
#        are collected: of 500 frames the buffer has the last 300. The diverse data that the warm-up is for
#        are never trained on. The trainers of SAC, TD3, DQN and IQL have the same code. No warning.
#        (Trainer.train in trainers/trainers.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 gymnasium==1.4.0

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
import gymnasium
import numpy as np
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymWrapper
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate
from torchrl.trainers.algorithms import DDPGTrainer


class Counting(gymnasium.Env):
    """Observes its step number."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    time = 0

    def reset(self, *, seed=None, options=None):
        return np.full(1, self.time, np.float32), {}

    def step(self, action):
        self.time += 1
        return np.full(1, self.time, np.float32), 0.0, False, False, {}


print(f"torchrl {version('torchrl')}: DDPGTrainer, 500 frames in batches of 50")
found = {}
for random_frames in (0, 250):
    torch.manual_seed(0)
    actor = TensorDictModule(nn.Linear(1, 1), ["observation"], ["action"])
    critic = ValueOperator(MLP(in_features=2, out_features=1, num_cells=[4]), in_keys=["observation", "action"])
    loss = DDPGLoss(actor, critic)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1000), batch_size=8)
    collector = Collector(
        GymWrapper(Counting()),
        actor,
        frames_per_batch=50,
        total_frames=500,
        init_random_frames=random_frames,
    )
    trainer = DDPGTrainer(
        collector=collector,
        total_frames=500,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters()),
        replay_buffer=buffer,
        progress_bar=False,
        target_net_updater=SoftUpdate(loss, tau=0.1),
        enable_logging=False,
    )
    trainer.train()
    found[random_frames] = (len(buffer), buffer[:]["observation"].min().item())
    print(f"  init_random_frames={random_frames}: {len(buffer)} in the buffer, the first of step {found[random_frames][1]:.0f}")
assert found[0] == (500, 0.0), found
assert found[250] == (300, 200.0), found
PY
