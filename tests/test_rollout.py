"""Episodes of a policy: one call acts in all of them, and they are those of one at a time."""

from __future__ import annotations

from contextlib import closing
from typing import Any

import pytest

pytest.importorskip("robosuite", exc_type=ImportError)
pytest.importorskip("scipy")

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.utils import RandomPolicy

from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation.rollout import evaluate_policy, rollout_episodes
from torchrl_bmrl.tasks import get_task

pytestmark = pytest.mark.robosuite


class Towards(TensorDictModuleBase):
    """Moves the end-effector to the goal, with noise of a given size; counts its calls."""

    in_keys = ("observation",)
    out_keys = ("action",)

    def __init__(self, noise: float = 0.0) -> None:
        super().__init__()
        self.noise, self.batches = noise, []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation = tensordict["observation"]
        self.batches.append(tuple(tensordict.batch_size))
        action = torch.zeros(*tensordict.batch_size, 7)
        action[..., :3] = 30 * (observation[..., -3:] - observation[..., 23:26])
        action += self.noise * torch.randn_like(action)
        return tensordict.set("action", action.clamp(-1, 1))


def test_outcomes_of_a_batch_are_those_of_one_episode_at_a_time() -> None:
    seeds, policy = [5, 1, 8, 2], Towards()
    with closing(make_env("reach")) as single, closing(make_env("reach", num_envs=2)) as batch:
        alone = evaluate_policy(single, policy, seeds, max_steps=40)
        policy.batches.clear()
        together = evaluate_policy(batch, policy, seeds, max_steps=40)
    assert together == alone
    assert len({outcome.episode_return for outcome in alone}) == 4
    assert all(outcome.success for outcome in alone)
    assert policy.batches == [(2,)] * 80  # one call a step for both


@pytest.mark.parametrize("horizon", [7, 10, 23])
def test_an_evaluation_in_pieces_has_the_outcomes_of_the_whole_episode(
    horizon: int,
) -> None:
    seeds, steps = [5, 1, 8], 25
    task = get_task("reach").with_options(horizon=horizon)
    with closing(make_env(task, num_envs=3)) as env:
        whole = rollout_episodes(env, Towards(0.3), seed=seeds, max_steps=steps)
        assert whole.batch_size == (3, horizon)
        returns = whole["next", "reward"].double().sum((1, 2)).tolist()
        policy, reported = Towards(0.3), []
        found = evaluate_policy(env, policy, seeds, max_steps=steps, report=reported.append)
    assert [outcome.episode_return for outcome in found] == returns
    assert [o.success for o in found] == whole["next", "success"].any(1).flatten().tolist()
    assert len(policy.batches) == horizon
    assert sum(reported) == 3 * horizon


def test_seeds_decide_what_the_policy_draws_and_nothing_outside_notices() -> None:
    torch.manual_seed(3)
    before = torch.get_rng_state()
    with closing(make_env("reach", num_envs=3)) as env:
        first, again, other = (
            rollout_episodes(env, Towards(0.5), seed=seed, max_steps=5)
            for seed in ([1, 2, 3], [1, 2, 3], [4, 2, 3])
        )
    assert first.batch_size == (3, 5)
    assert torch.equal(first["action"], again["action"])
    assert not torch.equal(first["action"], other["action"])
    # Episodes of the same batch draw different numbers.
    assert not torch.equal(first["action"][0, :, 6], first["action"][1, :, 6])
    assert torch.equal(torch.get_rng_state(), before)


def test_progress_counts_every_step_of_every_episode() -> None:
    steps: list[int] = []
    with closing(make_env("reach", num_envs=3)) as env:
        evaluate_policy(env, Towards(), range(6), max_steps=4, report=steps.append)
    assert sum(steps) == 6 * 4
    assert max(steps) == 3


def test_one_environment_whose_episodes_end_at_different_steps_is_refused() -> None:
    """Its other episodes would be cut off with the first one."""

    class Countdown(EnvBase):
        """Episode i ends after its i + 1 steps."""

        def __init__(self) -> None:
            super().__init__(batch_size=[2])
            self.observation_spec = Composite(observation=Unbounded((2, 1)), shape=[2])
            self.action_spec = Bounded(-1, 1, (2, 1))
            self.reward_spec = Unbounded((2, 1))

        def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
            self.left = torch.tensor([[1], [3]])
            return TensorDict({"observation": torch.zeros(2, 1)}, [2])

        def _step(self, tensordict: TensorDictBase) -> TensorDict:
            self.left = self.left - 1
            after = {"observation": torch.zeros(2, 1), "reward": torch.ones(2, 1)}
            return TensorDict(after | {"done": self.left <= 0}, [2])

        def _set_seed(self, seed: int | None) -> None: ...

    env = Countdown()
    with pytest.raises(BMRLError, match=r"1 of 2 episodes of a Countdown ended after 1 steps"):
        evaluate_policy(env, RandomPolicy(env.action_spec), [0, 1], max_steps=5)


@pytest.mark.parametrize("seeds", [[1], [1, 2, 3]])
def test_seeds_that_do_not_fill_the_environments_are_refused(seeds: list[int]) -> None:
    with (
        closing(make_env("reach", num_envs=2)) as env,
        pytest.raises(BMRLError, match=r"1 seeds for 2 environments|3 seeds for 2"),
    ):
        rollout_episodes(env, Towards(), seed=seeds, max_steps=5)
