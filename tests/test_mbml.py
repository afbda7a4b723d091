"""MBML: relabelled rewards are those of the task, and the embedding is read from the rewards."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import make_mbml_loss, reached, refused, task_transitions
from point_mass import GOALS, HELD_OUT, nearness, point_mass
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl import modules
from torchrl_bmrl.modules import embed_context, extract_network
from torchrl_bmrl.objectives import MBMLLoss, RewardModelLoss


def fit(loss: torch.nn.Module, updates: int, lr: float = 2e-3) -> None:
    optimizer = torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], lr=lr)
    for update in range(updates):
        losses = loss(point_mass(GOALS, 32, seed=update))
        optimizer.zero_grad()
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        optimizer.step()


@pytest.fixture(scope="module")
def reward_models() -> TensorDictModule:
    torch.manual_seed(0)
    loss = RewardModelLoss(modules.make_reward_models(8, 2, 2, num_models=5, num_cells=(32,)))
    fit(loss, 300, lr=5e-3)
    return extract_network(loss, "reward_models")


class Towards(nn.Module):
    """A teacher that moves to a goal; its latent is noise."""

    def __init__(self, goal: np.ndarray) -> None:
        super().__init__()
        self.goal = nn.Parameter(torch.as_tensor(goal, dtype=torch.float32))

    def forward(self, observation: Tensor, latent: Tensor) -> Tensor:
        return (self.goal - observation).clamp(-1, 1) * 0.9 + 0.05 * latent


class Near(Towards):
    """A critic that values an action by the distance to the goal that is left."""

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return -(observation + 0.5 * action - self.goal).norm(dim=-1, keepdim=True)


def make_loss(reward_models: TensorDictModule) -> MBMLLoss:
    keys = {"in_keys": ["observation", "action_latent"], "out_keys": ["action"]}
    critic_keys = {"in_keys": ["observation", "action"], "out_keys": ["state_action_value"]}
    latent = {"task_latent_dim": 4, "num_cells": (32, 32)}
    return MBMLLoss(
        modules.make_context_encoder(2, 2, 4, pooling="mean", num_features=16, num_cells=(32, 32)),
        modules.make_decoder(2, 2, 2, **latent),
        modules.make_qvalue_network(2, 2, **latent),
        [TensorDictModule(Towards(goal), **keys) for goal in GOALS],
        [TensorDictModule(Near(goal), **critic_keys) for goal in GOALS],
        reward_models,
        latent_dim=2,
        context_size=8,
    )


# -- relabelling -----------------------------------------------------------------------------------


def test_relabelled_rewards_are_those_that_the_task_gives(reward_models: TensorDictModule) -> None:
    loss = make_loss(reward_models)
    data = point_mass(GOALS, 32, seed=1000)
    rows, valid = loss._transitions(data)
    relabelled, own = loss._relabelled(data, rows, valid)
    after, mask = relabelled["next", "observation"], relabelled["mask"]
    goals = torch.as_tensor(GOALS, dtype=torch.float32)[:, None, None]
    expected = -(after - goals).norm(dim=-1)
    error = (relabelled["next", "reward"].squeeze(-1) - expected)[mask].abs()
    change = (relabelled["next", "reward"] - own["next", "reward"]).squeeze(-1)[mask].abs()
    assert mask.any()
    assert error.mean() < 0.1
    assert change.mean() > 5 * error.mean()


def test_relabelled_contexts_differ_from_the_others_in_rewards_alone() -> None:
    loss, data = make_mbml_loss(), task_transitions(3, 5)
    relabelled, own = loss._relabelled(data, *loss._transitions(data))
    for key, value in own.items(True, True):
        assert torch.equal(relabelled[key], value) == (key != ("next", "reward")), key


def test_transitions_that_the_models_disagree_on_do_not_count() -> None:
    loss, data = make_mbml_loss(max_deviation=0.0), task_transitions(3, 5)
    relabelled, _ = loss._relabelled(data, *loss._transitions(data))
    assert not relabelled["mask"].any()
    losses = loss(data)
    assert losses["loss_triplet"] == 0
    assert all(value.isfinite() for value in losses.values())


def test_padded_transitions_are_not_relabelled() -> None:
    loss, data = make_mbml_loss(), task_transitions(3, 6)
    data["collector", "mask"] = torch.tensor([True, True, False]).repeat(3, 2).unsqueeze(-1)
    rows, valid = loss._transitions(data)
    relabelled, _ = loss._relabelled(data, rows, valid)
    assert relabelled["observation"][relabelled["mask"]].any(-1).all()  # padding is zeros


def test_a_context_without_a_row_that_counts_is_in_no_triplet() -> None:
    loss, data = make_mbml_loss(context_size=2), task_transitions(3, 6)
    mask = torch.ones(3, 6, 1, dtype=torch.bool)
    mask[1, 1:] = False  # of the three contexts of this task, one has a row
    data["collector", "mask"] = mask
    found = []
    for far in (0.0, 1e6):
        points = torch.zeros(3, 9, 2, dtype=torch.float64)  # anchors, positive and negative ones
        points[1, 4:6] = far
        loss._points = lambda *_, points=points: points  # type: ignore[method-assign]
        torch.manual_seed(0)
        found.append(loss._triplet_error(data))
    assert torch.equal(*found)


def test_reward_models_are_frozen_copies() -> None:
    loss = make_mbml_loss()
    losses = loss(task_transitions(3, 5))
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    assert "reward_models" not in reached(loss)
    assert not any(p.requires_grad for p in loss.reward_models_params.parameters())


def test_the_models_of_a_task_learn_from_its_own_rows_alone() -> None:
    loss = RewardModelLoss(modules.make_reward_models(3, 3, 2, num_models=4).double())
    data = task_transitions(3, 5)
    data["collector", "mask"] = torch.tensor([True, False, True]).view(3, 1, 1).expand(3, 5, 1)
    loss(data)["loss_reward"].backward()
    for parameter in loss.parameters():
        assert parameter.grad is not None
        assert [bool(task.any()) for task in parameter.grad] == [True, False, True]


def test_an_encoder_that_does_not_read_rewards_is_refused() -> None:
    encoder = modules.make_context_encoder(3, 2, 2).double()
    encoder.in_keys = [key for key in encoder.in_keys if key[-1] != "reward"]
    loss = make_mbml_loss(edit=lambda name, x: encoder if name == "task_encoder" else x)
    with refused("valid: an encoder that also reads .*'next', 'reward'"):
        loss(task_transitions(3, 5))


# -- a family of tasks -----------------------------------------------------------------------------


def test_relabelled_contexts_bring_contexts_of_a_task_together(
    reward_models: TensorDictModule,
) -> None:
    torch.manual_seed(0)
    loss = make_loss(reward_models)
    contexts = [point_mass(GOALS, 16, seed=seed) for seed in (1000, 1001)]
    encoder = extract_network(loss, "task_encoder")
    before = nearness(*(embed_context(encoder, context) for context in contexts))
    fit(loss, 100)
    encoder = extract_network(loss, "task_encoder")
    assert nearness(*(embed_context(encoder, context) for context in contexts)) < 0.5 * before


@pytest.mark.slow
def test_the_student_finds_the_goals_of_contexts_also_of_tasks_it_was_not_trained_on(
    reward_models: TensorDictModule,
) -> None:
    torch.manual_seed(0)
    loss = make_loss(reward_models)
    loss.triplet_weight = 0.1
    fit(loss, 750, lr=4e-3)
    for goals in (GOALS, HELD_OUT):
        context = point_mass(goals, 16, seed=1000)
        latent = embed_context(extract_network(loss, "task_encoder"), context)
        state = {key: torch.zeros(len(goals), 2) for key in ("observation", "action_latent")}
        data = TensorDict(state | {"task_latent": latent}, [len(goals)])
        action = extract_network(loss, "student_generator")(data)["action"]
        direction = torch.as_tensor(goals, dtype=torch.float32)
        assert (torch.cosine_similarity(action, direction) > 0.6).all()


def test_reward_models_see_what_a_step_did_in_units_of_steps_and_rewards() -> None:
    torch.manual_seed(0)
    state, action = torch.randn(2, 500, 3), torch.rand(2, 500, 2)
    step = 0.01 * torch.randn(2, 500, 3)
    # Task i is paid for number i of the step, in large units.
    reward = 1e5 + 1e6 * torch.stack([step[i, :, i] for i in range(2)]).unsqueeze(-1)
    after = {"observation": state + step, "reward": reward}
    data = TensorDict({"observation": state, "action": action, "next": after}, [2, 500])
    models = modules.make_reward_models(2, 3, 2, num_models=2, num_cells=(32, 32), reads_next=True)
    models.module.set_scales(*data)
    torch.testing.assert_close(models.module.step_scale, step.reshape(-1, 3).std(0))
    loss = RewardModelLoss(models)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for _ in range(300):
        optimizer.zero_grad()
        value = loss(data.clone())["loss_reward"] / reward.var()
        value.backward()
        optimizer.step()
    assert value < 0.02
    blind = RewardModelLoss(modules.make_reward_models(2, 3, 2, num_models=2))
    assert ("next", "observation") not in blind.in_keys
