#!/usr/bin/env bash
# metaworld 3.1.1: the success rate of metalearning_evaluation, and which episodes it counts.
#
# Guess: so many evaluation episodes for each test goal, as the page on evaluation says. A policy that
#        solves 3 of 10 goals has a success rate of 30 %.
# Seen:  episodes are counted for each task family, over all environments of it, in the order in which
#        they end. The environments of an ML1 test are of one family, and a success ends its episode
#        at once. With the default of 3 episodes, the 3 quickest environments are counted: the policy
#        that fails on 7 of 10 goals has 100 %. With 30 episodes it has 50 %, as solved goals begin
#        further episodes while the others run to the time limit. No warning. In ML10 and ML45 the
#        four environments of a family compete in the same way. evaluation() counts alike, and is
#        right where every environment has a family of its own, as in MT10.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metaworld==3.1.1 mujoco==3.3.0 gymnasium==1.4.0 \
  numpy==2.4.0 scipy==1.17.1 packaging==25.0

"$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import metaworld
import numpy as np
from metaworld.evaluation import evaluation, metalearning_evaluation
from metaworld.policies import SawyerDrawerCloseV3Policy

GOALS, STEPS = 10, 150


class Agent:
    """Closes the drawer in the first environments and does nothing in the others."""

    def __init__(self, solved):
        self.solved, self.expert = solved, SawyerDrawerCloseV3Policy()

    def eval_action(self, observations):
        actions = np.zeros((len(observations), 4), np.float32)
        for i in range(self.solved):
            actions[i] = np.clip(self.expert.get_action(observations[i]), -1, 1)
        return actions

    def adapt_action(self, observations):
        return self.eval_action(observations), {}

    def init(self): ...

    def adapt(self): ...

    def step(self, timestep): ...

    def reset(self, mask): ...


envs = metaworld.make_ml_envs_test(
    "drawer-close-v3", seed=0, meta_batch_size=GOALS, max_episode_steps=STEPS
)
seen = {}
for solved in (0, 3, GOALS):
    seen[solved] = metalearning_evaluation(
        Agent(solved), envs, num_evals=1, adaptation_episodes=1
    )[0]
    print(f"metaworld {version('metaworld')}: {solved} of {GOALS} goals solved,", end="")
    print(f" metalearning_evaluation {seen[solved]:.0%}")
more = evaluation(Agent(3), envs, num_episodes=30)[0]
print(f"  3 of {GOALS} goals solved, evaluation with 30 episodes {more:.0%}")
assert seen[0] == 0 and seen[GOALS] == 1
assert seen[3] == 1.0, "other episodes than the quickest are counted now"
assert 0.4 < more < 0.6, "quick environments no longer have more episodes"
PY
