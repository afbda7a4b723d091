"""The tabletop scene: one arm, a table, perhaps a cube, and the skills of an episode.

:class:`TabletopScene` is a robosuite environment that runs one or several skills
(:mod:`torchrl_bmrl.envs.skills`) in an episode. :class:`torchrl_bmrl.envs.tabletop.TabletopEnv` is
the :class:`gymnasium.Env` around it.
"""

from __future__ import annotations

import logging
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchrl_bmrl.envs.arms import Gripper, check_arm, inverse_kinematics
from torchrl_bmrl.envs.caching import user_numba_cache
from torchrl_bmrl.envs.lean import without_pictures
from torchrl_bmrl.envs.physics import check_mujoco, kept_environment
from torchrl_bmrl.envs.skills import Skill, SkillLike, make_skills
from torchrl_bmrl.envs.table import (
    CONTROL_FREQUENCY,
    CUBE_HALF_SIZE,
    CUBE_RANGE,
    HOVER_HEIGHT,
    TABLE_SIZE,
    TABLE_TOP,
    TARGET_HIGH,
    TARGET_LOW,
)
from torchrl_bmrl.extras import needs

# robosuite logs "no private macro file" and controller notes at import and at every construction.
# Its import undoes a level that was set before; a filter stays.
logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)

with needs("robosuite"), user_numba_cache(), kept_environment("MUJOCO_GL"):
    import mujoco

    check_mujoco(getattr(mujoco, "__version__", None))
    from robosuite.controllers import load_composite_controller_config
    from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
    from robosuite.models.arenas import TableArena
    from robosuite.models.objects import BoxObject
    from robosuite.models.robots import RobotModel
    from robosuite.models.tasks import ManipulationTask
    from robosuite.utils.mjcf_utils import new_site
    from robosuite.utils.observables import Observable, sensor


class _LeanTask(ManipulationTask):
    def generate_id_mappings(self, sim: Any) -> None:
        """Does nothing: robosuite collects geoms here for cameras that segment."""


