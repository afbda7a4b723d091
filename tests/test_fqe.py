"""What makes it fitted Q evaluation; the contract that all losses hold is tested elsewhere."""

from __future__ import annotations

import pickle
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    NO_UPDATER,
    NUM_ACTIONS,
    OBSERVATION_DIM,
    make_bcq_loss,
    make_critics,
    make_discrete_bcq_loss,
    make_fqe_loss,
    make_plas_loss,
    make_policy,
    run,
    transitions,
)
from recomputed import numpy_mlp
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torchrl.envs import ExplorationType
from torchrl.modules import IndependentNormal, NormalParamExtractor, ProbabilisticActor
from torchrl.objectives import SoftUpdate

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import (
    BCQPolicy,
    DiscreteBCQPolicy,
    PLASPolicy,
    make_qvalue_network,
)
from torchrl_bmrl.objectives import FQELoss, StackedLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
GAMMA = 0.99
POLICIES: dict[str, Any] = {
    "bcq": lambda: BCQPolicy.frozen(make_bcq_loss(), num_candidates=4),
    "bcq_perturbed": lambda: BCQPolicy.frozen(make_bcq_loss(perturbation=True)),
    "plas": lambda: PLASPolicy.frozen(make_plas_loss()),
}
every_policy = pytest.mark.parametrize("make", POLICIES.values(), ids=POLICIES)


# -- the equations -----------------------------------------------------------------------------


def mlp(params: TensorDict, *inputs: Any) -> np.ndarray:
    return numpy_mlp(params["module"], *inputs)[..., 0]


def test_one_update_is_the_one_of_the_equations() -> None:
    """Loss, gradient step and target in NumPy, with two critics whose targets are elsewhere."""
    policy = make_policy(torch.float64)
    loss, data = make_fqe_loss(policy=policy, gamma=GAMMA), transitions(8)
    observation, action = data["observation"].numpy(), data["action"].numpy()
    after, reward = data["next", "observation"].numpy(), data["next", "reward"].numpy()[:, 0]
    bootstraps = 1.0 - data["next", "terminated"].numpy()[:, 0]
    params = TensorDict.from_module(policy)["module", "0"]
    next_action = np.tanh(numpy_mlp(params, after))
    critics = [loss.qvalue_network_params[i] for i in range(2)]
    targets = [loss.target_qvalue_network_params[i] for i in range(2)]

    next_value = np.mean([mlp(target, after, next_action) for target in targets], 0)
    target = reward + GAMMA * bootstraps * next_value
    predicted = np.stack([mlp(critic, observation, action) for critic in critics])
    errors = (predicted - target) ** 2
    losses = loss(data)
    expected = {
        "loss_qvalue": errors.sum(0).mean(),
        "pred_value": predicted.mean(),
        "target_value": target.mean(),
        "next_state_value": next_value.mean(),
    }
    for key, value in expected.items():
        np.testing.assert_allclose(losses[key].item(), value, rtol=0, atol=1e-9, err_msg=key)
    np.testing.assert_allclose(data["td_error"], errors.max(0), rtol=0, atol=1e-9)

    # The last layer's bias: its gradient is twice the mean of the prediction's error.
    key = ("module", "2", "bias")
    trained, moved = loss.qvalue_network_params[key], loss.target_qvalue_network_params[key]
    updater = SoftUpdate(loss, tau=0.1)
    expected = trained.detach()[:, 0].numpy() - 0.5 * 2.0 * (predicted - target).mean(1)
    held = 0.9 * moved[:, 0].numpy() + 0.1 * expected
    losses["loss_qvalue"].backward()
    torch.optim.SGD(loss.parameters(), lr=0.5).step()
    updater.step()
    np.testing.assert_allclose(trained.detach()[:, 0], expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(moved[:, 0], held, rtol=0, atol=1e-9)

    critics = [loss.qvalue_network_params[i] for i in range(2)]
    values = [
        mlp(critic, observation, np.tanh(numpy_mlp(params, observation))) for critic in critics
    ]
    value = loss.policy_value(data.select("observation"))
    assert value.shape == ()
    assert not value.requires_grad
    np.testing.assert_allclose(value, np.mean(values), rtol=0, atol=1e-9)


def test_terminated_rows_do_not_bootstrap_and_truncated_ones_do() -> None:
    data = transitions(8)  # the first row is terminated, the second truncated
    loss = make_fqe_loss(num_critics=1, gamma=GAMMA, reduction="none")
    before = loss(data)["loss_qvalue"]
    loss.target_qvalue_network_params["critics", "0", "module", "2", "bias"].add_(1.0)
    same = loss(data)["loss_qvalue"] == before
    assert same.tolist() == [True, *[False] * 7]


def chain(num_states: int, probability: float) -> tuple[TensorDict, np.ndarray]:
    """Every transition of a chain, and the value of a policy that steps right that often.

    One step left or right, the end to the right terminates with a reward of 1, other steps cost
    0.1; the end to the left is a wall.
    """
    states = np.repeat(np.arange(num_states), 2)
    steps = np.tile([0, 1], num_states)
    after = np.clip(states + 2 * steps - 1, 0, num_states)
    ended = after == num_states
    reward = np.where(ended, 1.0, -0.1)
    matrix, mean = np.zeros((num_states, num_states)), np.zeros(num_states)
    for s, a, s2, r, end in zip(states, steps, after, reward, ended, strict=True):
        share = probability if a else 1.0 - probability
        mean[s] += share * r
        if not end:
            matrix[s, s2] += share
    value = np.linalg.solve(np.eye(num_states) - 0.9 * matrix, mean)

    def encode(index: np.ndarray, size: int) -> Tensor:
        return one_hot(torch.from_numpy(index), size).double()

    flag = torch.from_numpy(ended)[:, None]
    following = {
        "observation": encode(np.minimum(after, num_states - 1), num_states),
        "reward": torch.from_numpy(reward)[:, None],
        "done": flag,
        "terminated": flag,
    }
    data = {"observation": encode(states, num_states), "action": encode(steps, 2)}
    return TensorDict(data | {"next": following}, [2 * num_states]), value


class Table(nn.Module):
    """A value for each state and action."""

    def __init__(self, num_states: int) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.zeros(num_states, 2, dtype=torch.float64))

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return ((observation @ self.value) * action).sum(-1, keepdim=True)


