#!/usr/bin/env bash
# metaworld 3.1.1: what the first observation of an ML1 task says about its goal.
#
# Guess: nothing: "the goal position is not part of the observation". An agent has to explore to find
#        out which task it is in.
# Seen:  the draw that decides a task's goal also decides where its object starts, in every episode. In
#        41 of the 50 families the first observation tells any two training tasks apart, so that a
#        policy without memory can learn all training goals by heart. In 23 of these it is the goal: a
#        linear fit to the training tasks predicts the held-out goals to a millimetre, since drawer,
#        button or door are seen. In 18, reach-v3, push-v3 and pick-place-v3 among them, held-out goals
#        do not follow from it. In three families all tasks have the same goal. Only in six does the
#        first observation say nothing. No warning.
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

metaworld._N_GOALS = 30


def starts(env, tasks):
    """First observations and goals of tasks; the first of them is begun a second time."""
    rows = []
    for task in [*tasks, tasks[0]]:
        env.set_task(task)
        observation, _ = env.reset(seed=len(rows))
        assert not observation[36:].any(), "the goal itself is shown"
        rows.append((observation[:18], env._target_pos.copy()))
    observations, goals = map(np.array, zip(*rows))
    assert np.array_equal(observations[0], observations[-1]), "episodes of a task start differently"
    return observations[:-1], goals[:-1]


def kind(name):
    """What the first observation says about the goal."""
    benchmark = metaworld.ML1(name, seed=0)
    env = benchmark.train_classes[name]()
    seen, goals = starts(env, benchmark.train_tasks)
    unseen, held_out = starts(env, benchmark.test_tasks)
    env.close()
    if np.ptp(goals, axis=0).max() < 1e-9:
        return "all tasks have one goal"
    if np.ptp(seen, axis=0).max() < 1e-9:
        return "it says nothing"
    apart = np.abs(seen[:, None] - seen).max(-1) + np.eye(len(seen))
    assert apart.min() > 1e-6, "some training tasks look alike"
    # The positions of hand and object.
    known, asked = (np.c_[x[:, [0, 1, 2, 4, 5, 6]], np.ones(len(x))] for x in (seen, unseen))
    error = np.abs(asked @ np.linalg.lstsq(known, goals, rcond=1e-9)[0] - held_out).max()
    return "it is the goal" if error < 1e-3 else "it tells training tasks apart"


kinds = {name: kind(name) for name in ALL_V3_ENVIRONMENTS}
counts = {}
for each in sorted(set(kinds.values())):
    names = [name.removesuffix("-v3") for name, found in kinds.items() if found == each]
    counts[each] = len(names)
    print(f"metaworld {version('metaworld')}, first observation: {each} in {len(names)} families:")
    print(f"  {' '.join(names)}")
assert counts == {
    "all tasks have one goal": 3,
    "it is the goal": 23,
    "it says nothing": 6,
    "it tells training tasks apart": 18,
}, "first observations say something else now"
PY
