#!/usr/bin/env bash
# torchrl 0.14.1: DecisionTransformerInferenceWrapper with inference_context=1.
#
# Guess: the policy sees the last observation and return to go, and no earlier action.
# Seen:  earlier observations and returns are masked, but all earlier actions are left: 19 of 20 in a
#        window of 20, where a context of 5 leaves 4 and one of 2 leaves 1. (mask_context in
#        modules/tensordict_module/actors.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import DecisionTransformerInferenceWrapper

policy = TensorDictModule(nn.Identity(), ["observation"], ["action"])
found = {}
for context in (1, 2, 5):
    wrapper = DecisionTransformerInferenceWrapper(policy, inference_context=context)
    data = {"observation": torch.ones(1, 20, 3), "action": torch.ones(1, 20, 2), "return_to_go": torch.ones(1, 20, 1)}
    masked = wrapper.mask_context(TensorDict(data, [1]))
    found[context] = [int(masked[name].any(-1).sum()) for name in ("observation", "action")]
    print(f"torchrl {version('torchrl')}, inference_context={context}: {found[context][0]} observations and {found[context][1]} actions are left of 20")
assert found == {1: [1, 19], 2: [2, 1], 5: [5, 4]}, found
PY
