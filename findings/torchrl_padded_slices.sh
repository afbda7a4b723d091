#!/usr/bin/env bash
# torchrl 0.14.1: which losses count the padding of SliceSampler(pad_output=True).
#
# Guess: the sampler writes ("collector", "mask"), every loss finds it (loss_mask_key is "auto"), and
#        so a padded batch gives the losses of its real rows.
# Seen:  DDPG, TD3, SAC, REDQ, TQC, CrossQ, DQN, DiscreteCQL, DiscreteIQL and BC give them in all
#        their terms. Three count the padding in one term and leave it out of the others: IQL in
#        loss_qvalue, because it selects some keys of the batch and loses the mask; CQL in loss_cql,
#        and TD3BC in loss_actor, whose imitation error and scale of the value are plain means. No
#        warning. The padding repeats the last step of an episode, so that short episodes weigh more
#        and their last steps most.
#
# Here: the losses of this library leave padded rows out of every term.
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
from torchrl.data import Bounded, LazyTensorStorage, OneHot, SliceSampler, TensorDictReplayBuffer
from torchrl.modules import (
    MLP, OneHotCategorical, ProbabilisticActor, QValueActor, TanhNormal, ValueOperator,
)

BOUNDS = Bounded(-1.0, 1.0, (2,))
COUNT = {
    "IQLLoss": "loss_qvalue",
    "CQLLoss": "loss_cql",
    "TD3BCLoss": "loss_actor",
}


def critic(outputs=1):
    return ValueOperator(MLP(5, outputs, num_cells=[8]), in_keys=["observation", "action"])


def state_value():
    return ValueOperator(MLP(3, 1, num_cells=[8]), in_keys=["observation"])


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


def values():
    return TensorDictModule(MLP(3, 2, num_cells=[8]), ["observation"], ["state_action_value"])


def greedy():
    return QValueActor(MLP(3, 2, num_cells=[8]), in_keys=["observation"], spec=OneHot(2))


def slices(discrete):
    """Four slices of 8 steps of episodes of 3 steps, as the sampler pads them."""
    torch.manual_seed(1)
    action = torch.rand(30, 2) * 1.6 - 0.8
    if discrete:
        action = nn.functional.one_hot(action.argmax(-1), 2)
    flag = torch.zeros(30, 1, dtype=torch.bool)
    after = {"observation": torch.randn(30, 3), "reward": torch.randn(30, 1), "done": flag}
    after |= {"terminated": flag.clone()}
    data = {"observation": torch.randn(30, 3), "action": action, "next": after}
    data["episode"] = torch.arange(30) // 3
    sampler = SliceSampler(
        slice_len=8, traj_key="episode", strict_length=False, pad_output=True
    )
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(30), sampler=sampler, batch_size=32)
    buffer.extend(TensorDict(data, [30]))
    return buffer.sample()


torch.manual_seed(0)
spec, one_hot = {"action_spec": BOUNDS}, {"action_space": "one_hot"}
losses = {
    "DDPGLoss": (policy(), critic()),
    "TD3Loss": (policy(), critic(), {"bounds": (-1.0, 1.0), "policy_noise": 0.0}),
    "TD3BCLoss": (policy(), critic(), {"bounds": (-1.0, 1.0), "policy_noise": 0.0}),
    "SACLoss": (gaussian(), critic(), spec),
    "CQLLoss": (gaussian(), critic(), {**spec, "num_random": 1}),
    "REDQLoss": (gaussian(), critic(), {**spec, "sub_sample_len": 10}),
    "TQCLoss": (gaussian(), critic(25), spec),
    "IQLLoss": (gaussian(), critic(), state_value()),
    "DiscreteIQLLoss": (chooser(), values(), state_value(), one_hot),
    "CrossQLoss": (gaussian(), critic(), spec),
    "DQNLoss": (greedy(), one_hot),
    "DiscreteCQLLoss": (greedy(), one_hot),
    "BCLoss": (gaussian(),),
}
print(f"torchrl {version('torchrl')}: terms that change with what the padding holds")
for name, parts in losses.items():
    networks = [part for part in parts if not isinstance(part, dict)]
    options = next((part for part in parts if isinstance(part, dict)), {})
    loss = getattr(objectives, name)(*networks, **options)
    data = slices(name.startswith(("Discrete", "DQN")))
    mask = data["collector", "mask"]
    assert mask.sum() == 12 and mask.shape == (32,), mask
    other = data.clone()
    # Another real step in place of the repeated last one.
    for key in ("observation", "action", ("next", "observation"), ("next", "reward")):
        other[key][~mask] = data[key][0]
    found = []
    for batch in (data, other):
        torch.manual_seed(2)
        found.append(loss(batch))
    terms = [key for key in found[0].keys() if key.startswith("loss_") or key == "loss"]
    changed = [key for key in terms if not torch.allclose(found[0][key], found[1][key], atol=1e-6)]
    print(f"  {name}: {', '.join(changed) or 'none'} of {', '.join(terms)}")
    assert changed == ([COUNT[name]] if name in COUNT else []), f"{name} has changed"
    if name == "TD3BCLoss":
        with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
            true = (loss.actor_network(data.clone())["action"] - data["action"])[mask].square().mean()
        stated = found[0]["bc_loss"].item()
        print(f"  TD3BCLoss: imitation error {stated:.4f}, of the real rows {true.item():.4f}")
        assert abs(stated - true.item()) > 1e-3, "the imitation error of TD3BCLoss has changed"
PY
