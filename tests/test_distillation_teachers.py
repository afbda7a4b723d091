"""Teachers of any kind teach, and nothing trains them."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest
import torch
from helpers import (
    LATENT_DIM,
    NO_UPDATER,
    ROWS,
    TASKS,
    make_distillation_loss,
    make_plas_loss,
    make_student_networks,
    make_teachers,
    run,
    task_transitions,
    total,
    undeclared,
)
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.modules import MLP

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import PLASPolicy, make_decoder, make_qvalue_network
from torchrl_bmrl.objectives import MetaDistillationLoss


def widened(module: TensorDictModule) -> TensorDictModule:
    """The same function as a wider network, whose additional units are always zero."""
    module = deepcopy(module)
    network = module.module if isinstance(module.module, MLP) else module.module.network
    first, last = network[0], network[2]
    for layer, name in ((first, "weight"), (first, "bias")):
        value = getattr(layer, name).data
        setattr(layer, name, nn.Parameter(torch.cat([value, torch.zeros_like(value)])))
    more = torch.randn_like(last.weight.data)
    last.weight = nn.Parameter(torch.cat([last.weight.data, more], -1))
    return module


def test_teachers_are_no_parameters_and_do_not_change() -> None:
    generators, critics = make_teachers(TASKS)
    before = [p.detach().clone() for module in (*generators, *critics) for p in module.parameters()]
    loss = make_distillation_loss(teachers=(generators, critics))
    assert not any("teacher" in name for name, _ in loss.named_parameters())
    buffers = {name: b.clone() for name, b in loss.named_buffers() if "teacher" in name}
    optimizer = torch.optim.SGD(loss.parameters(), lr=1.0)
    total(loss(task_transitions())).backward()
    optimizer.step()
    after = [p for module in (*generators, *critics) for p in module.parameters()]
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))
    assert all(p.grad is None for p in after)
    now = dict(loss.named_buffers())
    assert len(buffers) == 10  # weights and biases of two layers twice, and the decoders' bounds
    assert all(torch.equal(now[name], value) for name, value in buffers.items())


def test_teachers_are_copies() -> None:
    for wide in (False, True):  # stacked, and one after the other
        generators, critics = make_teachers(TASKS)
        if wide:
            generators[1], critics[2] = widened(generators[1]), widened(critics[2])
        loss = make_distillation_loss(teachers=(generators, critics))
        before = run(loss, task_transitions())
        for module in (*generators, *critics):
            for parameter in module.parameters():
                parameter.data.add_(1.0)
        assert (run(loss, task_transitions()) == before).all()


# -- teachers of any kind --------------------------------------------------------------------------


def test_teachers_of_different_widths_teach_as_equally_wide_ones() -> None:
    torch.manual_seed(1)
    generators, critics = make_teachers(TASKS)
    stacked = make_distillation_loss(teachers=(generators, critics))
    generators[1], critics[2] = widened(generators[1]), widened(critics[2])
    looped = make_distillation_loss(teachers=(generators, critics))
    assert stacked.teacher_generators.stacked
    assert stacked.teacher_qvalue_networks.stacked
    assert not looped.teacher_generators.stacked
    assert not looped.teacher_qvalue_networks.stacked
    results = [run(loss, task_transitions()).detach().to_dict() for loss in (stacked, looped)]
    torch.testing.assert_close(*results, rtol=1e-10, atol=0)
    fresh = make_distillation_loss(teachers=(generators, critics), seed=1)
    fresh.load_state_dict(looped.state_dict(), strict=True)
    assert (run(fresh, task_transitions()) == run(looped, task_transitions())).all()


@pytest.mark.filterwarnings(NO_UPDATER)
def test_decoders_and_critics_of_plas_are_teachers() -> None:
    experts = [make_plas_loss(seed=seed) for seed in range(TASKS)]
    decoders = [PLASPolicy.frozen(expert).decoder for expert in experts]
    critics = []
    for expert in experts:
        critic, params = expert.critic(0)
        critics.append(deepcopy(critic))
        TensorDictParams(params.data.clone()).to_module(critics[-1], preserve_module_state=False)
    loss, data = make_distillation_loss(teachers=(decoders, critics)), task_transitions()
    taught = loss.teach(data)
    for i, expert in enumerate(experts):
        observation, latent = data["observation"][i], taught["action_latent"][i]
        row = TensorDict({"observation": observation}, [ROWS])
        decoded = expert.decode(row, latent)
        torch.testing.assert_close(taught["action"][i], decoded["action"])
        value = expert.qvalue(decoded)[0]
        torch.testing.assert_close(taught["state_action_value"][i].squeeze(-1), value)
    total(loss(data)).backward()


def test_teachers_may_hold_dropout_that_no_other_network_holds() -> None:
    generators, critics = make_teachers(TASKS)
    value, data = ["state_action_value"], task_transitions()
    expected = run(make_distillation_loss(teachers=(generators, critics)), data)
    critics = [
        TensorDictSequential(critic, TensorDictModule(nn.Dropout(0.5), value, value))
        for critic in critics
    ]
    assert (run(make_distillation_loss(teachers=(generators, critics)), data) == expected).all()


# -- refusals --------------------------------------------------------------------------------------


def test_as_many_generators_as_critics_are_needed() -> None:
    generators, critics = make_teachers(TASKS)
    with pytest.raises(BMRLError, match="3 teacher_generators and 2 teacher_qvalue_networks"):
        make_distillation_loss(teachers=(generators, critics[:2]))


def test_a_teacher_of_another_action_is_refused_and_not_broadcast() -> None:
    networks = [
        make_student_networks(TASKS, torch.float64),
        [make_decoder(3, 1, LATENT_DIM).double() for _ in range(TASKS)],
        [make_qvalue_network(3, 1).double() for _ in range(TASKS)],
    ]

    def build(students: Any, generators: Any, critics: Any) -> MetaDistillationLoss:
        options = {"latent_dim": LATENT_DIM, "context": "current"}
        return MetaDistillationLoss(*students, generators, critics, **options)

    with pytest.raises(BMRLError, match=r"'action' has the size 2 in .* and 1 in a teacher"):
        build(*networks)
    # Networks that do not declare their sizes are refused at the first batch.
    loss = build(*([undeclared(x) for x in part] for part in networks))
    with pytest.raises(BMRLError, match=r"'action' has the shape \(3, 5, 1\); valid: \(3, 5, 2\)"):
        loss(task_transitions())
