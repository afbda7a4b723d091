"""A policy judges its candidates and acts with the networks of its loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    CELLS,
    CRITIC_KEYS,
    DIMS,
    LATENT_DIM,
    NO_UPDATER,
    OBSERVATION_DIM,
    TASK_LATENT_DIM,
    make_bcq_loss,
    observations,
    state,
    total,
    transitions,
    undeclare,
    undeclared,
)
from recomputed import numpy_mlp, recorded
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import QValueActor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import (
    ActionVAE,
    BCQPolicy,
    DiscreteBCQPolicy,
    PLASPolicy,
    make_decoder,
    make_latent_actor,
    make_qvalue_network,
)
from torchrl_bmrl.objectives import BCQLoss, DiscreteBCQLoss, PLASLoss


class Near(nn.Module):
    """A critic that prefers actions near a point."""

    def __init__(self, point: Tensor) -> None:
        super().__init__()
        self.point = point

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return -(action - self.point).square().sum(-1, keepdim=True)


def near(point: float = 0.0) -> TensorDictModule:
    return TensorDictModule(Near(torch.full((ACTION_DIM,), point)), **CRITIC_KEYS)


# -- candidates ------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(), (5,), (2, 4)])
@pytest.mark.parametrize("num_candidates", [1, 20])
def test_policy_takes_the_best_of_exactly_so_many_candidates(
    batch: tuple[int, ...], num_candidates: int
) -> None:
    torch.manual_seed(0)
    generator, critic = ActionVAE(*DIMS, num_cells=CELLS), near()
    policy = BCQPolicy(
        generator.decoder,
        critic,
        latent_dim=LATENT_DIM,
        num_candidates=num_candidates,
        latent_clip=None,
    )
    calls = recorded(generator.decoder.module)
    data = observations(*batch)
    action = policy(data)["action"]
    ((observation, latent), candidates), *others = calls
    assert not others
    assert candidates.shape == (*batch, num_candidates, ACTION_DIM)
    assert torch.equal(observation, data["observation"].unsqueeze(-2).expand(observation.shape))
    assert len(latent.flatten(0, -2).unique(dim=0)) == latent[..., 0].numel()
    best = candidates.square().sum(-1).argmin(-1)
    for index in np.ndindex(*batch):
        assert torch.equal(action[index], candidates[index][best[index]])
    assert set(data.keys()) == {"observation", "action"}


@pytest.mark.parametrize("clip", [0.5, None])
def test_policy_clips_the_latent_only_if_asked(clip: float | None) -> None:
    generator = ActionVAE(*DIMS, num_cells=CELLS)
    policy = BCQPolicy(generator.decoder, near(), latent_dim=LATENT_DIM, latent_clip=clip)
    calls = recorded(generator.decoder.module)
    policy(observations(5))
    assert calls[0][1].shape == (5, 100, ACTION_DIM)
    largest = calls[0][0][1].abs().max()
    assert largest > 2 if clip is None else largest == 0.5


def test_policy_perturbs_the_candidates_within_the_bounds_before_it_judges_them() -> None:
    generator = ActionVAE(*DIMS, num_cells=CELLS)
    perturbation = TensorDictModule(
        lambda observation, action: torch.ones_like(action) * torch.tensor([1.0, -1.0]),
        in_keys=["observation", "action"],
        out_keys=["perturbation"],
    )
    low, high = torch.tensor([-0.1, -0.2]), torch.tensor([0.3, 0.05])
    critic = near(0.2)
    policy = BCQPolicy(
        undeclared(generator.decoder),
        critic,
        perturbation,
        latent_dim=LATENT_DIM,
        max_perturbation=0.25,
        bounds=(low, high),
    )
    proposed, judged = recorded(generator.decoder.module), recorded(critic.module)
    action = policy(observations(5))["action"]
    moved = proposed[0][1] + 0.25 * (0.5 * (high - low)) * torch.tensor([1.0, -1.0])
    moved = moved.clamp(low, high)
    assert torch.equal(judged[0][0][1], moved)
    best = (moved - 0.2).square().sum(-1).argmin(-1)
    assert torch.equal(action, moved[torch.arange(5), best])


def test_student_policy_reads_the_task_latent() -> None:
    torch.manual_seed(0)
    decoder = make_decoder(*DIMS, LATENT_DIM, task_latent_dim=TASK_LATENT_DIM, num_cells=CELLS)
    critic = make_qvalue_network(*DIMS, task_latent_dim=TASK_LATENT_DIM, num_cells=CELLS)
    policy = BCQPolicy(decoder, critic, latent_dim=LATENT_DIM)
    assert policy.in_keys == ["observation", "task_latent"]
    assert policy.out_keys == ["action"]
    decoded, judged = recorded(decoder.module), recorded(critic.module)
    data = observations(5).set("task_latent", torch.randn(5, TASK_LATENT_DIM))
    policy(data)
    expected = data["task_latent"].unsqueeze(-2).expand(5, 100, TASK_LATENT_DIM)
    assert torch.equal(decoded[0][0][2], expected)
    assert torch.equal(judged[0][0][2], expected)
    with pytest.raises(KeyError, match="task_latent"):
        policy(observations(5))


def test_a_policy_needs_a_candidate() -> None:
    with pytest.raises(BMRLError, match="num_candidates is 0; valid: at least 1"):
        BCQPolicy(ActionVAE(*DIMS).decoder, near(), latent_dim=LATENT_DIM, num_candidates=0)


# -- policies of losses ----------------------------------------------------------------------------


@pytest.mark.parametrize("perturbation", [False, True])
@pytest.mark.parametrize("clip", [0.25, None])
@pytest.mark.filterwarnings(NO_UPDATER)
def test_policy_of_a_loss_acts_with_its_networks_and_first_critic(
    perturbation: bool, clip: float | None
) -> None:
    loss = make_bcq_loss(
        perturbation=perturbation,
        latent_clip=clip,
        max_perturbation=0.4,
        bounds=(torch.tensor([-0.25, -0.5]), torch.tensor([0.5, 0.75])),
        edit=undeclare,
    )
    loss.qvalue_loss(transitions(8))  # the policy of a loss in use
    policy = BCQPolicy.frozen(loss, num_candidates=20)
    calls = recorded(policy.generator.module)
    data = transitions(6).select("observation")
    action = policy(data)["action"]
    (observation, latent), _ = calls[0]
    assert latent.shape == (6, 20, LATENT_DIM)
    assert latent.abs().max() > 1 if clip is None else latent.abs().max() == clip

    candidates = np.tanh(
        numpy_mlp(loss.generator_params["decoder", "module", "network"], observation, latent)
    )
    if perturbation:
        network = loss.perturbation_network_params["module", "network"]
        xi = np.tanh(numpy_mlp(network, observation, candidates))
        moved = candidates + 0.4 * np.array([0.375, 0.625]) * xi
        candidates = np.clip(moved, [-0.25, -0.5], [0.5, 0.75])
    q = numpy_mlp(loss.qvalue_network_params["module"][0], observation, candidates)[..., 0]
    np.testing.assert_allclose(action, candidates[np.arange(6), q.argmax(-1)], rtol=1e-8)


@pytest.mark.filterwarnings(NO_UPDATER)
def test_policy_of_a_loss_is_a_copy() -> None:
    loss = make_bcq_loss(perturbation=True)
    before = state(loss)
    policy = BCQPolicy.frozen(loss)
    assert not any(parameter.requires_grad for parameter in policy.parameters())
    assert all(parameter.requires_grad for parameter in loss.parameters())
    data = transitions(6).select("observation")
    torch.manual_seed(0)
    action = policy(data)["action"].clone()
    total(loss(transitions(8))).backward()
    torch.optim.SGD(loss.parameters(), lr=10.0).step()
    torch.manual_seed(0)
    assert torch.equal(policy(data)["action"], action)
    for parameter in policy.parameters():
        parameter.data.zero_()
    now = loss.state_dict()
    assert all(now[key].any() for key, value in before.items() if value.any())


# -- networks with their own keys and inputs -------------------------------------------------------


def act(policy: TensorDictModuleBase, **entries: Tensor) -> Tensor:
    rows = len(next(iter(entries.values())))
    return policy(TensorDict(entries, [rows]))["action"]


def test_a_discrete_policy_takes_the_best_action_of_a_q_value_actor() -> None:
    torch.manual_seed(0)
    network = nn.Linear(3, 4)
    critic = QValueActor(network, in_keys=["observation"], action_space="one-hot")
    generator = TensorDictModule(nn.Linear(3, 4), in_keys=["observation"], out_keys=["logits"])
    policy = DiscreteBCQPolicy.frozen(DiscreteBCQLoss(generator, critic, threshold=0.0))
    observation = torch.randn(50, 3)
    best = network(observation).argmax(-1)
    assert torch.equal(act(policy, observation=observation).argmax(-1), best)
    assert len(best.unique()) > 1


class WithExtra(nn.Module):
    """Writes something after the action."""

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        action = torch.cat(inputs, -1)[..., :ACTION_DIM].tanh()
        return action, action.sum(-1, keepdim=True)


@pytest.mark.parametrize("kind", ["bcq", "plas"])
def test_a_policy_reads_what_its_networks_read_and_writes_the_action(kind: str) -> None:
    generator = ActionVAE(*DIMS, num_cells=CELLS)
    keys = ["observation", "action_latent"]
    generator.decoder = TensorDictModule(WithExtra(), in_keys=keys, out_keys=["action", "extra"])
    critic = TensorDictModule(
        make_qvalue_network(5, ACTION_DIM, num_cells=CELLS).module,
        in_keys=["state", "action"],
        out_keys=["state_action_value"],
    )
    actor = make_latent_actor(6, LATENT_DIM, num_cells=CELLS).module
    actor = TensorDictModule(actor, in_keys=["goal"], out_keys=["action_latent"])
    entries = {"observation": torch.randn(6, OBSERVATION_DIM)}
    if kind == "bcq":
        policy = BCQPolicy.frozen(BCQLoss(generator, critic, bounds=(-1.0, 1.0)))
        entries["state"] = torch.randn(6, 5)
    else:
        policy = PLASPolicy.frozen(PLASLoss(generator, actor, critic, bounds=(-1.0, 1.0)))
        entries["goal"] = torch.randn(6, 6)
    assert set(policy.in_keys) == set(entries)
    assert policy.out_keys == ["action"]
    written = policy(TensorDict(entries, [6]))
    assert set(written.keys()) == {*entries, "action"}
    assert written["action"].shape == (6, ACTION_DIM)


class Scaled(nn.Module):
    """Reads bytes."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, pixels: Tensor, other: Tensor) -> Tensor:
        return self.network(pixels.float() / 255, other)


def test_a_policy_acts_on_bytes() -> None:
    generator, critic = ActionVAE(*DIMS, num_cells=CELLS), make_qvalue_network(*DIMS)
    for module in (generator.decoder, critic):
        module.module = Scaled(module.module)
    policy = BCQPolicy(generator.decoder, critic, latent_dim=LATENT_DIM, num_candidates=5)
    pixels = torch.randint(256, (6, OBSERVATION_DIM), dtype=torch.uint8)
    actions = []
    for observation in (pixels, pixels.float()):
        torch.manual_seed(0)
        actions.append(act(policy, observation=observation))
    assert actions[0].shape == (6, ACTION_DIM)
    assert torch.equal(*actions)
