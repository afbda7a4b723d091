"""Rows of the distillation between two tasks: m, the teachers' actions and their values."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import (
    TASKS,
    make_distillation_loss,
    make_teachers,
    run,
    task_transitions,
)
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import make_decoder, make_qvalue_network, make_told_encoder
from torchrl_bmrl.objectives import MetaDistillationLoss
from torchrl_bmrl.objectives.lessons import Mix, draw_mix

SCALE = torch.arange(1.0, TASKS + 1)


def test_both_teachers_answer_for_the_same_state_and_latent() -> None:
    generators, critics = make_teachers(TASKS)
    loss = make_distillation_loss(
        teachers=(generators, critics), qvalue_loc=-SCALE, qvalue_scale=SCALE
    )
    data = task_transitions()
    partner = torch.tensor([(i + 2) % TASKS for i in range(TASKS)])
    share = torch.rand(*data.batch_size, 1, dtype=torch.float64)
    taught = loss.teach(data, Mix(partner, share))
    for i in range(TASKS):
        answers = []
        for j in (i, int(partner[i])):
            asked = taught[i].select("observation", "action_latent")
            answer = critics[j](generators[j](asked))
            value = (answer["state_action_value"] + SCALE[j]) / SCALE[j]
            answers.append((answer["action"], value))
        for key, own, other in zip(("action", "state_action_value"), *answers, strict=True):
            torch.testing.assert_close(taught[key][i], torch.lerp(own, other, share[i]))


@pytest.mark.parametrize("fraction", [0.3, 1.0])
def test_a_fraction_of_the_rows_is_mixed_with_another_task(fraction: float) -> None:
    torch.manual_seed(0)
    latent = torch.arange(4.0).reshape(4, 1, 1).expand(4, 500, 1)
    partners = set()
    for _ in range(30):
        mix = draw_mix(latent, None, fraction)
        assert sorted(mix.partner.tolist()) == [0, 1, 2, 3]
        assert (mix.partner != torch.arange(4)).all()
        partners |= set(enumerate(mix.partner.tolist()))
        mixed = mix.share > 0
        assert mixed.float().mean() == pytest.approx(fraction, abs=0.05)
        assert mix.share[mixed].mean() == pytest.approx(0.5, abs=0.05)
        own, other = latent, latent[mix.partner]
        torch.testing.assert_close(mix.between(latent), own + mix.share * (other - own))
    assert len(partners) == 12  # every pair


def test_a_row_is_not_mixed_with_one_that_does_not_count() -> None:
    torch.manual_seed(0)
    valid = torch.rand(4, 50) < 0.5
    for _ in range(10):
        mix = draw_mix(torch.zeros(4, 50, 2), valid, 1.0)
        assert torch.equal(mix.share.squeeze(-1) > 0, valid[mix.partner])


def test_classifier_and_penalty_read_the_task_s_own_m() -> None:
    data = task_transitions()
    options: dict[str, Any] = {"context": "current", "reduction": "none"}
    plain = make_distillation_loss(**options)(data.clone())
    mixed = make_distillation_loss(**options, mixing_fraction=1.0)(data.clone())
    for name in ("loss_classification", "loss_latent_norm", "accuracy"):
        assert torch.equal(plain[name], mixed[name])
    for name in ("loss_generator", "loss_direction", "loss_qvalue"):
        assert not torch.isclose(plain[name], mixed[name]).any()


def test_no_row_is_mixed_by_default() -> None:
    data = task_transitions()
    default = run(make_distillation_loss(), data.clone())
    assert (run(make_distillation_loss(mixing_fraction=0.0), data.clone()) == default).all()


def test_the_advantage_term_compares_mixed_values_with_mixed_values() -> None:
    data = task_transitions()
    loss = make_distillation_loss(
        advantage_weight=1.0, context="current", mixing_fraction=1.0, reduction="none"
    )
    asked, original = [], loss.teach

    def teach(tensordict: TensorDictBase, mix: Mix | None = None) -> TensorDictBase:
        asked.append(mix)
        return original(tensordict, mix)

    loss.teach = teach
    loss(data)
    assert len(asked) == 2
    assert asked[0] is asked[1] is not None


def test_what_is_no_share_is_refused_and_one_task_has_no_other() -> None:
    for fraction in (-0.1, 1.1):
        with pytest.raises(BMRLError, match=r"mixing_fraction is .*; valid: "):
            make_distillation_loss(mixing_fraction=fraction)
    with pytest.raises(BMRLError, match="mixing_fraction need at least two tasks"):
        make_distillation_loss(num_tasks=1, mixing_fraction=0.5)


class Constant(nn.Module):
    """A decoder of one action."""

    def __init__(self, action: float) -> None:
        super().__init__()
        self.action = nn.Parameter(torch.tensor([action]))

    def forward(self, observation: Tensor, latent: Tensor) -> Tensor:
        return self.action.expand(*observation.shape[:-1], 1)


def error_between(fraction: float) -> float:
    """Distance of a student's actions between two tasks from those between its teachers'."""
    torch.manual_seed(0)
    keys = (["observation", "action_latent"], ["action"])
    codes, actions = torch.tensor([[-5.0], [5.0]]), (-0.9, 0.9)
    loss = MetaDistillationLoss(
        make_told_encoder(codes),
        None,
        make_decoder(2, 1, 1, task_latent_dim=1, num_cells=(32, 32)),
        make_qvalue_network(2, 1, task_latent_dim=1, num_cells=(8,)),
        [TensorDictModule(Constant(action), *keys) for action in actions],
        [make_qvalue_network(2, 1, num_cells=(8,)) for _ in actions],
        latent_dim=1,
        context="current",
        mixing_fraction=fraction,
    )
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for _ in range(500):
        state = torch.randn(2, 32, 2)
        after = {"observation": state, "reward": torch.zeros(2, 32, 1)}
        data = {"observation": state, "action": torch.zeros(2, 32, 1), "next": after}
        data["task"] = torch.arange(2).unsqueeze(-1).expand(2, 32)
        losses = loss(TensorDict(data, [2, 32]))
        optimizer.zero_grad()
        losses["loss_generator"].backward()
        optimizer.step()
    share = torch.linspace(0, 1, 200).unsqueeze(-1)
    given = {"task_latent": torch.lerp(*codes, share), "observation": torch.randn(200, 2)}
    given["action_latent"] = torch.randn(200, 1)
    action = loss.get_stateful_net("student_generator")(TensorDict(given, [200]))["action"]
    return (action - 0.9 * (2 * share - 1)).abs().mean().item()


def test_a_student_does_between_two_tasks_what_lies_between_its_teachers() -> None:
    mixed, plain = error_between(0.7), error_between(0.0)
    assert mixed < 0.05
    assert mixed < plain / 2


@pytest.mark.parametrize(("apart", "says"), [(0.0, False), (1.0, True)])
def test_stage_2_warns_if_the_agents_do_not_know_the_states_they_are_asked_in(
    apart: float, says: bool, caplog: pytest.LogCaptureFixture
) -> None:
    for extra in ("h5py", "safetensors", "yaml"):
        pytest.importorskip(extra)
    from torchrl_bmrl.pipeline.stage2 import warn_of_marks

    tasks = []
    for number in range(3):
        observation = torch.randn(40, 4)
        observation[:, 2] = 0.01 * torch.randn(40) + apart * number  # where the object lies
        step = torch.arange(40) % 5
        tasks.append(TensorDict({"observation": observation, "step": step}, [40]))
    warn_of_marks(tasks)
    assert ("1 of 4 numbers of the observation differ between the tasks" in caplog.text) == says
    assert bool(caplog.records) == says
