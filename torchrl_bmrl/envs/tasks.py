"""Six Sawyer tasks on robosuite's own robot, controller and table.

Three robosuite environments (:class:`BMRLSawyerReach`, :class:`BMRLSawyerLift`,
:class:`BMRLSawyerPush`) hold the physics, the starts, the rewards and the definitions of success.
:class:`torchrl_bmrl.envs.sawyer.SawyerEnv` shows any of the six as a :class:`gymnasium.Env`.

Reference: *Compositional Skill Learning Using Batch Meta RL*, section 3.
"""

from __future__ import annotations

import logging
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from torchrl_bmrl.envs.caching import user_numba_cache
from torchrl_bmrl.envs.physics import check_mujoco, kept_environment
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.extras import needs
from torchrl_bmrl.names import PUSH_DIRECTIONS, TASKS, check_task, composition_stages

# robosuite logs "no private macro file" and controller notes at import and at every construction.
# A level set before its import is undone by it; a filter stays.
logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)

with needs("robosuite"), user_numba_cache(), kept_environment("MUJOCO_GL"):
    import mujoco

    check_mujoco(getattr(mujoco, "__version__", None))
    import robosuite
    from robosuite.controllers import load_composite_controller_config
    from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
    from robosuite.models.arenas import TableArena
    from robosuite.models.objects import BoxObject
    from robosuite.models.robots import RobotModel
    from robosuite.models.tasks import ManipulationTask
    from robosuite.utils.mjcf_utils import new_site
    from robosuite.utils.observables import Observable, sensor

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

    Trajectories stay the same to the bit; a model takes 0.1 MB and not 80, its physics three
    quarters of the time.

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

    Subclasses say which of the six tasks is at hand and place the end-effector. The horizon is not
    theirs: ``SawyerEnv`` truncates.

    Args:
        seed: of the starts.
        lean: simulate :func:`without_pictures`; for cameras leave it off.
        **kwargs: robosuite's own options.
    """

    has_cube: ClassVar[bool] = True
    task: str
    """The task at hand: it decides goal, reward and success."""
    stage: int = 0
    """Tasks of a composition that are done."""

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

    def _load_robots(self) -> None:
        if not self.lean:
            return super()._load_robots()
        # robosuite compiles the robot alone, too, with all its meshes: 300 MB that nothing reads.
        compile_robot = RobotModel.set_mujoco_model
        RobotModel.set_mujoco_model = lambda model: None
        try:
            return super()._load_robots()
        finally:
            RobotModel.set_mujoco_model = compile_robot

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

    def _above_cube(self) -> np.ndarray:
        return self.goal_start + np.array([0.0, 0.0, HOVER_HEIGHT])

    def _near_reach_start(self) -> np.ndarray:
        direction = self.rng.standard_normal(3)
        radius = REACH_START_RADIUS * self.rng.uniform() ** (1 / 3)
        return REACH_START + radius * direction / np.linalg.norm(direction)

    def _place_cube(self) -> None:
        xy = self.rng.uniform(-CUBE_RANGE, CUBE_RANGE, size=2)
        position = TABLE_TOP + np.array([xy[0], xy[1], CUBE_HALF_SIZE])
        self.sim.data.set_joint_qpos(self.cube.joints[0], np.append(position, [1.0, 0, 0, 0]))
        self.goal_start = position

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

    def episode_state(self) -> dict[str, np.ndarray]:
        """What an episode remembers besides the simulator, as arrays."""
        return {"goal_start": self.goal_start}

    def set_episode_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes back to what :meth:`episode_state` gave."""
        self.goal_start = state["goal_start"]

    def update_stage(self) -> None:
        """Called after every action; a task alone has no stages."""

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
        """Goal position (3,) [m]: the point to reach, or the cube's centre."""
        return self.goal_start if self.task == "reach" else self.cube_position

    @property
    def cube_position(self) -> np.ndarray:
        """The cube's centre (3,) [m]."""
        return np.array(self.sim.data.body_xpos[self._cube_body_id])

    @property
    def cube_displacement(self) -> np.ndarray:
        """Cube's position relative to its start (3,) [m]."""
        return self.cube_position - self.goal_start

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
        self.update_stage()
        return super()._post_action(action)

    def reward_terms(self) -> dict[str, float]:
        """The reward's terms by name; the reward is their sum.

        All: the end-effector's distance to the goal. Lift: grasp, height. Push: the cube's
        velocity, its distance from the start.
        """
        terms = {"reach": reach_reward(float(np.linalg.norm(self.eef_position - self.goal)))}
        if self.task == "reach":
            return terms
        if self.task == "lift":
            high = float(self.cube_displacement[2] > LIFT_SUCCESS_HEIGHT)
            return terms | {"grasp": float(self.grasped), "lift": high}
        velocity = self.sim.data.qvel[self._cube_dof : self._cube_dof + 3]
        moved = float(np.linalg.norm(self.cube_displacement))
        return terms | {
            "velocity": push_velocity_reward(velocity, self.direction),
            "distance": float(moved > PUSH_SUCCESS_DISTANCE),
        }

    @property
    def direction(self) -> np.ndarray:
        """Unit vector (3,) that the push at hand is measured along."""
        return np.array(PUSH_DIRECTIONS[self.task.removeprefix("push_")])

    def task_success(self) -> bool:
        """Whether the definition of success of the task at hand holds now."""
        if self.task == "reach":
            return bool(np.linalg.norm(self.eef_position - self.goal) < REACH_SUCCESS_DISTANCE)
        if self.task == "lift":
            return bool(self.cube_displacement[2] > LIFT_SUCCESS_HEIGHT) and self.grasped
        along = float(self.cube_displacement @ self.direction)
        sideways = float(np.linalg.norm(self.cube_displacement - along * self.direction))
        return along > PUSH_SUCCESS_DISTANCE and sideways <= PUSH_SUCCESS_DISTANCE / 2

    def _check_success(self) -> bool:
        return self.task_success()

    def reward(self, action: np.ndarray | None = None) -> float:
        """Sum of :meth:`reward_terms`."""
        return sum(self.reward_terms().values())


