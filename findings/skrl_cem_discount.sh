#!/usr/bin/env bash
# skrl 2.1.1: the discount factor of its cross-entropy method (CEM).
#
# Guess: as its page says, episodes are ranked by the sum of discount_factor^t r_t: a reward at once counts
#        more than the same reward later.
# Seen:  the powers are reversed. The last reward of an episode has the weight 1, the first
#        discount_factor^(n-1). With one choice between a reward of 1 at once and a reward of 1 nine steps
#        later, and a factor of 0.5, the agent learns to wait. (CEM.update in agents/torch/cem/cem.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 skrl==2.1.1 gymnasium==1.4.0 numpy==2.4.0

cd "$folder"
"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import numpy as np
import torch
from skrl.agents.torch.cem import CEM, CEM_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import CategoricalMixin, Model
from skrl.trainers.torch import SequentialTrainer


class Choice(gym.Env):
    """The first action: 0 has the reward 1 at once, 1 has it nine steps later."""

    observation_space = gym.spaces.Box(0, 1, (2,))
    action_space = gym.spaces.Discrete(2)

    def look(self):
        return np.eye(2, dtype=np.float32)[min(self.time, 1)]

    def reset(self, *, seed=None, options=None):
        self.time = 0
        return self.look(), {}

    def step(self, action):
        if self.time == 0:
            self.first = int(action)
        self.time += 1
        return self.look(), float(self.time == (1, 10)[self.first]), self.time == 10, False, {}


class Policy(CategoricalMixin, Model):
    def __init__(self, **options):
        Model.__init__(self, **options)
        CategoricalMixin.__init__(self)
        self.net = torch.nn.Linear(2, 2)

    def compute(self, inputs, role=""):
        return self.net(inputs["observations"]), {}


torch.manual_seed(0)
environment = wrap_env(Choice())
spaces = {
    "observation_space": environment.observation_space,
    "action_space": environment.action_space,
    "device": "cpu",
}
policy = Policy(**spaces)
agent = CEM(
    models={"policy": policy},
    memory=RandomMemory(memory_size=100, device="cpu"),
    **spaces,
    cfg=CEM_CFG(
        rollouts=100,
        discount_factor=0.5,
        learning_rate=0.1,
        experiment={"write_interval": 0, "checkpoint_interval": 0},
    ),
)
trainer = SequentialTrainer(
    env=environment, agents=agent, cfg={"timesteps": 3000, "headless": True, "disable_progressbar": True}
)
trainer.train()
now, later = policy.net(torch.eye(2)[:1]).softmax(-1)[0].tolist()
print(f"skrl {version('skrl')}: CEM, discount factor 0.5, a reward of 1 at once or nine steps later")
print(f"  probability of the reward at once {now:.3f}, of the later one {later:.3f}")
assert later > 0.95, (now, later)
PY
