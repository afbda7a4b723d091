"""Networks, the acting policy, and where the task embedding comes from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    CELLS,
    LATENT_DIM,
    NO_UPDATER,
    OBSERVATION_DIM,
    TASK_LATENT_DIM,
    make_bcq_loss,
    numpy_mlp,
    recorded,
    transitions,
    undeclare,
    undeclared,
)
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import check_env_specs
from torchrl.modules import QValueActor

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import (
    ActionVAE,
    BCQPolicy,
    DemonstrationTaskLatent,
    DiscreteBCQPolicy,
    OnlineTaskLatent,
    PathTaskLatent,
    PLASPolicy,
    PrototypeTaskLatent,
    StageTaskLatent,
    make_decoder,
    make_latent_actor,
    make_perturbation_network,
    make_qvalue_network,
    make_task_classifier,
    make_task_encoder,
    prototype,
)
from torchrl_bmrl.modules.generator import Network, make_mlp
from torchrl_bmrl.objectives import BCQLoss, DiscreteBCQLoss, PLASLoss

DIMS = (OBSERVATION_DIM, ACTION_DIM)


def observations(*batch: int) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {"observation": torch.randn(*batch, OBSERVATION_DIM, generator=generator)}, batch_size=batch
    )


# -- the generator -----------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(), (5,), (2, 4)])
@pytest.mark.parametrize("latent_dim", [None, 3])
def test_encoder_and_decoder_have_the_shapes_that_they_say(
    batch: tuple[int, ...], latent_dim: int | None
) -> None:
    generator = ActionVAE(*DIMS, latent_dim=latent_dim, num_cells=CELLS)
    size = latent_dim or 2 * ACTION_DIM
    assert generator.latent_dim == size
    data = observations(*batch).set("action", torch.zeros(*batch, ACTION_DIM))
    data = generator.encoder(data)
    assert data["action_latent_loc"].shape == data["action_latent_scale"].shape == (*batch, size)
    data["action_latent"] = data["action_latent_loc"]
    assert generator.decoder(data)["action"].shape == (*batch, ACTION_DIM)


@pytest.mark.parametrize(("bias", "expected"), [(-100.0, np.exp(-4)), (100.0, np.exp(15))])
def test_log_deviation_is_clamped_as_published(bias: float, expected: float) -> None:
    generator = ActionVAE(*DIMS, num_cells=CELLS)
    generator.encoder.module.network[-1].bias.data[LATENT_DIM:] = bias
    data = observations(5).set("action", torch.zeros(5, ACTION_DIM))
    scale = generator.encoder(data)["action_latent_scale"]
    assert scale.numpy(force=True) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("bounds", [(-1.0, 1.0), (-2.0, 0.5)])
def test_decoded_actions_fill_the_bounds_and_never_leave_them(bounds: tuple[float, float]) -> None:
    torch.manual_seed(0)
    decoder = make_decoder(*DIMS, LATENT_DIM, num_cells=CELLS, bounds=bounds)
    for parameter in decoder.parameters():
        parameter.data.mul_(20.0)
    data = observations(500).set("action_latent", torch.randn(500, LATENT_DIM))
    action = decoder(data)["action"]
    assert (action >= bounds[0]).all()
    assert (action <= bounds[1]).all()
    assert action.min() < bounds[0] + 0.01
    assert action.max() > bounds[1] - 0.01
    for parameter in decoder.parameters():
        parameter.data.zero_()
    assert decoder(data)["action"].unique().item() == sum(bounds) / 2


def test_generator_proposes_a_fresh_action_for_every_row_and_call() -> None:
    generator = ActionVAE(*DIMS, num_cells=CELLS)
    same = TensorDict({"observation": torch.zeros(5, OBSERVATION_DIM)}, [5])
    proposed = generator(same.clone())
    assert len(proposed["action"].unique(dim=0)) == 5
    # In a rollout the last step's latent comes along; it must not be acted with again.
    before = proposed["action_latent"].clone()
    again = generator(proposed.clone())
    assert (again["action_latent"] != before).all()
    assert torch.equal(generator.decoder(again.clone())["action"], again["action"])


@pytest.mark.parametrize("task_latent_dim", [0, 2])
def test_every_input_reaches_decoder_and_critic(task_latent_dim: int) -> None:
    torch.manual_seed(0)
    modules = [
        make_decoder(*DIMS, LATENT_DIM, task_latent_dim=task_latent_dim),
        make_qvalue_network(*DIMS, task_latent_dim=task_latent_dim),
        make_perturbation_network(*DIMS),
        make_task_encoder(*DIMS),
    ]
    for module in modules:
        data = transitions(4, dtype=torch.float32)
        data["action_latent"] = torch.randn(4, LATENT_DIM)
        data["task_latent"] = torch.randn(4, TASK_LATENT_DIM)
        inputs = [data[key].requires_grad_() for key in module.in_keys]
        assert ("task_latent" in module.in_keys) == (task_latent_dim > 0 and module in modules[:2])
        module(data)[module.out_keys[0]].sum().backward()
        assert all(x.grad.any() for x in inputs)


def test_perturbation_is_as_wide_as_the_action_and_bounded() -> None:
    torch.manual_seed(0)
    network = make_perturbation_network(*DIMS, num_cells=CELLS)
    for parameter in network.parameters():
        parameter.data.mul_(20.0)
    data = observations(500).set("action", torch.randn(500, ACTION_DIM))
    perturbation = network(data)["perturbation"]
    assert perturbation.shape == (500, ACTION_DIM)
    assert (perturbation[:, 0] != perturbation[:, 1]).any()
    assert 0.99 < perturbation.abs().max() <= 1.0


# -- the policy --------------------------------------------------------------------------------


class Near(nn.Module):
    """A critic that prefers actions near a point."""

    def __init__(self, point: Tensor) -> None:
        super().__init__()
        self.point = point

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return -(action - self.point).square().sum(-1, keepdim=True)


def near(point: float = 0.0) -> TensorDictModule:
    return TensorDictModule(
        Near(torch.full((ACTION_DIM,), point)),
        in_keys=["observation", "action"],
        out_keys=["state_action_value"],
    )


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
    before = {key: value.clone() for key, value in loss.state_dict().items()}
    policy = BCQPolicy.frozen(loss)
    assert not any(parameter.requires_grad for parameter in policy.parameters())
    assert all(parameter.requires_grad for parameter in loss.parameters())
    data = transitions(6).select("observation")
    torch.manual_seed(0)
    action = policy(data)["action"].clone()
    losses = loss(transitions(8))
    sum(losses[key] for key in losses.keys() if key.startswith("loss_")).backward()  # noqa: SIM118
    torch.optim.SGD(loss.parameters(), lr=10.0).step()
    torch.manual_seed(0)
    assert torch.equal(policy(data)["action"], action)
    for parameter in policy.parameters():
        parameter.data.zero_()
    now = loss.state_dict()
    assert all(now[key].any() for key, value in before.items() if value.any())


def test_a_policy_needs_a_candidate() -> None:
    with pytest.raises(BMRLError, match="num_candidates is 0; valid: at least 1"):
        BCQPolicy(ActionVAE(*DIMS).decoder, near(), latent_dim=LATENT_DIM, num_candidates=0)


# -- the task embedding ------------------------------------------------------------------------


def test_task_encoder_embeds_the_transition_in_this_order() -> None:
    torch.manual_seed(0)
    encoder = make_task_encoder(*DIMS, TASK_LATENT_DIM, num_cells=CELLS)
    data = transitions(2, 4, dtype=torch.float32)
    parameters = TensorDict.from_module(encoder)["module"]
    expected = numpy_mlp(
        parameters,
        data["observation"],
        data["action"],
        data["next", "reward"],
        data["next", "observation"],
    )
    result = encoder(data)["task_latent"]
    np.testing.assert_allclose(result.detach(), expected, rtol=1e-4, atol=1e-6)


def test_task_classifier_is_one_linear_layer() -> None:
    classifier = make_task_classifier(6, TASK_LATENT_DIM)
    assert [tuple(p.shape) for p in classifier.parameters()] == [(6, TASK_LATENT_DIM), (6,)]
    m = torch.randn(4, TASK_LATENT_DIM)
    logits = classifier(TensorDict({"task_latent": m}, [4]))["task_logits"]
    torch.testing.assert_close(logits, m @ classifier.module.weight.T + classifier.module.bias)


def test_prototype_is_the_mean_or_the_medoid() -> None:
    points = torch.tensor([[0.0, 0.0], [1.0, 1.0], [1.2, 0.9], [1.1, 4.0], [50.0, 1.1]])
    assert torch.equal(prototype(points), points.mean(0))
    # The coordinate-wise median is (1.1, 1.0): not a point; the nearest one is (1, 1).
    assert prototype(points, "medoid").tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("points", "kind", "message"),
    [
        (torch.zeros(3, 2), "mode", "valid prototypes: mean, medoid"),
        (torch.zeros(0, 2), "mean", "at least one"),
    ],
)
def test_prototypes_that_make_no_sense_are_refused(points: Tensor, kind: str, message: str) -> None:
    with pytest.raises(BMRLError, match=message):
        prototype(points, kind)


class Walk(EnvBase):
    """Moves by the action; the third coordinate counts the steps; truncates after six."""

    def __init__(self, batch_size: tuple[int, ...] = ()) -> None:
        super().__init__(batch_size=batch_size)
        shape = self.batch_size
        self.observation_spec = Composite(
            observation=Unbounded((*shape, OBSERVATION_DIM)), shape=shape
        )
        self.action_spec = Bounded(-1.0, 1.0, shape=(*shape, ACTION_DIM))
        self.reward_spec = Unbounded((*shape, 1))
        flag = Bounded(0, 1, shape=(*shape, 1), dtype=torch.bool)
        self.full_done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=shape
        )

    def _reset(self, tensordict: TensorDictBase | None, **kwargs: Any) -> TensorDict:
        return TensorDict(
            {"observation": torch.zeros(*self.batch_size, OBSERVATION_DIM)}, self.batch_size
        )

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        ones = torch.ones(*self.batch_size, 1)
        observation = tensordict["observation"] + torch.cat([tensordict["action"], ones], -1)
        truncated = observation[..., -1:] >= 6
        return TensorDict(
            {
                "observation": observation,
                "reward": observation.sum(-1, keepdim=True),
                "done": truncated,
                "truncated": truncated,
                "terminated": torch.zeros_like(truncated),
            },
            self.batch_size,
        )

    def _set_seed(self, seed: int | None) -> None:
        pass


POINT = torch.tensor([0.5, -2.0])


@pytest.fixture
def encoder() -> TensorDictModule:
    torch.manual_seed(0)
    return make_task_encoder(*DIMS, TASK_LATENT_DIM, num_cells=CELLS)


def demonstration() -> TensorDict:
    """Four transitions, step t at (10 t, 0, t)."""
    data = transitions(4, dtype=torch.float32)
    data["observation"] = torch.tensor([[10.0 * t, 0.0, float(t)] for t in range(4)])
    return data


def sources(encoder: TensorDictModule) -> dict[str, Transform]:
    return {
        "prototype": PrototypeTaskLatent(POINT),
        "online": OnlineTaskLatent(POINT, encoder),
        "time": DemonstrationTaskLatent(demonstration(), encoder),
        "state": DemonstrationTaskLatent(demonstration(), encoder, alignment="state"),
    }


def embedded(encoder: TensorDictModule, data: TensorDictBase) -> Tensor:
    with torch.no_grad():
        return encoder(data.select(*encoder.in_keys))["task_latent"]


@pytest.mark.parametrize("name", ["prototype", "online", "time", "state"])
@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_environments_with_a_task_latent_keep_to_their_specs(
    name: str, batch_size: tuple[int, ...], encoder: TensorDictModule
) -> None:
    env = TransformedEnv(Walk(batch_size), sources(encoder)[name])
    check_env_specs(env, seed=0)
    assert env.observation_spec["task_latent"].shape == (*batch_size, TASK_LATENT_DIM)


@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_prototype_is_constant(batch_size: tuple[int, ...]) -> None:
    rollout = TransformedEnv(Walk(batch_size), PrototypeTaskLatent(POINT)).rollout(10)
    assert rollout.shape == (*batch_size, 6)
    for latent in (rollout["task_latent"], rollout["next", "task_latent"]):
        assert torch.equal(latent, POINT.expand(*batch_size, 6, TASK_LATENT_DIM))


@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_online_is_the_embedding_of_the_last_transition_and_the_prototype_at_first(
    batch_size: tuple[int, ...], encoder: TensorDictModule
) -> None:
    env = TransformedEnv(Walk(batch_size), OnlineTaskLatent(POINT, encoder))
    for _ in range(2):  # the second episode starts from the prototype again
        rollout = env.rollout(10)
        latent = rollout["task_latent"]
        assert torch.equal(latent[..., 0, :], POINT.expand(*batch_size, TASK_LATENT_DIM))
        expected = embedded(encoder, rollout)
        torch.testing.assert_close(rollout["next", "task_latent"], expected)
        torch.testing.assert_close(latent[..., 1:, :], expected[..., :-1, :])
    assert not rollout["next", "task_latent"].requires_grad


def test_demonstration_by_time_goes_step_by_step_and_holds_its_last(
    encoder: TensorDictModule,
) -> None:
    env = TransformedEnv(Walk(), DemonstrationTaskLatent(demonstration(), encoder))
    latents = embedded(encoder, demonstration())
    for steps in (10, 2, 10):  # an episode that is broken off restarts as well
        latent = env.rollout(steps)["task_latent"]
        expected = latents[torch.arange(min(steps, 6)).clamp(max=3)]
        assert torch.equal(latent, expected)


@pytest.mark.parametrize("name", ["online", "time"])
def test_of_several_environments_only_those_that_restart_start_again(
    name: str, encoder: TensorDictModule
) -> None:
    env = TransformedEnv(Walk((2,)), sources(encoder)[name])
    data = env.reset()
    first = data["task_latent"][0].clone()
    for _ in range(2):
        data = env.step(env.rand_action(data))["next"].exclude("reward")
    before = data["task_latent"].clone()
    data = env.reset(data.set("_reset", torch.tensor([[True], [False]])))
    assert torch.equal(data["task_latent"], torch.stack([first, before[1]]))
    latent = env.step(env.rand_action(data))["next", "task_latent"]
    if name == "time":
        assert torch.equal(latent, embedded(encoder, demonstration())[[1, 3]])


@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_demonstration_by_state_takes_the_nearest_observation(
    batch_size: tuple[int, ...], encoder: TensorDictModule
) -> None:
    env = TransformedEnv(
        Walk(batch_size), DemonstrationTaskLatent(demonstration(), encoder, alignment="state")
    )
    latents = embedded(encoder, demonstration())
    assert torch.equal(env.reset()["task_latent"], latents[0].expand(*batch_size, TASK_LATENT_DIM))
    for x, nearest in ((18.0, 2), (-7.0, 0), (999.0, 3)):
        data = env.reset()
        data["observation"] = torch.tensor([x, 0.0, 0.0]).expand(*batch_size, OBSERVATION_DIM)
        data["action"] = torch.zeros(*batch_size, ACTION_DIM)
        latent = env.step(data)["next", "task_latent"]
        assert torch.equal(latent, latents[nearest].expand(*batch_size, TASK_LATENT_DIM))


def staged() -> TensorDict:
    """Seven transitions of a demonstration: three of stage 0, two of stage 1, two after the end."""
    data = transitions(7, dtype=torch.float32)
    return data.set("stage", torch.tensor([0, 0, 0, 1, 1, 2, 2]))


def driven(transform: Transform, stages: list[int], batch_size: tuple[int, ...] = ()) -> Tensor:
    """``task_latent`` before each step of an episode that is at ``stages``."""

    def at(stage: int) -> TensorDict:
        data = transitions(1, dtype=torch.float32)[0].exclude("next").expand(*batch_size)
        return data.clone().set("stage", torch.full(batch_size, stage))

    latents = [transform._reset(None, at(stages[0]))["task_latent"]]
    for stage in stages[1:]:
        following = at(stage).set("reward", torch.zeros(*batch_size, 1))
        latents.append(transform._step(at(stage), following)["task_latent"])
    return torch.stack(latents, -2)


@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_a_staged_demonstration_by_time_waits_for_the_stage_and_starts_anew_with_it(
    batch_size: tuple[int, ...], encoder: TensorDictModule
) -> None:
    transform = DemonstrationTaskLatent(staged(), encoder)
    expected = embedded(encoder, staged())[[0, 1, 2, 2, 2, 3, 5, 6, 6]]
    latents = driven(transform, [0, 0, 0, 0, 0, 1, 2, 2, 2], batch_size)
    assert torch.equal(latents, expected.expand_as(latents))


@pytest.mark.parametrize("alignment", ["state", "progress"])
def test_a_staged_demonstration_drives_a_stage_with_its_own_transitions_alone(
    alignment: str, encoder: TensorDictModule
) -> None:
    transform = DemonstrationTaskLatent(staged(), encoder, alignment=alignment)
    latents = embedded(encoder, staged())
    stages = [0, 0, 0, 1, 1, 1, 2, 2]
    for latent, stage in zip(driven(transform, stages), stages, strict=True):
        mine = latents[staged()["stage"] == stage]
        assert (latent == mine).all(-1).any()


def test_a_stage_that_the_demonstration_lacks_is_driven_by_its_last(
    encoder: TensorDictModule,
) -> None:
    transform = DemonstrationTaskLatent(staged()[:5], encoder)
    latents = driven(transform, [1, 1, 2, 2])
    assert torch.equal(latents[1:], embedded(encoder, staged())[[4, 4, 4]][: len(latents) - 1])


def test_progress_never_goes_back_nor_further_than_its_window(encoder: TensorDictModule) -> None:
    data = transitions(40, dtype=torch.float32)
    latents = embedded(encoder, data)
    for window in (1, 4):
        transform = DemonstrationTaskLatent(data, encoder, alignment="progress", window=window)
        rollout = TransformedEnv(Walk(), transform).rollout(6)
        taken = rollout["next", "task_latent"]
        position = [int((latents == latent).all(-1).nonzero()[0]) for latent in taken]
        steps = torch.tensor([0, *position]).diff()
        assert (steps >= 0).all()
        assert (steps <= window).all()


def test_progress_follows_an_episode_that_repeats_the_demonstration(
    encoder: TensorDictModule,
) -> None:
    data = transitions(8, dtype=torch.float32)
    transform = DemonstrationTaskLatent(data, encoder, alignment="progress")
    latents = embedded(encoder, data)
    transform._reset(None, data[0].exclude("next"))
    for t in range(8):
        for _ in range(2):  # at half the speed
            following = data[t]["next"].clone()
            latent = transform._step(data[t], following)["task_latent"]
            assert torch.equal(latent, latents[t])


def test_progress_stays_where_it_is_when_an_episode_falls_back(
    encoder: TensorDictModule,
) -> None:
    data = transitions(8, dtype=torch.float32)
    latents = embedded(encoder, data)
    transform = DemonstrationTaskLatent(data, encoder, alignment="progress")
    transform._reset(None, data[0].exclude("next"))
    positions = []
    for t in (5, 1):
        latent = transform._step(data[t], data[t]["next"].clone())["task_latent"]
        positions.append(int((latents == latent).all(-1).nonzero()[0]))
    nearest = (latents[5:] - latents[1]).norm(dim=-1).argmin()
    assert positions == [5, 5 + int(nearest)]


@pytest.mark.parametrize(
    ("rows", "options", "says"),
    [(0, {}, "0 transitions; valid: at least one"), (4, {"window": 0}, "window is 0; valid")],
)
def test_a_demonstration_that_cannot_drive_is_refused(
    rows: int, options: dict[str, Any], says: str, encoder: TensorDictModule
) -> None:
    with pytest.raises(BMRLError, match=says):
        DemonstrationTaskLatent(demonstration()[:rows], encoder, **options)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d.exclude(("next", "reward")), r"has no \('next', 'reward'\); valid: \["),
        (lambda d: d.set("observation", torch.zeros(7, 9)), r"'observation': \(7, 9\)"),
        (lambda d: d.set("action", torch.zeros(7, 1)), r"'action': \(7, 1\)"),
        (lambda d: d.set("stage", torch.tensor([0, 1, 0, 1, 1, 1, 1])), "never goes back"),
        (lambda d: d.set("stage", d["stage"] - 1), "from 0 on"),
    ],
    ids=["no reward", "other observation", "other action", "stages go back", "negative stage"],
)
def test_a_demonstration_of_another_layout_is_refused(
    change: Callable[[TensorDict], TensorDict], says: str, encoder: TensorDictModule
) -> None:
    with pytest.raises(BMRLError, match=says):
        DemonstrationTaskLatent(change(staged()), encoder)


def test_the_stage_chooses_among_points() -> None:
    points = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
    latents = driven(StageTaskLatent(points), [0, 0, 1, 2], (3,))
    assert torch.equal(latents, points[[0, 0, 1, 1]].expand(3, 4, 2))


def test_sources_hold_copies_without_gradients(encoder: TensorDictModule) -> None:
    point = POINT.clone().requires_grad_()
    transform = PrototypeTaskLatent(point)
    point.data.add_(1.0)
    assert torch.equal(transform.task_latent, POINT)
    data = demonstration()
    transform = DemonstrationTaskLatent(data, encoder)
    latents = transform.latents.clone()
    for parameter in encoder.parameters():
        parameter.data.zero_()
    assert torch.equal(transform.latents, latents)
    assert not transform.latents.requires_grad


def test_an_unknown_alignment_is_refused_with_the_valid_ones(encoder: TensorDictModule) -> None:
    with pytest.raises(BMRLError, match="'phase'; valid alignments: time, state, progress"):
        DemonstrationTaskLatent(demonstration(), encoder, alignment="phase")


def test_a_demonstration_is_no_transform_of_stored_data(encoder: TensorDictModule) -> None:
    with pytest.raises(BMRLError, match="environment"):
        DemonstrationTaskLatent(demonstration(), encoder)(demonstration())


PATHS = torch.arange(24.0).reshape(2, 4, 3)[..., :TASK_LATENT_DIM]
"""A path of four points for each of two environments."""


@pytest.mark.parametrize(
    ("batch_size", "points"),
    [((), PATHS[0]), ((2,), PATHS[0]), ((2,), PATHS), ((2,), PATHS[:, :1])],
)
def test_a_path_goes_point_by_point_in_every_environment_and_holds_its_last(
    batch_size: tuple[int, ...], points: Tensor
) -> None:
    env = TransformedEnv(Walk(batch_size), PathTaskLatent(points))
    check_env_specs(env, seed=0)
    for steps in (10, 2, 10):  # an episode that is broken off restarts as well
        latent = env.rollout(steps)["task_latent"]
        held = torch.arange(min(steps, 6)).clamp(max=points.shape[-2] - 1)
        expected = points[..., held, :].expand(*batch_size, -1, -1)
        assert torch.equal(latent, expected)


def test_of_several_paths_only_those_whose_episode_restarts_start_again() -> None:
    env = TransformedEnv(Walk((2,)), PathTaskLatent(PATHS))
    data = env.reset()
    for _ in range(2):
        data = env.step(env.rand_action(data))["next"].exclude("reward")
    data = env.reset(data.set("_reset", torch.tensor([[True], [False]])))
    assert torch.equal(data["task_latent"], torch.stack([PATHS[0, 0], PATHS[1, 2]]))
    latent = env.step(env.rand_action(data))["next", "task_latent"]
    assert torch.equal(latent, torch.stack([PATHS[0, 1], PATHS[1, 3]]))


def test_a_path_without_points_or_for_other_environments_is_refused() -> None:
    for points in (torch.zeros(2), torch.zeros(0, 2)):
        with pytest.raises(BMRLError, match=r"valid: \(\*B, T, m\), T > 0"):
            PathTaskLatent(points)
    for batch_size in ((), (3,)):
        with pytest.raises(BMRLError, match=r"paths of batch \(2,\) in an environment of"):
            TransformedEnv(Walk(batch_size), PathTaskLatent(PATHS)).reset()
    with pytest.raises(BMRLError, match="PathTaskLatent acts in an environment"):
        PathTaskLatent(PATHS)(demonstration())


def test_student_acts_in_an_environment_with_a_task_latent(encoder: TensorDictModule) -> None:
    policy = BCQPolicy(
        make_decoder(*DIMS, LATENT_DIM, task_latent_dim=TASK_LATENT_DIM, num_cells=CELLS),
        make_qvalue_network(*DIMS, task_latent_dim=TASK_LATENT_DIM, num_cells=CELLS),
        latent_dim=LATENT_DIM,
    )
    for transform in sources(encoder).values():
        rollout = TransformedEnv(Walk(), transform).rollout(10, policy)
        assert rollout["action"].abs().max() <= 1.0
        assert len(rollout["action"].unique(dim=0)) == 6


# -- policies of losses whose networks bring their own keys -------------------------------------


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
    assert act(policy, **entries).shape == (6, ACTION_DIM)


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
    assert act(policy, observation=pixels).shape == (6, ACTION_DIM)


# -- states that are expanded over their candidates ------------------------------------------------


def a_mlp() -> nn.Module:
    torch.manual_seed(0)
    return make_mlp(9, 2, (16, 16)).double()


def candidate_inputs(*batch: int, parts: int) -> tuple[list[Tensor], list[Tensor]]:
    """Inputs of which all but one are a state's, expanded over five candidates, and copies."""
    torch.manual_seed(1)
    sizes = {1: (9,), 2: (6, 3), 3: (4, 3, 2)}[parts]
    own = torch.randn(*batch, 5, sizes[1 % parts], dtype=torch.float64)
    inputs = [
        own
        if i == 1 % parts
        else torch.randn(*batch, 1, size, dtype=torch.float64).expand(*batch, 5, size)
        for i, size in enumerate(sizes)
    ]
    return inputs, [x.contiguous() for x in inputs]


