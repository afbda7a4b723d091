#!/usr/bin/env bash
# metaworld 3.1.1: recurrent_info_in_obs, which adds the last action, reward and end to observations.
#
# Guess: a recurrent policy that adapts over several episodes of a task, as in RL^2, is shown the end of
#        each episode and its last reward.
# Seen:  it is shown neither. By default a vector environment begins the next episode in the same step,
#        and a new episode's observation has zeros there. The flag is never 1, and the last action and
#        reward of an episode are never seen. Where a success ends the episode, its reward is the one
#        that is lost. No warning. The right observation lies in infos["final_obs"]. With
#        autoreset_mode="NextStep" the flag is 1 once an episode.
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
import numpy as np

EPISODES, STEPS = 4, 5


def play(**options):
    """Ends that happened, ends that the observations show, and rewards that these never show."""
    envs = metaworld.make_ml_envs_train(
        "reach-v3", seed=0, meta_batch_size=1, max_episode_steps=STEPS,
        recurrent_info_in_obs=True, normalize_reward_in_recurrent_info=False, **options,
    )
    envs.call("sample_tasks")
    envs.reset()
    ends, shown, hidden, final = 0, 0, 0, 0
    while ends < EPISODES:
        observation, reward, terminated, truncated, info = envs.step(np.full((1, 4), 0.5, "f4"))
        ends += int(truncated[0] or terminated[0])
        shown += int(observation[0, -1])
        hidden += not np.isclose(observation[0, -2], reward[0])
        final += int(info["final_obs"][0][-1]) if "final_obs" in info else 0
    return ends, shown, hidden, final


default, later = play(), play(autoreset_mode=gym.vector.AutoresetMode.NEXT_STEP)
for name, (ends, shown, hidden, final) in (("by default", default), ("next step", later)):
    print(f"metaworld {version('metaworld')}, {name}: {ends} episodes ended, the flag is 1 {shown} times", end="")
    print(f" (in final_obs {final} times), rewards not shown: {hidden}")
assert default == (EPISODES, 0, EPISODES, EPISODES), "ends reach the observation now"
assert later == (EPISODES, EPISODES, 0, 0)
PY
