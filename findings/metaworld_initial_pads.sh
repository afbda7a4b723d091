#!/usr/bin/env bash
# metaworld 3.1.1: the rewards that compare the gripper with init_left_pad and init_right_pad.
#
# Guess: these are where the fingers' pads were at the start. The way from there to the object is the
#        margin over which the reward for approaching grows.
# Seen:  they are where the pads are now. The arrays are MuJoCo's own memory and move with the gripper,
#        by 25 to 51 cm in an episode. The margin always equals the distance, so that the reward hardly
#        sees the distance: in door-lock-v3 it is 0.11 to 0.13 anywhere between 15 and 30 cm from the
#        lock (0.00 to 0.04 with the pads of the start). In soccer-v3 the return of the scripted policy
#        is 3541 in place of 3790. No warning. A copy taken after reset() mends it:
#        env.init_left_pad = env.init_left_pad.copy(), and the right one.
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

metaworld._N_GOALS = 1
NAMES = ("door-lock-v3", "pick-place-v3", "push-back-v3", "soccer-v3", "sweep-v3", "sweep-into-v3")


def play(name, copied):
    """Return and approach rewards of the scripted policy, distances, and how far the pad moved."""
    env, policy = ALL_V3_ENVIRONMENTS[name](), ENV_POLICY_MAP[name]()
    env.set_task(metaworld.MT1(name, seed=0).train_tasks[0])
    observation, _ = env.reset()
    start = env.init_left_pad.copy()
    if copied:
        env.init_left_pad, env.init_right_pad = start, env.init_right_pad.copy()
    rewards, steps, moved = [], [], 0.0
    for _ in range(500):
        action = np.clip(policy.get_action(observation), -1, 1)
        observation, reward, _, _, info = env.step(action)
        rewards.append(reward)
        distance = np.linalg.norm(observation[4:7] - env.get_body_com("leftpad"))
        steps.append((distance, info["grasp_reward"]))
        moved = max(moved, np.linalg.norm(env.init_left_pad - start))
    return sum(rewards), np.array(steps), moved


def far(steps):
    """Range of the approach reward farther than 15 cm from the object, past the first steps."""
    away = steps[50:][steps[50:, 0] > 0.15, 1]
    return away.min(), away.max()


returns = {}
for name in NAMES:
    (as_is, steps, moved), (mended, others, none) = play(name, False), play(name, True)
    print(f"metaworld {version('metaworld')}, {name}: init_left_pad moves by {100 * moved:.0f} cm,", end="")
    print(f" return {as_is:.0f}, with copies {mended:.0f}")
    assert moved > 0.2 and none == 0, "the initial pads stay where they were"
    returns[name] = as_is / mended
    if name == "door-lock-v3":
        (low, high), (small, large) = far(steps), far(others)
        print(f"  15 cm from the lock and more: approach reward {low:.2f} to {high:.2f},", end="")
        print(f" with copies {small:.2f} to {large:.2f}")
        assert high < 1.25 * low and large > 3 * small
assert returns["soccer-v3"] < 0.95
PY
