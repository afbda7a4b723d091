#!/usr/bin/env bash
# d3rlpy 2.8.1: fitted Q evaluation of a policy that was trained with scalers.
#
# Guess: FQE(algo, FQEConfig()), as on the page of off-policy evaluation, estimates the return of the
#        policy. The page on scalers: "you don't need to take care of preprocessing at production".
# Seen:  it evaluates another policy. In the targets, the policy's network gets observations without the
#        policy's scaling, and its action, between -1 and 1, is taken for the action itself. A policy
#        that acts about 5 at a reward equal to the action is worth 10 with gamma 0.5; the estimate is
#        about 6. fqe.predict() does scale. No warning. With the same scalers in FQEConfig, which none
#        of the pages asks for, it is right.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 d3rlpy==2.8.1

"$folder/venv/bin/python" -W ignore - <<'PY' 2>"$folder/log" | grep '^d3rlpy' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import d3rlpy
import numpy as np
import torch
from d3rlpy.logging import NoopAdapterFactory
from d3rlpy.models import VectorEncoderFactory
from d3rlpy.preprocessing import MinMaxActionScaler, StandardObservationScaler

EPISODES, STEPS, GAMMA = 50, 20, 0.5
torch.set_num_threads(1)
d3rlpy.seed(0)
rng = np.random.default_rng(0)
rows = EPISODES * STEPS
observations = rng.normal(100, 1, (rows, 1)).astype("f4")  # independent of each other
actions = rng.uniform(0, 10, (rows, 1)).astype("f4")
dataset = d3rlpy.dataset.MDPDataset(
    observations, actions, actions.copy(), np.zeros(rows),
    timeouts=np.arange(rows) % STEPS == STEPS - 1,
)
encoder = VectorEncoderFactory([64])


def scalers():
    return {"action_scaler": MinMaxActionScaler(), "observation_scaler": StandardObservationScaler()}


def fit(algo, steps):
    algo.fit(
        dataset, n_steps=steps, n_steps_per_epoch=steps, show_progress=False,
        logger_adapter=NoopAdapterFactory(),
    )
    return algo


policy = fit(d3rlpy.algos.BCConfig(encoder_factory=encoder, **scalers()).create(), 500)
acted = policy.predict(observations)
true = float(acted.mean() / (1 - GAMMA))  # the reward is the action
estimates = []
for given in ({}, scalers()):
    config = d3rlpy.ope.FQEConfig(gamma=GAMMA, learning_rate=3e-3, encoder_factory=encoder, **given)
    fqe = fit(d3rlpy.ope.FQE(policy, config), 2000)
    assert np.allclose(fqe.predict(observations), acted)
    estimates.append(float(fqe.predict_value(observations, acted).mean()))
    name = "the same" if given else "no"
    print(f"d3rlpy {version('d3rlpy')}, FQE with {name} scalers: {estimates[-1]:.2f};", end=" ")
    print(f"the policy is worth {true:.2f}", flush=True)
assert estimates[0] < 0.75 * true, "the scaled policy is evaluated now"
assert abs(estimates[1] - true) < 0.1 * true
PY
