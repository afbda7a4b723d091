#!/usr/bin/env bash
# torchrl 0.14.1: the initial scale of gSDEModule's noise.
#
# Guess: as the page says, sigma_init is "the initial value of the standard deviation", and without it the
#        noise has the deviation 1 for states of unit variance, whatever their size.
# Seen:  sigma_init is stored and never read. Each entry of sigma begins with softplus(0) = 0.693, so that the
#        noise of an action grows with the root of the state's size: 0.7 for one number, 5.5 for 64 numbers.
#        It is the same for sigma_init=0.01. With learn_sigma=False, sigma_init is used. (gSDEModule.sigma in
#        modules/models/exploration.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.models.exploration import gSDEModule

torch.manual_seed(0)


def deviation(size, **options):
    """That of the noise of an action, over states of unit variance and draws of the noise."""
    module = gSDEModule(2, size, **options)
    states = torch.randn(20000, size)
    with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
        action = module(torch.zeros(20000, 2), states, None)[2]
    return action.std().item()


print(f"torchrl {version('torchrl')}: deviation of the noise")
sizes = {size: deviation(size) for size in (1, 16, 64)}
for size, value in sizes.items():
    print(f"  {size} numbers in a state: {value:.2f}; expected 1")
given = {sigma: deviation(16, sigma_init=sigma) for sigma in (0.01, 0.1, 1.0)}
fixed = {sigma: deviation(16, sigma_init=sigma, learn_sigma=False) for sigma in given}
for sigma in given:
    print(f"  sigma_init={sigma}: {given[sigma]:.2f}; learn_sigma=False: {fixed[sigma]:.2f}")
assert all(abs(value / (0.6931 * size**0.5) - 1) < 0.05 for size, value in sizes.items()), sizes
assert all(abs(value / 2.77 - 1) < 0.05 for value in given.values()), given
assert all(abs(value / (4 * sigma) - 1) < 0.05 for sigma, value in fixed.items()), fixed
PY
