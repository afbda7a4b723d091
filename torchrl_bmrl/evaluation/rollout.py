"""Plays whole episodes of a policy in a TorchRL environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase

from torchrl_bmrl.errors import BMRLError


@dataclass(frozen=True)
class EpisodeOutcome:
    """Return and success of one episode.

    Attributes:
        episode_return: sum of the rewards.
        success: whether the task succeeded at some step (robomimic's convention); ``None`` if the
            task does not define success.
        stages: number of a composition's tasks that succeeded.

    Example:
        >>> EpisodeOutcome(episode_return=151.2, success=True)
        EpisodeOutcome(episode_return=151.2, success=True, stages=0)
    """

    episode_return: float
    success: bool | None
    stages: int = 0


def rollout_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    seed: int | Sequence[int],
    max_steps: int,
    report: Callable[[int], object] | None = None,
) -> TensorDictBase:
    """Plays one episode, or one in each environment of a batch with one policy call per step.

    ``seed`` decides the starts and the policy's random numbers. PyTorch's global random state does
    not change.

    Args:
        env: environment with ``observation``, batch ``[]`` or ``[N]``.
        policy: writes ``action``.
        seed: seed of the episode, or N seeds. All episodes share one stream of the policy's random
            numbers, which therefore depend on the batch.
        max_steps: steps after which the episodes are cut off.
        report: called after every step with the number of episodes that advanced.

    Returns:
        the trajectory, batch ``[T]`` or ``[N, T]``.

    Raises:
        BMRLError: if there are more or fewer seeds than environments.

    Example:
        >>> from torchrl.envs.utils import RandomPolicy
        >>> from torchrl_bmrl.envs.transforms import make_env
        >>> env = make_env("reach", num_envs=2)
        >>> policy = RandomPolicy(env.action_spec)
        >>> rollout_episodes(env, policy, seed=[3, 4], max_steps=5).batch_size
        torch.Size([2, 5])
    """
    seeds = [seed] if isinstance(seed, int) else list(seed)
    (data,) = _pieces(env, policy, seeds, max_steps, report, length=max_steps)
    return data


def _pieces(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seeds: list[int],
    max_steps: int,
    report: Callable[[int], object] | None,
    length: int,
) -> Iterator[TensorDictBase]:
    """Plays as :func:`rollout_episodes`, and yields the steps in pieces of some length.

    Environments whose episodes end at different steps yield one piece.
    """
    if len(seeds) != env.numel():
        raise BMRLError(f"{len(seeds)} seeds for {env.numel()} environments; valid: one for each")
    reported = 0

    def callback(*_: object) -> None:
        nonlocal reported
        if report is not None:
            reported += len(seeds)
            report(len(seeds))

    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seeds[0])
        options: dict[str, bool] = {}
        if isinstance(getattr(env, "base_env", env), BatchedEnvBase):
            start = env.reset(list_of_kwargs=[{"seed": each} for each in seeds])
            # Episodes end at different steps; a finished one repeats its last observation.
            options = {"break_when_any_done": False, "break_when_all_done": True}
            length = max_steps
        else:
            start = env.reset(seed=seeds if env.batch_size else seeds[0])
        played = 0
        while played < max_steps:
            data = env.rollout(
                min(length, max_steps - played),
                policy,
                tensordict=start,
                auto_reset=False,
                callback=callback,
                **options,
            )
            played += data.shape[-1]
            if report is not None:  # TorchRL does not call back after the last step
                report(played * len(seeds) - reported)
                reported = played * len(seeds)
            yield data
            ended = data["next", "done"][..., -1, :]
            if options or ended.all():
                return
            if ended.any():
                raise BMRLError(
                    f"{int(ended.sum())} of {len(seeds)} episodes of a {type(env).__name__} ended "
                    f"after {played} steps, before the others; valid: torchrl.envs.SerialEnv or "
                    "ParallelEnv, which go on with the others"
                )
            start = env.step_mdp(data[..., -1])


PIECE = 10
"""Steps after which an evaluation forgets all but returns and successes."""


def evaluate_policy(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seeds: Sequence[int],
    *,
    max_steps: int,
    report: Callable[[int], object] | None = None,
) -> list[EpisodeOutcome]:
    """Plays one episode per seed and returns the outcomes in the seeds' order.

    Args:
        env: environment with ``observation`` and optionally ``success``, batch ``[]`` or ``[N]``,
            which plays N episodes at a time.
        policy: writes ``action``.
        seeds: seeds of the episodes; their number is a multiple of N.
        max_steps: steps after which an episode is cut off.
        report: called after every step with the number of episodes that advanced.

    Raises:
        BMRLError: if the seeds do not fill the environments.

    Example:
        >>> from torchrl.envs.utils import RandomPolicy
        >>> from torchrl_bmrl.envs.transforms import make_env
        >>> env = make_env("reach", num_envs=2)
        >>> outcomes = evaluate_policy(env, RandomPolicy(env.action_spec), range(4), max_steps=5)
        >>> [outcome.success for outcome in outcomes]
        [False, False, False, False]
    """
    outcomes, size = [], env.numel()
    keys = ["reward", "done", "success", "stage"]
    for first in range(0, len(seeds), size):
        part = list(seeds[first : first + size])
        # A whole trajectory of 20 episodes takes hundreds of megabytes.
        pieces = [
            piece.select(*(("next", key) for key in keys), strict=False).reshape(len(part), -1)
            for piece in _pieces(env, policy, part, max_steps, report, PIECE)
        ]
        data: TensorDictBase = torch.cat(pieces, 1)
        after, playing = data.get("next"), still_playing(data)
        returns = (after.get("reward").double().squeeze(-1) * playing).sum(-1).tolist()
        successes: list[bool | None] = [None] * len(part)
        if (success := after.get("success", None)) is not None:
            successes = (success.reshape(len(part), -1) & playing).any(-1).tolist()
        stages = (
            after.get("stage", torch.zeros_like(playing, dtype=torch.int64))
            .reshape(len(part), -1)
            .amax(-1)
        )
        rows = zip(returns, successes, stages.tolist(), strict=True)
        outcomes += [EpisodeOutcome(*row) for row in rows]
    return outcomes


def still_playing(data: TensorDictBase) -> Tensor:
    """Which steps belong to their episode: those up to its end, boolean, ``(*B, T)``.

    Args:
        data: trajectories of :func:`rollout_episodes`, ``[*B, T]``; what follows the end of an
            episode before the others end is filled up.

    Example:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([False, True, True]).unsqueeze(-1)
        >>> still_playing(TensorDict({"next": {"done": done}}, [3]))
        tensor([ True,  True, False])
    """
    done = data.get(("next", "done")).squeeze(-1).long()
    return done.cumsum(-1) - done == 0
