#!/usr/bin/env bash
# pfrl 0.4.0: EmpiricalNormalization, whose statistics are loaded after it was used.
#
# Guess: a module that has loaded another's state_dict gives the other's outputs.
# Seen:  it subtracts the loaded mean and divides by its own old deviation, because the inverse of the
#        deviation is computed once and kept until the next batch is learned from. In evaluation
#        (update=False) no batch ever is, and the wrong scale stays. A module that nothing had passed
#        through before loading is right, and so is one after its next batch. The properties mean and
#        std show the loaded numbers in either case. No warning.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 pfrl==0.4.0 gym==0.26.2 numpy==1.26.4 packaging==25.0

"$folder/venv/bin/python" -W ignore - 2>&1 <<'PY' | grep -v -i "gym"
from importlib.metadata import version

import torch
from pfrl.nn import EmpiricalNormalization

torch.manual_seed(0)
saved = EmpiricalNormalization(1)
saved(100 + 50 * torch.randn(1000, 1))  # learns a mean near 100 and a deviation near 50

fresh, used = EmpiricalNormalization(1), EmpiricalNormalization(1)
used(torch.randn(1000, 1))  # as an agent does that acts before its checkpoint is loaded
for module in (fresh, used):
    module.load_state_dict(saved.state_dict())

value = torch.tensor([[200.0]])
outputs = {
    "saved": saved(value, update=False).item(),
    "loaded, fresh": fresh(value, update=False).item(),
    "loaded, used before": used(value, update=False).item(),
}
said = ", ".join(f"{name} {output:.2f}" for name, output in outputs.items())
print(f"pfrl {version('pfrl')}: 200 is normalised to: {said}")
print(f"deviation that each reports: {saved.std.item():.2f}, {fresh.std.item():.2f}, {used.std.item():.2f}")
assert outputs["loaded, fresh"] == outputs["saved"]
assert used.std.item() == saved.std.item()
assert outputs["loaded, used before"] > 20 * outputs["saved"], "a used module is right after loading now"
for module in (fresh, used):
    module.experience(value)
assert used(value, update=False) == fresh(value, update=False)
PY
