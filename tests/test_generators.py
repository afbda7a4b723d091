"""Whatever proposes actions serves as a generator: the flow of docs/generators.md."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from helpers import (
    BOUNDS,
    CRITICS,
    DIMS,
    NO_UPDATER,
    OBSERVATION_DIM,
    Q,
    guide,
    make_critics,
    run,
    transitions,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.generators import ActionKeys
from torchrl_bmrl.modules import (
    ActionVAE,
    BCQPolicy,
    PLASPolicy,
    make_decoder,
    make_latent_actor,
)
from torchrl_bmrl.objectives import BCQLoss, PLASLoss, StackedLoss
from torchrl_bmrl.testing import Case, OfflineLossContract

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
Flow = guide("generators").Flow  # now: the page draws random numbers when it runs


def flow(**options: Any) -> Any:
    return Flow(*DIMS, **options)


def networks() -> dict[str, Any]:
    return {"generator": flow(), Q: make_critics(1)[0]}


CASE = Case(BCQLoss, networks, CRITICS, (Q,), BOUNDS)


class TestBCQOverAFlow(OfflineLossContract):
    """All of the contract, but for what wraps each network: a flow is no network with keys."""

    case = CASE
    test_renamed_and_nested_keys_give_the_same_losses = None
    test_separate_losses_leave_a_shared_torso_to_the_generator = None
    test_shared_parameters_are_trained_once_for_all = None


def test_a_generator_reads_and_writes_under_the_names_of_the_loss() -> None:
    names = {"observation": ("agent", "s"), "action": ("agent", "a")}
    data, expected = transitions(8), run(CASE.make(), transitions(8))
    torch.manual_seed(0)
    generator = flow(observation_key=names["observation"]).double()
    critics = []
    for critic in make_critics(2):
        critic.in_keys = [names[key] for key in critic.in_keys]
        critics.append(critic)
    loss = BCQLoss(generator, critics, **BOUNDS)
    loss.set_keys(action=names["action"])
    loss.load_state_dict(CASE.make().state_dict())
    renamed = TensorDict({"next": data["next"].exclude("observation")}, [8])
    for key, name in names.items():
        renamed[name] = data[key]
    renamed["next", "agent", "s"] = data["next", "observation"]
    result = run(loss, renamed)
    assert all(torch.equal(value, result[key]) for key, value in expected.items())


def test_a_trained_flow_proposes_the_actions_of_the_data() -> None:
    torch.manual_seed(0)
    generator, data = Flow(1, 1), TensorDict({}, [512])
    side = torch.randint(2, (512, 1)) * 2.0 - 1.0  # two modes, which a mean would miss
    data["observation"], data["action"] = torch.randn(512, 1), 0.5 * side
    optimizer = torch.optim.Adam(generator.parameters(), lr=3e-3)
    for _ in range(400):
        loss, _ = generator.row_loss(data, ActionKeys())
        optimizer.zero_grad()
        loss.mean().backward()
        optimizer.step()
    with torch.no_grad():
        action = generator.propose(data[:1], 400, ActionKeys())["action"].flatten()
    assert ((action.abs() - 0.5).abs() < 0.2).double().mean() > 0.8
    assert 0.3 < (action > 0).double().mean() < 0.7


def test_a_loss_over_a_flow_has_its_metrics_and_not_the_options_of_an_autoencoder() -> None:
    loss = CASE.make()
    assert "velocity_error" in loss.out_keys
    assert "kl_divergence" not in loss.out_keys
    assert "kl_weight" not in loss.state_dict()
    with pytest.raises(BMRLError, match=r"kl_weight is 0.1, and generator Flow does not take it"):
        CASE.make(kl_weight=0.1)
    with pytest.raises(BMRLError, match=r"generator Flow has no 'decode'; valid: .*latent"):
        PLASLoss(flow(), make_latent_actor(3, 4), make_critics(1)[0], **BOUNDS)
    with pytest.raises(
        BMRLError, match=r"Flow has no encode\(\); valid: a generator with a latent"
    ):
        loss.encode(transitions(8))


def test_a_policy_asks_the_generator_that_proposes_in_its_own_way() -> None:
    """Also if it has a decoder, of which it does not draw N(0, I)."""

    class Shifted(ActionVAE):
        def propose(self, *args: Any, **options: Any) -> Any:
            proposed = super().propose(*args, **options)
            return proposed.set("action", torch.full_like(proposed["action"], 0.25))

    loss = BCQLoss(Shifted(*DIMS).double(), make_critics(2), **BOUNDS)
    for make in (BCQPolicy.frozen, BCQPolicy.live):
        action = make(loss, num_candidates=3)(transitions(4).select("observation"))["action"]
        assert torch.equal(action, torch.full_like(action, 0.25))


def test_a_plas_policy_needs_only_what_its_loss_needs_of_a_generator() -> None:
    class Latent(TensorDictModuleBase):
        """The members that docs/generators.md lists, and no decoder."""

        metrics, options, latent_dim = ("error",), (), 4

        def __init__(self) -> None:
            super().__init__()
            self.inner = make_decoder(*DIMS, 4).double()
            self.in_keys, self.out_keys = ["observation"], ["action"]

        def row_loss(self, tensordict: Any, keys: Any) -> Any: ...

        def propose(self, observation: Any, num_candidates: int, keys: Any) -> Any: ...

        def decode(self, tensordict: Any, keys: Any) -> Any:
            return self.inner(tensordict)

    actor = make_latent_actor(OBSERVATION_DIM, 4).double()
    loss, state = PLASLoss(Latent(), actor, make_critics(2), **BOUNDS), transitions(4)
    expected = loss.generator.inner(actor(state.select("observation")))["action"]
    for make in (PLASPolicy.frozen, PLASPolicy.live):
        assert torch.equal(make(loss)(state.select("observation"))["action"], expected)


def test_a_generator_that_lacks_a_member_is_refused_by_name() -> None:
    class Half(nn.Module):
        in_keys, metrics, options = ("observation",), (), ()

        def propose(self, observation: Any, num_candidates: int, keys: Any) -> Any: ...

    with pytest.raises(BMRLError, match=r"generator Half has no 'row_loss'; valid: .*'propose'"):
        BCQLoss(Half(), make_critics(1)[0], **BOUNDS)
    with pytest.raises(BMRLError, match="generator Linear has no 'encoder'; valid"):
        BCQLoss(nn.Linear(1, 1), make_critics(1)[0], **BOUNDS)


def test_policies_act_by_the_best_of_a_flow_s_proposals() -> None:
    loss = CASE.make()
    live, frozen = (make(loss, num_candidates=4) for make in (BCQPolicy.live, BCQPolicy.frozen))
    state = TensorDict({"observation": torch.randn(6, OBSERVATION_DIM).double()}, [6])
    torch.manual_seed(0)
    proposals = loss.propose(state, 4)
    best = loss.qvalue(proposals)[0].argmax(-1)
    expected = proposals["action"][torch.arange(6), best]
    for policy in (live, frozen):
        torch.manual_seed(0)
        torch.testing.assert_close(policy(state.clone())["action"], expected)
    with torch.no_grad():
        next(loss.generator_params.parameters()).mul_(2.0)
    torch.manual_seed(0)
    assert not torch.equal(live(state.clone())["action"], frozen(state.clone())["action"])


@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_losses_over_flows_stack(deactivate_vmap: bool) -> None:
    stack = StackedLoss(
        [CASE.make(seed=seed) for seed in range(3)], deactivate_vmap=deactivate_vmap
    )
    data = torch.stack([transitions(8, seed=seed) for seed in range(3)])
    losses = stack(data)
    (losses["loss_generator"] + losses["loss_qvalue"]).backward()
    gradient = next(stack.generator_params.parameters()).grad
    assert (gradient.flatten(1).abs().sum(1) > 0).all()
