"""Converts data sets between formats."""

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
from torchrl_bmrl.data.source_files import check_unchanged
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
    """Result of a conversion.

    Attributes:
        account: of the episodes of all sources.
        notes: descriptions of what was changed or left out.
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
    """Writes a data set in another format, completely or not at all; the source is only read.

    Args:
        source: an HDF5 file in the layout of robomimic, robosuite, Isaac Lab or D4RL, or the folder
            of a Minari or LeRobot data set. Several sources become one data set.
        target: the new file (robomimic) or folder (LeRobot, Minari). Minari's folders are named
            ``<namespace>/<name>-v<number>``.
        to: ``"robomimic"``, ``"minari"`` or ``"lerobot"``.
        task: the task in whose scene a robosuite ``demo.hdf5`` was recorded.
        tracking: see :func:`torchrl_bmrl.data.robosuite.open_episodes`.
        fps: steps per second [Hz]; ``None`` for the source's own.
        report: called with 1 after every episode.
        options: see :class:`~torchrl_bmrl.data.options.ReadOptions`.

    Returns:
        the account of what was read, and notes on what was changed or left out.

    Raises:
        UnknownNameError: for a format that cannot be written.
        ConfigError: for options that do not apply to the format, for sources with different bounds
            of the actions, and for LeRobot without ``fps`` if the source does not state it.
        DataError: naming file, key and row, for data that cannot be trained on; for a data set that
            would lose all of its reward or successes; and for a target that exists or cannot be
            written.

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
    # Built once, because an iterator of keys is exhausted after the first source.
    options = vars(ReadOptions(**options))
    with open_sources(source, task=task, tracking=tracking, **options) as sources:
        stream = Stream(with_joint_range(sources), report)
        with writing(target):
            _write(target, to, stream, fps)
        return Conversion(account=stream.account, notes=tuple(stream.notes(to)))


@contextmanager
def writing(target: Path) -> Iterator[None]:
    """Refuses a target that exists, and turns errors of the file system into a DataError.

    Raises:
        DataError: if the target exists or cannot be written.
    """
    try:
        if os.path.lexists(target):
            raise DataError(target, None, "exists; valid: a new name")
        yield
    except BMRLError:
        raise
    except (OSError, RuntimeError) as error:  # RuntimeError: h5py's error on a full disk
        raise DataError(target, None, f"cannot be written ({error})") from error


class Stream:
    """Iterator over the episodes of all sources, which checks and counts each of them.

    Args:
        sources: open, in order.
        report: called with 1 after every episode.
    """

    def __init__(
        self, sources: Sequence[Source], report: Callable[[int], object] = lambda _: None
    ) -> None:
        self.sources, self.report = sources, report
        self.metadata = joined(sources)
        self.account = Account()
        # Writers set these attributes themselves.
        structure = ("env_args", "masks", "total", "action_bounds")
        self.attributes_of_file = {k: v for k, v in self.metadata.items() if k not in structure}
        self.extras: dict[str, None] = {}
        self.attributes: dict[str, None] = {}
        self.rounded = self.whole_numbers = self.bounded = False

    @property
    def names(self) -> list[str]:
        """Names of all episodes."""
        return [name for source in self.sources for name in source.episodes]

    @property
    def fps(self) -> float | None:
        """Steps per second [Hz]; ``None`` if the sources do not state it."""
        told = {source.fps for source in self.sources}
        if len(told) > 1:
            rates = ", ".join(sorted(map(str, told)))
            raise ConfigError(f"the sources have {rates} steps per second; valid: --fps")
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
        # Before the writer finishes, so that a refused data set is not written.
        for source in self.sources:
            if source.identity is not None:
                check_unchanged(source.path, source.identity)
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
        """Descriptions of what the new data set lacks or has changed."""
        for source in self.sources:
            where = f"{source.path}: " if len(self.sources) > 1 else ""
            yield from (f"{where}{oddity}" for oddity in source.oddities)
        yield from self.account.warnings()
        named = {"robomimic": "demo", "minari": "episode", "lerobot": "episode"}[to]
        renamed = [
            f"{old} to {named}_{i}" for i, old in enumerate(self.names) if old != f"{named}_{i}"
        ]
        if renamed:
            yield f"renamed: {len(renamed)} episodes, such as {renamed[0]}"
        yield from self._dropped(to)
        if to == "lerobot":
            yield from lerobot.describe_losses(
                extras=list(self.extras),
                attributes=list(self.attributes),
                rounded=self.rounded,
                whole_numbers=self.whole_numbers,
            )

    def _dropped(self, to: str) -> Iterator[str]:
        """Metadata of the sources that are not in the new data set."""
        told = {str(source.metadata.get("env_args")) for source in self.sources}
        if len(told) > 1:
            yield f"env_args differ between the sources: those of {self.sources[0].path} are used"
        for mask in self.metadata["masks"]:
            lacking = [x.path for x in self.sources if mask not in x.metadata.get("masks", {})]
            if lacking:
                yield f"mask {mask} has no episodes of {lacking[0]}, which has no such mask"
        keys = [key for source in self.sources for key in source.metadata]
        if to != "robomimic":
            bounds = ["action_bounds"] if to == "minari" and self.bounded else []
            placed = ("fps", "task", "masks", *bounds)
            dropped = [key for key in keys if key not in placed]
            dropped += [f"mask {name}" for name in self.metadata["masks"]]
        else:
            # The bounds are equal, even if they are written differently.
            dropped = [key for key in keys if key not in (*self.metadata, "action_bounds")]
        if dropped:
            names = ", ".join(dict.fromkeys(dropped))
            yield f"left out, because the format has no place for it: {names}"


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
        raise ConfigError("the source does not state its steps per second; valid: --fps")
    else:
        lerobot.write_episodes(target, stream, fps=fps, task=str(name))