@pytest.mark.parametrize("parts", [2, 3])
@pytest.mark.parametrize("batch", [(), (4,), (3, 4)])
def test_a_state_shared_by_its_candidates_gives_the_same_output_and_gradients(
    batch: tuple[int, ...], parts: int
) -> None:
    inputs, copies = candidate_inputs(*batch, parts=parts)
    results = []
    for given in (inputs, copies):
        network = a_mlp()
        value = network(*given)
        value.square().sum().backward()
        results.append([value, *(p.grad for p in network.parameters())])
    assert results[0][0].shape == (*batch, 5, 2)
    for ours, expected in zip(*results, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-10, atol=1e-12)


def test_a_state_shared_by_its_candidates_enters_the_first_layer_once() -> None:
    inputs, copies = candidate_inputs(4, parts=2)
    counts = []
    for given in (inputs, copies):
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            a_mlp()(*given)
        counts.append(counter.get_total_flops())
    assert counts[1] - counts[0] == 2 * 4 * (5 - 1) * 6 * 16  # states, candidates, inputs, cells


def test_networks_under_vmap_give_what_each_gives_alone() -> None:
    inputs, _ = candidate_inputs(3, 4, parts=2)
    network = a_mlp()
    value = torch.vmap(network)(*inputs)
    for row, expected in enumerate(value):
        torch.testing.assert_close(network(*(x[row] for x in inputs)), expected)


