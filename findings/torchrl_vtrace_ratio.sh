#!/usr/bin/env bash
# torchrl 0.14.1: the importance weights of VTrace.
#
# Guess: as published (Espeholt et al. 2018), the weight is π(a|x) / μ(a|x) of the action a in the data.
# Seen:  π is taken of another action. The policy is called anew and its own action is scored: the mode within
#        a loss, a fresh sample elsewhere. The action in the data is not read. A policy that now takes an
#        action with probability 0.0009 gives a step with this action, which had probability 0.5, the full
#        weight instead of 0.0018, so that old data are not corrected. No warning. (_call_actor_net in
#        objectives/value/advantages.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, set_interaction_type
from torch import nn
from torchrl.modules import OneHotCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives.value import VTrace

policy, value = nn.Linear(1, 2), nn.Linear(1, 1)
for parameter in (*policy.parameters(), *value.parameters()):
    parameter.data.zero_()
policy.bias.data[1] = 7.0  # action 0 has the probability 0.0009
actor = ProbabilisticActor(
    TensorDictModule(policy, ["observation"], ["logits"]),
    in_keys=["logits"],
    distribution_class=OneHotCategorical,
    return_log_prob=True,
)
critic = ValueOperator(value, in_keys=["observation"])
module = VTrace(gamma=0.99, actor_network=actor, value_network=critic)
module.set_keys(sample_log_prob="log_mu")


def advantage(action):
    """That of a last step with reward 1 and value 0: min(weight, 1)."""
    yes = torch.ones(4, 1, 1, dtype=torch.bool)
    after = {"observation": torch.zeros(4, 1, 1), "reward": torch.ones(4, 1, 1)}
    after |= {"done": yes, "terminated": yes.clone()}
    data = {
        "observation": torch.zeros(4, 1, 1),
        "action": torch.tensor(action).expand(4, 1, 2),
        "log_mu": torch.full((4, 1), 0.5).log(),
        "next": after,
    }
    with set_interaction_type("deterministic"):  # as within a loss
        return module(TensorDict(data, [4, 1]))["advantage"].flatten().tolist()


probabilities = policy(torch.zeros(1, 1)).softmax(-1)[0].tolist()
rare, usual = advantage([1, 0]), advantage([0, 1])
print(f"torchrl {version('torchrl')}: reward 1, value 0, both actions had the probability 0.5")
print(f"  probabilities now {probabilities[0]:.4f}, {probabilities[1]:.4f}")
print(f"  advantages {rare[0]:.4f} and {usual[0]:.4f}; by definition {probabilities[0] / 0.5:.4f} and 1")
assert probabilities[0] < 0.001
assert rare == usual == [1.0] * 4, (rare, usual)
PY
