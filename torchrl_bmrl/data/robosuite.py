"""robosuite's ``demo.hdf5`` as transitions of one of the six tasks.

Such a file contains simulator states of a person's demonstrations, but neither observations nor
rewards. Both are computed from these states, without replaying the input device::

    data/demo_<i>             attribute model_file: models/<model_file> beside the file, or XML text
        states                (T, 1 + nq + nv)  time [s], joint positions, joint velocities

Two models are used. The recording's own MJCF, without its meshes, defines the states' columns, the
position of the table and the size of the cube. The task's model gets the same joints by name, and
the cube at the same place on its own table; the task's functions compute everything else.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode, LazyEpisodes
from torchrl_bmrl.data.hdf5 import open_file, read_names
from torchrl_bmrl.data.recordings import Recording, read_recording, resample
from torchrl_bmrl.envs.skills import make_skills
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.extras import needs

if TYPE_CHECKING:
    import mujoco

    from torchrl_bmrl.envs.scene import TabletopScene

TRACKING = 0.22
"""Share of a commanded position delta that the arm covers in one step, measured.

The least-squares slope of what a person's demonstrations, executed as actions in this simulator,
moved (0.21 along x, 0.17 along y, 0.25 along z; 0.18 to 0.20 of a rotation), whatever their scale.
"""
JOINTS = (*(f"right_j{i}" for i in range(7)), "l_finger_joint", "r_finger_joint")
"""Ends of the joints' names; later versions added prefixes such as ``robot0_``."""
MAX_MODEL_ERROR = 5e-3
"""Largest accepted distance between the end-effectors of the two models [m]."""
CLOSING_MOTION, OPENING_MOTION = 1e-3, 3e-3
"""Change of the fingers' opening in one step that indicates a command [m]. A squeezed cube pushes
them apart by 2 mm per step although the command is still to close."""
FINGER_REST = 2e-3
"""Fingers within this of their opening at rest under the command "open" are open [m]."""


@dataclass(frozen=True, kw_only=True)
class Relabelling:
    """Result of computing one demonstration.

    Attributes:
        name: of the demonstration.
        steps: transitions at the control rate.
        recorded_rows: rows of the recording.
        duration: of the recording [s].
        lift_height: the cube's height after the last step, above its place in the first recorded
            row [m]; nan without a cube. Up to 50 ms of the recording come after the last step.
        grasped_at_end: whether both fingers touch the cube then.
        success: whether the task's own definition of success holds after some step.
        action_error: largest distance between the path that the actions add up to and the
            recorded path of the end-effector [m].
        rotation_error: the same for its rotation [rad].
        saturated_share: share of the steps whose motion does not fit into [-1, 1].
        model_error: largest distance between the end-effector in the recording's model and in the
            task's, both relative to the table [m].
    """

    name: str
    steps: int
    recorded_rows: int
    duration: float
    lift_height: float
    grasped_at_end: bool
    success: bool
    action_error: float
    rotation_error: float
    saturated_share: float
    model_error: float

    @classmethod
    def of(cls, name: str, episode: Episode) -> Relabelling:
        """Reads the attributes of an episode of :func:`open_episodes`."""
        kept = {field.name for field in fields(cls)}
        return cls(
            name=name,
            steps=len(episode),
            success=bool(episode.extras["successes"].any()),
            **{key: value for key, value in episode.attributes.items() if key in kept},
        )