@pytest.mark.parametrize("shape", [(), (1,), (4,), (3, 4)])
def test_a_network_takes_any_batch(shape: tuple[int, ...]) -> None:
    x = torch.randn(*shape, 9, dtype=torch.float64)
    network = a_mlp()
    expected = nn.Sequential(*network)(x)  # layer by layer
    torch.testing.assert_close(network(x), expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("inplace", [True, False, "empty"])
def test_a_network_writes_where_a_tensordict_module_does(inplace: bool | str) -> None:
    data = TensorDict({"x": torch.randn(4, 3)}, [4])
    linear = nn.Linear(3, 2)
    options = {"in_keys": ["x"], "out_keys": ["y"], "inplace": inplace}
    ours, theirs = Network(linear, **options), TensorDictModule(linear, **options)
    result, expected = ours(data.copy()), theirs(data.copy())
    assert set(result.keys()) == set(expected.keys())
    assert result.batch_size == expected.batch_size
    torch.testing.assert_close(result["y"], expected["y"])
    torch.testing.assert_close(ours(x=data["x"]), expected["y"])
    dropped = Network(linear, in_keys=["x"], out_keys=["_"])
    assert set(dropped(data.copy()).keys()) == {"x"}
    with pytest.raises(RuntimeError, match="more out_keys than tensors"):
        Network(linear, in_keys=["x"], out_keys=["y", "z"])(data.copy())
