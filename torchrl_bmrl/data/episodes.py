"""One episode as every format's reader returns it and every writer takes it, and its TensorDict."""

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
"""Names that a part of the observation cannot have: TorchRL's layout uses them."""


@dataclass(frozen=True, kw_only=True)
class LeftOut:
    """What a file has of an episode, and the episode that was read from it has not.

    Attributes:
        steps: at its end.
        reward: their sum of rewards.
        success: whether the only successful steps are among them.
        arrays: names of what is not read, such as groups of another tool.
    """

    steps: int = 0
    reward: float = 0.0
    success: bool = False
    arrays: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode of T steps; row t of every array belongs to step t.

    It ends with its last step: terminated there, or truncated if not.

    Attributes:
        observations: named parts before each action, ``(T, ...)`` each.
        next_observations: the same parts after it.
        actions: ``(T, action_dim)``.
        rewards: ``(T,)``.
        terminated: ``(T,)`` bool; where no value follows. A horizon does not terminate.
        extras: further arrays of T rows, such as ``successes`` (bool), ``phases`` and ``states``
            (the simulator's, before each action).
        attributes: numbers, strings and lists of strings, such as ``seed`` and ``model_file``.
        left_out: what the file that it was read from has beyond that.

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
    """What an attribute ``success`` says, in any of the ways that tools write it.

    Args:
        value: a flag, its name, or a list of one of them.

    Returns:
        ``None`` where it is neither 0 nor 1.

    Example:
        >>> as_success([1.0]), as_success("False"), as_success(2)
        (True, False, None)
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
    """Episodes of a file by name, each read when it is asked for.

    Args:
        names: in the order of the file.
        read: reads the episode of a name.
    """

    def __init__(self, names: Iterable[str], read: Callable[[str], E]) -> None:
        self._names = dict.fromkeys(names)  # in order, and found at once
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
    """Why a part of the observation cannot have a name; ``None`` if it can."""
    if name in RESERVED:
        return f"valid: none of {sorted(RESERVED)}, which TorchRL's layout uses"
    # Memory-mapped tensors have it for the name of their file, and it may come from a stranger.
    length = len(name.encode(errors="surrogateescape"))
    if not 0 < length <= 240 or name.startswith(".") or "/" in name or "\\" in name:
        return "valid: a name without slashes that does not begin with a dot, of at most 240 bytes"
    return None


def as_tensordict(episode: Episode, *, number: int = 0) -> TensorDict:
    """One episode in TorchRL's layout (TED).

    Args:
        episode: of T steps; its arrays are not copied where the dtype stays.
        number: written to ``episode``.

    Returns:
        batch ``[T]``: the named parts of the observation and the same under ``"next"`` with the
        dtypes that they have, ``action`` (float32 if it is floating-point), ``("next", "reward")``
        (float32), ``("next", "done")``, ``("next", "terminated")``, ``("next", "truncated")`` and,
        where the episode has ``successes``, ``("next", "success")``, each ``(T, 1)``; ``episode``
        and ``step`` ``(T,)`` int64.

    Raises:
        BMRLError: if a part of the observation is named like one of TorchRL's keys, or like a path.

    Example:
        >>> part = np.zeros((5, 3))
        >>> data = as_tensordict(
        ...     Episode(
        ...         observations={"x": part},
        ...         next_observations={"x": part},
        ...         actions=np.zeros((5, 2)),
        ...         rewards=np.zeros(5),
        ...         terminated=np.zeros(5, bool),
        ...     )
        ... )
        >>> data["next", "truncated"].squeeze(-1).tolist()
        [False, False, False, False, True]
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
    """The observations of an episode as one sequence.

    Args:
        path: of the data set, for the message.
        name: of the episode, for the message.
        episode: of T steps, checked.

    Returns:
        the named parts, ``(T + 1, ...)``: before each action and after the last.

    Raises:
        DataError: if the observation after a step is not the one before the next step: naming
            episode, part and row.
    """
    whole = {}
    for part, before in episode.observations.items():
        after = episode.next_observations[part]
        differs = (after[:-1] != before[1:]).reshape(len(before) - 1, math.prod(before.shape[1:]))
        for row in np.flatnonzero(differs.any(axis=1)):
            raise DataError(
                path,
                f"{name}/next_obs/{part}",
                f"row {row} differs from row {row + 1} of obs; valid: one sequence, which is all "
                "that this format keeps",
            )
        whole[part] = np.concatenate([before, after[-1:]])
    return whole


def stack_episodes(episodes: Iterable[Episode], *, task: int) -> TensorDict:
    """Episodes one after the other, in TorchRL's layout.

    Args:
        episodes: of equal parts and dtypes.
        task: class index written to ``task``.

    Returns:
        batch ``[N]`` with the keys of :func:`as_tensordict` and ``task`` ``(N,)`` int64.

    Raises:
        BMRLError: without episodes, or if a part of the observation is named like one of TorchRL's
            keys, or like a path.

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