@pytest.mark.parametrize("probability", [1.0, 0.0, 0.7])
def test_it_converges_to_the_value_of_a_policy_on_a_chain(probability: float) -> None:
    torch.manual_seed(0)
    size = 5
    data, value = chain(size, probability)

    def act(observation: Tensor) -> Tensor:
        right = torch.rand(observation.shape[:-1]) < probability
        return one_hot(right.long(), 2).double()

    policy = TensorDictModule(act, in_keys=["observation"], out_keys=["action"])
    critic = TensorDictModule(Table(size), ["observation", "action"], ["state_action_value"])
    loss = FQELoss(policy, critic, gamma=0.9)
    optimizer = torch.optim.SGD(loss.parameters(), lr=5.0)  # an entry's whole error at a step
    updater = SoftUpdate(loss, tau=0.5)
    starts = TensorDict({"observation": torch.eye(size, dtype=torch.float64)}, [size])
    batch = torch.cat([data] * 20)
    estimates = []
    for _ in range(1000):
        optimizer.zero_grad()
        loss.qvalue_loss(batch)[0].backward()
        optimizer.step()
        updater.step()
        with torch.no_grad():
            estimates.append(loss.state_value(starts))
    # A policy that draws is met in the mean.
    atol = 0.02 if 0 < probability < 1 else 1e-9
    np.testing.assert_allclose(torch.stack(estimates[500:]).mean(0), value, rtol=0, atol=atol)
    spread = 0.2 if 0 < probability < 1 else 0.0
    assert loss.policy_value(starts).item() == pytest.approx(value.mean(), abs=spread + 1e-9)


# -- the policy stays as it is -----------------------------------------------------------------


