"""Six Sawyer tasks on robosuite's own robot, controller and table.

Three robosuite environments (:class:`BMRLSawyerReach`, :class:`BMRLSawyerLift`,
:class:`BMRLSawyerPush`) hold the physics, the starts, the rewards and the definitions of success.
:class:`SawyerEnv` shows any of the six tasks as a :class:`gymnasium.Env`.

Reference: *Compositional Skill Learning Using Batch Meta RL*, section 3.
"""

from __future__ import annotations

import logging
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import mujoco
import numpy as np

from torchrl_bmrl.envs.caching import user_numba_cache
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.names import PUSH_DIRECTIONS, STEPPERS, TASKS, check_task

# robosuite logs "no private macro file" and controller notes at import and at every construction.
# A level set before its import is undone by it; a filter stays.
logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)

with user_numba_cache():
    import robosuite
    from robosuite.controllers import load_composite_controller_config
    from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
    from robosuite.models.arenas import TableArena
    from robosuite.models.objects import BoxObject
    from robosuite.models.tasks import ManipulationTask
    from robosuite.utils.mjcf_utils import new_site
    from robosuite.utils.observables import Observable, sensor

    from torchrl_bmrl.envs.stepper import FastStepper, why_not_fast

CONTROL_FREQUENCY = 20
"""Actions per second [Hz]."""
TABLE_SIZE = (0.8, 0.8, 0.05)
TABLE_TOP = np.array([0.0, 0.0, 0.8])
"""Centre of the table's surface [m]; +x points away from the robot, +y to its left."""
CUBE_HALF_SIZE = 0.021
CUBE_RANGE = 0.08
"""The cube starts within this distance of the table's centre along x and along y [m]."""
HOVER_HEIGHT = 0.10
"""Height of the gripper above the cube's centre at the start of lift and push [m]."""
REACH_START = TABLE_TOP + np.array([0.0, 0.0, 0.20])
REACH_START_RADIUS = 0.01
REACH_GOAL_LOW = TABLE_TOP + np.array([-0.12, -0.20, 0.06])
REACH_GOAL_HIGH = TABLE_TOP + np.array([0.12, 0.20, 0.32])

GRIPPER_OPEN = np.array([0.0115, -0.0115])
"""Finger joints at rest under the command "open" [m]."""

REACH_SUCCESS_DISTANCE = 0.02
LIFT_SUCCESS_HEIGHT = 0.05
PUSH_SUCCESS_DISTANCE = 0.07


def reach_reward(distance: float) -> float:
    r"""Dense reward for the end-effector's distance to the goal.

    .. math:: r = 1 - \tanh(10\, d^2)

    Args:
        distance: d, end-effector to goal [m].

    Example:
        >>> reach_reward(0.0)
        1.0
    """
    return float(1.0 - np.tanh(10.0 * distance**2))


def push_velocity_reward(velocity: np.ndarray, direction: np.ndarray) -> float:
    r"""Dense reward for moving the cube along the target direction.

    .. math:: r = 1 - \tanh(\lVert v - u \rVert)

    Args:
        velocity: v, the cube's linear velocity, shape ``(3,)`` [m/s].
        direction: u, the unit target direction, shape ``(3,)``.
    """
    return float(1.0 - np.tanh(np.linalg.norm(velocity - direction)))


def without_pictures(xml: str) -> str:
    """The same physics without what only a camera sees: geoms that touch nothing, their meshes.

    Trajectories stay the same to the bit; a model takes 0.1 MB and not 80, a step three quarters of
    the time.

    Args:
        xml: MJCF whose bodies have explicit inertias, as robosuite's robots do.
    """
    root = ET.fromstring(xml)
    for parent in list(root.iter()):
        for geom in parent.findall("geom"):
            if geom.get("contype") == geom.get("conaffinity") == "0":
                parent.remove(geom)
            else:
                geom.attrib.pop("material", None)
    asset = root.find("asset")
    assert asset is not None
    shown = {geom.get("mesh") for geom in root.iter("geom")}
    for element in list(asset):
        if element.tag != "mesh" or element.get("name") not in shown:
            asset.remove(element)
    size = root.find("size")
    assert size is not None
    # robosuite asks for room for 5000 contacts; an episode uses 60 kB of this.
    size.attrib = {"memory": "32M"}
    return ET.tostring(root, encoding="unicode")


