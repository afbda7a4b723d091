#!/usr/bin/env bash
# metaworld 3.1.1: the goals of which evaluation() plays 50 episodes of a multi-task benchmark.
#
# Guess: one episode for each of the 50 goals of a task, as the page on evaluation says.
# Seen:  each reset draws one of the 50 goals anew, with replacement. In 50 episodes, 30 goals are
#        played, some of them several times, and 20 never. All ten environments of MT10 have the same
#        seed and draw the same numbers, so that the same 20 are left out of every task. No warning.
#        With task_select="pseudorandom" and toggle_sample_tasks_on_reset(True) each goal is played
#        before one comes again.
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
import numpy as np
from metaworld.evaluation import evaluation

EPISODES = 50


class Agent:
    """Does nothing, and notes which of its task's goals each environment has."""

    def __init__(self, envs):
        self.envs, self.played = envs, []
        self.goals = [
            [tuple(pickle.loads(task.data)["rand_vec"]) for task in tasks]
            for tasks in envs.get_attr("tasks")
        ]

    def eval_action(self, observations):
        goals = self.envs.get_attr("_last_rand_vec")
        self.played.append([known.index(tuple(goal)) for known, goal in zip(self.goals, goals)])
        return np.zeros((len(observations), 4), np.float32)

    def reset(self, mask): ...


def play(envs):
    """Numbers of the goals that each task plays, in episodes of one step."""
    agent = Agent(envs)
    evaluation(agent, envs, num_episodes=EPISODES)
    assert len(agent.played) == EPISODES
    return np.array(agent.played).T


played = play(metaworld.make_mt_envs("MT10", seed=0, max_episode_steps=1))
counts = [len(set(row)) for row in played]
same = all(np.array_equal(row, played[0]) for row in played)
print(f"metaworld {version('metaworld')}, MT10: {EPISODES} episodes a task, different goals {counts},", end="")
print(f" the same numbers in every task: {same}")
assert max(counts) < 40 and same, "other goals are drawn now"

envs = gym.make_vec(
    "Meta-World/custom-mt-envs", envs_list=["reach-v3"], vector_strategy="sync", seed=1,
    max_episode_steps=1, task_select="pseudorandom",
)
envs.call("toggle_sample_tasks_on_reset", True)
count = len(set(play(envs)[0]))
print(f"one task, pseudorandom: {EPISODES} episodes, {count} different goals")
assert count == EPISODES, "pseudorandom repeats goals"
PY
