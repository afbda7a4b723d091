#!/usr/bin/env bash
# imitation 1.0.1: behaviour cloning whose rollouts are logged, or that is evaluated between two trainings.
#
# Guess: log_rollouts_venv only logs. Batch normalisation and dropout of the policy train on every batch.
# Seen:  the first rollout, after the first batch, puts the policy into evaluation mode, and nothing puts it
#        back: predict() of Stable-Baselines3 sets it, and imitation never sets training mode. From then on
#        dropout is off, and batch normalisation keeps the statistics of one batch. 50 batches of
#        observations near 5: the running mean is 5.0 without rollouts and 0.5 with them. Any
#        evaluate_policy between two calls of train does the same; DAgger collects with predict. No warning.
#        (train in algorithms/bc.py)
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
import torch
from imitation.algorithms import bc
from imitation.data.types import Transitions
from imitation.util import logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn


class Extractor(BaseFeaturesExtractor):
    def __init__(self, space):
        super().__init__(space, 3)
        self.norm = nn.BatchNorm1d(3)

    def forward(self, x):
        return self.norm(x)


torch.manual_seed(0)
rng, size = np.random.default_rng(0), 1600
venv = DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")])
observations = (5 + rng.normal(size=(size, 3))).astype(np.float32)
demonstrations = Transitions(
    obs=observations,
    acts=rng.uniform(-1, 1, (size, 1)).astype(np.float32),
    infos=np.array([{}] * size),
    next_obs=observations,
    dones=np.zeros(size, bool),
)


def trained(rollouts):
    """Batches that the normalisation counted, and its mean, after 50 batches."""
    policy = ActorCriticPolicy(
        venv.observation_space,
        venv.action_space,
        lambda _: 1e-3,
        features_extractor_class=Extractor,
    )
    algorithm = bc.BC(
        observation_space=venv.observation_space,
        action_space=venv.action_space,
        policy=policy,
        demonstrations=demonstrations,
        rng=rng,
        custom_logger=logger.configure(format_strs=[]),
    )
    options = {"log_rollouts_venv": venv, "log_rollouts_n_episodes": 1} if rollouts else {}
    algorithm.train(n_epochs=1, progress_bar=False, **options)
    norm = policy.features_extractor.norm
    return int(norm.num_batches_tracked), norm.running_mean.mean().item()


print(f"imitation {version('imitation')}, BC: 50 batches of observations near 5")
plain, logged = trained(False), trained(True)
print(f"  without rollouts: {plain[0]} batches counted, running mean {plain[1]:.2f}")
print(f"  log_rollouts_venv: {logged[0]} counted, {logged[1]:.2f}")
assert plain[0] == 50 and abs(plain[1] - 5) < 0.1, plain
assert logged[0] == 1 and logged[1] < 1, logged
PY
