#!/usr/bin/env bash
# robosuite 1.5.2, mujoco 3.8.1: "interpolation": "linear" in the configuration of OSC_POSE.
#
# Guess: goals are approached in small steps within a control period. An action of zeros leaves the hand
#        where it is, as without interpolation.
# Seen:  with the default frame, input_ref_frame="base", goals are positions relative to the robot's
#        base. The interpolated goal is taken for a position in the world, without the transformation.
#        An action of zeros pulls the hand to another place, 0.4 m away within a second: the base of
#        the robot lies there from the world's origin. No warning. With "world" the hand stays.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" - <<'PY' 2>"$folder/log" | grep '^robosuite' || { cat "$folder/log"; exit 1; }
from importlib.metadata import version

import numpy as np
import robosuite
from robosuite.controllers import load_composite_controller_config


def moved(interpolation, frame):
    """How far 20 actions of zeros (one second) move the hand [m]."""
    config = load_composite_controller_config(controller="BASIC")
    config["body_parts"]["right"].update(interpolation=interpolation, input_ref_frame=frame)
    env = robosuite.make(
        "Lift", robots="Panda", controller_configs=config, use_camera_obs=False,
        has_offscreen_renderer=False, initialization_noise=None,
    )
    start = env.reset()["robot0_eef_pos"]
    for _ in range(20):
        observation = env.step(np.zeros(env.action_dim))[0]
    env.close()
    return np.linalg.norm(observation["robot0_eef_pos"] - start)


for interpolation in (None, "linear"):
    for frame in ("base", "world"):
        metres = moved(interpolation, frame)
        print(f"robosuite {version('robosuite')}, interpolation {interpolation}, {frame} frame:", end=" ")
        print(f"20 actions of zeros move the hand by {metres:.3f} m")
        wrong = interpolation == "linear" and frame == "base"
        assert metres > 0.3 if wrong else metres < 0.005, "another distance now"
PY