class _LeanTask(ManipulationTask):
    def generate_id_mappings(self, sim: Any) -> None:
        """Nothing: robosuite looks up the geoms here that its segmenting cameras show."""


class _BMRLSawyerTask(ManipulationEnv):
    """What the tasks share: Sawyer, table, goal marker, a start set by inverse kinematics.

    Subclasses place the end-effector, name the goal, and compute reward terms and success. The
    horizon is not theirs: :class:`SawyerEnv` truncates.

    Args:
        seed: of the starts.
        lean: simulate :func:`without_pictures`; for cameras leave it off.
        **kwargs: robosuite's own options.
    """

    has_cube: ClassVar[bool] = True

    def __init__(self, *, seed: int | None = None, lean: bool = False, **kwargs: Any) -> None:
        self.lean = lean
        settings: dict[str, Any] = {
            "robots": "Sawyer",
            "controller_configs": load_composite_controller_config(robot="Sawyer"),
            "initialization_noise": None,
            "use_camera_obs": False,
            "has_renderer": False,
            "has_offscreen_renderer": False,
            "control_freq": CONTROL_FREQUENCY,
            "ignore_done": True,
            "hard_reset": False,
        }
        self.use_object_obs = kwargs.pop("use_object_obs", True)
        super().__init__(**(settings | kwargs), seed=seed)

    # -- model ---------------------------------------------------------------------------------

    def _load_model(self) -> None:
        super()._load_model()
        model = self.robots[0].robot_model
        model.set_base_xpos(model.base_xpos_offset["table"](TABLE_SIZE[0]))
        arena = TableArena(
            table_full_size=TABLE_SIZE,
            table_friction=(1.0, 5e-3, 1e-4),
            table_offset=TABLE_TOP,
        )
        arena.set_origin([0, 0, 0])
        objects = []
        if self.has_cube:
            # One fixed size: a random one would be hidden from the observation.
            half = [CUBE_HALF_SIZE] * 3
            self.cube = BoxObject("cube", size_min=half, size_max=half, rgba=[0.8, 0.2, 0.1, 1])
            objects.append(self.cube)
        self.model = (_LeanTask if self.lean else ManipulationTask)(arena, [model], objects)
        if self.lean:
            model.mujoco_model = None  # a second robot, 60 MB, for robosuite's whole-body IK
        self.model.worldbody.append(
            new_site("goal_marker", pos=(0, 0, 1), size=(0.015,), rgba=(1, 0.1, 0.1, 0.7), group=1)
        )

    def edit_model_xml(self, xml_str: str) -> str:
        """Besides what robosuite does to it, the leaner model where asked for."""
        self._scene = super().edit_model_xml(xml_str)
        return without_pictures(self._scene) if self.lean else self._scene

    def scene_xml(self) -> str:
        """MJCF of the whole scene, pictures included, the goal marker where it stands.

        It is this environment's own. MuJoCo's ``mj_saveLastXML`` would save the one loaded last.
        """
        root = ET.fromstring(self._scene)
        (marker,) = (site for site in root.iter("site") if site.get("name") == "goal_marker")
        position = self.sim.model.site_pos[self._goal_site_id]
        marker.set("pos", " ".join(repr(float(x)) for x in position))
        return ET.tostring(root, encoding="unicode")

    def _setup_references(self) -> None:
        super()._setup_references()
        self._goal_site_id = self.sim.model.site_name2id("goal_marker")
        self._eef_site_id = self.robots[0].eef_site_id["right"]
        self._eef_body_id = self.sim.model.body_name2id(self.robots[0].gripper["right"].root_body)
        if self.has_cube:
            self._cube_body_id = self.sim.model.body_name2id(self.cube.root_body)
            self._cube_dof = self.sim.model.get_joint_qvel_addr(self.cube.joints[0])[0]
            pads = self.robots[0].gripper["right"].important_geoms
            names = [*pads["left_fingerpad"], *pads["right_fingerpad"], *self.cube.contact_geoms]
            self._grasp_geoms = [self.sim.model.geom_name2id(name) for name in names]

    def _setup_observables(self) -> dict[str, Observable]:
        """Adds ``goal_pos`` to robosuite's own observables; none at all without object_obs."""
        if not self.use_object_obs:
            return {}
        observables = super()._setup_observables()

        @sensor(modality="object")
        def goal_pos(obs_cache: dict[str, Any]) -> np.ndarray:
            return self.goal

        observables["goal_pos"] = Observable("goal_pos", goal_pos, sampling_rate=self.control_freq)
        return observables

    # -- start ---------------------------------------------------------------------------------

    def _sample_start(self) -> np.ndarray:
        """Places what the task needs and returns where the end-effector starts, (3,) [m]."""
        raise NotImplementedError

    def _reset_internal(self) -> None:
        super()._reset_internal()
        if self.deterministic_reset:
            return
        self.sim.forward()
        joints = self._inverse_kinematics(self._sample_start())
        robot = self.robots[0]
        robot.set_robot_joint_positions(joints)
        self.sim.data.qpos[robot._ref_gripper_joint_pos_indexes["right"]] = GRIPPER_OPEN
        # Without these two the controller holds the pose before the move for one control step, and
        # the gripper half closes: both are state that no reset of the simulator touches. The
        # fingers come first: the controller keeps the mass matrix for the first physics step.
        robot.composite_controller.part_controllers["right"].update_initial_joints(joints)
        robot.gripper["right"].current_action = np.array([-1.0, 1.0])
        self.sim.forward()

    def _place_cube(self) -> np.ndarray:
        xy = self.rng.uniform(-CUBE_RANGE, CUBE_RANGE, size=2)
        position = TABLE_TOP + np.array([xy[0], xy[1], CUBE_HALF_SIZE])
        self.sim.data.set_joint_qpos(self.cube.joints[0], np.append(position, [1.0, 0, 0, 0]))
        self.goal_start = position
        return position

    def _inverse_kinematics(
        self, target: np.ndarray, tolerance: float = 1e-5, iterations: int = 100
    ) -> np.ndarray:
        """Joint positions (7,) [rad] that bring the end-effector to ``target`` (3,) [m].

        Damped least squares from the present joints, the present orientation kept.
        """
        robot, model = self.robots[0], self.sim.model._model
        scratch = mujoco.MjData(model)
        scratch.qpos[:] = self.sim.data.qpos
        mujoco.mj_kinematics(model, scratch)
        mujoco.mj_comPos(model, scratch)
        site = self._eef_site_id
        qpos, qvel = robot._ref_joint_pos_indexes, robot._ref_joint_vel_indexes
        orientation = scratch.site_xmat[site].reshape(3, 3).copy()
        jacp, jacr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        for _ in range(iterations):
            current = scratch.site_xmat[site].reshape(3, 3)
            error = np.empty(6)
            error[:3] = target - scratch.site_xpos[site]
            error[3:] = 0.5 * np.cross(current, orientation, axis=0).sum(axis=1)
            if np.abs(error).max() < tolerance:
                return scratch.qpos[qpos].copy()
            mujoco.mj_jacSite(model, scratch, jacp, jacr, site)
            jacobian = np.vstack([jacp[:, qvel], jacr[:, qvel]])
            damped = jacobian @ jacobian.T + 1e-4 * np.eye(6)
            step = jacobian.T @ np.linalg.solve(damped, error)
            scratch.qpos[qpos] += np.clip(step, -0.2, 0.2)
            mujoco.mj_kinematics(model, scratch)
            mujoco.mj_comPos(model, scratch)
        raise RuntimeError(f"inverse kinematics found no joints for the end-effector at {target}")

    # -- state ---------------------------------------------------------------------------------

    @property
    def goal_start(self) -> np.ndarray:
        """Where the goal was when the episode began, (3,) [m]: the goal marker's place.

        The point to reach, or the cube's centre before anything moved it.
        """
        return np.array(self.sim.model.site_pos[self._goal_site_id])

    @goal_start.setter
    def goal_start(self, position: np.ndarray) -> None:
        self.sim.model.site_pos[self._goal_site_id] = position

    @property
    def eef_position(self) -> np.ndarray:
        """End-effector position (3,) [m]."""
        return np.array(self.sim.data.site_xpos[self._eef_site_id])

    @property
    def eef_rotation(self) -> np.ndarray:
        """End-effector rotation matrix (3, 3)."""
        return np.array(self.sim.data.site_xmat[self._eef_site_id]).reshape(3, 3)

    @property
    def goal(self) -> np.ndarray:
        """Goal position (3,) [m]; by default the cube's centre."""
        return np.array(self.sim.data.body_xpos[self._cube_body_id])

    @property
    def cube_displacement(self) -> np.ndarray:
        """Cube's position relative to its start (3,) [m]."""
        return np.array(self.sim.data.body_xpos[self._cube_body_id]) - self.goal_start

    @property
    def grasped(self) -> bool:
        """Whether both fingers touch the cube."""
        left, right, cube = self._grasp_geoms
        touching = self.sim.data._data.contact.geom
        others = touching[(touching == cube).any(1)]
        return bool((others == left).any() and (others == right).any())

    def named_observation(self) -> dict[str, np.ndarray]:
        """The observation's parts under robosuite's names (float64; quaternion xyzw)."""
        robot, data = self.robots[0], self.sim.data
        w, x, y, z = data.body_xquat[self._eef_body_id]
        return {
            "robot0_joint_pos": np.array(data.qpos[robot._ref_joint_pos_indexes]),
            "robot0_gripper_qpos": np.array(
                data.qpos[robot._ref_gripper_joint_pos_indexes["right"]]
            ),
            "robot0_joint_vel": np.array(data.qvel[robot._ref_joint_vel_indexes]),
            "robot0_eef_pos": self.eef_position,
            "robot0_eef_quat": np.array([x, y, z, w]),
            "goal_pos": self.goal,
        }

    # -- reward --------------------------------------------------------------------------------

    def _post_action(self, action: np.ndarray) -> tuple[float, bool, dict[str, Any]]:
        # Poses lag the joints by one physics substep; the observation must be a function of the
        # state.
        mujoco.mj_fwdPosition(self.sim.model._model, self.sim.data._data)
        return super()._post_action(action)

    def reward_terms(self) -> dict[str, float]:
        """The reward's terms by name; the reward is their sum."""
        return {"reach": reach_reward(float(np.linalg.norm(self.eef_position - self.goal)))}

    def reward(self, action: np.ndarray | None = None) -> float:
        """Sum of :meth:`reward_terms`."""
        return sum(self.reward_terms().values())


