"""Any of the formats in, any of the formats out."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_bmrl.data import lerobot, minari, robomimic, robosuite
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.hdf5 import open_file, read_names
from torchrl_bmrl.data.schema import Bounds, check_episode, layout_of
from torchrl_bmrl.errors import BMRLError, ConfigError, DataError, UnknownNameError

TARGETS = ("robomimic", "minari", "lerobot")


@dataclass(frozen=True, kw_only=True)
class Source:
    """A data set that is open for reading.

    Attributes:
        format: ``"robomimic"``, ``"robosuite"`` or ``"minari"``.
        episodes: by name, each read when it is asked for.
        prefix: of the names inside the file, for messages.
        bounds: of floating-point actions; ``None`` where the format has none.
        metadata: attributes of the file, ``env_args`` and ``masks`` among them.
        problems: what is wrong beside the episodes: key and message.
        oddities: what deserves a look beside them.
    """

    format: str
    episodes: Mapping[str, Episode]
    prefix: str = "data/"
    bounds: Bounds | None = (-1.0, 1.0)
    metadata: Mapping[str, Any] = field(default_factory=dict)
    problems: Sequence[tuple[str, str]] = ()
    oddities: Sequence[str] = ()

    @property
    def fps(self) -> float | None:
        """Steps per second [Hz], where the data set tells them."""
        kwargs = self.metadata.get("env_args", {}).get("env_kwargs") or {}
        for known in (self.metadata.get("fps"), kwargs.get("control_freq")):
            if isinstance(known, int | float) and 0 < known < float("inf"):
                return float(known)
        return None


def find_format(path: Path) -> str:
    """Format of a data set: ``"robomimic"``, ``"robosuite"`` or ``"minari"``.

    Raises:
        DataError: if it is none of them.
    """
    if path.is_dir():
        if (path / "data" / "main_data.hdf5").exists():
            return "minari"
        raise DataError(path, None, "a folder without data/main_data.hdf5; valid: Minari's, a file")
    with open_file(path) as file:
        for name in read_names(path, file, "data"):
            present = read_names(path, file, f"data/{name}")
            if "obs" in present:
                return "robomimic"
            if "states" in present:
                return "robosuite"
    raise DataError(path, "data", "no demonstration with obs (robomimic) or states (robosuite)")


@contextmanager
def open_source(
    path: str | Path, *, task: str | None = None, tracking: float = 1.0, split: str | None = None
) -> Iterator[Source]:
    """Opens a data set of any format.

    Args:
        path: an HDF5 file, or the folder of a Minari data set.
        task: whose scene a robosuite ``demo.hdf5`` was recorded in: it holds states alone.
        tracking: see :func:`torchrl_bmrl.data.robosuite.open_episodes`.
        split: name of a mask of a file in robomimic's layout.

    Raises:
        DataError: for a missing or damaged data set.
        ConfigError: for a robosuite file without ``task``, and for options that another format has
            no use for.
    """
    path = Path(path).expanduser()
    form = find_format(path)
    if form != "robosuite" and (task is not None or tracking != 1.0):
        raise ConfigError(f"task and tracking are for robosuite's demo.hdf5; {path} is {form}'s")
    if split is not None and form != "robomimic":
        raise ConfigError(f"split is {split!r}, but {path} is {form}'s, which has no masks")
    if form == "minari":
        with minari.open_episodes(path) as episodes:
            told = minari.read_metadata(path)
            # As gymnasium's environments are in robomimic's layout.
            env_args = {"env_name": told.get("dataset_id", path.name), "type": 2, "env_kwargs": {}}
            metadata: dict[str, Any] = {"env_args": env_args}
            if "fps" in told:
                metadata["fps"] = told["fps"]
            yield Source(format=form, episodes=episodes, prefix="", bounds=None, metadata=metadata)
    elif form == "robomimic":
        metadata = robomimic.read_metadata(path)
        with robomimic.open_episodes(path, split=split) as episodes:
            yield Source(
                format=form,
                episodes=episodes,
                metadata=metadata,
                problems=robomimic.find_mask_problems(path),
                oddities=robomimic.find_oddities(path),
            )
    else:
        if task is None:
            raise ConfigError(
                f"{path} holds simulator states alone; valid: --task, the task whose scene it is"
            )
        from torchrl_bmrl.envs.tasks import robosuite_metadata

        with robosuite.open_episodes(path, task=task, tracking=tracking) as episodes:
            metadata = {"env_args": robosuite_metadata(task), "task": task}
            yield Source(format=form, episodes=episodes, metadata=metadata)


def convert(
    source: str | Path,
    target: str | Path,
    *,
    to: str,
    task: str | None = None,
    tracking: float = 1.0,
    split: str | None = None,
    fps: float | None = None,
    report: Callable[[int], object] = lambda _: None,
) -> None:
    """Writes a data set in another format, whole, or not at all; the source is only read.

    Args:
        source: an HDF5 file in robomimic's layout or of robosuite, or a Minari data set's folder.
        target: what to write: a file for robomimic, a folder for LeRobot and for Minari, whose
            names it ``<namespace>/<name>-v<number>``.
        to: ``"robomimic"``, ``"minari"`` or ``"lerobot"``.
        task: whose scene a robosuite ``demo.hdf5`` was recorded in.
        tracking: see :func:`torchrl_bmrl.data.robosuite.open_episodes`.
        split: name of a mask of a file in robomimic's layout; ``None`` for all episodes.
        fps: steps per second [Hz], for Minari and LeRobot; ``None`` for the source's own.
        report: called with 1 after every episode.

    Raises:
        UnknownNameError: for a format that cannot be written.
        ConfigError: for options that the formats have no use for, and for LeRobot without ``fps``
            where the source does not tell it.
        DataError: naming file, key and row for what cannot be trained on, for a target that exists
            or cannot be written.

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
        >>> convert(folder / "lift.hdf5", target, to="minari", fps=20)
        >>> sorted(file.name for file in target.rglob("*.*"))
        ['main_data.hdf5', 'metadata.json']
    """
    if to not in TARGETS:
        raise UnknownNameError("format", to, TARGETS)
    source, target = Path(source).expanduser(), Path(target).expanduser()
    with open_source(source, task=task, tracking=tracking, split=split) as data:
        for key, message in data.problems:
            raise DataError(source, key, message)
        episodes = _checked(source, data, report)
        try:
            if os.path.lexists(target):
                raise DataError(target, None, "exists; valid: a new name")
            _write(target, to, data, episodes, data.fps if fps is None else fps)
        except BMRLError:
            raise
        except (OSError, RuntimeError) as error:  # RuntimeError: how h5py reports a full disk
            raise DataError(target, None, f"cannot be written ({error})") from error


def _write(
    target: Path, to: str, data: Source, episodes: Iterator[Episode], fps: float | None
) -> None:
    env_args = data.metadata.get("env_args", {})
    name = data.metadata.get("task") or env_args.get("env_name") or target.name
    if to == "robomimic":
        # Of one mask's episodes the other masks keep what is left of theirs.
        positions = {name: i for i, name in enumerate(data.episodes)}
        masks = {
            mask: [positions[name] for name in chosen if name in positions]
            for mask, chosen in data.metadata.get("masks", {}).items()
        }
        attributes = {
            key: value
            for key, value in data.metadata.items()
            if key not in ("env_args", "masks", "total")
        }
        robomimic.write_episodes(
            target, episodes, env_args=env_args, attributes=attributes, masks=masks
        )
    elif to == "minari":
        minari.write_episodes(target, episodes, fps=fps, description=str(name))
    elif fps is None:
        raise ConfigError("the source does not tell its steps per second; valid: --fps")
    else:
        lerobot.write_episodes(target, episodes, fps=fps, task=str(name))


def _checked(path: Path, data: Source, report: Callable[[int], object]) -> Iterator[Episode]:
    layout = None
    for name in data.episodes:
        episode = data.episodes[name]
        check_episode(path, f"{data.prefix}{name}", episode, layout=layout, bounds=data.bounds)
        layout = layout or layout_of(episode)
        yield episode
        report(1)
