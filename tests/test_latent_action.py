"""Acting in the task embedding: what a hold does, what it sums up, what it refuses."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import ActionScaling, EnvBase, ExplorationType, TransformedEnv, check_env_specs
from torchrl.envs import set_exploration_type as exploring

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import HeldTaskLatent, task_latent_box


class Counter(EnvBase):
    """Counts its steps in every episode and is paid each one's number; episodes end at ``ends``."""

    def __init__(self, ends: list[int]) -> None:
        super().__init__(batch_size=[len(ends)])
        shape = (len(ends), 1)
        self.ends = torch.tensor(ends).unsqueeze(-1)
        self.observation_spec = Composite(observation=Unbounded(shape), shape=self.batch_size)
        self.action_spec = Bounded(-1, 1, (len(ends), 3))
        self.reward_spec = Unbounded(shape)
        self.actions: list[torch.Tensor] = []

    def _reset(self, tensordict: TensorDictBase | None) -> TensorDictBase:
        zero = torch.zeros(*self.batch_size, 1)
        return TensorDict({"observation": zero}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.actions.append(tensordict["action"])
        count = tensordict["observation"] + 1
        done = count >= self.ends
        return TensorDict(
            {"observation": count, "reward": count.clone(), "done": done, "terminated": done},
            self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(seed or 0)


def make_policy(size: int = 2) -> TensorDictModule:
    """Shows in its action what it saw: the observation, and the first and last part of m."""
    weight = torch.eye(size)[[0, -1]]
    return TensorDictModule(
        lambda observation, m: torch.cat([observation, m @ weight.T], -1),
        in_keys=["observation", "task_latent"],
        out_keys=["action"],
    )


def held(ends: list[int], hold: int, size: int = 2) -> tuple[Counter, TransformedEnv]:
    env = Counter(ends)
    box = -2 * torch.ones(size), 3 * torch.ones(size)
    return env, TransformedEnv(env, HeldTaskLatent(make_policy(size), *box, hold=hold))


def decide(env: EnvBase, *decisions: list[float]) -> TensorDictBase:
    """The first decisions of an episode, the same in all of a batch."""
    data, steps = env.reset(), []
    for m in decisions:
        data["action"] = torch.tensor(m).expand(*env.batch_size, -1)
        data = env.step(data)
        steps.append(data)
        data = env.step_mdp(data)
    return torch.stack(steps, 1)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_m_stays_for_the_hold_and_the_policy_sees_every_step(size: int) -> None:
    env, latent = held([100, 100], hold=4, size=size)
    first, second = [0.5] * size, [-1.0] * (size - 1) + [2.0]
    decide(latent, first, second)
    seen = torch.stack(env.actions)[:, 0]
    assert seen[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 6, 7]
    assert seen[:4, 1:].tolist() == [[first[0], first[-1]]] * 4
    assert seen[4:, 1:].tolist() == [[second[0], second[-1]]] * 4


def test_a_decisions_reward_is_the_sum_of_its_steps() -> None:
    _, latent = held([100], hold=4)
    data = decide(latent, [0.0, 0.0], [0.0, 0.0])
    assert data["next", "reward"].flatten().tolist() == [1 + 2 + 3 + 4, 5 + 6 + 7 + 8]
    assert data["next", "observation"].flatten().tolist() == [4, 8]
    assert data["next", "held_steps"].flatten().tolist() == [4, 4]
    assert data["action"].shape[-1] == 2  # what the agent decided, not what was executed


def test_a_hold_ends_with_the_episode_and_the_rest_of_the_batch_goes_on() -> None:
    env, latent = held([2, 6, 100], hold=4)
    data = decide(latent, [0.0, 0.0])
    after = data["next"].squeeze(1)
    assert after["done"].flatten().tolist() == [True, False, False]
    assert after["terminated"].flatten().tolist() == [True, False, False]
    assert after["observation"].flatten().tolist() == [2, 4, 4]
    assert after["reward"].flatten().tolist() == [1 + 2, 10, 10]
    assert after["held_steps"].flatten().tolist() == [2, 4, 4]

    env, latent = held([2, 3], hold=10)
    decide(latent, [0.0, 0.0])
    assert len(env.actions) == 3  # nothing is stepped once all are over


def test_episodes_restart_one_by_one() -> None:
    _, latent = held([4, 100], hold=4)
    data = latent.rollout(3, break_when_any_done=False)
    assert data["observation"].squeeze(-1).tolist() == [[0, 0, 0], [0, 4, 8]]
    assert data["held_steps"].squeeze(-1).tolist() == [[0, 0, 0], [0, 4, 4]]


def test_the_action_is_bounded_by_the_box_and_scales_to_it() -> None:
    env, latent = held([100, 100], hold=3)
    check_env_specs(latent)
    spec = latent.action_spec
    assert spec.shape == (2, 2)
    assert (spec.space.low == -2).all()
    assert (spec.space.high == 3).all()
    scaled = latent.append_transform(ActionScaling())
    assert (scaled.action_spec.space.high == 1).all()
    env.actions.clear()
    decide(scaled, [-1.0, 1.0])
    torch.testing.assert_close(env.actions[-1][0, 1:], torch.tensor([-2.0, 3.0]))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"hold": 0}, "hold is 0; valid: at least 1"),
        ({"low": torch.ones(2)}, "the box is .*; valid: .*low below high"),
        ({"low": torch.zeros(3)}, "the box is"),
        (
            {"policy": TensorDictModule(lambda x: x, ["observation"], ["action"])},
            "the policy reads .'observation'.; valid: task_latent",
        ),
    ],
    ids=["hold", "empty box", "sizes", "policy"],
)
def test_what_cannot_be_held_is_refused(options: dict[str, Any], says: str) -> None:
    valid = {"policy": make_policy(), "low": torch.zeros(2), "high": torch.ones(2), "hold": 5}
    with pytest.raises(BMRLError, match=says):
        HeldTaskLatent(**(valid | options))


