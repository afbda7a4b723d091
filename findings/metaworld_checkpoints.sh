#!/usr/bin/env bash
# metaworld 3.1.1: get_checkpoint and load_checkpoint of the environments of ML1, to go on training.
#
# Guess: every environment gets its own goals and state back. Loading what was saved a moment before
#        changes nothing.
# Seen:  an environment looks its checkpoint up by a name. make_ml_envs gives all environments of one
#        family the same name, so that each takes the first one's. Of 50 goals, ten remain in an ML1
#        batch of five, and all five environments go through the same ones. No warning. In MT10, whose
#        environments have numbers in their names, every one gets its own.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metaworld==3.1.1 mujoco==3.3.0 gymnasium==1.4.0 \
  numpy==2.4.0 scipy==1.17.1 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
import pickle
from importlib.metadata import version

import metaworld


def goals(envs):
    """The goals of each environment."""
    return [
        {tuple(pickle.loads(task.data)["rand_vec"]) for task in tasks}
        for tasks in envs.get_attr("tasks")
    ]


def inspect(name, envs):
    before, checkpoints = goals(envs), envs.call("get_checkpoint")
    envs.call("load_checkpoint", checkpoints)
    after = goals(envs)
    names = len({key for key, _ in checkpoints})
    counts = len(set.union(*before)), len(set.union(*after))
    print(f"metaworld {version('metaworld')}, {name}: {envs.num_envs} environments, {names} names,", end="")
    print(f" {counts[0]} goals before loading, {counts[1]} after")
    return names, counts, before == after


ml1 = inspect("ML1", metaworld.make_ml_envs_train("reach-v3", seed=0, meta_batch_size=5))
mt10 = inspect("MT10", metaworld.make_mt_envs("MT10", seed=0))
assert ml1 == (1, (50, 10), False), "each environment gets its own checkpoint now"
assert mt10 == (10, (500, 500), True)
PY
