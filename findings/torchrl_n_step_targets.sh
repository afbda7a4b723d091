#!/usr/bin/env bash
# torchrl 0.14.1: which losses discount the next value of n-step data by gamma^n.
#
# Guess: MultiStep writes the number of steps to "steps_to_next_obs", the TD(0) estimator reads it,
#        and so every loss with a bootstrapped target discounts the next value by gamma^n.
# Seen:  DDPG, TD3, TD3BC, SAC (both versions), DiscreteSAC, CQL, DiscreteCQL, CrossQ, TQC, DQN and
#        distributional DQN do. IQL, DiscreteIQL and REDQ select some keys of the batch before they
#        call the estimator, lose this one, and discount by gamma. No warning. With three rewards of
#        1, gamma 0.5 and a next value of 8, the target is 1.75 + 0.125 * 8 = 2.75 in TD3 and
#        1.75 + 0.5 * 8 = 5.75 in IQL.
#
# Here: studies.algorithms puts the number of steps under "next" for IQL, where it is not lost.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl import objectives
from torchrl.data import Bounded, MultiStep, OneHot
from torchrl.modules import (
    MLP, DistributionalQValueActor, OneHotCategorical, ProbabilisticActor, QValueActor, TanhNormal,
    ValueOperator,
)

GAMMA, BOUNDS = 0.5, Bounded(-1.0, 1.0, (2,))
IGNORE = {"IQLLoss", "DiscreteIQLLoss", "REDQLoss"}


class Critic(nn.Module):
    def __init__(self, outputs=1, value=None):
        super().__init__()
        self.net = MLP(5, outputs, num_cells=[8])
        if value is not None:  # the same for all inputs
            nn.init.zeros_(self.net[-1].weight)
            nn.init.constant_(self.net[-1].bias, value)

    def forward(self, observation, action):
        return self.net(torch.cat([observation, action], -1))


def critic(**options):
    return ValueOperator(Critic(**options), in_keys=["observation", "action"])


def state_value(value=None):
    net = MLP(3, 1, num_cells=[8])
    if value is not None:
        nn.init.zeros_(net[-1].weight)
        nn.init.constant_(net[-1].bias, value)
    return ValueOperator(net, in_keys=["observation"])


def policy():
    return TensorDictModule(nn.Sequential(nn.Linear(3, 2), nn.Tanh()), ["observation"], ["action"])


