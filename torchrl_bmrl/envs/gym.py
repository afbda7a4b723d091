"""Any gymnasium environment with continuous actions as a task's environment."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, GymEnv, SerialEnv, TransformedEnv
from torchrl.envs.gym_like import BaseInfoDictReader
from torchrl.envs.transforms import ActionScaling, DoubleToFloat

from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.extras import needs

log = logging.getLogger(__name__)


def make_gym_env(
    *,
    num_envs: int | None = None,
    env: str,
    env_options: Mapping[str, Any] | None = None,
    success: str | None = None,
) -> EnvBase:
    """A registered gymnasium environment, or several side by side; actions lie in [-1, 1].

    Args:
        num_envs: number of environments; ``None`` for one without a batch dimension.
        env: gymnasium's id, such as ``"HalfCheetah-v5"`` or ``"module:MyEnv-v0"``.
        env_options: keyword arguments of ``gymnasium.make``.
        success: key of ``info`` that becomes ``success (*B,)``; ``None``: there is none. A key
            that ``info`` did not contain in the first episode is logged as a warning.

    Returns:
        an environment with batch ``[]`` or ``[num_envs]``.

    Raises:
        ConfigError: if gymnasium cannot make it, or its actions are not bounded numbers.

    Example:
        >>> env = make_gym_env(env="Pendulum-v1", num_envs=2)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 3])
    """
    with needs("robosuite"):
        import gymnasium

    make = partial(_make_one, env, dict(env_options or {}), success)
    try:
        made = make() if num_envs is None else SerialEnv(num_envs, make)
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise ConfigError(f"env is {env}: gymnasium cannot make it ({error})") from error
    spec = made.action_spec
    if not isinstance(spec, Bounded) or not (spec.space.high - spec.space.low).isfinite().all():
        raise ConfigError(
            f"env is {env}, whose actions are {type(spec).__name__} of shape {tuple(spec.shape)}; "
            "valid: numbers between bounds"
        )
    return TransformedEnv(made, ActionScaling(), auto_unwrap=True)


def action_bounds(
    env: str, env_options: Mapping[str, Any] | None = None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lowest and highest action of a gymnasium environment.

    Args:
        env: as in :func:`make_gym_env`.
        env_options: as in :func:`make_gym_env`.

    Raises:
        ConfigError: as in :func:`make_gym_env`.

    Example:
        >>> action_bounds("Pendulum-v1")
        ((-2.0,), (2.0,))
    """
    made = make_gym_env(env=env, env_options=env_options)
    space = made.base_env.action_spec.space
    made.close()
    return tuple(space.low.tolist()), tuple(space.high.tolist())


def max_episode_steps(env: str, env_options: Mapping[str, Any] | None = None) -> int | None:
    """Steps after which gymnasium truncates an episode; ``None``: it does not.

    Args:
        env: as in :func:`make_gym_env`.
        env_options: as in :func:`make_gym_env`.

    Example:
        >>> max_episode_steps("Pendulum-v1"), max_episode_steps("Pendulum-v1", {"g": 9.8})
        (200, 200)
    """
    with needs("robosuite"):
        import gymnasium

    module, _, name = env.rpartition(":")
    if module:
        import_module(module)  # registers the id
    return (env_options or {}).get("max_episode_steps") or gymnasium.spec(name).max_episode_steps


def _make_one(env: str, env_options: dict[str, Any], success: str | None) -> EnvBase:
    one = GymEnv(env, **env_options)
    if success is not None:
        one.set_info_dict_reader(_SuccessReader(success))
    leaves = one.observation_spec.items(True, True)
    double = [key for key, spec in leaves if spec.dtype == torch.float64]
    # Not around several environments: TorchRL writes what they emit into what the transforms made
    # of the step before, once one of them has ended.
    return TransformedEnv(one, DoubleToFloat(in_keys=double)) if double else one


class _SuccessReader(BaseInfoDictReader):
    """Writes a value of ``info`` as ``success ()``; TorchRL's own reader refuses Python's bools."""

    def __init__(self, key: str) -> None:
        self.key = key
        self.seen: set[str] = set()

    def __call__(self, info: Mapping[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        # Some environments give the value at the last step alone.
        self.seen.update(info)
        if self.key not in self.seen and bool(tensordict.get("done", False)):
            # Perhaps a wrong key. But some environments give it only when the task succeeds.
            keys = ", ".join(sorted(self.seen)) or "none"
            log.warning(
                "success is %r, which info did not contain in an episode; keys of info: %s",
                self.key,
                keys,
            )
            self.seen.add(self.key)  # one warning is enough
        return tensordict.set("success", torch.tensor(bool(info.get(self.key, False))))

    def reset(self) -> None:
        """The key is the same for every episode."""

    @property
    def info_spec(self) -> Composite:
        return Composite({"success": Unbounded((), dtype=torch.bool)})
