#!/usr/bin/env bash
# metaworld 3.1.1: rewards of solved tasks.
#
# Guess: a solved task has a reward near 10, the upper end of the documented range, in each of them, as
#        "all task rewards have the same magnitude".
# Seen:  in button-press-v3 and coffee-button-v3 it stays below 1.7. The scripted policies press the
#        button with the fingers 11 cm below it, while the reward for pressing, 8 of the 10, is only
#        given within 5 cm, so that info["near_object"] is 0 during the whole episode. The best reward of
#        unsolved steps is as high as that of solved ones: demonstrations of these tasks do not show
#        that the button is to be pressed. Their return is a ninth of reach-v3's. No warning.
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
from metaworld.env_dict import ALL_V3_ENVIRONMENTS
from metaworld.policies import ENV_POLICY_MAP

metaworld._N_GOALS = 3


def play(name):
    """Rewards, successes and nearness of the scripted policy over the goals of a task."""
    env, policy = ALL_V3_ENVIRONMENTS[name](), ENV_POLICY_MAP[name]()
    steps = []
    for task in metaworld.MT1(name, seed=0).train_tasks:
        env.set_task(task)
        observation, _ = env.reset()
        for _ in range(500):
            action = np.clip(policy.get_action(observation), -1, 1)
            observation, reward, _, _, info = env.step(action)
            steps.append((reward, info["success"], info["near_object"]))
    return np.array(steps, dtype=float).T


best, returns = {}, {}
for name in ("reach-v3", "button-press-wall-v3", "button-press-v3", "coffee-button-v3"):
    reward, success, near = play(name)
    solved = success > 0
    best[name], returns[name] = reward[solved].max(), reward.sum() / 3
    print(f"metaworld {version('metaworld')}, {name}: best reward of solved steps {best[name]:.2f},", end="")
    print(f" of others {reward[~solved].max():.2f}, return {returns[name]:.0f}, near in {near.mean():.0%}")
    assert solved.reshape(3, 500).any(1).all(), "the scripted policy fails"
    if name in ("button-press-v3", "coffee-button-v3"):
        assert best[name] < 1.7 and not near.any(), "pressing is rewarded now"
        assert reward[~solved].max() > 0.9 * best[name]
    else:
        assert best[name] > 9.9
assert returns["button-press-v3"] < returns["reach-v3"] / 8
PY
