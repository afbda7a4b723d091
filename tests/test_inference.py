"""The encoder that tells the task from any behaviour: its loss and its contexts."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("tqdm")
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import as_context, make_context_encoder, make_task_encoder
from torchrl_bmrl.objectives import ContextInferenceLoss
from torchrl_bmrl.pipeline.context_data import ContextSampler
from torchrl_bmrl.pipeline.student import Student

POINTS = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])


def transitions(*batch: int, goal: float = 0.0) -> TensorDict:
    """Random motion; the reward alone depends on the goal."""
    state, action = torch.randn(*batch, 3), torch.rand(*batch, 2) * 2 - 1
    after = {"observation": state + 0.1, "reward": action[..., :1] * goal}
    data = {"observation": state, "action": action, "next": after}
    return TensorDict(data, batch_size=list(batch))


def contexts(size: int = 12) -> TensorDictBase:
    rows = [transitions(4, size, goal=goal) for goal in (-1.0, 1.0, 2.0)]
    return as_context(torch.stack(rows))


def make_loss(**options) -> ContextInferenceLoss:
    torch.manual_seed(0)
    encoder = make_context_encoder(3, 2, 2, num_features=16, num_cells=(32,))
    return ContextInferenceLoss(encoder, POINTS, **options)


def test_the_loss_is_the_squared_distance_to_the_tasks_points_over_their_spread():
    loss, data = make_loss(), contexts()
    made = loss.context_encoder(data.copy())["task_latent"]
    error = (made - POINTS[:, None]).square().sum(-1)
    spread = (POINTS - POINTS.mean(0)).square().sum(-1).mean()
    assert torch.allclose(loss(data)["loss_inference"], error.mean() / spread)
    assert torch.allclose(data["td_error"], (error / spread).detach())


def test_an_encoder_learns_to_tell_the_task_from_rewards_alone():
    loss = make_loss()
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for _ in range(300):
        optimizer.zero_grad()
        loss(contexts())["loss_inference"].backward()
        optimizer.step()
    assert loss(contexts())["accuracy"] > 0.9


def test_the_points_are_constants_and_saved():
    loss = make_loss()
    assert "task_latents" in loss.state_dict()
    assert not any(param is loss.task_latents for param in loss.parameters())


def test_each_context_has_its_own_loss_without_a_reduction():
    loss = make_loss(reduction="none")
    assert loss(contexts())["loss_inference"].shape == (3, 4)


def test_a_context_that_does_not_count_affects_no_number_and_no_gradient():
    rows, counts = contexts(), torch.ones(3, 4, dtype=torch.bool)
    counts[1, 2] = False
    results = []
    for value in (0.0, float("nan")):
        data = rows.clone()
        data["collector", "mask"] = counts
        data["context", "observation"][1, 2] = value
        loss = make_loss()
        result = loss(data)
        result["loss_inference"].backward()
        gradient = torch.cat([p.grad.flatten() for p in loss.parameters() if p.grad is not None])
        results.append((result["loss_inference"].detach(), result["accuracy"], gradient))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))
    assert results[0][2].any()


def test_what_does_not_fit_is_refused():
    with pytest.raises(BMRLError, match="valid: an encoder of sets"):
        ContextInferenceLoss(make_task_encoder(3, 2), POINTS)
    with pytest.raises(BMRLError, match=r"valid: \(num_tasks, m\)"):
        ContextInferenceLoss(make_context_encoder(3, 2, 2), POINTS[0])
    with pytest.raises(BMRLError, match=r"valid: \[3, C\]"):
        make_loss()(contexts()[:2])
    with pytest.raises(BMRLError, match="task_latent"):
        ContextInferenceLoss(make_context_encoder(3, 2, 5), POINTS)(contexts())


def episodes(task: int, behaviour: int) -> TensorDict:
    """Three episodes of 2, 3 and 4 steps; the reward names task, behaviour and episode."""
    data = transitions(9)
    data["episode"] = torch.tensor([0, 0, 1, 1, 1, 2, 2, 2, 2])
    data["next", "reward"] = (100.0 * task + 10 * behaviour + data["episode"]).unsqueeze(-1)
    return data


def test_a_context_is_of_one_task_and_one_behaviour():
    torch.manual_seed(0)
    own, others = ([episodes(i, kind) for i in range(4)] for kind in (1, 2))
    sample = ContextSampler(own, others, size=6)
    single = []
    for _ in range(40):
        reward = sample()["context", "next", "reward"].squeeze(-1)
        assert reward.shape == (4, 3, 6)
        for task in range(4):
            assert torch.equal(reward[task] // 100, torch.full((3, 6), float(task)))
            behaviour = reward[task] % 100 // 10
            assert torch.equal(behaviour[0], torch.ones(6))
            assert torch.equal(behaviour[1:], torch.full((2, 6), 2.0))
        single.append((reward == reward[..., :1]).all(-1).float().mean())
    assert 0.5 < torch.stack(single).mean() < 0.9  # most contexts are of one episode


class Rewards(torch.nn.Module):
    """The reward of task i is 1000 i plus what the motion says."""

    def forward(self, observation, action):
        task = torch.arange(len(action)).reshape(-1, 1, 1)
        return (1000.0 * task + action[..., :1]).expand(*action.shape[:2], 2)


def test_contexts_of_other_behaviour_are_often_other_tasks_with_the_own_task_s_rewards():
    torch.manual_seed(0)
    own, others = ([episodes(i, kind) for i in range(4)] for kind in (1, 2))
    models = TensorDictModule(Rewards(), ["observation", "action"], ["reward_prediction"])
    sample = ContextSampler(own, others, size=6, reward_models=models)
    lent, lenders = [], set()
    for _ in range(60):
        context = sample()["context"]
        reward = context["next", "reward"].squeeze(-1)
        action = context["action"][..., 0]
        for task in range(4):
            recorded = others[task]["action"][:, 0]
            assert torch.equal(reward[task, 0] // 10, torch.full((6,), 10.0 * task + 1))
            for k in (1, 2):
                relabelled = torch.isclose(reward[task, k], 1000 * task + action[task, k]).all()
                kept = (reward[task, k] // 10 == 10 * task + 2).all()
                assert relabelled != kept
                lent.append(float(relabelled))
                if kept:
                    assert torch.isin(action[task, k], recorded).all()
                else:
                    lenders |= {
                        (task, i)
                        for i in range(4)
                        if torch.isin(action[task, k], others[i]["action"][:, 0]).all()
                    }
    assert 0.6 < sum(lent) / len(lent) < 0.8
    assert len(lenders) == 16  # each task lends to each


def test_contexts_have_few_transitions_and_many_and_never_none():
    torch.manual_seed(0)
    data = [episodes(i, 1) for i in range(2)]
    sample = ContextSampler(data, data, size=8)
    counts = torch.cat([sample()["context", "mask"].sum(-1).flatten() for _ in range(100)])
    assert counts.min() == 1
    assert counts.max() == 8


def test_a_student_infers_with_its_second_encoder_if_it_has_one():
    sizes = {"num_tasks": 3, "observation_dim": 3, "action_dim": 2, "num_cells": (8,)}
    data = transitions(5)
    plain = Student(task_encoder="set_mean", **sizes)
    assert torch.equal(plain.infer(data), plain.embed_context(data))
    both = Student(task_encoder="set_mean", infers=True, **sizes)
    assert not torch.equal(both.infer(data), both.embed_context(data))
    assert both.infer(data).shape == both.embed_context(data).shape


def test_scales_are_those_of_rewards_and_steps():
    student = Student(
        num_tasks=3, observation_dim=3, action_dim=2, task_encoder="set_attention", infers=True
    )
    data = transitions(50)
    data["next", "observation"] = data["observation"] + torch.randn(50, 3) * torch.tensor(
        [0.1, 2.0, 0.0]
    )
    data["next", "reward"] = 5 + 3 * torch.randn(50, 1)
    student.set_scales(data[:20], data[20:])
    for encoder in (student.task_encoder, student.context_encoder):
        network = encoder.module
        assert torch.allclose(network.step_scale, torch.tensor([0.1, 2.0, 1.0]), rtol=0.4)
        assert abs(network.reward_loc.item() - 5) < 2
        assert abs(network.reward_scale.item() - 3) < 1


def test_what_tells_tasks_apart_before_anything_is_done_is_not_read():
    torch.manual_seed(0)
    student = Student(
        num_tasks=3, observation_dim=3, action_dim=2, task_encoder="set_attention", infers=True
    )
    tasks = [transitions(30) for _ in range(3)]
    for i, data in enumerate(tasks):
        data["step"] = torch.arange(30) % 10
        data["observation"][::10, 1] = float(i)  # and later anything
        data["observation"][::10, 2] = 5.0  # equal everywhere
    student.set_scales(*tasks)
    other, moved = tasks[0].clone(), tasks[0].clone()
    for key in ("observation", ("next", "observation")):
        other[key][:, 1] += 2.0
        moved[key][:, 0] += 1.0
    for encoder, m in (
        (student.task_encoder, student.embed_context),
        (student.context_encoder, student.infer),
    ):
        assert encoder.module.read.tolist() == [1, 0, 1]
        torch.testing.assert_close(m(other), m(tasks[0]))  # the steps are rounded
        assert not torch.equal(m(moved), m(tasks[0]))
    for rest in ([tasks[0]], [data.exclude("step") for data in tasks]):  # nothing is told apart
        student.set_scales(*rest)
        assert student.task_encoder.module.read.tolist() == [1, 1, 1]


def test_an_encoder_of_an_earlier_version_reads_everything():
    encoder = make_context_encoder(3, 2, 4)
    state = {name: x for name, x in encoder.state_dict().items() if not name.endswith("read")}
    encoder.module.read.zero_()
    encoder.load_state_dict(state)
    assert encoder.module.read.tolist() == [1, 1, 1]