def test_an_m_of_another_size_than_the_policys_is_named_when_attached() -> None:
    transform = HeldTaskLatent(make_policy(2), torch.zeros(3), torch.ones(3), hold=5)
    with pytest.raises(BMRLError, match="does not act with an m of size 3"):
        _ = TransformedEnv(Counter([5]), transform).observation_spec


def test_the_box_leaves_out_as_many_on_either_side() -> None:
    points = torch.stack([torch.arange(101.0), -torch.arange(101.0)], -1)
    points = points[torch.randperm(101)]
    low, high = task_latent_box(points, share=0.9)
    assert (low.tolist(), high.tolist()) == ([5, -95], [95, -5])
    low, high = task_latent_box(points, share=1.0)
    assert (low.tolist(), high.tolist()) == ([0, -100], [100, 0])


@pytest.mark.parametrize("points", [torch.zeros(1, 2), torch.zeros(5, 2), torch.zeros(5)])
def test_embeddings_that_span_no_box_are_refused(points: torch.Tensor) -> None:
    with pytest.raises(BMRLError, match=r"no box|valid: \(N, m\)"):
        task_latent_box(points)
    with pytest.raises(BMRLError, match="share is 0; valid"):
        task_latent_box(torch.rand(5, 2), share=0)


@pytest.mark.parametrize("size", [2, 3])
def test_a_student_acts_with_m_of_its_own_size(size: int) -> None:
    pytest.importorskip("safetensors")
    from torchrl_bmrl.pipeline.student import Student

    student = Student(
        num_tasks=2, task_latent_dim=size, num_cells=(8,), observation_dim=1, action_dim=3
    )
    # latent_dim is the default student's; any will do
    policy = student.policy(num_candidates=3, latent_clip=0.5)
    transform = HeldTaskLatent(policy, -torch.ones(size), torch.ones(size), hold=3)
    env = TransformedEnv(Counter([5, 5]), transform)
    with exploring(ExplorationType.DETERMINISTIC):
        data = env.rollout(2)
    assert data["action"].shape == (2, 2, size)
    wrong = HeldTaskLatent(policy, -torch.ones(size + 1), torch.ones(size + 1), hold=3)
    with pytest.raises(BMRLError, match=f"an m of size {size + 1}"):
        _ = TransformedEnv(Counter([5, 5]), wrong).observation_spec