@contextmanager
def open_episodes(
    path: str | Path, *, task: str, tracking: float = 1.0
) -> Iterator[Mapping[str, Episode]]:
    r"""Opens demonstrations by name as episodes of a task; each is computed on access.

    Observations, rewards and successes are the task's own. Actions are differences of the
    end-effector's recorded poses at the control rate (20 Hz), in the axes of the robot's base:

    .. math::
        a_k = \left(\frac{p_{k+1} - p_k}{0.05\,c},\;
        \frac{\log(R_{k+1} R_k^\top)}{0.5\,c},\; g_k\right)

    clipped to [-1, 1], with c = ``tracking`` and g the gripper, +1 closing (or holding the cube),
    -1 opening, read off the fingers' motion. The states, at about 100 Hz with gaps of 10 to 24 ms,
    are interpolated linearly onto the grid (quaternions normalised): the nearest row would be up to
    12 ms early or late, a quarter of a step's motion.

    Args:
        path: the file; it is only read.
        task: a skill of :data:`~torchrl_bmrl.envs.skills.SKILLS`; reach needs the goal, which only
            recordings of that task have (their site ``goal_marker``).
        tracking: share of a commanded delta that the arm covers within one step. The controller
            measures deltas from the pose that it has reached: a command held at 1 moves the arm by
            about 11 mm and not 50 mm a step. With 1 an action is the motion itself; with
            :data:`TRACKING` (0.22) it is about what had to be commanded for it.

    Yields:
        episodes; ``extras``: ``successes`` and ``states``, the task's simulator before each action
        ``(T, 1 + nq + nv)``; ``attributes``: ``model_file``, XML text of the task's simulator, and
        the numbers of :class:`Relabelling`.

    Raises:
        UnknownNameError: for a name that is not a task.
        ConfigError: if ``tracking`` is not in (0, 1].
        DataError: naming file, key and row: on opening for a missing or damaged file, when an
            episode is read for states or a model that are missing, damaged or of another scene.
    """
    make_skills(task)  # refuses an unknown name before the file is opened
    if not 0 < tracking <= 1:
        raise ConfigError(f"tracking must be in (0, 1], got {tracking}")
    with ExitStack() as stack:
        file = stack.enter_context(open_file(path))
        names = read_names(path, file, "data")
        if not names:
            raise DataError(path, "data", "no demonstrations")

        @cache
        def env() -> TabletopScene:
            # Loads the simulator: only once a recording has been read.
            from torchrl_bmrl.envs.scene import TabletopScene

            made = TabletopScene(task, use_object_obs=False)
            stack.callback(made.close)
            return made

        def read(name: str) -> Episode:
            recording = read_recording(Path(path), file, name)
            return _relabel(recording, env(), tracking)

        yield LazyEpisodes(names, read)


# -- from one model to the other -------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class _Scene:
    """Positions of joints, bodies and shapes that both models have.

    ``columns``: of a flattened state, by joint. ``hand``: the body that carries the gripper.
    ``cube``: shapes of the cube. ``table``: centre of the table's surface (3,) [m].
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    columns: dict[str, list[int]]
    hand: int
    cube: list[int]
    table: np.ndarray


def _find_scene(recording: Recording, model: mujoco.MjModel, *, cube: bool) -> _Scene:
    with needs("robosuite"):
        import mujoco

    joints = [model.joint(i).name for i in range(model.njnt)]
    bodies = [model.body(i).name for i in range(model.nbody)]
    geoms = [model.geom(i).name for i in range(model.ngeom)]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    table = _only(recording, "geom", "table_collision", geoms)
    columns: dict[str, list[int]] = {}
    boxes: list[int] = []
    for name in (*JOINTS, "cube") if cube else JOINTS:
        joint = _only(recording, "joint", name, joints, at_start=name == "cube")
        positions, velocities = (7, 6) if name == "cube" else (1, 1)
        first, second = 1 + model.jnt_qposadr[joint], 1 + model.nq + model.jnt_dofadr[joint]
        columns[name] = [*range(first, first + positions), *range(second, second + velocities)]
        if name == "cube":
            boxes = [
                i
                for i in range(model.ngeom)
                if model.geom_bodyid[i] == model.jnt_bodyid[joint]
                and model.geom_type[i] == mujoco.mjtGeom.mjGEOM_BOX
            ]
            if not boxes or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_FREE:
                raise recording.error("the cube in its model is not a free box")
    return _Scene(
        model=model,
        data=data,
        columns=columns,
        hand=_only(recording, "body", "right_hand", bodies),
        cube=boxes,
        table=data.geom_xpos[table] + [0, 0, model.geom_size[table, 2]],
    )


def _only(
    recording: Recording, kind: str, name: str, names: list[str], *, at_start: bool = False
) -> int:
    """Index of the only name that ends with ``name`` or, with ``at_start``, begins with it."""
    found = [i for i, given in enumerate(names) if given.endswith(name)]
    if at_start:  # cube, cube_jnt0 and cube_joint0
        found = [i for i, given in enumerate(names) if given.startswith(name)]
    if len(found) != 1:
        there = ", ".join(given for given in names if given)
        raise recording.error(f"its model has {len(found)} x {kind} ...{name}; there: {there}")
    return found[0]


def _set_cube_size(scene: _Scene, size: np.ndarray) -> None:
    """Sets the cube's half sizes (3,) [m], and the bounds that MuJoCo derives from them."""
    model = scene.model
    model.geom_size[scene.cube] = size
    model.geom_rbound[scene.cube] = np.linalg.norm(size)
    model.geom_aabb[scene.cube, 3:] = size
    body = model.geom_bodyid[scene.cube[0]]
    first = model.body_bvhadr[body]
    model.bvh_aabb[first : first + model.body_bvhnum[body], 3:] = size


