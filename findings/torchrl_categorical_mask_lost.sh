#!/usr/bin/env bash
# torchrl 0.14.1: the mask of a Categorical action spec, which forbids actions.
#
# Guess: the mask stays with the spec when the spec is expanded to a batch, moved, indexed or turned into its
#        one-hot form, as that of OneHot stays.
# Seen:  expand(), to(), reshape(), [...] and to_one_hot_spec() return a spec without a mask. EGreedyModule
#        expands its spec to the batch, so a third of its random actions are the forbidden one; with a state
#        without a batch dimension, there is none. With OneHot there is none in either case. No warning.
#        (Categorical.expand in data/tensor_specs.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from torchrl.data import Categorical, OneHot
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import EGreedyModule

torch.manual_seed(0)
mask = torch.tensor([True, False, True])
spec, one_hot = Categorical(3, mask=mask), OneHot(3, mask=mask)
assert spec.mask is not None and one_hot.mask is not None
kept = {
    "expand": (spec.expand(5).mask, one_hot.expand(5, 3).mask),
    "to": (spec.to(torch.int32).mask, one_hot.to(torch.int32).mask),
    "to_one_hot_spec / to_categorical_spec": (spec.to_one_hot_spec().mask, one_hot.to_categorical_spec().mask),
}
print(f"torchrl {version('torchrl')}: is the mask kept? (Categorical, OneHot)")
for name, masks in kept.items():
    print(f"  {name}: {[each is not None for each in masks]}")


def forbidden(spec, batch):
    """Share of random actions that the mask forbids."""
    module = EGreedyModule(spec, eps_init=1.0, eps_end=1.0)
    first = torch.zeros(3) if isinstance(spec, OneHot) else torch.tensor(0)
    if isinstance(spec, OneHot):
        first[0] = 1
    with set_exploration_type(ExplorationType.RANDOM):
        if batch:
            rows = TensorDict({"action": first.expand(3000, *first.shape).clone()}, [3000])
            action = module(rows)["action"]
        else:
            action = torch.stack([module(TensorDict({"action": first.clone()}, []))["action"] for _ in range(300)])
    return (action.argmax(-1) == 1 if isinstance(spec, OneHot) else action == 1).float().mean().item()


shares = {(type(s).__name__, batch): forbidden(s, batch) for s in (spec, one_hot) for batch in (False, True)}
for (name, batch), share in shares.items():
    print(f"  EGreedyModule, {name}, {'batch' if batch else 'one state'}: {share:.0%} forbidden")
assert all(each is None for each, _ in kept.values()), kept
assert kept["expand"][1] is not None and kept["to"][1] is not None, kept
assert shares.pop(("Categorical", True)) > 0.25
assert set(shares.values()) == {0.0}, shares
PY