class BMRLSawyerReach(_BMRLSawyerTask):
    """Bring the end-effector to a random point, from within 1 cm of a set point."""

    has_cube = False

    def _sample_start(self) -> np.ndarray:
        self.goal_start = self.rng.uniform(REACH_GOAL_LOW, REACH_GOAL_HIGH)
        direction = self.rng.standard_normal(3)
        radius = REACH_START_RADIUS * self.rng.uniform() ** (1 / 3)
        return REACH_START + radius * direction / np.linalg.norm(direction)

    @property
    def goal(self) -> np.ndarray:
        """The point to reach (3,) [m]."""
        return self.goal_start

    def _check_success(self) -> bool:
        return bool(np.linalg.norm(self.eef_position - self.goal) < REACH_SUCCESS_DISTANCE)


class BMRLSawyerLift(_BMRLSawyerTask):
    """Grasp a randomly placed cube from above and lift it more than 5 cm."""

    def _sample_start(self) -> np.ndarray:
        return self._place_cube() + np.array([0.0, 0.0, HOVER_HEIGHT])

    def reward_terms(self) -> dict[str, float]:
        """Distance to the cube, grasp, height."""
        return super().reward_terms() | {
            "grasp": float(self.grasped),
            "lift": float(self.cube_displacement[2] > LIFT_SUCCESS_HEIGHT),
        }

    def _check_success(self) -> bool:
        return bool(self.cube_displacement[2] > LIFT_SUCCESS_HEIGHT) and self.grasped


