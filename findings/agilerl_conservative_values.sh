#!/usr/bin/env bash
# agilerl 2.58.0: the conservative term of CQN, its offline Q-learning (Kumar et al. 2020).
#
# Guess: the term raises the value of the data's action over that of all others, so that the greedy
#        action of a trained agent is the data's where rewards say nothing.
# Seen:  it subtracts the mean over all actions from the log-sum-exp, not the value of the data's
#        action. It is the same for any data, and pulls the values of all actions together. After 500
#        updates on rows with one action, a reward of 0 and terminations, the values of that action and
#        of the two that never occur differ by less than 1e-5; with the published term, by more than 0.5.
#        No warning. (Importing CQN needs peft, which a plain installation lacks.)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet agilerl==2.58.0 torch==2.13.0 tensordict==0.13.0 \
    peft==0.21.2 transformers==5.24.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium
import numpy as np
import torch
from agilerl.algorithms.cqn import CQN
from tensordict import TensorDict

ROWS = 64
space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
state = torch.zeros(1, 2)


def rows(action):
    data = {"obs": state.expand(ROWS, 2), "next_obs": state.expand(ROWS, 2)}
    data |= {"action": torch.full((ROWS, 1), action), "reward": torch.zeros(ROWS, 1)}
    return TensorDict({**data, "done": torch.ones(ROWS, 1)}, [ROWS])


def published(network, action):
    """500 updates with the term of the publication: log-sum-exp less the data's value."""
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(500):
        values = network(state.expand(ROWS, 2))
        chosen = values[:, action]
        loss = (torch.logsumexp(values, 1) - chosen).mean() + 0.5 * chosen.square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


print(f"agilerl {version('agilerl')}, CQN: values of three actions after 500 updates")
for action in range(3):
    gaps = []
    for way in ("CQN", "published"):
        torch.manual_seed(0)
        agent = CQN(space, gymnasium.spaces.Discrete(3), lr=1e-3)
        if way == "CQN":
            for _ in range(500):
                agent.learn(rows(action))
        else:
            published(agent.actor, action)
        with torch.no_grad():
            values = agent.actor(state)[0]
        others = values[[other for other in range(3) if other != action]]
        gaps.append((values[action] - others.max()).item())
        print(f"  data with action {action}, {way}: {[round(v, 6) for v in values.tolist()]}")
    assert abs(gaps[0]) < 1e-5, "the term of CQN depends on the data now"
    assert gaps[1] > 0.5, gaps
PY
