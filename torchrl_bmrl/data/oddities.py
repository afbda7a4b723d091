"""Finds oddities in recordings that can be trained on, but may not be as intended."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from torchrl_bmrl.data.episodes import Episode, as_success

FROZEN_STEPS = 10
"""This many identical observations in a row are unlikely to be a coincidence.

It is half a second at 20 Hz. A commanded arm moves within two or three steps, and simulated or
measured values at rest still differ in their last digits. Up to four identical ones occur if a
camera or a gripper is read less often than actions are sent.
"""
AT_REST = 1e-6
"""Largest change per step of a number at rest, as a share of its range in the episode."""
NAMED = 8
"""Largest number of names in a message."""


@dataclass
class _Found:
    """Episodes with one oddity, in order: a detail of each, by its name."""

    episodes: dict[str, str] = field(default_factory=dict)

    def example(self) -> str:
        """Name and detail of the first one."""
        name, text = next(iter(self.episodes.items()))
        return f"{name} ({text})" if text else name

    def names(self) -> str:
        """All names, or the first few."""
        names = list(self.episodes)
        return ", ".join(names[:NAMED]) + (", ..." if len(names) > NAMED else "")


class Oddities:
    """Collects the oddities of a data set, one episode after the other.

    It stores a few numbers for each episode, and the previous episode.
    """

    def __init__(self) -> None:
        self._count = 0
        self._frozen, self._idle, self._foreign = _Found(), _Found(), _Found()
        self._rewards = _Found()
        self._still: dict[str, _Found] = {}
        self._varied: dict[str, int] = {}
        self._steps, self._reward = 0, 0.0
        self._sparse = True
        self._last: tuple[str, Episode] | None = None

    def add(self, name: str, episode: Episode) -> None:
        """Examines an episode.

        Args:
            name: of the episode, for messages.
            episode: a sound one, in the order of the file.
        """
        self._count += 1
        same = {key: _equal_to_next(part) for key, part in episode.observations.items()}
        if (run := _longest(np.logical_and.reduce(list(same.values())), episode)) is not None:
            self._frozen.episodes[name] = f"steps {run[0]} to {run[1]}"
        if len(episode) >= FROZEN_STEPS:
            for key, equal in same.items():
                # Parts that change at few steps of one episode may change at none of another.
                self._varied[key] = self._varied.get(key, 0) + (equal.mean() < 0.5)
                others = (not other.all() for part, other in same.items() if part != key)
                if equal.all() and any(others):
                    self._still.setdefault(key, _Found()).episodes[name] = ""
        if idle := _idle_steps(episode):
            self._idle.episodes[name] = f"its last {idle} steps"
        if self._last is not None and _is_foreign(self._last[1], episode):
            self._foreign.episodes[self._last[0]] = f"{name} follows"
        self._last = (name, episode)
        self._look_at_rewards(name, episode)

    def _look_at_rewards(self, name: str, episode: Episode) -> None:
        earned = bool(np.any(episode.rewards)) or episode.left_out.reward != 0
        self._steps += len(episode)
        self._reward += float(np.sum(episode.rewards)) + episode.left_out.reward
        self._sparse &= bool(np.isin(episode.rewards, (0, 1)).all())
        success = as_success(episode.attributes.get("success"))
        if success is not None and earned != success:
            said = f"success is {int(success)}, {'a' if earned else 'no'} reward"
            self._rewards.episodes[name] = said

    def warnings(self) -> list[str]:
        """Describes each oddity: its count, an example, and a possible cause."""
        return list(self._warnings())

    def _warnings(self) -> Iterator[str]:
        of = f"of {self._count} episodes"
        if frozen := self._frozen.episodes:
            yield (
                f"{len(frozen)} {of} have one observation for {FROZEN_STEPS} steps or more while "
                f"actions change, such as {self._frozen.example()}: was the recording stuck?"
            )
        for key, still in self._still.items():
            # Parts that are constant in most episodes are not reported.
            if len(still.episodes) <= self._varied[key]:
                yield (
                    f"obs/{key}: never changes in {len(still.episodes)} {of}, such as "
                    f"{still.example()}, and does in others: was a sensor or a camera off?"
                )
        if idle := self._idle.episodes:
            yield (
                f"{len(idle)} {of} end idle, such as {self._idle.example()}: neither action nor "
                "observation changes; a policy learns to stand still there"
            )
        if foreign := self._foreign.episodes:
            yield (
                f"in {len(foreign)} {of} the last next observation is the first observation of the "
                f"next episode in the file: {self._foreign.names()}. It was probably not recorded, "
                "as in D4RL's files: values would be bootstrapped from another episode"
            )
        # Only rewards that are 1 for a solved task can contradict success.
        sparse = self._sparse and 0 < self._reward < self._steps / 2
        if sparse and (found := self._rewards.episodes):
            yield (
                f"in {len(found)} {of} the attribute success contradicts the rewards, which are 0 "
                f"or 1, such as {self._rewards.example()}: which of them is right?"
            )


def _equal_to_next(rows: np.ndarray) -> np.ndarray:
    """Whether each row is identical to the next one, ``(T - 1,)``."""
    return (rows[1:] == rows[:-1]).all(axis=tuple(range(1, rows.ndim)))


def _changes(rows: np.ndarray) -> bool:
    return not _equal_to_next(rows).all()


def _longest(equal: np.ndarray, episode: Episode) -> tuple[int, int] | None:
    """First and last step of the longest run of one observation while actions change."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], equal, [False]]).astype(int)))
    # Rows first to last are identical: the actions between them had no effect.
    runs = [
        (int(first), int(last))
        for first, last in edges.reshape(-1, 2)
        if last - first + 1 >= FROZEN_STEPS and _changes(episode.actions[first:last])
    ]
    return max(runs, key=lambda run: run[1] - run[0], default=None)


