"""Stock robosuite environments that step several times faster and return the same numbers."""

from __future__ import annotations

import warnings
from typing import Any, TypeVar

import numpy as np

from torchrl_bmrl.envs.obstacles import why_not_fast
from torchrl_bmrl.envs.shortcuts import take_shortcuts
from torchrl_bmrl.envs.stepper import FastStepper
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import mujoco
    import robosuite.utils.transform_utils as T
    from robosuite.environments.base import MujocoEnv
    from robosuite.utils.observables import Observable
    from robosuite.wrappers import Wrapper

Env = TypeVar("Env", bound="MujocoEnv | Wrapper")
Clock = tuple[float, bool, float, float]  # time since a sample, sampled, period, delay [s]

_AVERAGE = np.ones(10) / 10.0  # robosuite's filter of accelerations


def accelerate_robosuite(env: Env) -> Env:
    """Makes a robosuite environment step fast; everything that ``step`` returns stays the same.

    Observations, rewards, ends of episodes and MuJoCo's state are the same bits as robosuite's own,
    through hard and soft resets. Any task works with one fixed-base arm of any make, any gripper
    and operational-space control without interpolation, robosuite's default.

    If a later change of the environment makes fast steps impossible, robosuite's own step is used
    and a ``RuntimeWarning`` gives the reason. ``del env.step`` restores robosuite's step for good.

    Args:
        env: robosuite environment, changed in place. Wrappers may be around it or come later.

    Returns:
        The same ``env``.

    Raises:
        BMRLError: if :func:`~torchrl_bmrl.envs.obstacles.why_not_fast` gives a reason.

    Example:
        >>> import robosuite
        >>> env = accelerate_robosuite(
        ...     robosuite.make("Stack", "UR5e", use_camera_obs=False, has_offscreen_renderer=False)
        ... )
        >>> _ = env.reset()
        >>> observation, reward, done, info = env.step(np.zeros(env.action_dim))
        >>> observation["robot0_joint_pos"].shape
        (6,)
    """
    stock: Any = env
    while isinstance(stock, Wrapper):
        stock = stock.env
    if not isinstance(vars(stock).get("step"), (_FastStep, type(None))):
        raise BMRLError(
            f"{type(stock).__name__}.step was replaced by {stock.step}; delete it first"
        )
    if (obstacle := why_not_fast(stock)) is not None:
        raise BMRLError(f"{type(stock).__name__} cannot step fast: {obstacle}")
    take_shortcuts(stock)
    stock.step = _FastStep(stock)
    return env


class _FastStep:
    """Takes the place of an environment's ``step``."""

    def __init__(self, env: MujocoEnv) -> None:
        self.env = env
        self.stepper: FastStepper | None = None
        self.memory: _Memory
        self.warned: set[str] = set()

    def __call__(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, dict[str, Any]]:
        env = self.env
        stepper = self.stepper
        if stepper is None or not stepper.serves(env):
            self.stepper = None  # frees the last episode's model
            if (obstacle := why_not_fast(env)) is not None:
                if obstacle.reason not in self.warned:
                    self.warned.add(obstacle.reason)
                    message = f"slow steps with robosuite's own code: {obstacle}"
                    warnings.warn(message, RuntimeWarning, stacklevel=2)
                return type(env).step(env, action)
            self.stepper = stepper = FastStepper(env)
            self.memory = _Memory(stepper)
        if env.done:
            raise ValueError("executing action in terminated episode")
        env.timestep += 1
        assert len(action) == env.action_dim, (
            f"environment got invalid action dimension -- expected {env.action_dim}, "
            f"got {len(action)}"
        )
        stepper.begin(action)
        self.memory.push(action)
        left = int(env.control_timestep / env.model_timestep)
        while left:
            substeps, due = _next_samples(env, left)
            stepper.advance(substeps)
            for observable in due:
                observable.update(env.model_timestep, env._obs_cache)
            left -= substeps
        env.cur_time += env.control_timestep
        reward, done, info = env._post_action(action)
        return env._get_observations(), reward, done, info


