#!/usr/bin/env bash
# cpprb 11.0.0: n-step transitions at the end of an episode that a time limit ends.
#
# Guess: the last n - 1 rows of an episode hold fewer rewards and the episode's last observation, so
#        that a target may bootstrap from it.
# Seen:  they hold fewer rewards, and the number 1 in every entry of next_obs, which is no
#        observation. An episode that terminates has done = 1 in these rows, so nothing reads it. After
#        a time limit done is 0, and the target of n - 1 rows of each episode bootstraps from a state
#        of ones. No warning, with on_episode_end() called as documented.
#
# Here: torchrl_bmrl.data.n_step gives these rows the last observation and the number of their steps.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet cpprb==11.0.0 numpy==2.4.6

"$folder/venv/bin/python" - <<'PY'
from importlib.metadata import version

import numpy as np
from cpprb import ReplayBuffer

STEPS, N = 6, 3
parts = {"obs": {"shape": 2}, "rew": {}, "next_obs": {"shape": 2}, "done": {}}
steps = {"size": N, "gamma": 0.5, "rew": "rew", "next": "next_obs"}
buffer = ReplayBuffer(64, parts, Nstep=steps)
for first in (100.0, 200.0):  # two episodes, each cut by a time limit
    for t in range(STEPS):
        now, after = np.array([first, t]), np.array([first, t + 1])
        buffer.add(obs=now, rew=1.0, next_obs=after, done=0.0)
    buffer.on_episode_end()

data = buffer.get_all_transitions()
print(f"cpprb {version('cpprb')}: {N}-step rows of two episodes of {STEPS} steps, none terminated")
for now, reward, after, done in zip(*(data[key].tolist() for key in parts)):
    print(f"  obs {now}, reward {reward[0]}, next_obs {after}, done {done[0]}")

assert len(data["obs"]) == 2 * STEPS and not data["done"].any()
rows = [(t, data["next_obs"][i]) for i, (_, t) in enumerate(data["obs"].tolist())]
for t, after in rows:
    whole = t + N <= STEPS
    assert (after[1] == t + N and after[0] >= 100) if whole else (after == 1).all(), (t, after)
assert sum(t + N > STEPS for t, _ in rows) == 2 * (N - 1)
rewards = data["rew"].reshape(2, STEPS)
assert (rewards == [1.75, 1.75, 1.75, 1.75, 1.5, 1.0]).all()
PY
