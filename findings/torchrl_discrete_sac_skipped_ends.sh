#!/usr/bin/env bash
# torchrl 0.14.1: DiscreteSACLoss(skip_done_states=True) and episodes that a time limit cuts.
#
# Guess: as the page says, the networks are "only run on valid, non-terminating next states": a truncated
#        state is not terminating, so its value is used as it is without the option.
# Seen:  states are skipped by "done", and a skipped state has the value 0. Truncated rows are then targets as
#        if the episode had terminated, although "terminated" is False: with a reward of 1, values of 100 and
#        γ = 0.99 the target is 1 instead of about 100. No warning. Rows that end in no way are right.
#        (_compute_target in objectives/sac.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import OneHotCategorical, ProbabilisticActor, ValueOperator
from torchrl.objectives import DiscreteSACLoss


class Hundred(nn.Linear):
    """The value of every action is 100."""

    def __init__(self):
        super().__init__(2, 3)
        self.weight.data.zero_()
        self.bias.data.fill_(100.0)


actor = ProbabilisticActor(
    TensorDictModule(nn.Linear(2, 3), ["observation"], ["logits"]),
    in_keys=["logits"],
    distribution_class=OneHotCategorical,
    return_log_prob=True,
)
critic = TensorDictModule(Hundred(), ["observation"], ["action_value"])


def squared_error(skip, *, done, terminated):
    """That of each row: (100 - target)^2, with no entropy."""
    loss = DiscreteSACLoss(
        actor,
        critic,
        action_space="one_hot",
        num_actions=3,
        skip_done_states=skip,
        fixed_alpha=True,
        alpha_init=1e-9,
        loss_function="l2",
        reduction="mean",
    )
    loss.make_value_estimator(gamma=0.99)
    # The first row ends in no way, as most do.
    flags = {"done": torch.tensor([[False], [done]]), "terminated": torch.tensor([[False], [terminated]])}
    after = {"observation": torch.zeros(2, 2), "reward": torch.ones(2, 1)} | flags
    action = torch.eye(3)[:2]
    data = TensorDict({"observation": torch.zeros(2, 2), "action": action, "next": after}, [2])
    loss(data)
    return data["td_error"].flatten().tolist()


print(f"torchrl {version('torchrl')}: squared error of the value 100; reward 1, next values 100")
found = {}
for name, done, terminated in (("goes on", False, False), ("truncated", True, False), ("terminated", True, True)):
    found[name] = [squared_error(skip, done=done, terminated=terminated)[1] for skip in (False, True)]
    print(f"  {name}: {found[name][0]:.0f}, with skip_done_states {found[name][1]:.0f}")
for name, (plain, skipped) in found.items():
    assert (abs(plain - skipped) < 1e-2) == (name != "truncated"), found
plain, skipped = found["truncated"]
assert plain < 1 and abs(skipped - found["terminated"][0]) < 1e-2, found
PY
