"""How several critics value an action in the target and in the policy."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import (
    BOUNDS,
    DIMS,
    NO_UPDATER,
    OBSERVATION_DIM,
    make_critics,
    make_distillation_loss,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_bmrl.errors import UnknownNameError
from torchrl_bmrl.modules import (
    ActionVAE,
    BCQPolicy,
    EnsembleCritic,
    make_perturbation_network,
    make_qvalue_network,
)
from torchrl_bmrl.objectives import BCQLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
RULES = {"mean": lambda q: q.mean(0), "min": lambda q: q.amin(0), "first": lambda q: q[0]}
each = pytest.mark.parametrize("rule", RULES)
STACKED = pytest.mark.parametrize("alike", [True, False], ids=["alike", "different"])


def agent(rule: str, *, alike: bool = True, perturbation: bool = False, **options: Any) -> BCQLoss:
    """A BCQ loss with three critics, of one structure or of two, and other targets."""
    torch.manual_seed(0)
    widths = [(8,)] * 3 if alike else [(8,), (8,), (9, 7)]
    critics = [make_qvalue_network(*DIMS, num_cells=width).double() for width in widths]
    change = make_perturbation_network(*DIMS, num_cells=(8,)).double() if perturbation else None
    loss = BCQLoss(
        ActionVAE(*DIMS, num_cells=(8,)).double(),
        critics,
        change,
        **BOUNDS,
        acting_rule=rule,
        latent_clip=None,
        **options,
    )
    for target in loss.target_qvalue_network_params.values(True, True):
        target.data.mul_(1.2)
    return loss


def states(number: int = 6) -> TensorDict:
    observation = torch.randn(number, OBSERVATION_DIM, dtype=torch.float64)
    return TensorDict({"observation": observation}, [number])


@STACKED
@each
def test_a_policy_chooses_by_the_rule_of_its_loss(rule: str, alike: bool) -> None:
    loss, state = agent(rule, alike=alike), states(64)
    torch.manual_seed(1)
    proposals = loss.propose(state, 8)
    best = RULES[rule](loss.qvalue(proposals)).argmax(-1)
    expected = proposals["action"][torch.arange(64), best]
    for make in (BCQPolicy.live, BCQPolicy.frozen):
        torch.manual_seed(1)
        torch.testing.assert_close(make(loss, num_candidates=8)(state)["action"], expected)


def test_the_rules_choose_differently() -> None:
    """Otherwise the test above would pass for any of them."""
    loss, state = agent("mean"), states(64)
    values = loss.qvalue(loss.propose(state, 8))
    chosen = [RULES[rule](values).argmax(-1) for rule in RULES]
    assert all((a != b).any() for a in chosen for b in chosen if a is not b)


@pytest.mark.parametrize("rule", ["clipped", "mean"])
def test_the_target_s_value_of_the_next_state_follows_its_own_rule(rule: str) -> None:
    loss, data = agent("first", target_rule=rule, num_candidates=5), transitions(8)
    torch.manual_seed(1)
    _, metrics = loss.qvalue_loss(data)
    torch.manual_seed(1)
    after = data["next"].select("observation")
    q = loss.qvalue(loss.propose(after, 5), target=True)
    value = q.mean(0) if rule == "mean" else 0.75 * q.amin(0) + 0.25 * q.amax(0)
    torch.testing.assert_close(metrics["next_state_value"], value.amax(-1).mean())


@each
def test_the_perturbation_climbs_the_value_of_the_rule(rule: str) -> None:
    loss, data = agent(rule, perturbation=True), transitions(8)
    torch.manual_seed(1)
    value, _ = loss.perturbation_loss(data)
    torch.manual_seed(1)
    proposal = loss.perturb(loss.propose(data.select("observation"), 1).squeeze(-1))
    torch.testing.assert_close(value, -RULES[rule](loss.qvalue(proposal)).mean())


@STACKED
@pytest.mark.parametrize("rule", ["mean", "min"])
def test_a_live_policy_follows_every_critic_and_a_frozen_one_none(rule: str, alike: bool) -> None:
    loss, state = agent(rule, alike=alike), states(64)
    live, frozen = BCQPolicy.live(loss), BCQPolicy.frozen(loss)
    data = loss.propose(state, 1).squeeze(-1)
    for index in range(3):
        before = frozen.qvalue_network(data.copy())["state_action_value"]
        for leaf in loss.critic(index)[1].values(True, True):
            leaf.data.mul_(1.5)
        live.follow()
        now = live.qvalue_network(data.copy())["state_action_value"]
        torch.testing.assert_close(now.squeeze(-1), RULES[rule](loss.qvalue(data)))
        assert torch.equal(frozen.qvalue_network(data.copy())["state_action_value"], before)


def test_a_student_learns_the_value_by_the_rule_of_its_teacher() -> None:
    rows = torch.stack([transitions(8, seed=seed) for seed in range(2)])
    rows["task"] = torch.arange(2).unsqueeze(-1).expand(2, 8)

    def error(rule: str, *, equal: bool) -> Tensor:
        loss = agent(rule)
        if equal:
            for leaf in loss.qvalue_network_params.values(True, True):
                leaf.data.copy_(leaf.data[:1].expand_as(leaf))
        policies = [BCQPolicy.frozen(loss) for _ in range(2)]
        teachers = [p.generator for p in policies], [p.qvalue_network for p in policies]
        torch.manual_seed(0)
        return make_distillation_loss(num_tasks=2, teachers=teachers)(rows.copy())["loss_qvalue"]

    for rule in ("mean", "min"):
        torch.testing.assert_close(error(rule, equal=True), error("first", equal=True))
        assert error(rule, equal=False) != error("first", equal=False)


class _TwoOutputs(nn.Module):
    """A critic that also returns its features, before the value."""

    def __init__(self) -> None:
        super().__init__()
        self.features, self.value = MLP(sum(DIMS), 4, num_cells=[8]), nn.Linear(4, 1)

    def forward(self, observation: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        features = self.features(observation, action)
        return features, self.value(features)


@pytest.mark.parametrize("key", ["state_action_value", ("points", "all")])
@each
def test_the_value_is_the_output_of_the_loss_s_key_wherever_it_stands(rule: str, key: Any) -> None:
    critics = [
        TensorDictModule(_TwoOutputs(), ["observation", "action"], ["features", key]).double()
        for _ in range(3)
    ]
    loss = BCQLoss(ActionVAE(*DIMS).double(), critics, **BOUNDS, acting_rule=rule)
    loss.set_keys(state_action_value=key)
    torch.manual_seed(0)
    proposed = loss.propose(states(), 5)
    best = RULES[rule](loss.qvalue(proposed)).argmax(-1)
    torch.manual_seed(0)
    chosen = BCQPolicy.live(loss, num_candidates=5)(states())["action"]
    torch.testing.assert_close(chosen, proposed["action"][torch.arange(6), best])


def test_unknown_rules_are_refused_by_name() -> None:
    with pytest.raises(UnknownNameError, match="'median'; valid acting_rules: first, mean, min"):
        agent("median")
    with pytest.raises(UnknownNameError, match="'min'; valid target_rules: clipped, mean"):
        agent("first", target_rule="min")


def test_an_ensemble_writes_only_the_value_and_declares_its_sizes() -> None:
    critic = EnsembleCritic(make_critics(3), "mean")
    data = transitions(4).select("observation", "action")
    values = torch.stack([one(data.copy())["state_action_value"] for one in critic.critics])
    out = critic(data)
    assert set(out.keys()) == {"observation", "action", "state_action_value"}
    torch.testing.assert_close(out["state_action_value"], values.mean(0))
    assert critic.sizes["action"] == DIMS[1]


@pytest.mark.parametrize("layer_norm", [True, False])
def test_a_normalised_critic_has_a_norm_before_each_activation(layer_norm: bool) -> None:
    network = make_qvalue_network(3, 2, num_cells=(8, 4), layer_norm=layer_norm).module
    assert isinstance(network, MLP)
    kinds = [type(part).__name__ for part in network]
    norm = ["LayerNorm"] if layer_norm else []
    assert kinds == ["Linear", *norm, "ReLU", "Linear", *norm, "ReLU", "Linear"]