class BMRLSawyerPush(_BMRLSawyerTask):
    """Push a randomly placed cube 7 cm in one of four directions.

    Args:
        direction: ``"right"``, ``"left"``, ``"up"`` or ``"down"``, seen from the robot's base.
    """

    def __init__(self, direction: str, **kwargs: Any) -> None:
        if direction not in PUSH_DIRECTIONS:
            raise UnknownNameError("push direction", direction, tuple(PUSH_DIRECTIONS))
        self.direction = np.array(PUSH_DIRECTIONS[direction])
        super().__init__(**kwargs)

    def _sample_start(self) -> np.ndarray:
        return self._place_cube() + np.array([0.0, 0.0, HOVER_HEIGHT])

    def reward_terms(self) -> dict[str, float]:
        """Distance to the cube, the cube's velocity, its distance from the start."""
        velocity = self.sim.data.qvel[self._cube_dof : self._cube_dof + 3]
        moved = float(np.linalg.norm(self.cube_displacement))
        return super().reward_terms() | {
            "velocity": push_velocity_reward(velocity, self.direction),
            "distance": float(moved > PUSH_SUCCESS_DISTANCE),
        }

    def _check_success(self) -> bool:
        along = float(self.cube_displacement @ self.direction)
        sideways = float(np.linalg.norm(self.cube_displacement - along * self.direction))
        return along > PUSH_SUCCESS_DISTANCE and sideways <= PUSH_SUCCESS_DISTANCE / 2


