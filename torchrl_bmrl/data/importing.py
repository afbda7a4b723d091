"""Demonstrations of any format become the file that a run trains on."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data import robomimic
from torchrl_bmrl.data.convert import Conversion, Stream, writing
from torchrl_bmrl.data.episodes import Episode, LazyEpisodes
from torchrl_bmrl.data.options import Bounds, ReadOptions, check_bounds, join_bounds
from torchrl_bmrl.data.robomimic_file import CONTEXT_MASK, MASKS
from torchrl_bmrl.data.schema import check_episode
from torchrl_bmrl.data.sources import Source, open_sources, range_of_actions
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.files import parse_json

ORIGINAL_BOUNDS = "original_action_bounds"
"""Attribute of ``data``: the bounds that the actions had before they were scaled to [-1, 1]."""

log = logging.getLogger(__name__)

Paths = str | os.PathLike[str] | Sequence[str | os.PathLike[str]]


def import_demonstrations(
    source: Paths,
    target: str | os.PathLike[str],
    *,
    options: ReadOptions | None = None,
    valid_share: float = 0.1,
    context: bool = False,
    bounds: Bounds | None = None,
) -> Conversion:
    """Writes a user's demonstrations into one file in robomimic's layout, ready for training.

    Actions are scaled to [-1, 1]. Two masks tell the episodes to train on (``train``) from those
    that are held out (``valid``): the sources' own, if every source has both. Otherwise,
    episodes that are evenly spread are held out, of those outside a mask ``context``.
    Observations, rewards, terminations, successes, other arrays and attributes are copied. Notes on
    what was changed or left out are logged.

    Args:
        source: a file or data set folder of any format that
            :func:`~torchrl_bmrl.data.sources.open_source` reads, a folder of HDF5 files, or a
            list of such paths. Several become one.
        target: the new HDF5 file.
        options: how the source is read; the defaults if ``None``.
        valid_share: share of the episodes to hold out, of which there is at least one.
        context: whether every source needs a mask ``context``.
        bounds: lowest and highest action, which become -1 and 1, in the units of the actions before
            any import; those of :func:`find_action_bounds` if ``None``. The file stores them, see
            :func:`read_original_bounds`.

    Returns:
        what was read, and notes on what was changed or left out.

    Raises:
        ConfigError: for invalid options.
        DataError: naming file, key and row for data that cannot be trained on, for discrete
            actions, missing rewards or masks, a single episode, and for a target that exists or
            cannot be written.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> x, r = {"x": np.zeros((5, 3))}, np.zeros(5)
        >>> episode = Episode(
        ...     observations=x,
        ...     next_observations=x,
        ...     actions=np.full((5, 2), 0.25),
        ...     rewards=r,
        ...     terminated=r > 0,
        ... )
        >>> robomimic.write_episodes(folder / "own.hdf5", [episode] * 20, env_args={})
        >>> files = folder / "own.hdf5", folder / "lift.hdf5"
        >>> done = import_demonstrations(*files, bounds=(-0.5, 0.5))
        >>> (
        ...     done.account.read.steps,
        ...     len(robomimic.read_metadata(folder / "lift.hdf5")["masks"]["valid"]),
        ... )
        (100, 2)
        >>> with robomimic.open_episodes(folder / "lift.hdf5") as episodes:
        ...     episodes["demo_0"].actions[0].tolist()
        [0.5, 0.5]
        >>> read_original_bounds(folder / "lift.hdf5")
        (-0.5, 0.5)
    """
    if isinstance(valid_share, bool) or not 0 < valid_share < 1:
        raise ConfigError(f"valid_share is {valid_share!r}; valid: a number between 0 and 1")
    target = Path(target).expanduser()
    with _open_scaled(source, options, bounds) as (stream, bounds):
        for opened in stream.sources if context else ():
            if not opened.metadata.get("masks", {}).get(CONTEXT_MASK):
                message = "names no episode; valid: the episodes of another behaviour"
                raise DataError(opened.path, f"mask/{CONTEXT_MASK}", message)
        masks, how = _masks(stream, valid_share)
        _write(target, stream, bounds, masks)
        notes = [*stream.notes("robomimic")]
    if bounds != (-1.0, 1.0):
        notes.append(f"actions were scaled from {bounds[0]} to {bounds[1]} to [-1, 1]")
    train, valid = (len(masks[mask]) for mask in MASKS)
    notes.append(f"{train} episodes to train on, {valid} held out ({how})")
    for note in notes:
        log.info("%s: %s", target, note)
    return Conversion(account=stream.account, notes=tuple(notes))


def copy_scaled(
    source: Paths,
    target: str | os.PathLike[str],
    *,
    bounds: Bounds,
    report: Callable[[int], object] = lambda _: None,
) -> Conversion:
    """Copies demonstrations as :func:`import_demonstrations` does; even one, and without new masks.

    Args:
        source: as for :func:`import_demonstrations`.
        target: the new HDF5 file.
        bounds: as for :func:`import_demonstrations`.
        report: called with 1 after every episode.

    Raises:
        DataError: as :func:`import_demonstrations`.

    Example:
        >>> copy_scaled("nowhere.hdf5", "copy.hdf5", bounds=(-2.0, 2.0))
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.DataError: nowhere.hdf5: no such file
    """
    with _open_scaled(source, None, bounds, report) as (stream, bounds):
        _write(Path(target).expanduser(), stream, bounds, stream.metadata["masks"])
        return Conversion(account=stream.account, notes=tuple(stream.notes("robomimic")))


def read_scaled_episode(
    source: Paths,
    index: int = 0,
    *,
    options: ReadOptions | None = None,
    bounds: Bounds | None = None,
    context: bool = False,
) -> Episode:
    """One of a user's demonstrations, as :func:`import_demonstrations` would write it.

    Args:
        source: as for :func:`import_demonstrations`.
        index: number of the episode, from 0.
        options: how the source is read; the defaults if ``None``.
        bounds: lowest and highest action, which become -1 and 1, in the units of the actions before
            any import: those of the data that a policy was trained on
            (:func:`read_original_bounds`); of the source itself if ``None``.
        context: count the episodes in the mask ``context``, of another behaviour, instead of those
            outside it.

    Raises:
        ConfigError: for invalid options.
        DataError: if the source is missing or damaged, has discrete actions or no rewards, or has
            not so many episodes.

    Example:
        >>> import tempfile
        >>> x, r = {"x": np.zeros((2, 3))}, np.zeros(2)
        >>> episode = Episode(
        ...     observations=x,
        ...     next_observations=x,
        ...     actions=np.full((2, 1), 0.25),
        ...     rewards=r,
        ...     terminated=r > 0,
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "own.hdf5"
        >>> robomimic.write_episodes(path, [episode], env_args={})
        >>> read_scaled_episode(path, bounds=(-0.5, 0.5)).actions.tolist()
        [[0.5], [0.5]]
    """
    with _open_scaled(source, options, bounds) as (stream, _):
        others = set(stream.metadata["masks"].get(CONTEXT_MASK, ()))
        left = index
        for i, episode in enumerate(stream):
            if (i in others) != context:
                continue
            if not left:
                return episode
            left -= 1
        where = f"{('outside', 'in')[context]} mask/{CONTEXT_MASK}"
        message = f"{index - left} episodes {where}; valid: at least {index + 1}"
        raise DataError(stream.sources[0].path, None, message)


def find_action_bounds(
    source: Paths,
    *,
    options: ReadOptions | None = None,
) -> Bounds:
    """Lowest and highest action of the demonstrations of one task, in the units before any import.

    They are those of ``options.bounds``, else those that the file states, else [-1, 1] if all
    actions lie in that range, else each dimension's smallest and largest action. Several sources
    have the bounds that contain those of each. :func:`~torchrl_bmrl.data.options.join_bounds`
    joins the bounds of several tasks.

    Args:
        source: as for :func:`import_demonstrations`.
        options: how the source is read; the defaults if ``None``.

    Returns:
        lowest and highest action: a number for all dimensions or a tuple with one for each.

    Raises:
        ConfigError: for invalid options, and for sources with different numbers of actions.
        DataError: for missing or damaged files, and for discrete actions.

    Example:
        >>> import tempfile
        >>> x, r = {"x": np.zeros((2, 3))}, np.zeros(2)
        >>> episode = Episode(
        ...     observations=x,
        ...     next_observations=x,
        ...     actions=np.array([[-2.0, 1.0], [3.0, 4.0]]),
        ...     rewards=r,
        ...     terminated=r > 0,
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "own.hdf5"
        >>> robomimic.write_episodes(path, [episode], env_args={}, bounds=(-4, 4))
        >>> find_action_bounds(path)
        (-4.0, 4.0)
        >>> find_action_bounds(path, options=ReadOptions(bounds="data"))
        ((-2.0, 1.0), (3.0, 4.0))
    """
    with open_sources(_expand(source), **vars(options or ReadOptions())) as sources:
        _check_actions(sources)
        return _bounds_of(sources)


def read_original_bounds(path: str | Path) -> Bounds | None:
    """The bounds that the actions of an imported file had before they were scaled to [-1, 1].

    Args:
        path: the file.

    Returns:
        lowest and highest action; ``None`` if the file was not imported.

    Raises:
        DataError: if the file is missing or damaged, or states them in another form.

    Example:
        >>> import tempfile
        >>> x, r = {"x": np.zeros((2, 3))}, np.zeros(2)
        >>> episode = Episode(
        ...     observations=x,
        ...     next_observations=x,
        ...     actions=np.zeros((2, 1)),
        ...     rewards=r,
        ...     terminated=r > 0,
        ... )
        >>> folder = Path(tempfile.mkdtemp())
        >>> robomimic.write_episodes(folder / "own.hdf5", [episode] * 2, env_args={})
        >>> _ = import_demonstrations(folder / "own.hdf5", folder / "run.hdf5", bounds=(-2, 2))
        >>> read_original_bounds(folder / "run.hdf5"), read_original_bounds(folder / "own.hdf5")
        ((-2.0, 2.0), None)
    """
    return _parse(path, robomimic.read_metadata(path).get(ORIGINAL_BOUNDS))


def _parse(path: str | Path, text: object) -> Bounds | None:
    if text is None:
        return None
    try:
        stated = parse_json(str(text))
        return check_bounds((stated["low"], stated["high"]), ORIGINAL_BOUNDS)
    except (ValueError, KeyError, TypeError) as error:  # ConfigError is a ValueError
        message = f"attribute {ORIGINAL_BOUNDS} is {text!r}; valid: JSON with low and high"
        raise DataError(path, "data", message) from error


@contextmanager
def _open_scaled(
    source: Paths,
    options: ReadOptions | None,
    bounds: Bounds | None,
    report: Callable[[int], object] = lambda _: None,
) -> Iterator[tuple[Stream, Bounds]]:
    """All episodes of a source with actions in [-1, 1], and the bounds that they had."""
    chosen = None if bounds is None else check_bounds(bounds)
    with open_sources(_expand(source), **vars(options or ReadOptions())) as sources:
        _check_actions(sources)
        bounds = chosen or _bounds_of(sources)
        yield Stream([_in_bounds(each, bounds) for each in sources], report), bounds


def _write(
    target: Path, stream: Stream, bounds: Bounds, masks: Mapping[str, Sequence[int]]
) -> None:
    original = {ORIGINAL_BOUNDS: json.dumps({"low": bounds[0], "high": bounds[1]})}
    with writing(target):
        robomimic.write_episodes(
            target,
            stream,
            env_args=stream.metadata["env_args"],
            attributes=stream.attributes_of_file | original,
            masks=masks,
        )


def _expand(source: Paths) -> Sequence[str | os.PathLike[str]]:
    """The paths of a source; those of its HDF5 files for a folder that is not a data set."""
    paths: list[str | os.PathLike[str]] = []
    for given in [source] if isinstance(source, str | os.PathLike) else source:
        path = Path(given).expanduser()
        files = sorted(file for file in path.glob("*") if file.suffix in (".hdf5", ".h5"))
        paths += files if path.is_dir() and files else [path]
    return paths


def _check_actions(sources: Sequence[Source]) -> None:
    """Refuses actions that are not vectors of floating-point numbers."""
    for source in sources:
        # The first episode is enough: the others are compared with it when they are copied.
        for name in list(source.episodes)[:1]:
            actions = source.episodes[name].actions
            if actions.dtype.kind == "f" and actions.ndim == 2:
                continue
            message = f"{actions.dtype} of shape {actions.shape}; valid: floating-point numbers of "
            message += "shape (T, action_dim), since stage 1 needs continuous actions"
            raise DataError(source.path, f"{source.prefix}{name}/actions", message)


def _bounds_of(sources: Sequence[Source]) -> Bounds:
    return join_bounds([_bounds_of_one(source) for source in sources])


def _bounds_of_one(source: Source) -> Bounds:
    bounds = source.bounds
    if not source.bounds_stated:
        found = range_of_actions(source.episodes, source.episodes)
        within = np.min(found[0]) >= -1 and np.max(found[1]) <= 1
        bounds = (-1.0, 1.0) if within else found
    if (known := _before(source)) is None:
        return bounds
    ends: Any = [known[0] + (np.asarray(x) + 1) / 2 * (known[1] - known[0]) for x in bounds]
    return check_bounds((ends[0], ends[1]))


def _before(source: Source) -> tuple[Any, Any] | None:
    """What -1 and 1 were before the source was imported; ``None`` if it was not."""
    found = _parse(source.path, source.metadata.get(ORIGINAL_BOUNDS))
    return found and (np.asarray(found[0]), np.asarray(found[1]))


def _in_bounds(source: Source, bounds: Bounds) -> Source:
    """The source with actions in [-1, 1], of which these are the bounds before any import."""
    ends: Any = [np.asarray(bound, dtype=np.float64) for bound in bounds]
    if (known := _before(source)) is not None:
        ends = [2 * (end - known[0]) / (known[1] - known[0]) - 1 for end in ends]
    low, high = ends
    own = check_bounds((low, high))

    def scaled(name: str) -> Episode:
        episode = source.episodes[name]
        check_episode(source.path, f"{source.prefix}{name}", episode, bounds=own)
        actions = np.clip(2 * (episode.actions - low) / (high - low) - 1, -1, 1)
        return replace(episode, actions=actions.astype(episode.actions.dtype))

    kept = {k: x for k, x in source.metadata.items() if k not in ("action_bounds", ORIGINAL_BOUNDS)}
    same = np.all(low == -1) and np.all(high == 1)
    episodes = source.episodes if same else LazyEpisodes(source.episodes, scaled)
    return replace(source, bounds=(-1.0, 1.0), metadata=kept, episodes=episodes)


def _masks(stream: Stream, valid_share: float) -> tuple[dict[str, Sequence[int]], str]:
    """Positions of the episodes of each mask, and how they were chosen."""
    masks = dict(stream.metadata["masks"])
    stated = all(set(MASKS) <= set(source.metadata.get("masks", {})) for source in stream.sources)
    stated = stated and bool(masks["train"] and masks["valid"])
    others = set() if stated else set(masks.get(CONTEXT_MASK, ()))
    own = [i for i in range(len(stream.names)) if i not in others]
    if len(own) < 2:
        found = ("no episode", "one episode")[len(own)]
        where = f" outside mask/{CONTEXT_MASK}" if others else ""
        message = f"{found}{where}; valid: at least two, one to train on and one to hold out"
        raise DataError(stream.sources[0].path, None, message)
    if stated:
        return masks, "by the masks of the source"
    held_out = min(len(own) - 1, max(1, round(valid_share * len(own))))
    # Spread over all of them: files that are joined may be of different kinds.
    chosen = {(k + 1) * len(own) // held_out - 1 for k in range(held_out)}
    valid = [i for position, i in enumerate(own) if position in chosen]
    train = [i for position, i in enumerate(own) if position not in chosen]
    return masks | {"train": train, "valid": valid}, f"{held_out} of {len(own)}, evenly spread"
