"""Whole episodes of a policy in a TorchRL environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.batched_envs import BatchedEnvBase

from torchrl_bmrl.errors import BMRLError


@dataclass(frozen=True)
class EpisodeOutcome:
    """Return and success of one episode.

    Attributes:
        episode_return: sum of rewards up to the end of the episode.
        success: whether the task succeeded at some step (robomimic's convention); ``None`` if the
            task has no definition of success.
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
    """One episode, or one in each environment of a batch; the policy acts in all with one call.

    ``seed`` decides the starts and what the policy draws. PyTorch's global random state is left as
    it was.

    Args:
        env: environment with ``observation``, batch ``[]`` or ``[N]``.
        policy: writes ``action``.
        seed: of the episode; of each one, N of them, in a batch. The policy draws for all of them
            from one stream, so that its draws depend on the others.
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
            # Episodes end one by one; the last observation of an ended one is repeated.
            options = {"break_when_any_done": False, "break_when_all_done": True}
        else:
            start = env.reset(seed=seeds if env.batch_size else seeds[0])
        data = env.rollout(
            max_steps, policy, tensordict=start, auto_reset=False, callback=callback, **options
        )
    if report is not None:
        report(data.numel() - reported)  # TorchRL calls back between steps: not after the last
    return data


def evaluate_policy(
    env: EnvBase,
    policy: TensorDictModuleBase,
    seeds: Sequence[int],
    *,
    max_steps: int,
    report: Callable[[int], object] | None = None,
) -> list[EpisodeOutcome]:
    """Outcome of one episode per seed, in their order.

    An environment of batch size ``[N]`` plays N of them at a time.

    Args:
        env: environment with ``observation`` and perhaps ``success``, batch ``[]`` or ``[N]``.
        policy: writes ``action``.
        seeds: of the episodes; a multiple of N.
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
    for first in range(0, len(seeds), size):
        part = seeds[first : first + size]
        data = rollout_episodes(env, policy, seed=part, max_steps=max_steps, report=report)
        after = data.get("next").reshape(len(part), -1)
        done = after.get("done").squeeze(-1).long()
        playing = done.cumsum(-1) - done == 0  # up to the step that ends the episode
        returns = (after.get("reward").double().squeeze(-1) * playing).sum(-1).tolist()
        successes: list[bool | None] = [None] * len(part)
        if (success := after.get("success", None)) is not None:
            successes = (success.reshape(len(part), -1) & playing).any(-1).tolist()
        stages = after.get("stage", torch.zeros_like(done)).reshape(len(part), -1).amax(-1)
        rows = zip(returns, successes, stages.tolist(), strict=True)
        outcomes += [EpisodeOutcome(*row) for row in rows]
    return outcomes
