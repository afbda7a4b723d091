"""Many episodes of one task side by side in one simulator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchrl_bmrl.envs.skills import SkillLike
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space


class TabletopVectorEnv(VectorEnv):
    """``num_envs`` episodes of the same skills; each costs the memory of its state, 3 kB.

    One :class:`~torchrl_bmrl.envs.tabletop.TabletopEnv` plays them in turn and restores the state
    of each, so that a policy acts in all of them with one call. Each episode equals that of a
    separate ``TabletopEnv`` to the bit.

    Episodes are not reset automatically (``AutoresetMode.DISABLED``, as TorchRL's ``GymWrapper``
    expects).

    Args:
        skills: as for ``TabletopEnv``.
        num_envs: number of episodes.
        **kwargs: other arguments of ``TabletopEnv``.

    Raises:
        BMRLError: for ``num_envs`` below one, and the errors of ``TabletopEnv``.

    Example:
        >>> env = TabletopVectorEnv("push_up", num_envs=3)
        >>> observation, info = env.reset(seed=[4, 5, 6])
        >>> observation["goal_pos"].shape
        (3, 3)
        >>> *_, reward, terminated, truncated, info = env.step(np.zeros((3, 7)))
        >>> reward.shape, info["success"]
        ((3,), array([False, False, False]))
    """

    def __init__(
        self, skills: SkillLike | Sequence[SkillLike], num_envs: int = 1, **kwargs: Any
    ) -> None:
        if num_envs < 1:
            raise BMRLError(f"num_envs is {num_envs}; valid: at least 1")
        self._env = TabletopEnv(skills, **kwargs)
        self.metadata = {**TabletopEnv.metadata, "autoreset_mode": AutoresetMode.DISABLED}
        self.autoreset_mode = AutoresetMode.DISABLED
        self.num_envs = num_envs
        self.render_mode = self._env.render_mode
        self.reward_terms = self._env.reward_terms
        self.single_observation_space = self._env.observation_space
        self.single_action_space = self._env.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._states: list[dict[str, np.ndarray] | None] = [None] * num_envs
        self._shown: list[Any] = [None] * num_envs  # each episode's last observation and info

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Starts episodes.

        Args:
            seed: a seed for each episode, or one number s for the seeds s, s + 1, ...
            options: ``{"reset_mask": mask}`` starts only the episodes of a mask ``(num_envs,)``;
                ``{"states": states}`` continues from states of :meth:`get_states`.

        Raises:
            BMRLError: if the number of seeds or states is not ``num_envs``, or a state is not
                valid; no episode changes then.
        """
        options = options or {}
        if seed is None or isinstance(seed, int | np.integer):
            seed = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        states = options.get("states", [None] * self.num_envs)
        mask = np.asarray(options.get("reset_mask", np.ones(self.num_envs, dtype=bool)))
        for name, rows in (("seeds", seed), ("states", states), ("entries of reset_mask", mask)):
            if len(rows) != self.num_envs:
                raise BMRLError(
                    f"{len(rows)} {name} for {self.num_envs} environments; valid: one for each"
                )
        if any(now is None for now, starts in zip(self._states, mask, strict=True) if not starts):
            raise BMRLError("reset_mask leaves out episodes that have not started")
        shown, started = list(self._shown), list(self._states)
        for i in np.flatnonzero(mask):
            wanted = None if states[i] is None else {"state": states[i]}
            shown[i] = self._env.reset(seed=seed[i], options=wanted)
            started[i] = self._env.get_state()
        self._shown, self._states = shown, started  # last, since set_state may raise an error
        observations, infos = zip(*self._shown, strict=True)
        return _stack(observations), _stack(infos)

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period in every episode.

        Args:
            actions: ``(num_envs, 7)``.

        Raises:
            BMRLError: if the shape differs or an action is not finite; no step is made then.
        """
        actions = np.asarray(actions, dtype=np.float64)
        if actions.shape != self.action_space.shape or not np.isfinite(actions).all():
            raise BMRLError(f"actions are {actions}; valid: finite, {self.action_space.shape}")
        rows = []
        for i, action in enumerate(actions):
            self._env._load_state(self._state(i))
            rows.append(self._env.step(action))
            self._states[i] = self._env.get_state()
        observations, rewards, terminated, truncated, infos = zip(*rows, strict=True)
        self._shown = list(zip(observations, infos, strict=True))
        return (
            _stack(observations),
            np.array(rewards),
            np.array(terminated),
            np.array(truncated),
            _stack(infos),
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Renders each episode like ``TabletopEnv.render``; ``None`` without ``render_mode``.

        Raises:
            BMRLError: before the first reset.
        """
        if self.render_mode is None:
            return None
        pictures = []
        for i in range(self.num_envs):
            self._env._load_state(self._state(i))
            pictures.append(self._env._draw())
        return tuple(pictures)

    def get_states(self) -> list[dict[str, np.ndarray]]:
        """Returns the state of each episode, as from ``TabletopEnv.get_state``.

        Raises:
            BMRLError: before the first reset.
        """
        states = [self._state(i) for i in range(self.num_envs)]
        return [{name: part.copy() for name, part in state.items()} for state in states]

    def _state(self, i: int) -> dict[str, np.ndarray]:
        if (state := self._states[i]) is None:
            raise BMRLError("an episode has not started; valid: call reset first")
        return state

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the simulator."""
        self._env.close()


def _stack(rows: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}
