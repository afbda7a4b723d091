"""Whole episodes of a policy in a TorchRL environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.names import HORIZON


@dataclass(frozen=True)
class EpisodeOutcome:
    """What an episode came to.

    Attributes:
        episode_return: sum of rewards over the horizon.
        success: whether the task's definition held at some step (robomimic's convention).
        stages: tasks of a composition that were done.

    Example:
        >>> EpisodeOutcome(episode_return=151.2, success=True)
        EpisodeOutcome(episode_return=151.2, success=True, stages=0)
    """

    episode_return: float
    success: bool
    stages: int = 0


def rollout_episodes(
    env: EnvBase,
    policy: TensorDictModuleBase,
    *,
    seed: int | Sequence[int],
    max_steps: int = HORIZON,
    report: Callable[[int], object] | None = None,
) -> TensorDictBase:
    """One episode, or one in each environment of a batch; the policy acts in all with one call.

    ``seed`` decides the starts and what the policy draws. PyTorch's global random state is left as
    it was.

    Args:
        env: environment with ``observation``, batch ``[]`` or ``[N]``.
        policy: writes ``action``.
        seed: of the episode; of each one, N of them, in a batch. The policy draws for all of them
            from one stream, so that its draws depend on the others.
        max_steps: length.
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
        start = env.reset(seed=seeds if env.batch_size else seeds[0])
        data = env.rollout(max_steps, policy, tensordict=start, auto_reset=False, callback=callback)
    if report is not None:
        report(data.numel() - reported)  # TorchRL calls back between steps: not after the last
    return data


def evaluate_policy(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seeds: Sequence[int],
    *,
    max_steps: int = HORIZON,
    report: Callable[[int], object] | None = None,
) -> list[EpisodeOutcome]:
    """Outcome of one episode per seed, in their order.

    An environment of batch size ``[N]`` plays N of them at a time.

    Args:
        env: environment with ``observation`` and ``success``, batch ``[]`` or ``[N]``.
        policy: writes ``action``.
        seeds: of the episodes; a multiple of N.
        max_steps: length of an episode.
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
    for first in range(0, len(seeds), size):
        part = seeds[first : first + size]
        after = rollout_episodes(env, policy, seed=part, max_steps=max_steps, report=report).get(
            "next"
        )
        returns = after.get("reward").double().sum((-2, -1)).reshape(-1)
        successes = after.get("success").any(-1).reshape(-1)
        stages = after.get("stage", torch.zeros_like(successes)).reshape(len(part), -1).amax(-1)
        rows = zip(returns.tolist(), successes.tolist(), stages.tolist(), strict=True)
        outcomes += [EpisodeOutcome(*row) for row in rows]
    return outcomes
