"""Opens data sets of any format."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_bmrl.data import d4rl, lerobot_reader, minari, robomimic, robosuite
from torchrl_bmrl.data.account import Account
from torchrl_bmrl.data.episodes import Episode, LazyEpisodes
from torchrl_bmrl.data.hdf5 import open_file, read_names
from torchrl_bmrl.data.options import Bounds, ReadOptions, check_bounds, join_bounds
from torchrl_bmrl.data.raw import Opened, RawEpisode, complete, success_fault
from torchrl_bmrl.data.schema import MAX_FPS
from torchrl_bmrl.data.source_files import Identity, identity_of
from torchrl_bmrl.errors import ConfigError, DataError

_STRUCTURE = (
    *("action_bounds", "action_space", "observation_space", "data_format", "dataset_id"),
    *("dataset_size", "env_args", "env_spec", "masks", "minari_version", "total"),
    *("total_episodes", "total_steps"),
)
"""Metadata that describe the file itself, and names with a meaning of their own here."""

FORMATS = ("robomimic", "robosuite", "minari", "d4rl", "lerobot")


@dataclass(frozen=True, kw_only=True)
class Source:
    """A data set that is open for reading.

    Attributes:
        path: of the file or folder.
        format: one of :data:`FORMATS`.
        episodes: by name; each is read on access.
        options: how they are read.
        prefix: of the names inside the file, for messages.
        bounds: of floating-point actions: those of the options, else those that the data set
            states, else [-1, 1].
        bounds_stated: whether the options or the data set state these bounds.
        metadata: attributes of the file, ``env_args`` and ``masks`` among them, and
            ``action_bounds`` if they are not [-1, 1].
        account: counts the episodes that are left out.
        problems: faults outside the episodes: key and message of each.
        oddities: warnings about the data set as a whole.
        identity: of its files when it was opened; ``None`` if they are not compared.
    """

    path: Path
    format: str
    episodes: Mapping[str, Episode]
    options: ReadOptions = field(default_factory=ReadOptions)
    prefix: str = ""
    bounds: Bounds = (-1.0, 1.0)
    bounds_stated: bool = False
    metadata: Mapping[str, Any] = field(default_factory=dict)
    account: Account = field(default_factory=Account)
    problems: Sequence[tuple[str, str]] = ()
    oddities: Sequence[str] = ()
    identity: Identity | None = None

    @property
    def fps(self) -> float | None:
        """Steps per second [Hz]; ``None`` if the data set does not state it."""
        kwargs = self.metadata.get("env_args", {}).get("env_kwargs")
        rate = kwargs.get("control_freq") if isinstance(kwargs, dict) else None
        for known in (self.metadata.get("fps"), rate):
            if isinstance(known, bool) or not isinstance(known, int | float):
                continue
            if 0 < known < MAX_FPS:
                return float(known)
        return None

    def check(self) -> None:
        """Refuses a data set with faults outside the episodes.

        Raises:
            DataError: for the first of :attr:`problems`.
        """
        for key, message in self.problems:
            raise DataError(self.path, key, message)


def find_format(path: Path, file: Any = None) -> str:
    """Format of a data set: one of :data:`FORMATS`.

    Args:
        path: the file or folder.
        file: the same HDF5 file if it is open already.

    Raises:
        DataError: if it is none of them.
    """
    if path.is_dir():
        if (path / "data" / "main_data.hdf5").exists():
            return "minari"
        if (path / "meta" / "info.json").exists():
            return "lerobot"
        valid = "valid: Minari's, LeRobot's, a file"
        message = "a folder without data/main_data.hdf5 or meta/info.json"
        raise DataError(path, None, f"{message}; {valid}")
    with nullcontext(file) if file else open_file(path) as file:
        if d4rl.is_d4rl(path, file):
            return "d4rl"
        for name in read_names(path, file, "data"):
            try:
                present = read_names(path, file, f"data/{name}")
            except DataError:  # reported when it is read
                continue
            if "obs" in present:
                return "robomimic"
            if "states" in present:
                return "robosuite"
    raise DataError(path, "data", "no demonstration with obs (robomimic) or states (robosuite)")


@contextmanager
def open_source(
    path: str | Path,
    *,
    task: str | None = None,
    tracking: float = 1.0,
    to_train: bool = False,
    file: Any = None,
    **options: Any,
) -> Iterator[Source]:
    """Opens a data set of any format.

    Args:
        path: an HDF5 file, or the folder of a Minari or LeRobot data set.
        task: the task in whose scene a robosuite ``demo.hdf5``, which only has simulator states,
            was recorded.
        tracking: see :func:`torchrl_bmrl.data.robosuite.open_episodes`.
        to_train: whether to skip what training does not need in a file in robomimic's layout:
            attributes of the episodes, and extras except ``successes``.
        file: the same file in robomimic's layout, open already; who opened it knows its content.
        options: see :class:`~torchrl_bmrl.data.options.ReadOptions`.

    Raises:
        DataError: for a missing or damaged data set.
        ConfigError: for a robosuite file without ``task``, and for options that are invalid or do
            not apply to the format.

    Example:
        >>> import tempfile
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.ones(5)
        >>> episode = Episode(
        ...     observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 1
        ... )
        >>> path = Path(tempfile.mkdtemp()) / "lift.hdf5"
        >>> robomimic.write_episodes(path, [episode] * 2, env_args={})
        >>> with open_source(path, reward="last") as source:
        ...     source.format, [episode.rewards.sum() for episode in source.episodes.values()]
        ('robomimic', [1.0, 1.0])
    """
    path = Path(path).expanduser()
    chosen = ReadOptions(**options)
    identity = None if file else identity_of(path)
    form = find_format(path, file)
    if form != "robosuite" and (task is not None or tracking != 1.0):
        raise ConfigError(
            f"task and tracking are for robosuite's demo.hdf5; {path} has the format {form}"
        )
    if chosen.split is not None and form != "robomimic":
        raise ConfigError(
            f"split is {chosen.split!r}, but {path} has the format {form}, without masks"
        )
    if chosen.horizon is not None and form != "d4rl":
        raise ConfigError(f"horizon is for D4RL's files; {path} has the format {form}")
    with ExitStack() as stack:
        if form == "robomimic":
            reader = robomimic.open_data(path, chosen, to_train=to_train, file=file)
            opened = stack.enter_context(reader)
        elif form == "robosuite":
            opened = _open_robosuite(stack, path, task, tracking)
        else:
            opened = _open_other(stack, path, form, chosen)
        yield replace(_apply(path, form, opened, chosen), identity=identity)


@contextmanager
def open_sources(
    source: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], **options: Any
) -> Iterator[list[Source]]:
    """Opens one or several data sets, and refuses those with faults outside the episodes.

    Args:
        source: a path as for :func:`open_source`, or several.
        options: as for :func:`open_source`.

    Raises:
        ConfigError: without a source, and as :func:`open_source`.
        DataError: as :func:`open_source`.
    """
    paths = [source] if isinstance(source, str | os.PathLike) else list(source)
    if not paths:
        raise ConfigError("no source; valid: at least one")
    with ExitStack() as stack:
        sources = [stack.enter_context(open_source(Path(path), **options)) for path in paths]
        for opened in sources:
            opened.check()
        yield sources


def _apply(path: Path, form: str, opened: Opened, options: ReadOptions) -> Source:
    """Applies the options to a data set that its reader has opened."""
    account = Account()
    names = _choose(path, opened, options, account)
    metadata = dict(opened.metadata)
    stated = metadata.pop("action_bounds", None)
    bounds: Bounds = (-1.0, 1.0)
    if options.bounds == "data":
        bounds = range_of_actions(opened.episodes, names)
    elif options.bounds is not None:
        bounds = options.bounds
    elif stated is not None:
        bounds = stated["low"], stated["high"]
    metadata |= _stated(bounds)

    def read(name: str) -> Episode:
        return complete(path, f"{opened.prefix}{name}", opened.episodes[name], options)

    return Source(
        path=path,
        format=form,
        episodes=LazyEpisodes(names, read),
        options=options,
        prefix=opened.prefix,
        bounds=bounds,
        bounds_stated=options.bounds is not None or stated is not None,
        metadata=metadata,
        account=account,
        problems=opened.problems,
        oddities=opened.oddities,
    )


def _choose(path: Path, opened: Opened, options: ReadOptions, account: Account) -> list[str]:
    """Names of the episodes to read: all, or the successful ones."""
    if not options.successful:
        return list(opened.episodes)
    names = []
    for name in opened.episodes:
        try:
            raw = opened.episodes[name]
        except DataError:  # reported when it is read
            names.append(name)
            continue
        if raw.succeeded is None:
            message = f"{success_fault(raw)}; valid: successful=False"
            raise DataError(path, f"{opened.prefix}{name}", message)
        if raw.succeeded:
            names.append(name)
        else:
            account.add_failure(raw, options)
    if not names:
        raise DataError(path, None, f"none of {len(opened.episodes)} episodes succeeded")
    return names


def range_of_actions(episodes: Mapping[str, Episode | RawEpisode], names: Iterable[str]) -> Bounds:
    """Smallest and largest action in each dimension, and ±1 around a constant dimension.

    Actions that are not vectors have one range for all numbers. Integer actions have no bounds:
    the result is [-1, 1].
    """
    low, high = np.array(np.inf), np.array(-np.inf)
    for name in names:
        try:
            actions = episodes[name].actions
            if actions.dtype.kind != "f":
                return -1.0, 1.0
            each = 0 if actions.ndim == 2 else None
            low = np.minimum(low, actions.min(axis=each)).astype(np.float64)
            high = np.maximum(high, actions.max(axis=each)).astype(np.float64)
        except (DataError, ValueError):  # reported when it is read
            continue
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        return -1.0, 1.0
    constant = low == high
    low, high = low - constant, high + constant
    return check_bounds((low, high))


def _open_other(stack: ExitStack, path: Path, form: str, options: ReadOptions) -> Opened:
    reader: Any = {"minari": minari, "d4rl": d4rl, "lerobot": lerobot_reader}[form]
    further = {"horizon": options.horizon} if form == "d4rl" else {}
    opened: Opened = stack.enter_context(reader.open_data(path, **further))
    told = opened.metadata
    # As robomimic's layout describes gymnasium's environments.
    env_args = {"env_name": told.get("dataset_id", path.stem), "type": 2, "env_kwargs": {}}
    kept = {
        key: value
        for key, value in told.items()
        if key not in _STRUCTURE and _fits_attribute(value)
    }
    if form == "minari" and "action_bounds" in told:
        kept["action_bounds"] = told["action_bounds"]
    return replace(opened, metadata={**kept, "env_args": env_args})


def _fits_attribute(value: Any) -> bool:
    """Whether a value is a number of 64 bits, a text, or a list of numbers or of texts."""
    values = value if isinstance(value, list) else [value]
    if any(isinstance(x, int) and not -(2**63) <= x < 2**63 for x in values):
        return False
    return any(all(isinstance(x, kind) for x in values) for kind in (str, int | float))


def _open_robosuite(stack: ExitStack, path: Path, task: str | None, tracking: float) -> Opened:
    if task is None:
        raise ConfigError(
            f"{path} only has simulator states; valid: --task, the task of the recorded scene"
        )
    from torchrl_bmrl.envs.robosuite_names import robosuite_metadata

    episodes = stack.enter_context(robosuite.open_episodes(path, task=task, tracking=tracking))

    def read(name: str) -> RawEpisode:
        episode = episodes[name]
        kept = {key: value for key, value in vars(episode).items() if key != "left_out"}
        return RawEpisode(**kept)

    return Opened(
        episodes=LazyEpisodes(episodes, read),
        metadata={"env_args": robosuite_metadata(task), "task": task},
        prefix="data/",
    )


def with_bounds(sources: Iterable[Source], bounds: Bounds) -> list[Source]:
    """The sources with other bounds of the actions."""
    changed = []
    for source in sources:
        kept = {key: value for key, value in source.metadata.items() if key != "action_bounds"}
        changed.append(replace(source, bounds=bounds, metadata=kept | _stated(bounds)))
    return changed


def _stated(bounds: Bounds) -> dict[str, Any]:
    """Metadata that states bounds; none for [-1, 1]."""
    if bounds == (-1.0, 1.0):
        return {}
    return {"action_bounds": {"low": bounds[0], "high": bounds[1]}}


def with_joint_range(sources: Sequence[Source]) -> list[Source]:
    """The sources, bounded by the range of all of their actions if the option ``bounds`` asks."""
    if sources[0].options.bounds != "data" or len(sources) == 1:
        return list(sources)
    try:
        return with_bounds(sources, join_bounds([source.bounds for source in sources]))
    except ConfigError:  # different sizes are reported when the episodes are read
        return list(sources)


def _equal(one: Bounds, other: Bounds) -> bool:
    """Whether bounds are equal, whether given as one number or as one for each dimension."""
    try:
        return bool(np.all(np.equal(one[0], other[0])) and np.all(np.equal(one[1], other[1])))
    except ValueError:
        return False


def joined(sources: Sequence[Source]) -> Mapping[str, Any]:
    """Metadata that several sources have in common, and their masks joined by name.

    Raises:
        ConfigError: for different bounds of the actions.
    """
    first = sources[0]
    if wrong := [source for source in sources if not _equal(source.bounds, first.bounds)]:
        raise ConfigError(
            f"the actions of {wrong[0].path} have bounds {wrong[0].bounds}, those of {first.path} "
            f"{first.bounds}; valid: equal bounds, such as bounds= for all"
        )
    metadata = {
        key: value
        for key, value in first.metadata.items()
        if all(source.metadata.get(key) == value for source in sources)
    }
    metadata.setdefault("env_args", first.metadata.get("env_args", {}))
    start = 0
    masks: dict[str, list[int]] = {}
    for source in sources:
        positions = {name: start + i for i, name in enumerate(source.episodes)}
        start += len(positions)
        for mask, chosen in source.metadata.get("masks", {}).items():
            # A mask keeps those of its episodes that are read.
            masks.setdefault(mask, []).extend(
                positions[name] for name in chosen if name in positions
            )
    return metadata | {"masks": masks}
