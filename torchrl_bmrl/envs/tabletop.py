"""The tabletop scene as a gymnasium environment whose state can be saved and restored exactly."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchrl_bmrl.envs.rendering import graphics_library, make_renderer
from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.envs.skills import REWARD_TERMS, SkillLike
from torchrl_bmrl.envs.stepper import FastStepper
from torchrl_bmrl.envs.table import CONTROL_FREQUENCY
from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import gymnasium
    import mujoco

STEPPERS = ("fast", "robosuite")
"""Implementations of a simulation step; both give the same trajectories to the bit."""

_PHYSICS = mujoco.mjtState.mjSTATE_INTEGRATION
_warned: set[str] = set()


class TabletopEnv(gymnasium.Env):
    """One skill, or a composition of several, with one arm at a table.

    The observation is a dict of named parts under robosuite's names, float64, for an arm with n
    joints and a gripper with k: ``robot0_joint_pos`` (n,) [rad], ``robot0_gripper_qpos`` (k,) [m]
    or [rad], ``robot0_joint_vel`` (n,) [rad/s], ``robot0_eef_pos`` (3,) [m], ``robot0_eef_quat``
    (4,) xyzw, ``goal_pos`` (3,) [m]. Sawyer has n = 7 and k = 2.

    The action is (7,) in [-1, 1]: position delta (x0.05 m), rotation delta (x0.5 rad), gripper (+1
    closes, -1 opens).

    ``info`` contains ``success``, each reward term as ``reward_<term>`` (0 for terms of other
    skills) and ``stage``, the number of the composition's skills that are done (0 for one skill).

    In a composition, goal and reward are those of the current skill. ``success`` is true from the
    step at which the last skill succeeds.

    An episode never terminates. The registered ids are truncated after 200 steps, compositions
    after 100 for each skill.

    Args:
        skills: a :class:`~torchrl_bmrl.envs.skills.Skill`, a sequence of them, or names of
            :data:`~torchrl_bmrl.envs.skills.SKILLS` joined by ``-``, such as ``"reach-lift"``.
        render_mode: ``None`` or ``"rgb_array"``, which needs no display
            (:func:`torchrl_bmrl.envs.rendering.graphics_library`).
        camera: robosuite camera for :meth:`render`.
        image_size: height and width of the rendered picture [pixels].
        robot: the arm, one of :data:`torchrl_bmrl.envs.arms.ARMS`.
        gripper: robosuite's name of a gripper; ``"default"`` is robosuite's default for the arm.
        stepper: ``"fast"``, compiled code with robosuite's trajectories to the bit, or
            ``"robosuite"``. For a controller that the compiled code does not support, robosuite is
            used after a warning.
        controller_configs: robosuite's composite controller; by default the arm's
            operational-space control of the pose.
        horizon: steps after which an episode is truncated; ``None`` for no limit. (gymnasium's
            ``max_episode_steps`` would restart its count when a state is restored.)

    Raises:
        UnknownNameError: for an unknown skill, arm, render mode or stepper.
        RenderError: for ``render_mode="rgb_array"`` if no graphics library works.

    Example:
        >>> env = TabletopEnv("lift")
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
        skills: SkillLike | Sequence[SkillLike],
        render_mode: str | None = None,
        camera: str = "frontview",
        image_size: tuple[int, int] = (256, 256),
        *,
        robot: str = "Sawyer",
        gripper: str = "default",
        stepper: str = "fast",
        controller_configs: dict[str, Any] | None = None,
        horizon: int | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise UnknownNameError("render_mode", render_mode, ("rgb_array",))
        if stepper not in STEPPERS:
            raise UnknownNameError("stepper", stepper, STEPPERS)
        if render_mode is not None:
            graphics_library()  # raises its error now and not at the first picture
        self.render_mode = render_mode
        self.camera = camera
        self.image_size = image_size
        self.stepper = stepper
        self.horizon = horizon
        self._fast: FastStepper | None = None
        self._picture: tuple[mujoco.MjModel, mujoco.MjData, mujoco.Renderer] | None = None
        options: dict[str, Any] = (
            {} if controller_configs is None else {"controller_configs": controller_configs}
        )
        self.robosuite_env = TabletopScene(
            skills,
            robots=robot,
            gripper_types=gripper,
            use_object_obs=False,
            lean=stepper == "fast",
            **options,
        )
        own = (term for skill in self.robosuite_env.skills for term in skill.terms)
        self.reward_terms = tuple(dict.fromkeys((*REWARD_TERMS, *own)))
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

    @property
    def task(self) -> str:
        """Names of the skills, joined by ``-``."""
        return "-".join(skill.name for skill in self.robosuite_env.skills)

    def _info(self, terms: dict[str, float]) -> dict[str, Any]:
        # TorchRL's info reader needs values with a dtype.
        return {
            "success": np.bool_(self.robosuite_env._check_success()),
            "stage": np.int64(self.robosuite_env.stage),
            **{f"reward_{name}": np.float64(terms.get(name, 0.0)) for name in self.reward_terms},
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts an episode; the same ``seed`` gives the same episode.

        Args:
            seed: seed of this reset and of later ones without a seed.
            options: ``{"state": state}`` continues from a state of :meth:`get_state` instead.

        Raises:
            BMRLError: see :meth:`set_state`.
        """
        super().reset(seed=seed)
        if options and "state" in options:
            self.set_state(options["state"])  # includes the generator's state: seed has no effect
        else:
            if seed is not None:
                # In place, since robosuite's samplers refer to this generator.
                state = np.random.default_rng(seed).bit_generator.state
                self.robosuite_env.rng.bit_generator.state = state
            self.robosuite_env.reset()
        return self.robosuite_env.named_observation(), self._info({})

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Acts for one control period (50 ms).

        Args:
            action: (7,) in [-1, 1].

        Raises:
            BMRLError: if the action has another shape or is not finite; no step is made then.
        """
        action = np.asarray(action, dtype=np.float64)
        shape = self.action_space.shape
        if action.shape != shape or not np.isfinite(action).all():
            raise BMRLError(f"action is {action}; valid: finite, of shape {shape}")
        self._advance(action)
        terms = self.robosuite_env.reward_terms()
        observation = self.robosuite_env.named_observation()
        truncated = self.horizon is not None and self.robosuite_env.timestep >= self.horizon
        return observation, sum(terms.values()), False, truncated, self._info(terms)

    def _advance(self, action: np.ndarray) -> None:
        env = self.robosuite_env
        if self.stepper == "fast" and (self._fast is None or not self._fast.serves(env)):
            self._fast = None
            try:
                self._fast = FastStepper(env)
            except BMRLError as error:
                if str(error) not in _warned:
                    _warned.add(str(error))
                    warnings.warn(f"slow steps with robosuite's own code: {error}", stacklevel=3)
        if self._fast is None:
            env.step(action)
            return
        self._fast.step(action)
        env.timestep += 1
        env.cur_time += env.control_timestep
        env.update_stage()

    # -- state ---------------------------------------------------------------------------------

    def get_state(self) -> dict[str, np.ndarray]:
        """Returns the complete state of the episode and of the random generator, as arrays.

        ``physics``: MuJoCo's integration state (positions, velocities, warm start, controls, time);
        ``gripper`` and ``rest_joints``: internal state of robosuite's gripper and arm controllers;
        ``goal_start`` (3,); in compositions ``stage`` (1,) and ``targets`` (stages, 3); with timed
        skills ``start`` (4,), position and step at which the skill began; number of ``steps``;
        ``rng``, which decides later resets. ``np.savez`` can save it.

        It is exact for controllers that do not interpolate goals, such as the arms' default ones.
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
            **env.episode_state(),
            "steps": np.array([env.timestep]),
            "rng": _rng_to_array(env.rng),
        }

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Restores a state of :meth:`get_state`, also one of another environment.

        The episode continues exactly, with the skill of this environment. States of lift and of the
        four pushes fit each other's environments.

        Args:
            state: arrays by name.

        Raises:
            BMRLError: if an array is missing, unknown, of another shape or not finite; the
                environment does not change then.
        """
        now = self.get_state()
        if state.keys() != now.keys():
            raise BMRLError(f"the state has {sorted(state)}; valid: {sorted(now)}")
        arrays = {name: np.asarray(state[name]) for name in now}
        for name, array in arrays.items():
            valid = now[name]
            if array.shape != valid.shape or array.dtype != valid.dtype:
                raise BMRLError(
                    f"{name} of the state is {array.dtype} {array.shape}; "
                    f"valid here ({self.task}): {valid.dtype} {valid.shape}"
                )
            if not np.isfinite(array).all():
                raise BMRLError(f"{name} of the state is {array}; valid: finite")
        self._load_state(arrays)
        env = self.robosuite_env
        mujoco.mj_fwdPosition(env.sim.model._model, env.sim.data._data)
        env.rng.bit_generator.state = _rng_from_array(arrays["rng"])

    def _load_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Restores a state except for the derived poses and the random generator."""
        env, robot = self.robosuite_env, self.robosuite_env.robots[0]
        mujoco.mj_setState(env.sim.model._model, env.sim.data._data, state["physics"], _PHYSICS)
        robot.gripper["right"].current_action = state["gripper"].copy()
        arm = robot.composite_controller.part_controllers["right"]
        arm.initial_joint = state["rest_joints"].copy()
        # Otherwise robosuite's controller would use the last pose that it read.
        arm.new_update = True
        env.set_episode_state(state)
        env.timestep = int(state["steps"][0])
        env.cur_time = env.timestep * env.control_timestep

    # -- pictures ------------------------------------------------------------------------------

    def render(self) -> np.ndarray | None:
        """Picture of the scene, (height, width, 3) uint8, in mode ``"rgb_array"``.

        Raises:
            RenderError: if the graphics library does not work in this process.
        """
        return None if self.render_mode is None else self._draw()

    def _draw(self) -> np.ndarray:
        env = self.robosuite_env
        if self._picture is None:
            # The simulated model may lack visual geometry.
            model = mujoco.MjModel.from_xml_string(env.scene_xml())
            self._picture = model, mujoco.MjData(model), make_renderer(model, *self.image_size)
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
    words = [word for name in ("state", "inc") for word in divmod(state["state"][name], 1 << 64)]
    return np.array([*words, state["has_uint32"], state["uinteger"]], dtype=np.uint64)


def _rng_from_array(array: np.ndarray) -> dict[str, Any]:
    """Inverse of :func:`_rng_to_array`."""
    words = [int(word) for word in array]
    return {
        "bit_generator": "PCG64",
        "state": {"state": words[0] << 64 | words[1], "inc": words[2] << 64 | words[3]},
        "has_uint32": words[4],
        "uinteger": words[5],
    }
