#!/usr/bin/env bash
# robosuite 1.5.2, mujoco 3.8.1: the "base" frame of actions turns with the first joint of two arms.
#
# Guess: with input_ref_frame="base", the default of OSC_POSE, the action +x moves the hand along the
#        x axis of the robot's fixed base, whatever the arm's pose.
# Seen:  so it is on Panda, Sawyer, UR5e, Kinova3 and Jaco. On IIWA and XArm7 the site "right_center",
#        whose frame the controller takes for the base's, belongs to the first moving link. With the
#        first joint turned by 90 degrees, +x moves the hand along y. The damping sees velocities
#        relative to that link, too: turning about the first joint is not damped.
#
# Here: the fast step follows robosuite on these arms, too (envs.control_period.Base).
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet robosuite==1.5.2 mujoco==3.8.1

"$folder/venv/bin/python" - <<'PY'
import numpy as np
import robosuite

EXPECTED = {"Panda": ("x", "x"), "IIWA": ("x", "y"), "XArm7": ("x", "y")}

for arm, axes in EXPECTED.items():
    env = robosuite.make(
        "Lift", robots=arm, use_camera_obs=False, has_offscreen_renderer=False,
        initialization_noise=None,
    )
    for turn, axis in zip((0, np.pi / 2), axes):
        env.reset()
        robot = env.robots[0]
        joints = np.array(robot.init_qpos)
        joints[0] += turn
        robot.set_robot_joint_positions(joints)
        robot.part_controllers["right"].update_initial_joints(joints)
        hand = robot.eef_site_id["right"]
        before = env.sim.data.site_xpos[hand].copy()
        for _ in range(5):
            env.step(np.eye(env.action_dim)[0])  # +x
        moved = np.round(env.sim.data.site_xpos[hand] - before, 3)
        print(f"{arm}, first joint turned by {np.degrees(turn):.0f} degrees: moved {moved} m")
        found = "xyz"[np.abs(moved).argmax()]
        assert found == axis, f"moved along {found}, where {axis} was seen"
PY
