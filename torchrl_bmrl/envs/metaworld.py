"""Meta-World's environments with a fixed goal that the observation does not show."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, GymWrapper, SerialEnv
from torchrl.envs.gym_like import default_info_dict_reader

from torchrl_bmrl.errors import ConfigError, UnknownNameError
from torchrl_bmrl.extras import needs

with needs("metaworld"):
    import gymnasium
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS
    from metaworld.types import Task as MetaWorldTask

HORIZON = 500
"""Steps after which Meta-World truncates an episode; it refuses a further step."""


class MetaWorldEnv(gymnasium.Env):
    """One task of ML1: an environment of Meta-World whose object starts and goal lie fixed.

    The observation is (39,) float32: hand position (3) [m], opening of the gripper (1), positions
    [m] and quaternions of two objects (14), the same 18 numbers one step before, and three zeros
    where Meta-World's multi-task environments show the goal.

    The action is (4,) in [-1, 1]: displacement of the hand's target (3) (x0.01 m) and gripper (+1
    closes, -1 opens). ``info`` contains ``success``.

    Args:
        env: one of Meta-World's 50 names, such as ``"push-v3"``.
        rand_vec: the numbers that Meta-World draws for a task: positions of object and goal [m],
            or of the one object [m].
        horizon: steps after which an episode is truncated, 500 at most.

    Raises:
        UnknownNameError: for a name that is not Meta-World's.
        ConfigError: for a horizon outside 1 to 500, or a ``rand_vec`` of another length or outside
            the task's bounds, or whose object and goal are too close to each other.

    Example:
        >>> env = MetaWorldEnv("drawer-close-v3", (0.05, 0.9, 0.0))
        >>> observation, info = env.reset()
        >>> observation.shape, info
        ((39,), {'success': array(False)})
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (39,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def __init__(self, env: str, rand_vec: Sequence[float], horizon: int = HORIZON) -> None:
        if not isinstance(horizon, int) or not 1 <= horizon <= HORIZON:
            raise ConfigError(f"horizon is {horizon}; valid: a whole number from 1 to {HORIZON}")
        self.horizon = horizon
        self.metaworld_env = make_metaworld_env(env)
        space, values = self.metaworld_env._random_reset_space, np.asarray(rand_vec, dtype=float)
        if values.shape != space.shape or not space.contains(values):
            raise ConfigError(
                f"rand_vec of {env} is {tuple(rand_vec)}; valid: numbers between "
                f"{tuple(space.low.tolist())} and {tuple(space.high.tolist())}"
            )
        data = {"env_cls": type(self.metaworld_env), "rand_vec": values}
        data["partially_observable"] = True  # the goal reads as zero
        # Meta-World's own interface takes pickled bytes: these are made here and read at once.
        self.metaworld_env.set_task(MetaWorldTask(env_name=env, data=pickle.dumps(data)))
        _check_accepted(self.metaworld_env, values)
        self._observation = np.zeros(39)
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Starts an episode; all episodes of a task start in the same state, whatever the seed.

        Args:
            seed: accepted and without effect.
            options: accepted and without effect.
        """
        super().reset(seed=seed)
        self._observation, _ = self.metaworld_env.reset()
        self._steps = 0
        return self._observation.astype(np.float32), {"success": np.array(False)}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Advances by 12.5 ms; episodes are truncated, never terminated.

        Args:
            action: (4,) in [-1, 1].
        """
        self._observation, reward, _, _, info = self.metaworld_env.step(action)
        self._steps += 1
        success = {"success": np.array(bool(info["success"]))}
        truncated = self._steps >= self.horizon
        return self._observation.astype(np.float32), float(reward), False, truncated, success

    def observation_with_goal(self) -> np.ndarray:
        """The last observation with the goal [m] in place of the zeros, (39,) float64.

        Meta-World's scripted policies need it.
        """
        return np.concatenate([self._observation[:-3], self.metaworld_env._get_pos_goal()])

    def close(self) -> None:
        """Frees the simulator."""
        self.metaworld_env.close()


def make_metaworld_env(env: str) -> Any:
    """Returns one of Meta-World's own environments, without a task.

    Args:
        env: one of Meta-World's 50 names.

    Raises:
        UnknownNameError: for another name.

    Example:
        >>> make_metaworld_env("reach-v3").action_space.shape
        (4,)
    """
    if env not in ALL_V3_ENVIRONMENTS:
        raise UnknownNameError("environment of Meta-World", env, ALL_V3_ENVIRONMENTS)
    return ALL_V3_ENVIRONMENTS[env]()


def _check_accepted(made: Any, rand_vec: np.ndarray) -> None:
    """Refuses a task in which Meta-World would draw again: it would never end a reset."""
    draws = iter([rand_vec])

    def draw() -> np.ndarray:
        for each in draws:
            return each.copy()
        raise ConfigError(
            f"rand_vec is {tuple(rand_vec.tolist())}; valid: object and goal farther apart"
        )

    made._get_state_rand_vec = draw
    made.reset_model()
    del made._get_state_rand_vec


def make_ml1_env(*, num_envs: int | None = None, **options: Any) -> EnvBase:
    """A task of ML1 as a TorchRL environment with ``observation (39,)`` and ``success``.

    Args:
        num_envs: number of environments side by side; ``None`` for one without a batch dimension.
        **options: ``env``, ``rand_vec`` and ``horizon`` of :class:`MetaWorldEnv`.

    Returns:
        an environment with batch ``[]`` or ``[num_envs]``.

    Raises:
        UnknownNameError: as :class:`MetaWorldEnv`.
        ConfigError: as :class:`MetaWorldEnv`.

    Example:
        >>> env = make_ml1_env(num_envs=2, env="drawer-close-v3", rand_vec=(0.05, 0.9, 0.0))
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 39])
    """
    make = partial(_make_one, options)
    return make() if num_envs is None else SerialEnv(num_envs, make)


def _make_one(options: dict[str, Any]) -> EnvBase:
    env = GymWrapper(MetaWorldEnv(**options))
    spec = Composite(success=Unbounded((), dtype=torch.bool))
    return env.set_info_dict_reader(default_info_dict_reader(["success"], spec=spec))