def _idle_steps(episode: Episode) -> int:
    """Number of last steps in which neither action nor observation changes; 0 if only a few."""
    still = _equal_to_next(episode.actions)
    # At least one step comes before them: the first step has no action to compare with.
    if not (steps := _trailing(still)):
        return 0
    for key, part in episode.observations.items():
        rows = np.append(part[-steps:], episode.next_observations[key][-1:], axis=0)
        low, high = (_numbers(extreme[None]) for extreme in (part.min(axis=0), part.max(axis=0)))
        moved = np.abs(np.diff(_numbers(rows), axis=0)) > AT_REST * (high - low)
        still[-steps:] &= ~moved.any(axis=1)
    steps = _trailing(still)
    return steps if steps >= FROZEN_STEPS else 0


def _trailing(flags: np.ndarray) -> int:
    """Number of true flags at the end."""
    return len(flags) if flags.all() else int(np.argmin(flags[::-1]))


def _is_foreign(episode: Episode, following: Episode) -> bool:
    """Whether an episode's last next observation belongs to the following episode.

    Pieces of one long recording are excluded: there, the last step is as small as the others.
    """
    if set(episode.observations) != set(following.observations):
        return False
    for key, part in following.observations.items():
        if not np.array_equal(episode.next_observations[key][-1], part[0]):
            return False
    jumps = smooth_jumps = False
    for key, part in episode.observations.items():
        rows = _numbers(np.append(part, following.observations[key], axis=0))
        steps = np.abs(np.diff(rows, axis=0))
        jump = steps[len(part) - 1]
        usual = np.delete(steps, len(part) - 1, axis=0).max(axis=0, initial=0.0)
        # Numbers that jump over their whole range at every step say nothing.
        smooth = 2 * usual <= np.ptp(rows, axis=0)
        if (smooth & (jump > 2 * usual)).any():
            return True
        jumps |= bool(jump.any())
        smooth_jumps |= bool((smooth & (jump > 0)).any())
    return jumps and not smooth_jumps


def _numbers(rows: np.ndarray) -> np.ndarray:
    """Rows as float vectors, whose differences neither overflow nor fail."""
    return np.asarray(rows, dtype=np.float64).reshape(len(rows), math.prod(rows.shape[1:]))
