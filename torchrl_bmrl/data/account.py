"""What a data set holds, what of it was read, and what was left out: nothing without a word."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode, as_success
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import RawEpisode, rewards_of
from torchrl_bmrl.errors import DataError

WAYS_OUT = (
    "valid: last_step 'truncate' or 'terminate', which keep it, dones_terminate where dones say "
    "that it terminates, or 'drop' to leave it out all the same"
)


@dataclass
class Tally:
    """Episodes, and what they add up to.

    Attributes:
        episodes: how many.
        steps: of all of them.
        reward: sum over all steps.
        rewarded: steps whose reward is not 0.
        successes: episodes that succeeded, of those that say so.
    """

    episodes: int = 0
    steps: int = 0
    reward: float = 0.0
    rewarded: int = 0
    successes: int = 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.episodes + other.episodes,
            self.steps + other.steps,
            self.reward + other.reward,
            self.rewarded + other.rewarded,
            self.successes + other.successes,
        )

    def include(self, rewards: np.ndarray, succeeded: bool | None) -> None:
        """Adds an episode."""
        self.episodes += 1
        self.steps += len(rewards)
        self.reward += float(np.sum(rewards, dtype=np.float64))
        self.rewarded += int(np.count_nonzero(rewards))
        self.successes += bool(succeeded)

    def __str__(self) -> str:
        episodes = f"{self.episodes} episodes, " if self.episodes else ""
        return (
            f"{episodes}{self.steps:,} steps, reward {self.reward:.6g}, {self.successes} successes"
        )


@dataclass
class Account:
    """What was read of the episodes of a file, and what was not.

    The three tallies add up to what the file holds of the episodes that can be read.

    Attributes:
        read: what there is to train on.
        cut: last steps without an observation after them.
        failed: episodes that did not succeed, left out on request.
        arrays: in how many episodes each array or group is left alone.
        contradictions: names of episodes whose attribute ``success`` is not what ``successes`` say.

    Example:
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.ones(5)
        >>> account = Account()
        >>> account.add(
        ...     "demo_0",
        ...     Episode(
        ...         observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 1
        ...     ),
        ... )
        >>> print(account.whole)
        1 episodes, 5 steps, reward 5, 0 successes
    """

    read: Tally = field(default_factory=Tally)
    cut: Tally = field(default_factory=Tally)
    failed: Tally = field(default_factory=Tally)
    arrays: Counter[str] = field(default_factory=Counter)
    contradictions: list[str] = field(default_factory=list)

    def add(self, name: str, episode: Episode) -> None:
        """Counts an episode that was read, and what was left out of it."""
        self.read.include(episode.rewards, episode.succeeded)
        left = episode.left_out
        self.cut += Tally(0, left.steps, left.reward, int(left.reward != 0), int(left.success))
        self.arrays.update(left.arrays)
        said = as_success(episode.attributes.get("success"))
        if said not in (None, episode.succeeded or left.success):
            self.contradictions.append(name)

    def add_failure(self, raw: RawEpisode, options: ReadOptions) -> None:
        """Counts an episode that is left out, since it did not succeed."""
        rewards = np.zeros(len(raw.actions))
        if raw.rewards is not None or options.reward is not None:
            rewards = rewards_of("", "", raw, options)
        self.failed.include(rewards, raw.succeeded)

    @property
    def whole(self) -> Tally:
        """What the file holds."""
        return self.read + self.cut + self.failed

    def refusal(self, options: ReadOptions) -> tuple[str, str] | None:
        """What is all lost with the steps that were cut: key and message."""
        if options.last_step is not None:
            return None
        cause = f"no observation after the last step was recorded; {WAYS_OUT}"
        if self.cut.rewarded and not self.read.rewarded:
            message = f"all of the reward ({self.cut.reward:.6g}) is at last steps, and lost: "
            return "rewards", message + cause
        if self.cut.successes and not self.read.successes:
            message = f"all successes ({self.cut.successes}) are at last steps, and lost: "
            return "successes", message + cause
        return None

    def check(self, path: str | Path, options: ReadOptions) -> None:
        """Refuses a data set that lost all of its reward, or all of its successes.

        Raises:
            DataError: naming the sum that is lost and the ways out.
        """
        if problem := self.refusal(options):
            raise DataError(path, *problem)

    def warnings(self) -> Iterator[str]:
        """What was left out, in words."""
        if self.cut.steps:
            yield (
                f"left out: {self.cut.steps} last steps with a reward of {self.cut.reward:.6g} of "
                f"{(self.read + self.cut).reward:.6g} and {self.cut.successes} of "
                f"{(self.read + self.cut).successes} successes, since no observation after them "
                "was recorded; last_step='truncate' or 'terminate' keeps them"
            )
        if self.failed.episodes:
            yield f"left out on request, as not successful: {self.failed}"
        if self.contradictions:
            yield (
                f"attribute success contradicts successes in {len(self.contradictions)} episodes, "
                f"such as {self.contradictions[0]}; successes are believed"
            )
        if self.arrays:
            named = ", ".join(f"{name} ({count}x)" for name, count in self.arrays.items())
            yield f"left alone in the episodes: {named}"

    def as_dict(self) -> dict[str, Any]:
        """Steps, reward and successes by tally, as JSON takes them."""
        return {
            name: {"steps": tally.steps, "reward": tally.reward, "successes": tally.successes}
            for name, tally in (("read", self.read), ("cut", self.cut), ("failed", self.failed))
        }
