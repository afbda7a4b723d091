"""Any of the formats in, any of the formats out."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_bmrl.data import lerobot, minari, robomimic
from torchrl_bmrl.data.account import Account
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.options import ReadOptions
from torchrl_bmrl.data.schema import Layout, check_episode, check_fps, layout_of
from torchrl_bmrl.data.sources import (
    Source,
    find_format,
    joined,
    open_source,
    open_sources,
    with_joint_range,
)
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError, UnknownNameError

__all__ = ["TARGETS", "Conversion", "convert", "find_format", "open_source"]

TARGETS = ("robomimic", "minari", "lerobot")


@dataclass(frozen=True, kw_only=True)
class Conversion:
    """What was written, and what of the source was not.

    Attributes:
        account: of the episodes, all sources together.
        notes: what the new data set lacks, or has otherwise, in words.
    """

    account: Account
    notes: tuple[str, ...]


def convert(
    source: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    target: str | os.PathLike[str],
    *,
    to: str,
    task: str | None = None,
    tracking: float = 1.0,
    fps: float | None = None,
    report: Callable[[int], object] = lambda _: None,
    **options: Any,
) -> Conversion:
    """Writes a data set in another format, whole, or not at all; the source is only read.

    Args:
        source: an HDF5 file in robomimic's layout, of robosuite, of Isaac Lab or D4RL, the folder
            of a Minari or LeRobot data set, or several of them, to become one.
        target: what to write: a file for robomimic, a folder for LeRobot and for Minari, whose
            names it ``<namespace>/<name>-v<number>``.
        to: ``"robomimic"``, ``"minari"`` or ``"lerobot"``.
        task: whose scene a robosuite ``demo.hdf5`` was recorded in.
        tracking: see :func:`torchrl_bmrl.data.robosuite.open_episodes`.
        fps: steps per second [Hz]; ``None`` for the source's own.
        report: called with 1 after every episode.
        options: how sources are read, see :class:`~torchrl_bmrl.data.options.ReadOptions`.

    Returns:
        what was read, and what is not in the new data set.

    Raises:
        UnknownNameError: for a format that cannot be written.
        ConfigError: for options that the formats have no use for, for sources whose actions have
            other bounds, and for LeRobot without ``fps`` where the source does not tell it.
        DataError: naming file, key and row for what cannot be trained on, for a data set that would
            lose all of its reward or successes, and for a target that exists or cannot be written.

    Example:
        >>> import tempfile
        >>> import numpy as np
        >>> folder = Path(tempfile.mkdtemp())
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.zeros(5)
        >>> episode = Episode(
        ...     observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 0
        ... )
        >>> robomimic.write_episodes(folder / "lift.hdf5", [episode], env_args={})
        >>> target = folder / "sawyer" / "lift-v0"
        >>> convert(folder / "lift.hdf5", target, to="minari", fps=20).account.read.steps
        5
        >>> sorted(file.name for file in target.rglob("*.*"))
        ['main_data.hdf5', 'metadata.json']
    """
    if to not in TARGETS:
        raise UnknownNameError("format", to, TARGETS)
    if fps is not None:
        check_fps(fps)
    target = Path(target).expanduser()
    # Once: an iterator of keys is at its end after the first source.
    options = vars(ReadOptions(**options))
    with open_sources(source, task=task, tracking=tracking, **options) as sources:
        stream = Stream(with_joint_range(sources), report)
        with writing(target):
            _write(target, to, stream, fps)
        return Conversion(account=stream.account, notes=tuple(stream.notes(to)))


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Refuses a target that exists, and reports in one way what the file system refuses.

    Raises:
        DataError: if the target exists or cannot be written.
    """
    try:
        if os.path.lexists(target):
            raise DataError(target, None, "exists; valid: a new name")
        yield
    except BMRLError:
        raise
    except (OSError, RuntimeError) as error:  # RuntimeError: how h5py reports a full disk
        raise DataError(target, None, f"cannot be written ({error})") from error