def _transfer(recording: Recording, env: TabletopScene, there: _Scene, rows: np.ndarray) -> Any:
    """Converts states to the task's (N, 1 + nq + nv), finds its scene, and sets cube and goal."""
    here = _find_scene(recording, env.sim.model._model, cube=env.has_cube)
    # The table and not the robot's base ties the scenes together: the bases differ by 1 mm in
    # height, the fingers' and the cube's places over the table by 0.1 mm.
    shift = here.table - there.table
    states = np.tile(env.sim.get_state().flatten(), (len(rows), 1))
    states[:, 0] = rows[:, 0]
    for name, columns in here.columns.items():
        states[:, columns] = rows[:, there.columns[name]]
    if env.has_cube:
        position = here.columns["cube"][:3]
        states[:, position] += shift
        env.goal_start = states[0, position].copy()
        _set_cube_size(here, there.model.geom_size[there.cube[0]])
    else:
        sites = [there.model.site(i).name for i in range(there.model.nsite)]
        goal = there.data.site_xpos[_only(recording, "site", "goal_marker", sites)] + shift
        env.goal_start = goal
    return states, here


def _observe(env: TabletopScene, states: np.ndarray) -> tuple[dict[str, np.ndarray], Any]:
    """Computes parts of the observation, and rotations, rewards and successes, of states."""
    seen: dict[str, list[Any]] = {}
    for state in states:
        env.sim.set_state_from_flattened(state)
        env.sim.forward()
        row = env.named_observation() | {
            "rotation": env.eef_rotation,
            "reward": env.reward(),
            "success": env._check_success(),
        }
        for name, part in row.items():
            seen.setdefault(name, []).append(part)
    parts = {name: np.array(values) for name, values in seen.items()}
    return parts, (parts.pop("rotation"), parts.pop("reward"), parts.pop("success"))