def _next_samples(env: MujocoEnv, limit: int) -> tuple[int, list[Observable]]:
    """Winds the clocks of observables on to the next substep in which one of them is sampled.

    robosuite updates each observable in each substep. Except for one update in a sampling period,
    this only counts time, and that is done here for all substeps at once.

    Returns:
        The number of substeps until then, at most ``limit``, and the observables whose update in
        the last of them is still to be made.
    """
    timestep = env.model_timestep
    quiet: dict[Clock, int] = {}  # updates before the one that samples; few clocks differ
    counted, clocks, first = [], [], limit
    for observable in env._observables.values():
        clock = None
        if type(observable) is not Observable:
            first = 0  # its update may do anything: it is called in every substep
        elif not observable._enabled:
            continue
        else:
            clock = _clock(observable)
            if clock not in quiet:
                quiet[clock] = _wind(clock, timestep, limit)[0]
                first = min(first, quiet[clock])
        counted.append(observable)
        clocks.append(clock)
    substeps = min(first + 1, limit)
    wound: dict[Clock, tuple[int, float, bool]] = {}
    due = []
    for observable, clock in zip(counted, clocks, strict=True):
        if clock is not None:
            if clock not in wound:
                wound[clock] = _wind(clock, timestep, substeps)
            updates, observable._time_since_last_sample, observable._sampled = wound[clock]
            if updates == substeps:
                continue
        due.append(observable)
    return substeps, due


def _clock(observable: Observable) -> Clock:
    return (
        observable._time_since_last_sample,
        observable._sampled,
        observable._sampling_timestep,
        observable._current_delay,
    )


def _wind(clock: Clock, timestep: float, limit: int) -> tuple[int, float, bool]:
    """How many updates take no sample, at most ``limit``, and time and flag after them.

    The arithmetic is that of ``Observable.update``, whose rounding decides when a sample is due.
    """
    time, sampled, period, delay = clock
    for updates in range(limit):
        later = time + timestep
        if not sampled and (period - delay >= later or later >= period):
            return updates, time, sampled
        if later >= period:
            later, sampled = later % period, False
        time = later
    return limit, time, sampled


class _Memory:
    """What the robot remembers of the last actions, forces and poses (``robot.recent_...``)."""

    def __init__(self, stepper: FastStepper) -> None:
        self.stepper, robot = stepper, stepper.robot
        (self.name,) = robot.arms
        model = stepper.model
        sensors = robot.gripper[self.name].important_sensors
        indices: list[int] = []
        for kind in ("force_ee", "torque_ee"):
            # robosuite's own address of a sensor
            sensor = model.sensor(sensors[kind]).id
            start = int(np.sum(model.sensor_dim[:sensor]))
            indices += range(start, start + int(model.sensor_dim[sensor]))
        self.sensors = np.array(indices)
        self.joints = np.array(robot._ref_joint_pos_indexes)
        self.accelerations = np.empty((6, 10))
        self.jacobians = np.zeros((2, 3, model.nv))
        self.site = model.site(stepper.arm.ref_name).id

    def push(self, action: np.ndarray) -> None:
        """As ``FixedBaseRobot.control`` does after the first substep's controls are set."""
        robot, name, arm, data = self.stepper.robot, self.name, self.stepper.arm, self.stepper.data
        robot.recent_qpos.push(data.qpos[self.joints])
        robot.recent_actions.push(action)
        robot.recent_torques.push(robot.torques)
        robot.recent_ee_forcetorques[name].push(data.sensordata[self.sensors])
        pose = np.concatenate((arm.ref_pos, T.mat2quat(arm.ref_ori_mat)))
        robot.recent_ee_pose[name].push(pose)
        if not self.stepper.seen:
            mujoco.mj_jacSite(self.stepper.model, data, *self.jacobians, self.site)
            np.dot(self.jacobians[0], data.qvel, out=arm.ref_pos_vel)
            np.dot(self.jacobians[1], data.qvel, out=arm.ref_ori_vel)
        velocity = np.concatenate((arm.ref_pos_vel, arm.ref_ori_vel))
        robot.recent_ee_vel[name].push(velocity)
        velocities = robot.recent_ee_vel_buffer[name]
        velocities.push(velocity)
        accelerations, buffer = self.accelerations, velocities.buf
        accelerations[:, 0] = robot.recent_ee_acc[name].current
        accelerations[:, 1:] = (robot.control_freq * (buffer[1:] - buffer[:-1])).T
        # As np.convolve sums them; the order in a scalar product depends on the processor.
        average = np.array([np.correlate(axis, _AVERAGE)[0] for axis in accelerations])
        robot.recent_ee_acc[name].push(average)