class Stream:
    """The episodes of all sources on their way to a writer: each is checked and counted.

    Args:
        sources: open, in order.
        report: called with 1 after every episode.
    """

    def __init__(self, sources: Sequence[Source], report: Callable[[int], object]) -> None:
        self.sources, self.report = sources, report
        self.metadata = joined(sources)
        self.account = Account()
        # What their file's attributes would say again: masks and totals are written anew.
        structure = ("env_args", "masks", "total", "action_bounds")
        self.attributes_of_file = {k: v for k, v in self.metadata.items() if k not in structure}
        self.extras: dict[str, None] = {}
        self.attributes: dict[str, None] = {}
        self.rounded = self.whole_numbers = self.bounded = False

    @property
    def names(self) -> list[str]:
        return [name for source in self.sources for name in source.episodes]

    @property
    def fps(self) -> float | None:
        """Steps per second [Hz], where all sources tell the same."""
        told = {source.fps for source in self.sources}
        if len(told) > 1:
            raise ConfigError(f"the sources have {sorted(map(str, told))} steps a second; --fps?")
        return told.pop()

    def __iter__(self) -> Iterator[Episode]:
        layout: Layout | None = None
        for source in self.sources:
            self.account.failed += source.account.failed
            for name in source.episodes:
                episode = source.episodes[name]
                check_episode(
                    source.path,
                    f"{source.prefix}{name}",
                    episode,
                    layout=layout,
                    bounds=source.bounds,
                )
                layout = layout or layout_of(episode)
                self._count(name, episode)
                yield episode
                self.report(1)
        # Before the writer ends, so that nothing is written.
        self.account.check(self.sources[0].path, self.sources[0].options)

    def _count(self, name: str, episode: Episode) -> None:
        self.account.add(name, episode)
        self.extras |= dict.fromkeys(episode.extras)
        self.attributes |= dict.fromkeys(episode.attributes)
        numbers = (episode.actions, episode.rewards, *episode.observations.values())
        self.rounded |= any(array.dtype.itemsize > 4 for array in numbers)
        self.whole_numbers |= any(array.dtype.kind != "f" for array in numbers)
        self.bounded = episode.actions.dtype.kind == "f"

    def notes(self, to: str) -> Iterator[str]:
        """What the new data set lacks, or has otherwise."""
        for source in self.sources:
            where = f"{source.path}: " if len(self.sources) > 1 else ""
            yield from (f"{where}{oddity}" for oddity in source.oddities)
        yield from self.account.warnings()
        named = {"robomimic": "demo", "minari": "episode", "lerobot": "episode"}[to]
        renamed = [
            f"{old} is {named}_{i} now" for i, old in enumerate(self.names) if old != f"{named}_{i}"
        ]
        if renamed:
            yield f"renamed: {len(renamed)} episodes; {renamed[0]}"
        yield from self._dropped(to)
        if to == "lerobot":
            yield from lerobot.describe_losses(
                extras=list(self.extras),
                attributes=list(self.attributes),
                rounded=self.rounded,
                whole_numbers=self.whole_numbers,
            )

    def _dropped(self, to: str) -> Iterator[str]:
        """What of the sources' metadata has no place in the new data set."""
        told = {str(source.metadata.get("env_args")) for source in self.sources}
        if len(told) > 1:
            yield f"env_args differ between the sources: those of {self.sources[0].path} are kept"
        for mask in self.metadata["masks"]:
            lacking = [x.path for x in self.sources if mask not in x.metadata.get("masks", {})]
            if lacking:
                yield f"mask {mask} has no episode of {lacking[0]}, which has no such mask"
        keys = [key for source in self.sources for key in source.metadata]
        if to != "robomimic":
            bounds = ["action_bounds"] if to == "minari" and self.bounded else []
            placed = ("fps", "task", "masks", *bounds)
            dropped = [key for key in keys if key not in placed]
            dropped += [f"mask {name}" for name in self.metadata["masks"]]
        else:
            # Bounds are equal, however they are written.
            dropped = [key for key in keys if key not in (*self.metadata, "action_bounds")]
        if dropped:
            names = ", ".join(dict.fromkeys(dropped))
            yield f"left out, as the data set has no place for it: {names}"


def _write(target: Path, to: str, stream: Stream, fps: float | None) -> None:
    metadata = stream.metadata
    env_args = metadata["env_args"]
    name = metadata.get("task") or env_args.get("env_name") or target.name
    bounds = stream.sources[0].bounds
    if to == "robomimic":
        robomimic.write_episodes(
            target,
            stream,
            env_args=env_args,
            attributes=stream.attributes_of_file | ({} if fps is None else {"fps": fps}),
            masks=metadata["masks"],
            bounds=bounds,
        )
        return
    fps = stream.fps if fps is None else fps
    if to == "minari":
        minari.write_episodes(target, stream, fps=fps, description=str(name), bounds=bounds)
    elif fps is None:
        raise ConfigError("the source does not tell its steps per second; valid: --fps")
    else:
        lerobot.write_episodes(target, stream, fps=fps, task=str(name))
