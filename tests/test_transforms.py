"""One observation for data and environments; normalisation that weighs every task alike."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("gymnasium")

import torch
from observations import OBSERVATION_SHAPES
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Composite, Unbounded

from torchrl_bmrl.data.episodes import Episode, stack_episodes
from torchrl_bmrl.envs.perturbation import PerturbAction, tilt
from torchrl_bmrl.envs.transforms import (
    ObservationStatistics,
    SinCosTransform,
    StageReward,
    make_observation_transform,
    transform_data,
)
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.experts.tabletop import OBSERVATION_PARTS
from torchrl_bmrl.tasks import get_task

TASK = get_task("push_left")


def random_episodes(
    count: int, *, seed: int, loc: float = 0.0, scale: float = 1.0
) -> list[Episode]:
    rng = np.random.default_rng(seed)

    def parts() -> dict[str, np.ndarray]:
        return {
            name: loc + scale * rng.standard_normal((6, size))
            for name, size in OBSERVATION_SHAPES.items()
        }

    return [
        Episode(
            observations=parts(),
            next_observations=parts(),
            actions=rng.uniform(-1, 1, (6, 7)).astype(np.float32),
            rewards=np.zeros(6),
            terminated=np.zeros(6, bool),
        )
        for _ in range(count)
    ]


def raw_observation(parts: dict[str, np.ndarray]) -> np.ndarray:
    """``observation`` as the documentation spells it."""
    joints = parts["robot0_joint_pos"]
    names = list(OBSERVATION_SHAPES)[1:]
    return np.concatenate([np.sin(joints), np.cos(joints), *(parts[n] for n in names)], axis=-1)


def test_zero_and_a_full_turn_are_the_same_point() -> None:
    transform = SinCosTransform("q", "sin", "cos")
    angles = torch.tensor([[0.0, 1.0, -3.0], [2 * torch.pi, 1 + 2 * torch.pi, 2 * torch.pi - 3]])
    out = transform(TensorDict({"q": angles.double()}, [2]))
    torch.testing.assert_close(out["sin"][0], out["sin"][1], atol=1e-6, rtol=0)
    torch.testing.assert_close(out["cos"][0], out["cos"][1], atol=1e-6, rtol=0)
    # And no other angle is: both parts are needed.
    assert (out["sin"][0] ** 2 + out["cos"][0] ** 2).allclose(torch.ones(3).double())
    torch.testing.assert_close(torch.atan2(out["sin"][0], out["cos"][0]).float(), angles[0])


def test_angles_are_replaced_in_the_data_and_in_the_specification() -> None:
    transform = SinCosTransform("q", "sin", "cos")
    assert set(transform(TensorDict({"q": torch.ones(4, 7)}, [4])).keys()) == {"sin", "cos"}
    spec = transform.transform_observation_spec(Composite(q=Unbounded((7,), dtype=torch.float64)))
    assert {key: (part.shape, part.dtype) for key, part in spec.items()} == {
        "sin": ((7,), torch.float64),
        "cos": ((7,), torch.float64),
    }


def test_observation_is_33_numbers_in_the_documented_order() -> None:
    assert OBSERVATION_PARTS == (
        "sin_joint_pos",
        "cos_joint_pos",
        "robot0_gripper_qpos",
        "robot0_joint_vel",
        "robot0_eef_pos",
        "robot0_eef_quat",
        "goal_pos",
    )
    (episode,) = random_episodes(1, seed=0)
    data = stack_episodes([episode], task=0)
    out = make_observation_transform(TASK)(data.copy())
    expected = torch.as_tensor(raw_observation(episode.observations)).float()
    assert out["observation"].shape == (6, 33)
    torch.testing.assert_close(out["observation"], expected)
    assert not set(OBSERVATION_SHAPES) & set(out.keys())


def test_stored_transitions_are_normalised_now_and_next() -> None:
    (episode,) = random_episodes(1, seed=1)
    statistics = ObservationStatistics(torch.arange(33.0), torch.linspace(0.5, 2, 33))
    data = stack_episodes([episode], task=3)
    kept = data.clone()
    out = transform_data(data, TASK, statistics)
    for observation, parts in (
        (out["observation"], episode.observations),
        (out["next", "observation"], episode.next_observations),
    ):
        raw = torch.as_tensor(raw_observation(parts)).float()
        torch.testing.assert_close(observation, (raw - statistics.loc) / statistics.scale)
        assert observation.dtype == torch.float32
    for key in ("action", "task", "step", ("next", "reward"), ("next", "truncated")):
        assert out[key].equal(kept[key])
    assert (data == kept).all()  # the argument is left as it was


def test_every_task_weighs_the_same_however_many_steps_it_has() -> None:
    few = stack_episodes(random_episodes(2, seed=2, loc=1.0, scale=0.1), task=0)
    many = stack_episodes(random_episodes(40, seed=3, loc=-1.0, scale=0.1), task=1)
    statistics = ObservationStatistics.of([few, many], [TASK] * 2)
    assert ObservationStatistics.of([few, few, many], [TASK] * 3).loc[20] > statistics.loc[20] + 0.2
    # Goal and positions: half of the weight at +1, half at -1.
    torch.testing.assert_close(statistics.loc[23:], torch.zeros(10), atol=0.1, rtol=0)
    torch.testing.assert_close(statistics.scale[23:], torch.ones(10), atol=0.1, rtol=0)
    repeated = stack_episodes(random_episodes(2, seed=2, loc=1.0, scale=0.1) * 20, task=0)
    again = ObservationStatistics.of([repeated, many], [TASK] * 2)
    torch.testing.assert_close(again.loc, statistics.loc)
    torch.testing.assert_close(again.scale, statistics.scale)


def test_normalised_training_data_have_mean_0_and_deviation_1() -> None:
    datasets = [
        stack_episodes(random_episodes(5, seed=i, loc=i, scale=1 + i), task=i) for i in range(3)
    ]
    statistics = ObservationStatistics.of(datasets, [TASK] * 3)
    observation = torch.cat([transform_data(d, TASK, statistics)["observation"] for d in datasets])
    torch.testing.assert_close(observation.mean(0), torch.zeros(33), atol=1e-5, rtol=0)
    torch.testing.assert_close(observation.std(0, correction=0), torch.ones(33), atol=1e-5, rtol=0)


def test_a_part_that_never_changes_stays_finite() -> None:
    data = stack_episodes(random_episodes(2, seed=0), task=0)
    data["goal_pos"] = torch.full_like(data["goal_pos"], 0.8)
    statistics = ObservationStatistics.of([data], [TASK] * 1)
    out = transform_data(data, TASK, statistics)["observation"]
    assert (statistics.scale > 0).all()
    assert out.isfinite().all()
    torch.testing.assert_close(out[:, 30:], torch.zeros(12, 3), atol=1e-3, rtol=0)


def test_a_part_that_hardly_changes_is_scaled_up_by_a_thousand_at_most() -> None:
    data = stack_episodes(random_episodes(2, seed=0), task=0)
    data["goal_pos"] = 1e-4 * data["goal_pos"]
    statistics = ObservationStatistics.of([data], [TASK])
    torch.testing.assert_close(statistics.scale[30:], torch.full((3,), 1e-3), rtol=0, atol=0)


@pytest.mark.robosuite
def test_data_and_environment_give_the_same_observation_for_the_same_episode() -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    from torchrl_bmrl.envs.tabletop import TabletopEnv
    from torchrl_bmrl.envs.transforms import make_env

    rng = np.random.default_rng(0)
    statistics = ObservationStatistics(
        torch.as_tensor(rng.normal(size=33)).float(),
        torch.as_tensor(rng.uniform(0.5, 2, 33)).float(),
    )
    actions = rng.uniform(-1, 1, (8, 7)).astype(np.float32)

    env = TabletopEnv("push_left")
    parts, _ = env.reset(seed=7)
    shown, rewards = [parts], []
    for action in actions:
        parts, reward, *_ = env.step(action)
        shown.append(parts)
        rewards.append(reward)
    env.close()
    stacked = {name: np.stack([parts[name] for parts in shown]) for name in OBSERVATION_SHAPES}
    episode = Episode(
        observations={name: part[:-1] for name, part in stacked.items()},
        next_observations={name: part[1:] for name, part in stacked.items()},
        actions=actions,
        rewards=np.array(rewards),
        terminated=np.zeros(8, bool),
    )
    stored = transform_data(stack_episodes([episode], task=0), TASK, statistics)

    env = make_env("push_left", statistics)
    steps = iter(torch.as_tensor(actions))
    lived = env.rollout(
        8,
        TensorDictModule(lambda _: next(steps), ["observation"], ["action"]),
        tensordict=env.reset(seed=7),
        auto_reset=False,
    )
    env.close()
    for key in ("observation", ("next", "observation"), ("next", "reward"), "action"):
        assert lived[key].shape == stored[key].shape
        assert lived[key].equal(stored[key]), key


# -- perturbed actions -----------------------------------------------------------------------------


def executed(transform: PerturbAction, action: torch.Tensor) -> torch.Tensor:
    return transform.inv(TensorDict({"action": action}, action.shape[:-1]))["action"]


def angle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.rad2deg(torch.cosine_similarity(a, b, -1).clamp(-1, 1).acos())


def test_the_motion_is_scaled_within_the_range_and_the_gripper_left_alone() -> None:
    torch.manual_seed(0)
    action = 0.4 * torch.randn(1000, 7).clamp(-1, 1)
    after = executed(PerturbAction(magnitude=(0.5, 1.5)), action)
    factor = after[:, :6] / action[:, :6]
    torch.testing.assert_close(factor, factor[:, :1].expand(-1, 6))
    assert 0.5 <= factor.min() < 0.51
    assert 1.49 < factor.max() <= 1.5
    assert torch.equal(after[:, 6], action[:, 6])


def test_the_position_is_tilted_by_up_to_the_angle_and_keeps_its_length() -> None:
    torch.manual_seed(0)
    action = 0.5 * torch.nn.functional.normalize(torch.randn(2000, 7), dim=-1)
    after = executed(PerturbAction(max_angle=45.0), action)
    turned = angle(after[:, :3], action[:, :3])
    assert turned.max() <= 45.01
    assert abs(turned.mean() - 22.5) < 1.0  # uniform
    torch.testing.assert_close(after[:, :3].norm(dim=-1), action[:, :3].norm(dim=-1))
    torch.testing.assert_close(after[:, 3:], action[:, 3:])


def test_what_is_executed_stays_within_the_bounds() -> None:
    after = executed(PerturbAction(magnitude=(3.0, 3.0), max_angle=45.0), torch.ones(50, 7))
    assert after.abs().max() == 1.0


def test_no_motion_stays_no_motion() -> None:
    after = executed(PerturbAction(magnitude=(0.5, 1.5), max_angle=45.0), torch.zeros(5, 7))
    assert torch.equal(after, torch.zeros(5, 7))


@pytest.mark.parametrize("per", ["step", "episode"])
def test_the_draw_lasts_a_step_or_an_episode(per: str) -> None:
    torch.manual_seed(0)
    transform = PerturbAction(magnitude=(0.5, 1.5), max_angle=45.0, per=per)
    action = torch.full((4, 7), 0.3)

    def start(mask: torch.Tensor | None) -> list[torch.Tensor]:
        reset = None if mask is None else TensorDict({"_reset": mask}, [4])
        transform._reset(reset, TensorDict({}, [4]))
        return [executed(transform, action) for _ in range(2)]

    first, second = start(None)
    assert torch.equal(first, second) == (per == "episode")
    assert len(first.unique(dim=0)) == 4  # each episode has its own
    again = start(torch.tensor([[True], [False], [False], [False]]))[0]
    assert not torch.equal(again[0], first[0])
    assert torch.equal(again[1:], first[1:]) == (per == "episode")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"magnitude": (1.5, 0.5)}, "magnitude is"),
        ({"magnitude": (-1.0, 0.5)}, "magnitude is"),
        ({"max_angle": 200.0}, "max_angle is 200.0; valid: between 0 and 180"),
        ({"per": "task"}, "'task'; valid pers: step, episode"),
    ],
)
def test_an_invalid_perturbation_is_named(options: dict, says: str) -> None:
    with pytest.raises(BMRLError, match=says):
        PerturbAction(**options)


def test_a_right_angle_is_a_cross_product_away() -> None:
    torch.manual_seed(0)
    vector, towards = torch.randn(2, 20, 3)
    turned = tilt(vector, towards, torch.full((20, 1), torch.pi / 2))
    normal = torch.linalg.cross(vector, towards)
    torch.testing.assert_close((turned * vector).sum(-1), torch.zeros(20), atol=1e-5, rtol=0)
    torch.testing.assert_close((turned * normal).sum(-1), torch.zeros(20), atol=1e-5, rtol=0)
    assert ((turned * towards).sum(-1) > 0).all()


def test_the_data_keep_the_policys_action_and_the_simulator_gets_the_perturbed_one() -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    from torchrl_bmrl.envs.transforms import make_env

    action = torch.tensor([0.0, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0])
    up = TensorDictModule(lambda _: action, ["observation"], ["action"])

    heights = []
    for factor in (1.0, 0.5):
        env = make_env("reach", None, PerturbAction(magnitude=(factor, factor)))
        env.set_seed(0)
        data = env.rollout(20, up)
        assert (data["action"][:, 2] == torch.tensor(0.4)).all()
        heights.append(float(data["next", "observation"][-1, 25] - data["observation"][0, 25]))
        env.close()
    assert 0 < heights[1] < 0.7 * heights[0]


# -- sparse reward ---------------------------------------------------------------------------------


def test_stages_are_paid_once_each_and_the_agent_knows_how_many_are_done() -> None:
    transform = StageReward(4)
    stages = [torch.tensor([0, 2]), torch.tensor([0, 3]), torch.tensor([2, 3])]
    shown = [TensorDict({"stage": stage}, [2]) for stage in stages]
    now = transform._reset(None, shown[0])
    assert now["progress"].flatten().tolist() == [0, 0.5]
    rewards = []
    for after in shown[1:]:
        now = transform._step(now, after.set("reward", torch.rand(2, 1)))  # the dense one goes
        rewards.append(now["reward"].flatten().tolist())
    assert rewards == [[0, 1], [2, 0]]
    assert now["progress"].flatten().tolist() == [0.5, 0.75]
    with pytest.raises(BMRLError, match="num_stages is 0"):
        StageReward(0)


@pytest.mark.robosuite
def test_a_composition_with_sparse_reward_keeps_its_specs() -> None:
    from torchrl.envs import check_env_specs

    from torchrl_bmrl.envs.transforms import make_env

    env = make_env("reach-lift", None, StageReward(2), num_envs=2)
    check_env_specs(env)
    data = env.rollout(2)
    assert data["next", "reward"].tolist() == [[[0], [0]]] * 2
    assert data["progress"].shape == (2, 2, 1)
    env.close()