def _recorded_path(
    env: TabletopScene, there: _Scene, here: _Scene, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The end-effector's path (N, 3) [m] by the recording's model, and rotations (N, 3, 3).

    The task's end-effector is attached to the recording's hand, because position (11.5 mm further
    out in 2018) and rotation of the recording's own end-effector differ between files.
    """
    with needs("robosuite"):
        import mujoco

    hand = env.sim.data.body_xmat[here.hand].reshape(3, 3)
    tool = hand.T @ (env.eef_position - env.sim.data.body_xpos[here.hand])
    path, rotations = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
    for k, row in enumerate(rows):
        there.data.qpos[:] = row[1 : 1 + there.model.nq]
        mujoco.mj_kinematics(there.model, there.data)
        rotations[k] = there.data.xmat[there.hand].reshape(3, 3)
        path[k] = there.data.xpos[there.hand] + rotations[k] @ tool + here.table - there.table
    return path, rotations


def _relabel(recording: Recording, env: TabletopScene, tracking: float) -> Episode:
    there = _find_scene(recording, recording.model, cube=env.has_cube)
    rows = resample(recording, env.control_freq)
    states, here = _transfer(recording, env, there, rows)
    parts, (rotations, rewards, successes) = _observe(env, states)
    path, hands = _recorded_path(env, there, here, rows)
    apart = np.linalg.norm(path - parts["robot0_eef_pos"], axis=1)
    if apart.max() > MAX_MODEL_ERROR:
        raise recording.error(
            f"row {apart.argmax()} at {env.control_freq} Hz: the end-effector is "
            f"{1e3 * apart.max():.1f} mm from where the task's model has it; "
            f"valid: {1e3 * MAX_MODEL_ERROR:g} mm"
        )
    scale = tracking * env.robots[0].part_controllers["right"].output_max
    motion = _motion(parts["robot0_eef_pos"], rotations) / scale
    gripper = _gripper_commands(parts["robot0_gripper_qpos"] @ [1.0, -1.0])
    actions = np.column_stack([motion.clip(-1, 1), gripper]).astype(np.float32)
    action_error, rotation_error = _action_errors(scale * actions[:, :6], path, hands)
    return Episode(
        observations={name: part[:-1] for name, part in parts.items()},
        next_observations={name: part[1:] for name, part in parts.items()},
        actions=actions,
        rewards=rewards[1:],
        terminated=np.zeros(len(actions), dtype=bool),
        extras={"successes": successes[1:], "states": states[:-1]},
        attributes={
            "model_file": env.sim.model.get_xml(),
            "recorded_rows": len(recording.states),
            "duration": float(np.ptp(recording.states[:, 0])),
            "lift_height": float(env.cube_displacement[2]) if env.has_cube else float("nan"),
            "grasped_at_end": env.has_cube and env.grasped,
            "action_error": action_error,
            "rotation_error": rotation_error,
            "saturated_share": float((np.abs(motion) > 1).any(axis=1).mean()),
            "model_error": float(apart.max()),
        },
    )


# -- actions ---------------------------------------------------------------------------------------


def _motion(path: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Differences (N - 1, 6) of poses: position [m], axis-angle [rad], in the world's axes.

    The robot's base, whose axes the controller uses, is not turned against the world.
    """
    with needs("robosuite"):
        from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(rotations[1:] @ rotations[:-1].transpose(0, 2, 1)).as_rotvec()
    return np.hstack([np.diff(path, axis=0), turns])


def _gripper_commands(opening: np.ndarray) -> np.ndarray:
    """Commands (N - 1,), +1 closes, -1 opens, from the distance between the fingers (N,) [m].

    The motion of the fingers indicates the command. Fingers at rest wide open have the command to
    open; fingers stopped by the cube or each other keep their last command. Before the first
    motion, fingers that are not open are closing.
    """
    from torchrl_bmrl.envs.arms import OPEN_FINGERS

    left, right = OPEN_FINGERS["RethinkGripper"]
    rest = left - right - FINGER_REST
    commands, command = [], 1.0
    for before, after in itertools.pairwise(opening):
        if before - after > CLOSING_MOTION:
            command = 1.0
        elif after - before > OPENING_MOTION or after > rest:
            command = -1.0
        commands.append(command)
    return np.array(commands)


def _action_errors(motion: np.ndarray, path: np.ndarray, hands: np.ndarray) -> tuple[float, float]:
    """Largest distance [m] and angle [rad] between summed motions (T, 6) and a path."""
    with needs("robosuite"):
        from scipy.spatial.transform import Rotation

    reached = path[0] + np.cumsum(motion[:, :3], axis=0)
    rotation, angles = Rotation.from_matrix(hands[0]), []
    for turn, hand in zip(Rotation.from_rotvec(motion[:, 3:]), hands[1:], strict=True):
        rotation = turn * rotation
        angles.append((rotation * Rotation.from_matrix(hand).inv()).magnitude())
    return float(np.linalg.norm(reached - path[1:], axis=1).max()), float(max(angles))