REWARD_TERMS = ("reach", "grasp", "lift", "velocity", "distance")
"""Names of the reward terms over all tasks; ``info["reward_<name>"]`` is 0 where absent."""


def make_robosuite_env(task: str, **kwargs: Any) -> _BMRLSawyerTask:
    """robosuite environment of one of the six tasks.

    Args:
        task: one of :data:`torchrl_bmrl.names.TASKS`.
        **kwargs: robosuite's own options (``seed``, ``use_object_obs``, cameras, ...).

    Raises:
        UnknownNameError: for a name that is not a task.
    """
    check_task(task)
    if task == "reach":
        return BMRLSawyerReach(**kwargs)
    if task == "lift":
        return BMRLSawyerLift(**kwargs)
    return BMRLSawyerPush(direction=task.removeprefix("push_"), **kwargs)


def robosuite_metadata(task: str) -> dict[str, Any]:
    """robomimic's ``env_args``: what rebuilds the environment of a task with ``robosuite.make``."""
    kwargs = {} if task in ("reach", "lift") else {"direction": task.removeprefix("push_")}
    name = {"reach": "BMRLSawyerReach", "lift": "BMRLSawyerLift"}.get(task, "BMRLSawyerPush")
    return {
        "env_name": name,
        "type": 1,
        "env_version": robosuite.__version__,
        "env_kwargs": kwargs | {"robots": "Sawyer", "control_freq": CONTROL_FREQUENCY},
    }


_PHYSICS = mujoco.mjtState.mjSTATE_INTEGRATION
_said: set[str] = set()


