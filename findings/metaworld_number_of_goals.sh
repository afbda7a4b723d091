#!/usr/bin/env bash
# metaworld 3.1.1: num_goals, the number of goals of a multi-task environment.
#
# Guess: it is about the environment that is made with it.
# Seen:  it is about everything that is made in this process from then on. After a smoke test of MT1 with
#        one goal, the benchmark ML1 has one training and one held-out goal in place of 50, and MT10 has
#        one a task. No warning. The default, no num_goals, does not set it back. The entry point
#        writes it into the module's own constant.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metaworld==3.1.1 mujoco==3.3.0 gymnasium==1.4.0 \
  numpy==2.4.0 scipy==1.17.1 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import gymnasium as gym
import metaworld


def goals():
    benchmark = metaworld.ML1("push-v3", seed=0)
    return len(benchmark.train_tasks), len(benchmark.test_tasks)


def tasks(**options):
    env = gym.make("Meta-World/MT1", env_name="reach-v3", seed=0, **options)
    return len(env.get_wrapper_attr("tasks"))


before, default = goals(), tasks()
one = tasks(num_goals=1)
after, again = goals(), tasks()
print(f"metaworld {version('metaworld')}: ML1 {before} goals, MT1 {default};")
print(f"  MT1 with num_goals=1 {one}; then ML1 {after}, MT1 without num_goals {again}")
assert before == (50, 50) and default == 50 and one == 1
assert after == (1, 1) and again == 1, "num_goals is about its own environment now"
PY
