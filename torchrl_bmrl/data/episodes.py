"""The episode that all readers return and all writers take, and its TensorDict."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_bmrl.errors import BMRLError, DataError

RESERVED = frozenset(
    (
        *("action", "task", "episode", "step", "next"),
        *("reward", "done", "terminated", "truncated", "success"),
        *("index", "mask"),
    )
)
"""Names that TorchRL's layout uses and a part of the observation cannot have."""


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """The content of a file's episode that was not read.

    Attributes:
        steps: number of steps left out at the end.
        reward: sum of their rewards.
        success: whether all successful steps are among them.
        arrays: names of arrays and groups that are not read, such as those of other tools.
    """

    steps: int = 0
    reward: float = 0.0
    success: bool = False
    arrays: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode of T steps; row t of every array belongs to step t.

    The last step either terminates or is truncated.

    Attributes:
        observations: named parts before each action, ``(T, ...)`` each.
        next_observations: the same parts after it.
        actions: ``(T, action_dim)``.
        rewards: ``(T,)``.
        terminated: ``(T,)`` bool; true if no value follows. A horizon does not terminate.
        extras: further arrays of T rows, such as ``successes`` (bool), ``phases`` and ``states``
            (the simulator's, before each action).
        attributes: numbers, strings and lists of strings, such as ``seed`` and ``model_file``.
        left_out: content of its file that was not read.

    Example:
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.zeros(5)
        >>> episode = Episode(
        ...     observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 0
        ... )
        >>> len(episode)
        5
    """

    observations: Mapping[str, np.ndarray]
    next_observations: Mapping[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    extras: Mapping[str, np.ndarray] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)
    left_out: LeftOut = LeftOut()

    def __len__(self) -> int:
        return len(self.actions)

    @property
    def succeeded(self) -> bool | None:
        """Whether the task was solved at some step; ``None`` if that is not known."""
        if "successes" in self.extras:
            return bool(np.any(self.extras["successes"]))
        return as_success(self.attributes.get("success"))


def as_success(value: Any) -> bool | None:
    """Interprets an attribute ``success`` in any of the forms that tools write.

    Args:
        value: a flag, its name, or a list of one of them.

    Returns:
        ``None`` for other values than 0 and 1.
    """
    if isinstance(value, list) and len(value) == 1:
        value = value[0]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, str):
        value = {"true": True, "false": False}.get(value.lower())
    return bool(value) if isinstance(value, bool | int | float) and value in (0, 1) else None


E = TypeVar("E")


class LazyEpisodes(Mapping[str, E], Generic[E]):
    """Episodes of a file by name; each is read on access.

    Args:
        names: in the order of the file.
        read: reads the episode of a name.
    """

    def __init__(self, names: Iterable[str], read: Callable[[str], E]) -> None:
        self._names = dict.fromkeys(names)  # ordered, with fast lookup
        self._read = read

    def __getitem__(self, name: str) -> E:
        if name not in self._names:
            raise KeyError(name)
        return self._read(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def name_fault(name: str) -> str | None:
    """Message that explains why a part cannot have a name; ``None`` if it can."""
    if name in RESERVED:
        return f"valid: none of {sorted(RESERVED)}, which TorchRL's layout uses"
    # It becomes the name of a memory-mapped file, and may come from an untrusted source.
    length = len(name.encode(errors="surrogateescape"))
    if not 0 < length <= 240 or name.startswith(".") or "/" in name or "\\" in name:
        return "valid: a name without slashes that does not begin with a dot, of at most 240 bytes"
    return None


def as_tensordict(episode: Episode, *, number: int = 0) -> TensorDict:
    """Converts one episode to TorchRL's layout (TED).

    Args:
        episode: of T steps; arrays whose dtype stays are not copied.
        number: of the episode, stored under ``episode``.

    Returns:
        batch ``[T]``: the parts of the observation, also under ``"next"``, with their dtypes;
        ``action`` (float32 if it is floating-point); ``("next", "reward")`` (float32),
        ``("next", "done")``, ``("next", "terminated")``, ``("next", "truncated")`` and, if the
        episode has ``successes``, ``("next", "success")``, each ``(T, 1)``; ``episode`` and
        ``step`` ``(T,)`` int64.

    Raises:
        BMRLError: for a part of the observation with an invalid name (:func:`name_fault`).
    """
    for name in episode.observations:
        if fault := name_fault(name):
            raise BMRLError(f"a part of the observation is named {name!r}; {fault}")
    steps = len(episode)
    action = torch.as_tensor(episode.actions)
    terminated = torch.as_tensor(episode.terminated, dtype=torch.bool).unsqueeze(-1)
    last = (torch.arange(steps) == steps - 1).unsqueeze(-1)
    after = {
        "reward": torch.as_tensor(episode.rewards, dtype=torch.float32).unsqueeze(-1),
        "done": last,
        "terminated": terminated,
        "truncated": last & ~terminated,
    }
    if "successes" in episode.extras:
        successes = torch.as_tensor(episode.extras["successes"])
        after["success"] = successes.bool().unsqueeze(-1)
    return TensorDict(
        {
            **{name: torch.as_tensor(part) for name, part in episode.observations.items()},
            "action": action.float() if action.is_floating_point() else action,
            "episode": torch.full((steps,), number),
            "step": torch.arange(steps),
            "next": {
                **{name: torch.as_tensor(part) for name, part in episode.next_observations.items()},
                **after,
            },
        },
        batch_size=[steps],
    )


def join_observations(path: Path, name: str, episode: Episode) -> dict[str, np.ndarray]:
    """Joins the observations of an episode to one sequence.

    Args:
        path: of the data set, for the message.
        name: of the episode, for the message.
        episode: of T steps, checked.

    Returns:
        the parts, ``(T + 1, ...)``: before each action and after the last.

    Raises:
        DataError: naming episode, part and row, if the observation after a step differs from the
            one before the next step.
    """
    whole = {}
    for part, before in episode.observations.items():
        after = episode.next_observations[part]
        differs = (after[:-1] != before[1:]).reshape(len(before) - 1, math.prod(before.shape[1:]))
        for row in np.flatnonzero(differs.any(axis=1)):
            raise DataError(
                path,
                f"{name}/next_obs/{part}",
                f"row {row} differs from row {row + 1} of obs; valid: one sequence, because "
                "this format stores each observation once",
            )
        whole[part] = np.concatenate([before, after[-1:]])
    return whole


def stack_episodes(episodes: Iterable[Episode], *, task: int) -> TensorDict:
    """Concatenates episodes in TorchRL's layout.

    Args:
        episodes: with equal parts and dtypes.
        task: class index, stored under ``task``.

    Returns:
        batch ``[N]`` with the keys of :func:`as_tensordict` and ``task`` ``(N,)`` int64.

    Raises:
        BMRLError: without episodes, or for a part of the observation with an invalid name.

    Example:
        >>> x, a, r = {"x": np.zeros((5, 3))}, np.zeros((5, 2)), np.zeros(5)
        >>> episode = Episode(
        ...     observations=x, next_observations=x, actions=a, rewards=r, terminated=r > 0
        ... )
        >>> data = stack_episodes([episode, episode], task=1)
        >>> data.batch_size, data["episode"].unique().tolist()
        (torch.Size([10]), [0, 1])
    """
    parts = [as_tensordict(episode, number=i) for i, episode in enumerate(episodes)]
    if not parts:
        raise BMRLError("no episodes; valid: at least one")
    data = TensorDict.cat(parts, dim=0)
    return data.set("task", torch.full((len(data),), task))
