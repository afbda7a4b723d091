#!/usr/bin/env bash
# tensordict 0.14.3: the log-probability of a policy whose second action depends on its first.
#
# Guess: log_prob of ProbabilisticTensorDictSequential is that of the actions in the data, the second given
#        the first.
# Seen:  the first action is drawn anew, and the second is scored given that one. For s1 ~ N(10 s0, 1) and
#        data s0 = 1, s1 = 10, the log-probability of s1 is -0.92; seen is -50.9 with the mode, and another
#        number at each call with samples. PPO's ratio for a policy that has not changed is then not 1. No
#        warning. (get_dist in nn/probabilistic.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from tensordict import TensorDict
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    set_composite_lp_aggregate,
    set_interaction_type,
)
from torch.distributions import Normal

torch.manual_seed(0)
options = {"distribution_class": Normal, "distribution_kwargs": {"scale": 1.0}}
policy = ProbabilisticTensorDictSequential(
    TensorDictModule(lambda x: x, in_keys=["x"], out_keys=["loc"]),
    ProbabilisticTensorDictModule(in_keys=["loc"], out_keys=["s0"], **options),
    TensorDictModule(lambda s: 10 * s, in_keys=["s0"], out_keys=["loc2"]),
    ProbabilisticTensorDictModule(in_keys={"loc": "loc2"}, out_keys=["s1"], **options),
    return_composite=True,
)
data = TensorDict({"x": torch.zeros(3), "s0": torch.ones(3), "s1": torch.full((3,), 10.0)}, [3])
expected = Normal(10 * data["s0"], 1.0).log_prob(data["s1"])
found = {}
with set_composite_lp_aggregate(False):
    for kind in (InteractionType.DETERMINISTIC, InteractionType.RANDOM):
        with set_interaction_type(kind):
            found[kind.name] = [policy.log_prob(data.clone())["s1_log_prob"] for _ in range(2)]
print(f"tensordict {version('tensordict')}: log-probability of s1 = 10 given s0 = 1, which is {expected[0]:.2f}")
for name, (first, second) in found.items():
    print(f"  {name}: {first[0]:.2f}, again {second[0]:.2f}")
first, second = found["DETERMINISTIC"]
assert torch.allclose(first, torch.full((3,), -50.9189), atol=1e-3), first
first, second = found["RANDOM"]
assert not torch.allclose(first, second), found
assert not torch.allclose(first, expected), found
PY