def gaussian():
    net = nn.Sequential(nn.Linear(3, 4), NormalParamExtractor())
    module = TensorDictModule(net, ["observation"], ["loc", "scale"])
    return ProbabilisticActor(
        module, ["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    )


def chooser():
    module = TensorDictModule(MLP(3, 2, num_cells=[8]), ["observation"], ["logits"])
    return ProbabilisticActor(
        module, ["logits"], distribution_class=OneHotCategorical, return_log_prob=True
    )


def values(key):
    return TensorDictModule(MLP(3, 2, num_cells=[8]), ["observation"], [key])


def greedy():
    return QValueActor(MLP(3, 2, num_cells=[8]), in_keys=["observation"], spec=OneHot(2))


def atoms():
    net = nn.Sequential(nn.Linear(3, 10), nn.Unflatten(-1, (5, 2)))
    module = TensorDictModule(net, ["observation"], ["action_value"])
    return DistributionalQValueActor(module, support=torch.linspace(-9, 9, 5), spec=OneHot(2))


def make(name, *networks, **options):
    loss = getattr(objectives, name)(*networks, **options)
    if name != "DistributionalDQNLoss":
        loss.make_value_estimator(gamma=GAMMA)
    return loss


def batch(discrete=False):
    """Four rows of three steps each, as MultiStep writes them."""
    torch.manual_seed(1)
    action = torch.rand(1, 6, 2) * 1.6 - 0.8
    if discrete:
        action = nn.functional.one_hot(action.argmax(-1), 2)
    flag = torch.zeros(1, 6, 1, dtype=torch.bool)
    after = {"observation": torch.randn(1, 6, 3), "reward": torch.ones(1, 6, 1)}
    after |= {"done": flag, "terminated": flag.clone()}
    data = TensorDict({"observation": torch.randn(1, 6, 3), "action": action, "next": after}, [1, 6])
    data = MultiStep(gamma=GAMMA, n_steps=3)(data)[0, :4]
    assert data["steps_to_next_obs"].tolist() == [3, 3, 3, 3]
    assert data["next", "reward"].flatten().tolist() == [1.75] * 4
    return data.set("steps_to_next_obs", data["steps_to_next_obs"].unsqueeze(-1))


torch.manual_seed(0)
spec = {"action_spec": BOUNDS}
one_hot = {"action_space": "one_hot"}
losses = {
    "DDPGLoss": make("DDPGLoss", policy(), critic()),
    "TD3Loss": make("TD3Loss", policy(), critic(), bounds=(-1.0, 1.0)),
    "TD3BCLoss": make("TD3BCLoss", policy(), critic(), bounds=(-1.0, 1.0)),
    "SACLoss": make("SACLoss", gaussian(), critic(), **spec),
    "SACLoss, version 1": make("SACLoss", gaussian(), critic(), state_value(), **spec),
    "DiscreteSACLoss": make(
        "DiscreteSACLoss", chooser(), values("action_value"), num_actions=2, **one_hot
    ),
    "CQLLoss": make("CQLLoss", gaussian(), critic(), **spec),
    "DiscreteCQLLoss": make("DiscreteCQLLoss", greedy(), **one_hot),
    "CrossQLoss": make("CrossQLoss", gaussian(), critic(), **spec),
    "TQCLoss": make("TQCLoss", gaussian(), critic(outputs=25), **spec),
    "DQNLoss": make("DQNLoss", greedy(), **one_hot),
    "DistributionalDQNLoss": make("DistributionalDQNLoss", atoms(), gamma=GAMMA),
    "REDQLoss": make("REDQLoss", gaussian(), critic(), **spec),
    "IQLLoss": make("IQLLoss", gaussian(), critic(), state_value()),
    "DiscreteIQLLoss": make(
        "DiscreteIQLLoss", chooser(), values("state_action_value"), state_value(), **one_hot
    ),
}
print(f"torchrl {version('torchrl')}: does the loss of the critic depend on the number of steps?")
for name, loss in losses.items():
    data = batch(name.startswith(("Discrete", "DQN", "Distributional")))
    seen = []
    for given in (data, data.exclude("steps_to_next_obs")):
        torch.manual_seed(2)
        out = loss(given.clone())
        key = next(key for key in ("loss_qvalue", "loss_value", "loss") if key in out.keys())
        seen.append(out[key].item())
    reads = seen[0] != seen[1]
    print(f"  {name}: {'yes' if reads else 'no'} ({seen[0]:.6f} with it, {seen[1]:.6f} without)")
    assert reads != (name in IGNORE), f"{name} has changed"

# The target itself, from the squared error of critics that give 8 everywhere.
options = {"loss_function": "l2", "num_qvalue_nets": 2}
td3 = make("TD3Loss", policy(), critic(value=8.0), bounds=(-1.0, 1.0), **options)
iql = make("IQLLoss", gaussian(), critic(value=8.0), state_value(8.0), **options)
target = {}
for name, loss in (("TD3Loss", td3), ("IQLLoss", iql)):
    error = loss(batch())["loss_qvalue"].item() / 2  # summed over two critics
    target[name] = 8.0 - error**0.5
    print(f"  {name}: target {target[name]:.4f}")
assert abs(target["TD3Loss"] - 2.75) < 1e-4, "the target of TD3Loss has changed"
assert abs(target["IQLLoss"] - 5.75) < 1e-4, "the target of IQLLoss has changed"
PY
