#!/usr/bin/env bash
# metaworld 3.1.1: the goals of gym.make_vec("Meta-World/ML1-train").
#
# Guess: the 50 training goals of ML1, in episodes that run to their time limit, as make_ml_envs_train
#        gives them. "Meta-World/ML1-test" has the 50 held-out goals.
# Seen:  both names make the test environments. Training happens on all held-out goals and on none of
#        the training goals, and episodes end at the first success. Train and test scores are of the
#        same tasks. No warning. ML10, ML25 and ML45 are right. The loop that registers both names
#        hands them its variable, which has its last value, "test", when the environment is made.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metaworld==3.1.1 mujoco==3.3.0 gymnasium==1.4.0 \
  numpy==2.4.0 scipy==1.17.1 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
import pickle
from importlib.metadata import version

import gymnasium as gym
import metaworld


def goals(tasks):
    return {tuple(pickle.loads(task.data)["rand_vec"]) for task in tasks}


benchmark = metaworld.ML1("reach-v3", seed=0)
training, held_out = goals(benchmark.train_tasks), goals(benchmark.test_tasks)
assert len(training) == len(held_out) == 50 and not training & held_out


def inspect(name, envs):
    has = goals(task for tasks in envs.get_attr("tasks") for task in tasks)
    ends = all(envs.get_attr("terminate_on_success"))
    print(f"metaworld {version('metaworld')}, {name}: {len(has & training)} training goals,", end="")
    print(f" {len(has & held_out)} held-out goals, ends at success: {ends}")
    return len(has & training), len(has & held_out), ends


make = {"env_name": "reach-v3", "seed": 0, "meta_batch_size": 5}
train = inspect("ML1-train", gym.make_vec("Meta-World/ML1-train", **make))
test = inspect("ML1-test", gym.make_vec("Meta-World/ML1-test", **make))
right = metaworld.make_ml_envs_train("reach-v3", seed=0, meta_batch_size=5)
right = inspect("make_ml_envs_train", right)
assert train == test == (0, 50, True), "ML1-train no longer makes the test environments"
assert right == (50, 0, False)
PY
