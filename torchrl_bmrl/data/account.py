"""Counts what a data set contains, what was read of it, and what was left out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode, as_success
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.raw import RawEpisode, rewards_of
from torchrl_bmrl.errors import DataError

WAYS_OUT = (
    "valid: last_step 'truncate' or 'terminate', which keep it, dones_terminate if dones mark a "
    "termination, or last_step 'drop' to leave it out anyway"
)


@dataclass
class Tally:
    """Totals over episodes.

    Attributes:
        episodes: number of episodes.
        steps: number of steps.
        reward: sum over all steps.
        rewarded: number of steps with a reward other than 0.
        successes: number of episodes that are known to have succeeded.
    """

    episodes: int = 0
    steps: int = 0
    reward: float = 0.0
    rewarded: int = 0
    successes: int = 0

    def __add__(self, other: Tally) -> Tally:
        pairs = zip(astuple(self), astuple(other), strict=True)
        return Tally(*(one + another for one, another in pairs))

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
    """What was read of a file's episodes, and what was left out.

    The three tallies add up to all readable episodes of the file.

    Attributes:
        read: the data to train on.
        cut: last steps, left out because no observation follows them.
        failed: unsuccessful episodes, left out on request.
        arrays: for each array or group that is not read, the number of episodes with it.
        contradictions: names of episodes whose attribute ``success`` contradicts ``successes``.
    """

    read: Tally = field(default_factory=Tally)
    cut: Tally = field(default_factory=Tally)
    failed: Tally = field(default_factory=Tally)
    arrays: Counter[str] = field(default_factory=Counter)
    contradictions: list[str] = field(default_factory=list)

    def add(self, name: str, episode: Episode) -> None:
        """Counts an episode that was read, and the steps that were left out of it."""
        self.read.include(episode.rewards, episode.succeeded)
        left = episode.left_out
        self.cut += Tally(0, left.steps, left.reward, int(left.reward != 0), int(left.success))
        self.arrays.update(left.arrays)
        said = as_success(episode.attributes.get("success"))
        if said not in (None, episode.succeeded or left.success):
            self.contradictions.append(name)

    def add_failure(self, raw: RawEpisode, options: ReadOptions) -> None:
        """Counts an episode that is left out because it did not succeed."""
        rewards = np.zeros(len(raw.actions))
        if raw.rewards is not None or options.reward is not None:
            rewards = rewards_of("", "", raw, options)
        self.failed.include(rewards, raw.succeeded)

    @property
    def whole(self) -> Tally:
        """Totals of the file."""
        return self.read + self.cut + self.failed

    def refusal(self, options: ReadOptions) -> tuple[str, str] | None:
        """Key and message of an error if all rewards or successes were in the steps left out."""
        if options.last_step is not None:
            return None
        cause = f"no observation after the last step was recorded; {WAYS_OUT}"
        if self.cut.rewarded and not self.read.rewarded:
            lost = f"all of the reward ({self.cut.reward:.6g}) is in last steps and would be lost"
            return "rewards", f"{lost}: {cause}"
        if self.cut.successes and not self.read.successes:
            lost = f"all successes ({self.cut.successes}) are in last steps and would be lost"
            return "successes", f"{lost}: {cause}"
        return None

    def check(self, path: str | Path, options: ReadOptions) -> None:
        """Refuses a data set that would lose all of its reward, or all of its successes.

        Raises:
            DataError: naming the total that would be lost, and the valid options.
        """
        if problem := self.refusal(options):
            raise DataError(path, *problem)

    def warnings(self) -> Iterator[str]:
        """Descriptions of what was left out."""
        if self.cut.steps:
            yield (
                f"left out: {self.cut.steps} last steps with a reward of {self.cut.reward:.6g} of "
                f"{(self.read + self.cut).reward:.6g} and {self.cut.successes} of "
                f"{(self.read + self.cut).successes} successes, because no observation after them "
                "was recorded; last_step='truncate' or 'terminate' keeps them"
            )
        if self.failed.episodes:
            yield f"left out on request, because not successful: {self.failed}"
        if self.contradictions:
            yield (
                f"attribute success contradicts successes in {len(self.contradictions)} episodes, "
                f"such as {self.contradictions[0]}; successes are used"
            )
        if self.arrays:
            named = ", ".join(f"{name} ({count}x)" for name, count in self.arrays.items())
            yield f"not read in the episodes: {named}"

    def as_dict(self) -> dict[str, Any]:
        """Steps, reward and successes by tally, ready for JSON."""
        return {
            name: {"steps": tally.steps, "reward": tally.reward, "successes": tally.successes}
            for name, tally in (("read", self.read), ("cut", self.cut), ("failed", self.failed))
        }