class TabletopScene(ManipulationEnv):
    """One arm at a table with the skills of an episode, as a robosuite environment.

    One skill is a task. Several are a composition: when the skill at hand succeeds, the next one
    begins where the arm and the cube are, with its own goal, reward and success. A composition
    always has a cube. A cube that was lifted must stay in the hand while skills that leave it where
    it is (:attr:`Skill.holds_cube_after`) follow.

    The scene has no time limit; :class:`~torchrl_bmrl.envs.tabletop.TabletopEnv` truncates.

    Args:
        skills: a skill, several in a row, or names of :data:`~torchrl_bmrl.envs.skills.SKILLS`.
        robots: the arm, one of :data:`~torchrl_bmrl.envs.arms.ARMS`.
        gripper_types: robosuite's name of a gripper, or ``"default"`` for the arm's own.
        seed: of the starts.
        lean: whether the model is :func:`without_pictures`; robosuite's cameras need it complete.
        **kwargs: robosuite's own options.

    Attributes:
        skills: the skills in their order.
        stage: number of skills that are done. The last skill goes on after its success.
        targets: a random point of the workspace for each skill, (stages, 3) [m].

    Raises:
        UnknownNameError: for a skill or an arm that does not exist.

    Example:
        >>> scene = TabletopScene("reach-lift", robots="Panda", seed=0)
        >>> _ = scene.reset()
        >>> scene.skill.name, scene.goal.shape
        ('reach', (3,))
    """

    def __init__(
        self,
        skills: SkillLike | Sequence[SkillLike],
        *,
        robots: str = "Sawyer",
        gripper_types: str = "default",
        seed: int | None = None,
        lean: bool = False,
        **kwargs: Any,
    ) -> None:
        self.skills = make_skills(skills)
        self.stage = 0
        self.targets = np.zeros((len(self.skills), 3))
        self.start_position, self._start_step = np.zeros(3), 0
        self.has_cube = len(self.skills) > 1 or self.skills[0].has_cube
        self.lean = lean
        settings: dict[str, Any] = {
            "robots": check_arm(robots),
            "controller_configs": load_composite_controller_config(robot=robots),
            "gripper_types": gripper_types,
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
        # robosuite also compiles the robot alone with all its meshes: 300 MB that nobody reads.
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
            table_full_size=TABLE_SIZE, table_friction=(1.0, 5e-3, 1e-4), table_offset=TABLE_TOP
        )
        arena.set_origin([0, 0, 0])
        objects = []
        if self.has_cube:
            # The size is fixed: the observation does not contain it.
            half = [CUBE_HALF_SIZE] * 3
            self.cube = BoxObject("cube", size_min=half, size_max=half, rgba=[0.8, 0.2, 0.1, 1])
            objects.append(self.cube)
        self.model = (_LeanTask if self.lean else ManipulationTask)(arena, [model], objects)
        self.model.worldbody.append(
            new_site("goal_marker", pos=(0, 0, 1), size=(0.015,), rgba=(1, 0.1, 0.1, 0.7), group=1)
        )

    def edit_model_xml(self, xml_str: str) -> str:
        """Applies robosuite's changes, and removes what only cameras see if ``lean`` is set."""
        self._scene = super().edit_model_xml(xml_str)
        return without_pictures(self._scene) if self.lean else self._scene

    def scene_xml(self) -> str:
        """MJCF of the whole scene with everything visible and the goal marker in its place."""
        # MuJoCo's mj_saveLastXML would save the model that was loaded last, perhaps another one.
        root = ET.fromstring(self._scene)
        (marker,) = (site for site in root.iter("site") if site.get("name") == "goal_marker")
        position = self.sim.model.site_pos[self._goal_site_id]
        marker.set("pos", " ".join(repr(float(x)) for x in position))
        return ET.tostring(root, encoding="unicode")

    def _initialize_sim(self, xml_string: str | None = None) -> None:
        super()._initialize_sim(xml_string)
        self._gripper: Gripper | None = None  # simulated once for each model, not at each reset

    def _setup_references(self) -> None:
        super()._setup_references()
        self._goal_site_id = self.sim.model.site_name2id("goal_marker")
        self._eef_site_id = self.robots[0].eef_site_id["right"]
        self._eef_body_id = self.sim.model.body_name2id(self.robots[0].gripper["right"].root_body)
        if self.has_cube:
            self._cube_body_id = self.sim.model.body_name2id(self.cube.root_body)
            self._cube_dof = self.sim.model.get_joint_qvel_addr(self.cube.joints[0])[0]
            (geom,) = self.cube.contact_geoms
            self._cube_geom_id = self.sim.model.geom_name2id(geom)

    def _setup_observables(self) -> dict[str, Observable]:
        """robosuite's own observables and ``goal_pos``; none at all without ``use_object_obs``."""
        if not self.use_object_obs:
            return {}
        observables = super()._setup_observables()

        @sensor(modality="object")
        def goal_pos(obs_cache: dict[str, Any]) -> np.ndarray:
            return self.goal

        observables["goal_pos"] = Observable("goal_pos", goal_pos, sampling_rate=self.control_freq)
        return observables

    # -- start ---------------------------------------------------------------------------------

    def _reset_internal(self) -> None:
        super()._reset_internal()
        if self.deterministic_reset:
            return
        self.sim.forward()
        joints = inverse_kinematics(self, self._sample_start())
        robot = self.robots[0]
        robot.set_robot_joint_positions(joints)
        # A reset of the simulator touches neither what the arm's controller nor what the gripper
        # remembers: the controller would hold the pose before the move for one control step, and
        # the gripper would half close. The fingers come first: the controller uses the mass matrix
        # of this moment for the first physics step.
        self.gripper.open()
        robot.composite_controller.part_controllers["right"].update_initial_joints(joints)
        self.sim.forward()

    def _sample_start(self) -> np.ndarray:
        """Places the cube and the goal; returns where the end-effector starts, (3,) [m]."""
        self.stage = 0
        if self.has_cube:
            xy = self.rng.uniform(-CUBE_RANGE, CUBE_RANGE, size=2)
            position = TABLE_TOP + np.array([xy[0], xy[1], CUBE_HALF_SIZE])
            self.sim.data.set_joint_qpos(self.cube.joints[0], np.append(position, [1.0, 0, 0, 0]))
            self.sim.forward()
        if len(self.skills) > 1 or self.skill.has_target:
            self.targets = self.rng.uniform(TARGET_LOW, TARGET_HIGH, self.targets.shape)
        start = self.skill.start(self)
        self._begin_stage()
        self.start_position, self._start_step = start, 0
        return start

    def _begin_stage(self) -> None:
        following = self.skills[self.stage + 1 : self.stage + 2]
        self.goal_start = self.skill.begin(self, following[0] if following else None)

    # -- skills --------------------------------------------------------------------------------

    @property
    def skill(self) -> Skill:
        """The skill at hand."""
        return self.skills[min(self.stage, len(self.skills) - 1)]

    @property
    def target(self) -> np.ndarray:
        """The random point of the workspace that belongs to the skill at hand, (3,) [m]."""
        return self.targets[min(self.stage, len(self.skills) - 1)].copy()

    @property
    def stage_time(self) -> float:
        """Time since the skill at hand began, at ``start_position`` of the end-effector [s]."""
        return (self.timestep - self._start_step) * self.control_timestep

    @property
    def carrying(self) -> bool:
        """Whether the cube has to be in the hand: an earlier skill left it there."""
        if self.skill.holds_cube_after is not None:
            return False
        earlier = (skill.holds_cube_after for skill in reversed(self.skills[: self.stage]))
        return next((holds for holds in earlier if holds is not None), False)

    def skill_success(self) -> bool:
        """Whether the skill at hand succeeds now; a cube that is carried must not be lost."""
        return self.skill.success(self) and (not self.carrying or self.grasped)

    def update_stage(self) -> None:
        """Begins the next skill of a composition if the one at hand succeeds; after each action."""
        if len(self.skills) > 1 and self.stage < len(self.skills) and self.skill_success():
            self.stage += 1
            if self.stage < len(self.skills):
                self._begin_stage()
                self.start_position, self._start_step = self.eef_position, self.timestep

    def _check_success(self) -> bool:
        if len(self.skills) > 1:
            return self.stage == len(self.skills)
        return self.skill_success()

    def _post_action(self, action: np.ndarray) -> tuple[float, bool, dict[str, Any]]:
        # Poses lag the joints by one substep; the observation must be a function of the state.
        mujoco.mj_fwdPosition(self.sim.model._model, self.sim.data._data)
        self.update_stage()
        return super()._post_action(action)

    def reward_terms(self) -> dict[str, float]:
        """The terms of the reward of the skill at hand by name."""
        return self.skill.reward_terms(self)

    def reward(self, action: np.ndarray | None = None) -> float:
        """Sum of :meth:`reward_terms`.

        Args:
            action: robosuite's argument; the reward does not depend on it.
        """
        return sum(self.reward_terms().values())

    # -- state ---------------------------------------------------------------------------------

    def episode_state(self) -> dict[str, np.ndarray]:
        """The episode's state besides the simulator's, as ``TabletopEnv.get_state`` lists it."""
        state = {"goal_start": self.goal_start}
        if any(skill.timed for skill in self.skills):
            state["start"] = np.append(self.start_position, self._start_step)
        if len(self.skills) > 1:
            state |= {"stage": np.array([self.stage]), "targets": self.targets.copy()}
        return state

    def set_episode_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Restores the state of an episode.

        Args:
            state: of :meth:`episode_state`.
        """
        self.goal_start = state["goal_start"]
        if any(skill.timed for skill in self.skills):
            self.start_position, self._start_step = (
                state["start"][:3].copy(),
                int(state["start"][3]),
            )
        if len(self.skills) > 1:
            self.stage = int(state["stage"][0])
            self.targets = state["targets"].copy()

    @property
    def gripper(self) -> Gripper:
        """The arm's gripper."""
        if self._gripper is None:
            self._gripper = Gripper(self)
        return self._gripper

    @property
    def goal_start(self) -> np.ndarray:
        """Position that the skill at hand is measured from, (3,) [m]: the goal marker's place.

        For example the point to reach, or the cube's centre before anything moved it.
        """
        return np.array(self.sim.model.site_pos[self._goal_site_id])

    @goal_start.setter
    def goal_start(self, position: np.ndarray) -> None:
        self.sim.model.site_pos[self._goal_site_id] = position

    @property
    def goal(self) -> np.ndarray:
        """Goal position of the skill at hand (3,) [m]."""
        return self.skill.goal(self)

    @property
    def eef_position(self) -> np.ndarray:
        """End-effector position (3,) [m]."""
        return np.array(self.sim.data.site_xpos[self._eef_site_id])

    @property
    def eef_rotation(self) -> np.ndarray:
        """End-effector rotation matrix (3, 3)."""
        return np.array(self.sim.data.site_xmat[self._eef_site_id]).reshape(3, 3)

    @property
    def cube_position(self) -> np.ndarray:
        """The cube's centre (3,) [m]."""
        return np.array(self.sim.data.body_xpos[self._cube_body_id])

    @property
    def cube_on_table(self) -> np.ndarray:
        """The cube's centre (3,) [m] if it lay on the table below its present place."""
        position = self.cube_position
        position[2] = TABLE_TOP[2] + CUBE_HALF_SIZE
        return position

    @property
    def above_cube(self) -> np.ndarray:
        """The point ``HOVER_HEIGHT`` above :attr:`cube_on_table` (3,) [m]."""
        return self.cube_on_table + np.array([0.0, 0.0, HOVER_HEIGHT])

    @property
    def cube_velocity(self) -> np.ndarray:
        """The cube's linear velocity (3,) [m/s]."""
        return np.array(self.sim.data.qvel[self._cube_dof : self._cube_dof + 3])

    @property
    def cube_displacement(self) -> np.ndarray:
        """The cube's position relative to its start (3,) [m]."""
        return self.cube_position - self.goal_start

    @property
    def grasped(self) -> bool:
        """Whether both fingers touch the cube."""
        return self.gripper.touches(self._cube_geom_id)

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
