#!/usr/bin/env bash
# torchrl 0.14.1: which goals HERReplayBuffer puts in place of the stored ones.
#
# Guess: strategy "final" takes what the episode has achieved at its end, and "final" and "episode"
#        take goals of the row's own episode, also in a full buffer, as the page says.
# Seen:  goals are read from "achieved_goal", the state before a row's action, never from
#        ("next", "achieved_goal"). The state that the last action reaches is never a goal, and where
#        success is judged after the action, the last step is never rewarded for reaching it. In a
#        full buffer an episode may begin in the last rows and go on in the first ones. The steps in
#        the last rows then get goals of the episode before. No warning. (With extend() in place of
#        add(), the second sample() of a full buffer raises a RuntimeError: it compares two tensors.)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import HERReplayBuffer, LazyTensorStorage

LENGTH = 6


def reached(transition):
    return (transition["next", "achieved_goal"] == transition["desired_goal"]).float()


def episode(number):
    """Positions 100 * number + 0, 1, ..., 6: six steps of one."""
    position = 100.0 * number + torch.arange(LENGTH + 1)[:, None]
    none = torch.full((LENGTH, 1), -1.0)
    following = {
        "achieved_goal": position[1:],
        "desired_goal": none,
        "reward": torch.zeros(LENGTH, 1),
        "done": (torch.arange(LENGTH) == LENGTH - 1)[:, None],
    }
    content = {"achieved_goal": position[:-1], "desired_goal": none, "next": following}
    return TensorDict(content, [LENGTH])


def relabelled(strategy, capacity):
    torch.manual_seed(0)
    storage = LazyTensorStorage(capacity)
    buffer = HERReplayBuffer(reached, storage=storage, her_ratio=1.0, strategy=strategy)
    for number in range(4):
        for row in episode(number):
            buffer.add(row)
    batch = buffer.sample(4000)
    goal, own = batch["desired_goal"], batch["achieved_goal"]
    return goal % 100, goal // 100 != own // 100, own // 100, batch


print(f"torchrl {version('torchrl')}: episodes of 7 positions 0 to 6, all in the buffer")
for strategy in ("final", "future", "episode"):
    goal, foreign, _, batch = relabelled(strategy, capacity=30)
    last = batch["next", "done"]
    highest, rewarded = int(goal.max()), batch["next", "reward"][last].sum().item()
    steps = f"{rewarded:.0f} of {last.sum()} last steps rewarded"
    print(f"  {strategy}: goals up to position {highest}, {steps}")
    assert not foreign.any(), "foreign goals before the buffer is full"
    assert highest == 5, "the last position is a goal now"
    assert rewarded == 0, "a last step is rewarded now"
    # What is missing: the position that the last action reaches, judged by the same function.
    batch["desired_goal"] = batch["next", "achieved_goal"]
    assert reached(batch)[last].all()

print("a buffer for 20 rows: 4 of episode 3 at its beginning, 2 of it at its end")
for strategy in ("final", "episode"):
    _, foreign, own, _ = relabelled(strategy, capacity=20)
    share = foreign[own == 3].float().mean().item()
    others = foreign[own != 3].float().mean().item()
    print(f"  {strategy}: {share:.0%} of episode 3's rows have foreign goals, {others:.0%} of the others")
    assert 0.25 < share < 0.42, "goals of other episodes no longer occur"
    assert others == 0
PY
