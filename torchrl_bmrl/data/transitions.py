"""Functions that add to, or select from, the transitions of whole episodes."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from torchrl_bmrl.data.n_step import check_single_steps, episode_ends
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.checks import check_number
from torchrl_bmrl.objectives.data import missing, next_key


def with_next_action(data: TensorDictBase, action_key: NestedKey = "action") -> TensorDictBase:
    """Adds to each transition the next action of its episode, under ``("next", action_key)``.

    The last transition of an episode has no next action. If it is a termination, it stays, with its
    own action as the next one: no target reads it, because there is no next value. Otherwise
    (a truncation, or the end of the data) its target would need the missing action, so the
    transition is left out. Its observation stays as the next one of the transition before it, which
    is marked as done and truncated: the episode is cut off there now.

    Args:
        data: transitions of one step in order of time, ``[N]``, with ``("next", "done")`` and,
            where there are terminations, ``("next", "terminated")``, ``(N, 1)``. Episodes end as
            for :class:`NStep`.
        action_key: the action, ``(N, action_dim)``.

    Returns:
        a copy, ``[M]``, with at most N transitions.

    Raises:
        BMRLError: for data of another batch size, of n steps, without action or flags, or in which
            no transition has a next action.

    Example:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([[False], [True], [False], [True]])
        >>> terminated = torch.tensor([[False], [True], [False], [False]])
        >>> after = TensorDict({"done": done, "terminated": terminated}, [4])
        >>> action = torch.arange(4.0).unsqueeze(-1)
        >>> data = with_next_action(TensorDict({"action": action, "next": after}, [4]))
        >>> data["action"].flatten().tolist(), data["next", "action"].flatten().tolist()
        ([0.0, 1.0, 2.0], [1.0, 1.0, 3.0])
    """
    if data.batch_dims != 1 or not len(data):
        size = list(data.batch_size)
        raise BMRLError(f"the data have the batch size {size}; valid: [N] with N >= 1")
    check_single_steps(data)
    action = data.get(action_key, None)
    if action is None:
        raise missing(data, action_key)
    last = episode_ends(data)
    last[-1] = True
    terminated = data.get(("next", "terminated"), None)
    kept = ~last if terminated is None else ~last | terminated[:, 0]
    if not kept.any():
        raise BMRLError("no transition has a next action; valid: episodes of two steps or more")
    rows = torch.arange(len(data), device=action.device)
    data = data.copy()
    data.set(next_key(action_key), action[rows + (~last).to(rows)])
    cut = torch.zeros_like(kept)
    cut[:-1] = ~last[:-1] & ~kept[1:]
    for key in (("next", "done"), ("next", "truncated")):
        if (flag := data.get(key, None)) is not None:
            data.set(key, flag | cut.unsqueeze(-1))
    return data[kept]


def best_episodes(data: TensorDictBase, share: float = 0.1) -> TensorDictBase:
    """Selects the episodes with the largest returns, for filtered behaviour cloning.

    Reference: Chen et al., *Decision Transformer*, NeurIPS 2021, https://arxiv.org/abs/2106.01345,
    whose baseline %BC clones the best episodes.

    Args:
        data: transitions of one step, ``[N]``, with ``episode (N,)`` and ``("next", "reward")
            (N, 1)``. Number the episodes of several data sets first
            (:func:`torchrl_bmrl.data.replay.number_episodes`).
        share: share of the episodes to select; at least one is. Of equal returns the earlier
            episodes are selected.

    Returns:
        their transitions, in the order of the data.

    Raises:
        BMRLError: for a share outside [0, 1], data of n steps, or without ``episode`` or reward,
            and if a ``step`` occurs twice in an episode, as after ``torch.cat`` of two data sets.

    Example:
        >>> from tensordict import TensorDict
        >>> after = TensorDict({"reward": torch.tensor([[1.0], [1.0], [5.0]])}, [3])
        >>> data = TensorDict({"episode": torch.tensor([0, 0, 1]), "next": after}, [3])
        >>> best_episodes(data, share=0.5)["episode"].tolist()
        [1]
    """
    share = check_number("share", share, 0.0, 1.0)
    check_single_steps(data)  # sums of n rewards would count a reward up to n times
    for key in ("episode", ("next", "reward")):
        if data.get(key, None) is None:
            raise missing(data, key)
    episodes, index = data["episode"].reshape(-1).unique(return_inverse=True)
    if (step := data.get("step", None)) is not None:
        size = int(step.max()) + 1
        places, counts = (index * size + step.reshape(-1)).unique(return_counts=True)
        if (counts > 1).any():
            number, at = divmod(int(places[counts.argmax()]), size)
            raise BMRLError(
                f"episode {int(episodes[number])} has step {at} {int(counts.max())} times; valid: "
                "one number for each episode, as torchrl_bmrl.data.replay.number_episodes gives"
            )
    returns = torch.zeros(len(episodes), dtype=torch.float64, device=index.device)
    returns.index_add_(0, index, data["next", "reward"].reshape(-1).double())
    number = max(1, round(share * len(episodes)))
    best = returns.argsort(descending=True, stable=True)[:number]
    return data[torch.isin(index, best)]
