"""Every source of the task embedding writes the point that it promises at every step."""

from __future__ import annotations

import pytest
import torch
from helpers import CELLS, DIMS, LATENT_DIM, TASK_LATENT_DIM
from latent_sources import POINT, Walk, demonstration, driven, embedded, make_encoder
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform
from torchrl.envs.utils import check_env_specs

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import (
    BCQPolicy,
    DemonstrationTaskLatent,
    OnlineTaskLatent,
    PathTaskLatent,
    PrototypeTaskLatent,
    StageTaskLatent,
    make_decoder,
    make_qvalue_network,
    prototype,
)

encoder = pytest.fixture(make_encoder)


def sources(encoder: TensorDictModule) -> dict[str, Transform]:
    return {
        "prototype": PrototypeTaskLatent(POINT),
        "online": OnlineTaskLatent(POINT, encoder),
        "time": DemonstrationTaskLatent(demonstration(), encoder),
        "state": DemonstrationTaskLatent(demonstration(), encoder, alignment="state"),
        "progress": DemonstrationTaskLatent(demonstration(), encoder, alignment="progress"),
    }


# -- every source ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["prototype", "online", "time", "state"])
@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_environments_with_a_task_latent_keep_to_their_specs(
    name: str, batch_size: tuple[int, ...], encoder: TensorDictModule
) -> None:
    env = TransformedEnv(Walk(batch_size), sources(encoder)[name])
    check_env_specs(env, seed=0)
    assert env.observation_spec["task_latent"].shape == (*batch_size, TASK_LATENT_DIM)


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


# -- points ----------------------------------------------------------------------------------------


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


def test_the_stage_chooses_among_points() -> None:
    points = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
    latents = driven(StageTaskLatent(points), [0, 0, 1, 2], (3,))
    assert torch.equal(latents, points[[0, 0, 1, 1]].expand(3, 4, 2))


# -- paths -----------------------------------------------------------------------------------------

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
