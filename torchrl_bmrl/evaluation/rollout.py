"""Whole episodes of a policy in a TorchRL environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from torchrl_bmrl.names import HORIZON


@dataclass(frozen=True)
class EpisodeOutcome:
    """What an episode came to.

    Attributes:
        episode_return: sum of rewards over the horizon.
        success: whether the task's definition held at some step (robomimic's convention).
    """

    episode_return: float
    success: bool


def rollout_episode(
    env: EnvBase, policy: TensorDictModuleBase, *, seed: int, max_steps: int = HORIZON
) -> TensorDictBase:
    """One episode; ``seed`` decides the start and what the policy draws.

    PyTorch's global random state is left as it was.

    Args:
        env: environment with ``observation`` and ``success``.
        policy: writes ``action``.
        seed: of the episode.
        max_steps: length.

    Returns:
        the trajectory, batch ``[T]``.
    """
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        return env.rollout(max_steps, policy, tensordict=env.reset(seed=seed), auto_reset=False)


def evaluate_policy(
    env: EnvBase, policy: TensorDictModuleBase, seeds: Sequence[int], *, max_steps: int = HORIZON
) -> list[EpisodeOutcome]:
    """Outcome of one episode per seed."""
    outcomes = []
    for seed in seeds:
        after = rollout_episode(env, policy, seed=seed, max_steps=max_steps).get("next")
        outcomes.append(
            EpisodeOutcome(
                episode_return=after.get("reward").double().sum().item(),
                success=bool(after.get("success").any()),
            )
        )
    return outcomes