@every_policy
def test_no_gradient_and_no_optimizer_reach_the_policy(make: Any) -> None:
    policy = make().requires_grad_()
    loss = make_fqe_loss(policy=policy)
    held = [value.clone() for value in loss.policy_params.values(True, True)]
    trained = {name.split(".")[0] for name, p in loss.named_parameters() if p.requires_grad}
    assert trained == {"qvalue_network_params"}
    assert not any(name.startswith("policy") for name, _ in loss.named_parameters())
    loss(transitions(8))["loss_qvalue"].backward()
    assert all(p.grad is None for p in policy.parameters())
    torch.optim.SGD(loss.parameters(), lr=1.0).step()
    SoftUpdate(loss, tau=0.5).step()
    now = list(loss.policy_params.values(True, True))
    assert all(map(torch.equal, held, now))


@every_policy
def test_later_updates_of_the_given_policy_do_not_reach_the_loss(make: Any) -> None:
    policy = make()
    loss, data = make_fqe_loss(policy=policy), transitions(8)
    before = run(loss, data)["target_value"]
    for parameter in policy.parameters():
        parameter.data.add_(1.0)
    assert torch.equal(run(loss, data)["target_value"], before)


@every_policy
@pytest.mark.parametrize("copy", [deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
def test_policies_of_the_library_are_copied_and_moved_with_the_loss(make: Any, copy: Any) -> None:
    loss = make_fqe_loss(policy=make())
    expected = run(loss, transitions(8))
    twin = copy(loss)
    assert torch.equal(run(twin, transitions(8))["loss_qvalue"], expected["loss_qvalue"])
    assert (
        run(twin.float(), transitions(8, dtype=torch.float32))["loss_qvalue"].dtype == torch.float32
    )
    assert torch.equal(run(loss, transitions(8))["loss_qvalue"], expected["loss_qvalue"])


@every_policy
def test_the_state_dict_brings_the_policy(make: Any) -> None:
    loss, other = (make_fqe_loss(policy=make(), seed=seed) for seed in (0, 1))
    for value in other.policy_params.values(True, True):
        value.mul_(0.5)
    other.load_state_dict(loss.state_dict(), strict=True)
    results = [run(each, transitions(8)) for each in (loss, other)]
    assert torch.equal(*(result["loss_qvalue"] for result in results))


@pytest.mark.slow
@every_policy
def test_a_loss_compiles_in_one_piece_with_a_policy_of_the_library(make: Any) -> None:
    torch._dynamo.reset()
    loss = make_fqe_loss(policy=make())
    expected = run(loss, transitions(8))
    compiled = torch.compile(loss, fullgraph=True, backend="eager")
    torch.testing.assert_close(run(compiled, transitions(8)).to_dict(), expected.to_dict())


@every_policy
@pytest.mark.parametrize("deactivate_vmap", [True, False])
def test_a_stack_evaluates_many_policies_each_as_alone(make: Any, deactivate_vmap: bool) -> None:
    policies = [make() for _ in range(3)]
    for i, policy in enumerate(policies):
        for parameter in policy.parameters():
            parameter.data.mul_(1 + 0.1 * i)
    losses = [make_fqe_loss(policy=policy, seed=i) for i, policy in enumerate(policies)]
    data = torch.stack([transitions(8, seed=i) for i in range(3)])
    stack = StackedLoss(losses, deactivate_vmap=deactivate_vmap)
    torch.manual_seed(0)
    values = stack(data)["target_value"]
    torch.manual_seed(0)
    alone = torch.stack(
        [loss(rows)["target_value"] for loss, rows in zip(losses, data, strict=True)]
    )
    assert len(values.unique()) == 3
    if not deactivate_vmap and make is not POLICIES["plas"]:
        return  # under vmap the policies draw other numbers
    torch.testing.assert_close(values, alone, rtol=0, atol=1e-12)


def test_a_stack_refuses_policies_that_act_in_other_ways() -> None:
    policies = [BCQPolicy.frozen(make_bcq_loss(), num_candidates=n) for n in (2, 3)]
    with pytest.raises(BMRLError, match="differs from '0' in kind"):
        StackedLoss([make_fqe_loss(policy=policy) for policy in policies])


# -- which policies, which critics -------------------------------------------------------------


def test_a_policy_of_discrete_actions_is_evaluated_by_a_critic_that_reads_them() -> None:
    policy = DiscreteBCQPolicy.frozen(make_discrete_bcq_loss())
    data = transitions(8)
    data["action"] = one_hot(torch.arange(8) % NUM_ACTIONS, NUM_ACTIONS)
    critic = make_qvalue_network(OBSERVATION_DIM, NUM_ACTIONS, num_cells=(8,)).double()
    loss = make_fqe_loss(policy=policy, critics=critic)
    assert loss.num_qvalue_nets == 1
    loss(data)["loss_qvalue"].backward()
    chosen = policy(data["next"].clone())["action"]
    data["next", "action"] = chosen
    expected = loss.qvalue(data["next"], target=True).mean()
    assert torch.equal(loss(data)["next_state_value"], expected)


def test_a_probabilistic_policy_acts_as_the_loss_says() -> None:
    network = nn.Sequential(
        nn.Linear(OBSERVATION_DIM, 2 * ACTION_DIM), NormalParamExtractor()
    ).double()
    network = TensorDictModule(network, ["observation"], ["loc", "scale"])
    policy = ProbabilisticActor(
        network, in_keys=["loc", "scale"], distribution_class=IndependentNormal
    )
    loss, data = make_fqe_loss(policy=policy), transitions(8)
    first, second = (loss(data)["next_state_value"] for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(loss.policy_value(data), loss.policy_value(data))
    loss.deterministic_sampling_mode = ExplorationType.RANDOM
    first, second = (loss(data)["next_state_value"] for _ in range(2))
    assert not torch.equal(first, second)
    assert not torch.equal(loss.policy_value(data), loss.policy_value(data))


def test_dropout_of_the_policy_is_off() -> None:
    policy = make_policy(torch.float64)
    dropped = TensorDictModule(
        nn.Sequential(policy.module, nn.Dropout(0.5)), policy.in_keys, policy.out_keys
    )
    loss, data = make_fqe_loss(policy=dropped.train()).train(), transitions(8)
    first, second = (loss(data)["next_state_value"] for _ in range(2))
    assert torch.equal(first, second)
    assert loss.train().qvalue_network.training
    assert torch.equal(loss(data)["next_state_value"], first)
    assert dropped.training


def test_renamed_keys_of_policy_and_critics_work() -> None:
    names = {"observation": ("agent", "state"), "action": "torque", "reward": "prize"}
    policy = make_policy(torch.float64, names["observation"], names["action"])
    keys = [names["observation"], names["action"]]
    critics = [
        TensorDictModule(critic.module, keys, ["worth"])
        for critic in make_critics(1, torch.float64)
    ]
    loss = FQELoss(policy, critics)
    loss.set_keys(action="torque", reward="prize", state_action_value="worth")
    data = transitions(8)
    for key, name in names.items():
        for part in (data, data["next"]):
            if key in part:
                part.rename_key_(key, name)
    assert set(loss.in_keys) <= set(data.keys(True, True))
    loss(data)["loss_qvalue"].backward()
    assert loss.policy_value(data.select(names["observation"])).isfinite()


def test_what_cannot_be_evaluated_is_refused() -> None:
    critics = make_critics(1, torch.float64)
    with pytest.raises(BMRLError, match="policy is a Linear; valid: a TensorDictModule"):
        FQELoss(nn.Linear(3, 2), critics)
    elsewhere = make_policy(torch.float64, out_key="motion")
    with pytest.raises(BMRLError, match=r"writes \['motion'\], not 'action'; valid"):
        FQELoss(elsewhere, critics)(transitions(8))
    each = TensorDictModule(
        nn.Linear(OBSERVATION_DIM, NUM_ACTIONS).double(), ["observation"], ["action_value"]
    )
    with pytest.raises(BMRLError, match=r"writes \['action_value'\], not 'state_action_value'"):
        FQELoss(make_policy(torch.float64), each)(transitions(8))
    with pytest.raises(BMRLError, match="no 'observation'"):
        make_fqe_loss().policy_value(TensorDict({}, [3]))


def test_a_policy_without_parameters_is_evaluated() -> None:
    policy = TensorDictModule(torch.tanh, in_keys=["observation"], out_keys=["action"])
    critic = make_qvalue_network(OBSERVATION_DIM, OBSERVATION_DIM, num_cells=(8,)).double()
    data = transitions(8)
    data["action"] = data["observation"].tanh()
    loss = FQELoss(policy, critic)
    assert loss(data)["loss_qvalue"].isfinite()
