#!/usr/bin/env bash
# d3rlpy 2.8.1: InitialStateValueEstimationEvaluator on long episodes.
#
# Guess: the mean value of the episodes' initial states, one state an episode, as the page says.
# Seen:  an episode is evaluated in pieces of 1024 steps, and the first state of each piece counts as
#        an initial state. With one episode of 100 steps and one of 5000, five of six "initial" states
#        are of the long one, four of them from its middle. No warning. Episodes of up to 1024 steps
#        count once. The sums of DiscountedSumOfAdvantageEvaluator begin anew at each piece, too.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 d3rlpy==2.8.1

"$folder/venv/bin/python" - 2>"$folder/log" <<'PY' | grep '^d3rlpy' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import d3rlpy
import numpy as np


def episode(steps):
    """Observations 0, 1, 2, ...: the initial one is 0."""
    return d3rlpy.dataset.Episode(
        observations=np.arange(steps, dtype="f4")[:, None],
        actions=np.linspace(-1, 1, steps, dtype="f4")[:, None],
        rewards=np.ones((steps, 1), "f4"),
        terminated=True,
    )


class Algorithm:
    """Values an observation by the observation itself."""

    def __init__(self):
        self.seen = []

    def predict(self, observations):
        self.seen += observations[:, 0].astype(int).tolist()
        return np.zeros((len(observations), 1), "f4")

    def predict_value(self, observations, actions):
        return observations[:, 0]


def evaluate(*lengths):
    algorithm = Algorithm()
    dataset = d3rlpy.dataset.create_infinite_replay_buffer([episode(steps) for steps in lengths])
    value = d3rlpy.metrics.InitialStateValueEstimationEvaluator()(algorithm, dataset)
    print(f"d3rlpy {version('d3rlpy')}: episodes of {lengths} steps,", end="")
    print(f" initial states at steps {algorithm.seen}, value {value:.1f}")
    return algorithm.seen, value


assert evaluate(100, 1024) == ([0, 0], 0.0)
states, value = evaluate(100, 5000)
assert states == [0, 0, 1024, 2048, 3072, 4096], "only initial states are evaluated now"
assert value > 1000
PY
