"""Episodes as files store them, and their completion as the options say."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode, LeftOut, as_success
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.errors import DataError


@dataclass(frozen=True, kw_only=True)
class RawEpisode:
    """One episode of T steps as a file stores it; missing arrays are ``None``.

    Attributes:
        observations: named parts before each action ``(T, ...)`` or, with the one after the last,
            ``(T + 1, ...)``; all of the same length.
        next_observations: the same parts after each action, ``(T, ...)``.
        actions: ``(T, action_dim)``.
        rewards: ``(T,)``.
        terminated: ``(T,)`` bool; true if no value follows.
        dones: ``(T,)`` bool; true at the end of an episode, whatever the reason.
        extras: further arrays of T rows, such as ``successes``.
        attributes: numbers, strings and lists of strings.
        left_alone: names of arrays and groups that are not read.
    """

    observations: Mapping[str, np.ndarray]
    actions: np.ndarray
    next_observations: Mapping[str, np.ndarray] | None = None
    rewards: np.ndarray | None = None
    terminated: np.ndarray | None = None
    dones: np.ndarray | None = None
    extras: Mapping[str, np.ndarray] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)
    left_alone: tuple[str, ...] = ()

    @property
    def succeeded(self) -> bool | None:
        """Whether the task was solved at some step; ``None`` if the file does not state it."""
        successes = self.extras.get("successes")
        if successes is None:
            return as_success(self.attributes.get("success"))
        return bool(np.any(successes))


@dataclass(frozen=True, kw_only=True)
class Opened:
    """A data set that the reader of its format has opened.

    Attributes:
        episodes: by name; each is read on access, while the data set is open.
        metadata: what the data set states about itself.
        prefix: of the episodes' names inside the file, for messages.
        problems: faults outside the episodes: key and message of each.
        oddities: warnings about the data set as a whole.
    """

    episodes: Mapping[str, RawEpisode]
    metadata: dict[str, Any]
    prefix: str = ""
    problems: Sequence[tuple[str, str]] = ()
    oddities: Sequence[str] = ()


def complete(path: str | Path, name: str, raw: RawEpisode, options: ReadOptions) -> Episode:
    """Completes an episode of a file as the options say.

    Args:
        path: file, for messages.
        name: of the episode, for messages.
        raw: the episode, whose arrays agree in their lengths.
        options: see :class:`ReadOptions`.

    Returns:
        the episode; its ``left_out`` describes the parts of the file that it does not contain.

    Raises:
        DataError: naming file and key, if neither the file nor the options define rewards, if a
            requested part of the observation is missing, and if no step remains.
    """
    if options.observation_keys is not None:
        raw = _choose_parts(path, name, raw, options.observation_keys)
    steps = len(raw.actions)
    rewards = rewards_of(path, name, raw, options)
    terminated = np.zeros(steps, bool) if raw.terminated is None else np.asarray(raw.terminated)
    if raw.terminated is None and options.dones_terminate:
        if raw.dones is None:
            message = "missing; valid: dones (T,), or dones_terminate=False"
            raise DataError(path, f"{name}/dones", message)
        # Only the last: some files mark every step at which the task is solved.
        terminated[-1:] = raw.dones[-1:]
    before, after, kept = raw.observations, raw.next_observations, steps
    if after is None and before and all(len(part) == steps + 1 for part in before.values()):
        after = {key: part[1:] for key, part in before.items()}
        before = {key: part[:-1] for key, part in before.items()}
    elif after is None:
        if options.last_step == "terminate":
            terminated = np.append(terminated[:-1], True)
        if terminated[-1:].any() or options.last_step == "truncate":
            after = {key: np.append(x[1:], x[-1:], axis=0) for key, x in before.items()}
        else:
            after = {key: part[1:] for key, part in before.items()}
            before = {key: part[:-1] for key, part in before.items()}
            kept = max(0, steps - 1)
    if steps and not kept:
        message = "a single step, and no observation after it was recorded"
        raise DataError(path, name, f"{message}; valid: last_step 'truncate' or 'terminate'")
    whole = Episode(
        observations=before,
        next_observations=after,
        actions=raw.actions,
        rewards=rewards,
        terminated=terminated,
        extras=raw.extras,
        attributes=raw.attributes,
        left_out=LeftOut(arrays=raw.left_alone),
    )
    # Arrays of different lengths stay as they are, so that checking the episode reports them.
    return whole if kept == steps else _cut(path, name, whole, kept)


def _cut(path: str | Path, name: str, episode: Episode, kept: int) -> Episode:
    """Cuts the last step of an episode whose observations have been cut already."""
    lost = np.asarray(episode.rewards[kept:], dtype=np.float64)
    if not np.isfinite(lost).all():
        raise DataError(path, f"{name}/rewards", f"a value that is not finite in row {kept}")
    extras = {key: array[:kept] for key, array in episode.extras.items()}
    successes = episode.extras.get("successes", np.zeros(kept, bool))
    left_out = LeftOut(
        steps=len(episode) - kept,
        reward=float(lost.sum()),
        success=bool(np.any(successes)) and not np.any(successes[:kept]),
        arrays=episode.left_out.arrays,
    )
    return replace(
        episode,
        actions=episode.actions[:kept],
        rewards=episode.rewards[:kept],
        terminated=episode.terminated[:kept],
        extras=extras,
        left_out=left_out,
    )


def _choose_parts(path: str | Path, name: str, raw: RawEpisode, keys: Iterable[str]) -> RawEpisode:
    for key in keys:
        if key not in raw.observations:
            valid = ", ".join(raw.observations)
            raise DataError(path, f"{name}/{key}", f"not a part of the observation; valid: {valid}")
    after = raw.next_observations
    return replace(
        raw,
        observations={key: raw.observations[key] for key in keys},
        next_observations=None if after is None else {key: after[key] for key in keys},
    )


def success_fault(raw: RawEpisode) -> str:
    """Message that explains why the success of an episode is unknown."""
    if (said := raw.attributes.get("success")) is not None:
        return f"attribute success is {said!r} instead of 0 or 1, and there are no successes"
    return "no attribute success and no successes"


def rewards_of(path: str | Path, name: str, raw: RawEpisode, options: ReadOptions) -> np.ndarray:
    """Rewards of an episode, from the source that the options choose.

    Raises:
        DataError: naming file and key, if that source is missing.
    """
    last = np.arange(len(raw.actions)) == len(raw.actions) - 1
    if options.reward == "last":
        return last.astype(np.float32)
    if options.reward == "success":
        if raw.succeeded is None:
            raise DataError(path, name, f"{success_fault(raw)}; valid: reward 'last', or None")
        return np.asarray(raw.extras.get("successes", last & raw.succeeded), dtype=np.float32)
    if raw.rewards is None:
        message = "missing; valid: rewards (T,), or the option reward 'success' or 'last'"
        raise DataError(path, f"{name}/rewards", message)
    return raw.rewards