class BMRLSawyerReach(_BMRLSawyerTask):
    """Bring the end-effector to a random point, from within 1 cm of a set point."""

    has_cube = False
    task = "reach"

    def _sample_start(self) -> np.ndarray:
        self.goal_start = self.rng.uniform(REACH_GOAL_LOW, REACH_GOAL_HIGH)
        return self._near_reach_start()


class BMRLSawyerLift(_BMRLSawyerTask):
    """Grasp a randomly placed cube from above and lift it more than 5 cm."""

    task = "lift"

    def _sample_start(self) -> np.ndarray:
        self._place_cube()
        return self._above_cube()


class BMRLSawyerPush(_BMRLSawyerTask):
    """Push a randomly placed cube 7 cm in one of four directions.

    Args:
        direction: ``"right"``, ``"left"``, ``"up"`` or ``"down"``, seen from the robot's base.
    """

    def __init__(self, direction: str, **kwargs: Any) -> None:
        if direction not in PUSH_DIRECTIONS:
            raise UnknownNameError("push direction", direction, tuple(PUSH_DIRECTIONS))
        self.task = f"push_{direction}"
        super().__init__(**kwargs)

    def _sample_start(self) -> np.ndarray:
        self._place_cube()
        return self._above_cube()


class BMRLSawyerComposition(_BMRLSawyerTask):
    """Several of the six tasks one after the other, with one cube, in one episode.

    It starts as its first task does. When the task at hand succeeds, the next one begins where the
    arm and the cube are; goal, reward and success are its own from there on. Reaching means: to
    above the cube if the next task is one on the cube and the cube lies on the table, else to a
    random point; a cube that was lifted must then still be in the hand. A push after a lift has to
    bring the cube back to the table.

    Args:
        stages: the tasks, in their order.

    Attributes:
        stage: number of tasks that are done; the last one goes on beyond its success.
    """

    def __init__(self, stages: Sequence[str], **kwargs: Any) -> None:
        self.stages = tuple(check_task(task) for task in stages)
        if not self.stages:
            raise BMRLError("a composition has no tasks; valid: at least one")
        self.stage = 0
        self.targets = np.zeros((len(self.stages), 3))
        super().__init__(**kwargs)

    @property
    def task(self) -> str:  # type: ignore[override]
        """The task at hand."""
        return self.stages[min(self.stage, len(self.stages) - 1)]

    def _sample_start(self) -> np.ndarray:
        self.stage = 0
        self._place_cube()
        self.targets = self.rng.uniform(REACH_GOAL_LOW, REACH_GOAL_HIGH, self.targets.shape)
        start = self._near_reach_start() if self.task == "reach" else self._above_cube()
        self.sim.forward()
        self._begin_stage()
        return start

    def _begin_stage(self) -> None:
        """Sets what the stage's task measures from: the point to reach, or the cube's place."""
        on_table = self.cube_position
        on_table[2] = TABLE_TOP[2] + CUBE_HALF_SIZE
        self.goal_start = on_table
        if self.task == "reach":
            following = self.stages[self.stage + 1 : self.stage + 2]
            to_cube = following not in ((), ("reach",)) and not self.carrying
            self.goal_start = self._above_cube() if to_cube else self.targets[self.stage]

    @property
    def carrying(self) -> bool:
        """Whether the cube has to be in the hand: it was lifted, and not pushed since."""
        moved = [task for task in self.stages[: self.stage] if task != "reach"]
        return self.task == "reach" and moved[-1:] == ["lift"]

    def task_success(self) -> bool:
        """Whether the task at hand succeeds now; a cube that is carried must not be lost."""
        return super().task_success() and (self.grasped or not self.carrying)

    def update_stage(self) -> None:
        """Goes on to the next task if the one at hand succeeds."""
        if self.stage < len(self.stages) and self.task_success():
            self.stage += 1
            if self.stage < len(self.stages):
                self._begin_stage()

    def _check_success(self) -> bool:
        return self.stage == len(self.stages)

    def episode_state(self) -> dict[str, np.ndarray]:
        """Besides the base's, ``stage`` (1,) and the random points to reach, ``targets``."""
        stage = np.array([self.stage])
        return super().episode_state() | {"stage": stage, "targets": self.targets.copy()}

    def set_episode_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes back to what :meth:`episode_state` gave."""
        super().set_episode_state(state)
        self.stage = int(state["stage"][0])
        self.targets = state["targets"].copy()


REWARD_TERMS = ("reach", "grasp", "lift", "velocity", "distance")
"""Names of the reward terms over all tasks; ``info["reward_<name>"]`` is 0 where absent."""


def make_robosuite_env(task: str, **kwargs: Any) -> _BMRLSawyerTask:
    """robosuite environment of one of the six tasks, or of a composition.

    Args:
        task: one of :data:`torchrl_bmrl.names.TASKS`, or several joined by ``-``.
        **kwargs: robosuite's own options (``seed``, ``use_object_obs``, cameras, ...).

    Raises:
        UnknownNameError: for a name that is not a task.
    """
    stages = composition_stages(task)
    if len(stages) > 1:
        return BMRLSawyerComposition(stages, **kwargs)
    if task == "reach":
        return BMRLSawyerReach(**kwargs)
    if task == "lift":
        return BMRLSawyerLift(**kwargs)
    return BMRLSawyerPush(direction=task.removeprefix("push_"), **kwargs)


def robosuite_metadata(task: str) -> dict[str, Any]:
    """robomimic's ``env_args``: what rebuilds the environment of a task with ``robosuite.make``."""
    stages = composition_stages(task)
    kwargs: dict[str, Any] = {}
    name = {"reach": "BMRLSawyerReach", "lift": "BMRLSawyerLift"}.get(task, "BMRLSawyerPush")
    if len(stages) > 1:
        name, kwargs = "BMRLSawyerComposition", {"stages": list(stages)}
    elif name == "BMRLSawyerPush":
        kwargs = {"direction": task.removeprefix("push_")}
    return {
        "env_name": name,
        "type": 1,
        "env_version": robosuite.__version__,
        "env_kwargs": kwargs | {"robots": "Sawyer", "control_freq": CONTROL_FREQUENCY},
    }


__all__ = [
    "CONTROL_FREQUENCY",
    "REWARD_TERMS",
    "TASKS",
    "BMRLSawyerComposition",
    "BMRLSawyerLift",
    "BMRLSawyerPush",
    "BMRLSawyerReach",
    "make_robosuite_env",
    "push_velocity_reward",
    "reach_reward",
    "robosuite_metadata",
]