class SawyerEnv(gymnasium.Env):
    """One Sawyer task as a gymnasium environment.

    Observation: a dict of named parts under robosuite's names, float64: ``robot0_joint_pos`` (7,)
    [rad], ``robot0_gripper_qpos`` (2,) [m], ``robot0_joint_vel`` (7,) [rad/s], ``robot0_eef_pos``
    (3,) [m], ``robot0_eef_quat`` (4,) xyzw, ``goal_pos`` (3,) [m].

    Action: (7,) in [-1, 1]: position delta (x0.05 m), rotation delta (x0.5 rad), gripper (+1
    closes, -1 opens).

    ``info``: ``success`` and each reward term as ``reward_<term>``.

    An episode never terminates; the registered ids are truncated after 200 steps.

    Args:
        task: one of :data:`torchrl_bmrl.names.TASKS`.
        render_mode: ``None`` or ``"rgb_array"``.
        camera: robosuite camera for :meth:`render`.
        image_size: height and width of the rendered picture [pixels].
        stepper: ``"fast"``, compiled code that gives robosuite's trajectories bit by bit, or
            ``"robosuite"``. A controller that the first does not cover is left to robosuite, which
            a warning says once.
        controller_configs: robosuite's composite controller; by default Sawyer's operational-space
            control of the pose.
        horizon: an episode is truncated after so many steps; ``None`` never. (Not gymnasium's
            ``max_episode_steps``, whose count starts anew when a state is restored.)

    Raises:
        UnknownNameError: for another task, render mode or stepper.

    Example:
        >>> env = SawyerEnv("lift")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> terminated, bool(info["success"])
        (False, False)
    """

    metadata = {  # noqa: RUF012 (gymnasium's convention)
        "render_modes": ["rgb_array"],
        "render_fps": CONTROL_FREQUENCY,
    }

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        camera: str = "frontview",
        image_size: tuple[int, int] = (256, 256),
        *,
        stepper: str = "fast",
        controller_configs: dict[str, Any] | None = None,
        horizon: int | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UnknownNameError("render_mode", render_mode, ("rgb_array",))
        if stepper not in STEPPERS:
            raise UnknownNameError("stepper", stepper, STEPPERS)
        self.task = task
        self.render_mode = render_mode
        self.camera = camera
        self.image_size = image_size
        self.stepper = stepper
        self.horizon = horizon
        self._steps = 0
        self._fast: FastStepper | None = None
        self._picture: tuple[mujoco.MjModel, mujoco.MjData, mujoco.Renderer] | None = None
        options = {} if controller_configs is None else {"controller_configs": controller_configs}
        self.robosuite_env = make_robosuite_env(
            task, use_object_obs=False, lean=stepper == "fast", **options
        )
        low, high = self.robosuite_env.action_spec
        self.action_space = gymnasium.spaces.Box(
            low.astype(np.float32), high.astype(np.float32), dtype=np.float32
        )
        self.observation_space = gymnasium.spaces.Dict(
            {
                name: gymnasium.spaces.Box(-np.inf, np.inf, part.shape, dtype=np.float64)
                for name, part in self.robosuite_env.named_observation().items()
            }
        )

    def _info(self, terms: dict[str, float]) -> dict[str, Any]:
        # numpy scalars: TorchRL's info reader asks every value for its dtype.
        return {
            "success": np.bool_(self.robosuite_env._check_success()),
            **{f"reward_{name}": np.float64(terms.get(name, 0.0)) for name in REWARD_TERMS},
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode; the same ``seed`` gives the same episode.

        Args:
            seed: of the start and of later unseeded ones.
            options: ``{"state": state}`` goes on from a state of :meth:`get_state` instead.

        Raises:
            BMRLError: as :meth:`set_state`.
        """
        super().reset(seed=seed)
        if seed is not None:
            # In place: assigning robosuite's rng would not reach the samplers that hold it.
            state = np.random.default_rng(seed).bit_generator.state
            self.robosuite_env.rng.bit_generator.state = state
        if options and "state" in options:
            self.set_state(options["state"])
        else:
            self._steps = 0
            self.robosuite_env.reset()
        return self.robosuite_env.named_observation(), self._info({})

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Acts for one control period (50 ms).

        Raises:
            BMRLError: if the action has another shape or is not finite; nothing has moved then.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            shape = f"({self.action_space.shape[0]},)"
            raise BMRLError(f"action is {action}; valid: finite, of shape {shape}")
        self._advance(action)
        self._steps += 1
        terms = self.robosuite_env.reward_terms()
        observation = self.robosuite_env.named_observation()
        truncated = self.horizon is not None and self._steps >= self.horizon
        return observation, sum(terms.values()), False, truncated, self._info(terms)

    def _advance(self, action: np.ndarray) -> None:
        env = self.robosuite_env
        if self.stepper == "fast" and (self._fast is None or not self._fast.serves(env)):
            self._fast = None
            if (reason := why_not_fast(env)) is None:
                self._fast = FastStepper(env)
            elif reason not in _said:
                _said.add(reason)
                warnings.warn(f"steps are robosuite's own, and slow: {reason}", stacklevel=3)
        if self._fast is None:
            env.step(action)
            return
        self._fast.step(action)
        env.timestep += 1
        env.cur_time += env.control_timestep

    # -- state ---------------------------------------------------------------------------------

    def get_state(self) -> dict[str, np.ndarray]:
        """Everything that decides how the episode goes on, at any step, as arrays.

        ``physics``: MuJoCo's integration state (positions, velocities, warm start, controls, time);
        ``gripper`` and ``rest_joints``: what robosuite's gripper and arm controllers remember;
        ``goal_start``; ``steps`` taken; ``rng``: of the starts to come. ``np.savez`` keeps it.

        Exact for Sawyer's own controller and every other that does not interpolate goals.
        """
        env, robot = self.robosuite_env, self.robosuite_env.robots[0]
        model, data = env.sim.model._model, env.sim.data._data
        physics = np.empty(mujoco.mj_stateSize(model, _PHYSICS))
        mujoco.mj_getState(model, data, physics, _PHYSICS)
        arm = robot.composite_controller.part_controllers["right"]
        return {
            "physics": physics,
            "gripper": np.array(robot.gripper["right"].current_action, dtype=np.float64),
            "rest_joints": np.array(arm.initial_joint, dtype=np.float64),
            "goal_start": env.goal_start,
            "steps": np.array([self._steps, env.timestep]),
            "rng": _rng_to_array(env.rng),
        }

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes back to a state of :meth:`get_state`, of this environment or of another one.

        What follows equals never having left, in the task at hand: states of lift and of the four
        pushes can be exchanged.

        Raises:
            BMRLError: if an array is missing, too many, of another shape or not finite; nothing has
                changed then.
        """
        now = self.get_state()
        if state.keys() != now.keys():
            raise BMRLError(f"a state has {sorted(state)}; valid: {sorted(now)}")
        arrays = {name: np.asarray(state[name]) for name in now}
        for name, array in arrays.items():
            valid = now[name]
            if array.shape != valid.shape or array.dtype != valid.dtype:
                raise BMRLError(
                    f"{name} of the state is {array.dtype} {array.shape}; valid here ({self.task}): "
                    f"{valid.dtype} {valid.shape}"
                )
            if not np.isfinite(array).all():
                raise BMRLError(f"{name} of the state is {array}; valid: finite")
        self._load_state(arrays)
        env = self.robosuite_env
        mujoco.mj_fwdPosition(env.sim.model._model, env.sim.data._data)
        env.rng.bit_generator.state = _rng_from_array(arrays["rng"])

    def _load_state(self, state: Mapping[str, np.ndarray]) -> None:
        """The state, but neither the poses that follow from it nor the random numbers to come."""
        env, robot = self.robosuite_env, self.robosuite_env.robots[0]
        mujoco.mj_setState(env.sim.model._model, env.sim.data._data, state["physics"], _PHYSICS)
        robot.gripper["right"].current_action = state["gripper"].copy()
        arm = robot.composite_controller.part_controllers["right"]
        arm.initial_joint = state["rest_joints"].copy()
        # Otherwise robosuite goes on from the pose that it saw last.
        arm.new_update = True
        env.goal_start = state["goal_start"]
        self._steps, env.timestep = (int(count) for count in state["steps"])
        env.cur_time = env.timestep * env.control_timestep

    # -- pictures ------------------------------------------------------------------------------

    def render(self) -> np.ndarray | None:
        """Picture of the scene, (height, width, 3) uint8, in mode ``"rgb_array"``."""
        if self.render_mode is None:
            return None
        env = self.robosuite_env
        if self._picture is None:
            # A model of its own, complete: the one that is simulated has no pictures.
            model = mujoco.MjModel.from_xml_string(env.scene_xml())
            self._picture = model, mujoco.MjData(model), mujoco.Renderer(model, *self.image_size)
        model, data, renderer = self._picture
        simulated = env.sim.model._model
        model.site_pos[:], model.site_rgba[:] = simulated.site_pos, simulated.site_rgba
        data.qpos[:] = env.sim.data.qpos
        mujoco.mj_fwdPosition(model, data)
        options = mujoco.MjvOption()
        options.geomgroup[0] = 0  # collision shapes
        renderer.update_scene(data, camera=self.camera, scene_option=options)
        return renderer.render()

    def close(self) -> None:
        """Frees the simulator and the renderer."""
        if self._picture is not None:
            self._picture[-1].close()
        self._picture = self._fast = None
        self.robosuite_env.close()


def _rng_to_array(rng: np.random.Generator) -> np.ndarray:
    """State of numpy's default generator (PCG64), uint64 (6,)."""
    state = rng.bit_generator.state
    low = (1 << 64) - 1
    words = [
        (state["state"][name] >> shift) & low for name in ("state", "inc") for shift in (64, 0)
    ]
    return np.array([*words, state["has_uint32"], state["uinteger"]], dtype=np.uint64)


def _rng_from_array(array: np.ndarray) -> dict[str, Any]:
    """What :func:`_rng_to_array` was made from."""
    words = [int(word) for word in array]
    return {
        "bit_generator": "PCG64",
        "state": {"state": words[0] << 64 | words[1], "inc": words[2] << 64 | words[3]},
        "has_uint32": words[4],
        "uinteger": words[5],
    }


__all__ = [
    "CONTROL_FREQUENCY",
    "REWARD_TERMS",
    "TASKS",
    "BMRLSawyerLift",
    "BMRLSawyerPush",
    "BMRLSawyerReach",
    "SawyerEnv",
    "make_robosuite_env",
    "push_velocity_reward",
    "reach_reward",
    "robosuite_metadata",
]
