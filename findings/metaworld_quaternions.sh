#!/usr/bin/env bash
# metaworld 3.1.1: the order of the object's quaternion in the observation, elements 7 to 10.
#
# Guess: one order in all tasks, as "the state space among the tasks maintains the same structure", so
#        that one policy can be shared: the scalar first, as in MuJoCo.
# Seen:  some tasks put the scalar first, others last, and a few have zeros. A puck that lies flat is
#        (1, 0, 0, 0) in sweep-v3 and (0, 0, 0, 1) in push-v3. Turned upside down, the puck of push-v3
#        reads as the flat one of sweep-v3. MT10 and ML10 have tasks of all three kinds. No warning.
#        MuJoCo's own quaternion, data.body(...).xquat, is used in some tasks, and SciPy's Rotation,
#        whose as_quat() puts the scalar last, in the others.
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
from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ML10_V3, MT10_V3

FLAT, FLIPPED = (1, 0, 0, 0), (0, 1, 0, 0)  # scalar first, as MuJoCo has it


def puck(name, quaternion):
    """What the task shows of its puck, turned in this way."""
    env = ALL_V3_ENVIRONMENTS[name]()
    env.set_task(metaworld.MT1(name, seed=0).train_tasks[0])
    env.reset()
    positions, velocities = env.data.qpos.copy(), env.data.qvel.copy()
    positions[12:16] = quaternion
    env.set_state(positions, velocities)
    assert np.allclose(env.data.body("obj").xquat, quaternion)
    return env._get_obs()[7:11].round(3) + 0.0


seen = {}
for name in ("sweep-v3", "push-v3"):
    for text, quaternion in (("flat", FLAT), ("flipped", FLIPPED)):
        seen[name, text] = puck(name, quaternion)
        print(f"metaworld {version('metaworld')}, {name}: puck {text} is {seen[name, text]}")
assert np.allclose(seen["sweep-v3", "flat"], FLAT)
assert np.allclose(seen["push-v3", "flat"], (0, 0, 0, 1)), "push-v3 puts the scalar first now"
assert np.allclose(seen["push-v3", "flipped"], seen["sweep-v3", "flat"])


def kind(name):
    quaternion = ALL_V3_ENVIRONMENTS[name]()._get_quat_objects()[:4]
    if not np.any(quaternion):
        return "zeros"
    for text, identity in (("first", FLAT), ("last", (0, 0, 0, 1))):
        if np.allclose(quaternion, identity, atol=0.01):
            return text
    return "turned"


kinds = {name: kind(name) for name in {*MT10_V3, *ML10_V3["train"], *ML10_V3["test"]}}
for benchmark, names in (("MT10", list(MT10_V3)), ("ML10, training", list(ML10_V3["train"]))):
    found = {text: [name for name in names if kinds[name] == text] for text in ("first", "last", "zeros")}
    for text, tasks in found.items():
        print(f"{benchmark}: {'no quaternion' if text == 'zeros' else 'scalar ' + text}: {' '.join(tasks)}")
    assert all(found.values()), f"{benchmark} has one order now"
PY
