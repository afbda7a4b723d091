#!/usr/bin/env bash
# d3rlpy 2.8.1: how many updates algo.fit(dataset, n_steps=...) makes.
#
# Guess: n_steps, "number of steps to train" as the page says, with one epoch that is shorter if it is
#        no multiple of n_steps_per_epoch.
# Seen:  only whole epochs, of 10,000 steps by default. n_steps=9000 makes no update, saves no model,
#        and returns an empty list: the policy is the untrained one. n_steps=15000 makes 10,000
#        updates. No warning. Decision Transformers' fit does so, too.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 d3rlpy==2.8.1

"$folder/venv/bin/python" - 2>"$folder/log" <<'PY' | grep '^d3rlpy' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import d3rlpy
import numpy as np

rng = np.random.default_rng(0)
episode = d3rlpy.dataset.Episode(
    observations=rng.normal(size=(20, 3)).astype("f4"),
    actions=rng.uniform(-1, 1, (20, 1)).astype("f4"),
    rewards=np.ones((20, 1), "f4"),
    terminated=True,
)
dataset = d3rlpy.dataset.create_infinite_replay_buffer([episode])
encoder = d3rlpy.models.VectorEncoderFactory(hidden_units=[4])


def fit(config, **options):
    """Number of updates, and of epochs that are reported."""
    updates = []
    results = config.create().fit(
        dataset,
        callback=lambda algo, epoch, step: updates.append(step),
        show_progress=False,
        logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        **options,
    )
    return len(updates), len(results)


bc = d3rlpy.algos.BCConfig(batch_size=4, encoder_factory=encoder)
seen = {}
for steps, epoch in ((9000, None), (150, 100), (200, 100)):
    options = {} if epoch is None else {"n_steps_per_epoch": epoch}
    seen[steps] = fit(bc, n_steps=steps, **options)
    print(f"d3rlpy {version('d3rlpy')}: n_steps={steps}, n_steps_per_epoch={epoch or 'default'}:", end="")
    print(f" {seen[steps][0]} updates, {seen[steps][1]} results")
assert seen[9000] == (0, 0), "less than an epoch is trained now"
assert seen[150] == (100, 1), "the rest of the steps is trained now"
assert seen[200] == (200, 2)
PY
