#!/usr/bin/env bash
# torchrl 0.14.1: ACTLoss on the chunks of ActionChunkTransform, whose ends are padded.
#
# Guess: steps past the end of a window do not count. ActionChunkTransform marks them in action_is_pad, and
#        its page says that the loss masks them out, as BCLoss with pad_mask does, and the authors' own
#        code of ACT (Zhao et al. 2023).
# Seen:  ACTLoss reads the chunk and not its mask, and has no key for one. The padding repeats the last
#        action of the window, also where the episode goes on after it. For demonstrations that move on by 1
#        a step, with windows and chunks of 8 steps, a policy that is right in every real step has a loss of
#        1.31, and the trained one stops: its fourth to eighth actions are 3 steps ahead, not 3, 4, 5, 6
#        and 7 as with BCLoss and pad_mask. The longer the chunk, the more of it is padding: where it is
#        as long as the window, nearly half. No warning. (ACTLoss.forward in objectives/act.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.transforms import ActionChunkTransform
from torchrl.objectives import ACTLoss, BCLoss

STEPS = 8  # of a window, and of a chunk
CHUNK, MASK = ("vla_action", "chunk"), "action_is_pad"


class Ahead(nn.Module):
    """Predicts how far ahead of the observation each action of the chunk is. The latent is a constant."""

    def __init__(self, ahead):
        super().__init__()
        self.ahead = nn.Parameter(ahead.clone())

    def forward(self, observation, chunk=None):
        prediction = observation[..., None] + self.ahead[:, None]
        latent = torch.zeros(*observation.shape[:-1], 2)
        return prediction if chunk is None else (prediction, latent, latent)


def act(ahead):
    policy = Ahead(ahead)
    keys = ["action_pred", "mu", "log_var"]
    return policy, ACTLoss(TensorDictModule(policy, ["observation", "action_chunk"], keys))


def cloning(ahead):
    policy = Ahead(ahead)
    loss = BCLoss(TensorDictModule(policy, ["observation"], [CHUNK]), loss_function="l1")
    loss.set_keys(action=CHUNK, pad_mask=MASK)
    return policy, loss


# Windows of demonstrations that move by 1 a step: at observation x, the action h steps later is x + h.
start = torch.arange(0.0, 16.0)[:, None]
position = (start + torch.arange(0.0, STEPS))[..., None]
data = TensorDict({"observation": position, "action": position.clone()}, [16, STEPS])
data = ActionChunkTransform(STEPS)(data)
padded = data[MASK].float().mean().item()
true = torch.arange(0.0, STEPS)

print(f"torchrl {version('torchrl')}: chunks of {STEPS} steps, {padded:.0%} of them padding")
found = {}
for name, make in (("ACTLoss", act), ("BCLoss with pad_mask", cloning)):
    policy, loss = make(true)
    right = loss(data).get("loss_act" if make is act else "loss_bc").item()
    policy, loss = make(torch.zeros(STEPS))
    optimizer = torch.optim.SGD(loss.parameters(), lr=10.0)
    for step in range(400):
        for group in optimizer.param_groups:
            group["lr"] = 10.0 * (1.0 - step / 400)
        optimizer.zero_grad()
        loss(data).get("loss_act" if make is act else "loss_bc").backward()
        optimizer.step()
    with torch.no_grad():
        ahead = next(iter(loss.actor_network_params.values(True, True))).detach()
    found[name] = (right, ahead)
    print(f"  {name}: the right policy {right:.2f}; trained, the actions are ahead by")
    print(f"    {', '.join(f'{a:.1f}' for a in ahead.tolist())}")

right, ahead = found["BCLoss with pad_mask"]
assert right < 1e-6 and torch.allclose(ahead, true, atol=0.1)
right, ahead = found["ACTLoss"]
assert right > 0.5 and ahead[-1] < 4.5, "padding is left out now"
PY
