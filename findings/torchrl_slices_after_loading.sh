#!/usr/bin/env bash
# torchrl 0.14.1: SliceSampler on a full replay buffer, before and after the buffer is saved and loaded.
#
# Guess: a buffer that was loaded gives the slices that the saved one gives: steps that follow each
#        other in one episode.
# Seen:  a full buffer whose newest episode is unfinished ends a slice at the last row written, where
#        the newest rows meet the oldest. Neither dumps/loads nor state_dict stores this position. A
#        loaded buffer takes the newest rows and the oldest ones after them for one episode, and some
#        of its slices jump from one to the other. Loaded into a buffer that was used before, it ends
#        slices at that buffer's position instead. No warning. The writer's own position is stored,
#        and after the next extend() the slices are right again.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False "$folder/venv/bin/python" - "$folder" <<'PY'
import sys
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer


def steps(first, count, length=10):
    number = torch.arange(first, first + count)
    done = (number % length == length - 1)[:, None]
    return TensorDict({"step": number, "next": {"done": done}}, [count])


def make():
    torch.manual_seed(0)
    sampler = SliceSampler(slice_len=3, end_key=("next", "done"))
    return TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=sampler, batch_size=3000)


def jumping(buffer):
    """Share of the slices whose steps do not follow each other."""
    step = buffer.sample()["step"].view(-1, 3)
    return ((step[:, 1:] - step[:, :-1]) != 1).any(1).float().mean().item()


saved = make()
saved.extend(steps(0, 20))  # two episodes of 10 steps
saved.extend(steps(20, 4))  # a third one, unfinished, over the beginning of the first
before = jumping(saved)
saved.dumps(sys.argv[1] + "/buffer")

loaded, from_state, used = make(), make(), make()
loaded.loads(sys.argv[1] + "/buffer")
from_state.load_state_dict(saved.state_dict())
used.extend(steps(0, 20))
used.loads(sys.argv[1] + "/buffer")
for buffer in (loaded, from_state, used):
    assert torch.equal(buffer[:]["step"], saved[:]["step"]), "other rows"
shares = [jumping(buffer) for buffer in (loaded, from_state, used)]
loaded.extend(steps(24, 1))
after = jumping(loaded)

print(f"torchrl {version('torchrl')}: slices of three steps that do not follow each other")
print(f"  before saving {before:.1%}, after loads() {shares[0]:.1%}, load_state_dict() {shares[1]:.1%},")
print(f"  loads() into a used buffer {shares[2]:.1%}, after a further extend() {after:.1%}")
assert before == 0.0, "slices jump before saving"
assert all(share > 0.03 for share in shares), "slices of a loaded buffer no longer jump"
assert after == 0.0, "slices jump after a further extend()"
PY
