"""Encoders of sets: what does not matter in a context, and how it grows in an episode."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import pytest
import torch
from helpers import CELLS, DIMS, transitions
from latent_sources import Walk
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.modules import (
    ContextTaskLatent,
    OnlineTaskLatent,
    as_context,
    embed_context,
    make_context_encoder,
    make_one_hot_encoder,
    make_task_encoder,
    make_told_encoder,
    reads_context,
)
from torchrl_bmrl.modules.context_encoder import POOLINGS
from torchrl_bmrl.modules.demonstration_latent import DemonstrationTaskLatent

SIZE = 4
each_pooling = pytest.mark.parametrize("pooling", POOLINGS)


def make_encoder(pooling: str = "attention", dtype: torch.dtype = torch.float64) -> Any:
    torch.manual_seed(0)
    encoder = make_context_encoder(*DIMS, SIZE, pooling=pooling, num_features=6, num_cells=CELLS)
    encoder.module.step_scale.copy_(torch.tensor([0.5, 2.0, 1.0]))
    encoder.module.reward_loc.fill_(3.0)
    encoder.module.reward_scale.fill_(0.2)
    return encoder.to(dtype)


def some(*batch: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> TensorDict:
    data = transitions(*batch, dtype=dtype, seed=seed)
    return data.select("observation", "action", ("next", "reward"), ("next", "observation"))


def m(encoder: TensorDictModule, data: TensorDictBase, mask: Tensor | None = None) -> Tensor:
    return encoder(as_context(data, mask))["task_latent"]


# -- the embedding ---------------------------------------------------------------------------------


@each_pooling
def test_it_is_the_formula(pooling: str) -> None:
    encoder, data = make_encoder(pooling), some(5)
    network = encoder.module
    embedded = []
    for row in data:
        step = (row["next", "observation"] - row["observation"]) / torch.tensor([0.5, 2.0, 1.0])
        reward = (row["next", "reward"] - 3) / torch.tensor(0.2).double()  # 0.2 in float32
        x = torch.cat([row["observation"], row["action"], reward, step])
        embedded.append(network.each(x))
    if pooling == "attention":
        raw = [math.exp(x[-1].item()) for x in embedded]
        weights = [x / sum(raw) for x in raw]
        embedded = [x[:-1] for x in embedded]
    else:
        weights = [1 / 5] * 5
    pooled = sum(weight * x for weight, x in zip(weights, embedded, strict=True))
    torch.testing.assert_close(m(encoder, data), network.whole(pooled))


@each_pooling
def test_the_order_of_a_context_does_not_matter(pooling: str) -> None:
    encoder, data = make_encoder(pooling), some(2, 7)
    torch.testing.assert_close(m(encoder, data[:, torch.randperm(7)]), m(encoder, data))


@each_pooling
def test_a_context_that_is_there_twice_has_the_same_embedding(pooling: str) -> None:
    encoder, data = make_encoder(pooling), some(6)
    torch.testing.assert_close(m(encoder, torch.cat([data, data])), m(encoder, data))


@each_pooling
@pytest.mark.parametrize("padding", [7.0, float("nan"), float("inf")])
def test_masked_transitions_may_hold_anything(pooling: str, padding: float) -> None:
    encoder, data = make_encoder(pooling), some(2, 5)
    mask = torch.tensor([[True, False, True, True, False], [False, True, False, False, False]])
    expected = torch.stack([m(encoder, data[i, mask[i]]) for i in range(2)])
    for key, value in list(data.items(True, True)):
        data[key] = value.masked_fill(~mask.unsqueeze(-1), padding)
    found = m(encoder, data, mask)
    torch.testing.assert_close(found, expected)
    found.sum().backward()
    assert all(p.grad.isfinite().all() for p in encoder.parameters())


@each_pooling
def test_it_does_not_depend_on_the_rest_of_the_batch(pooling: str) -> None:
    encoder, data = make_encoder(pooling), some(2, 3, 5)
    every = m(encoder, data)
    assert every.shape == (2, 3, SIZE)
    torch.testing.assert_close(m(encoder, data[1, 2]), every[1, 2])
    torch.testing.assert_close(torch.vmap(lambda *x: encoder.module(*x))(*inputs(data)), every)


def inputs(data: TensorDictBase) -> list[Tensor]:
    mask = torch.ones(data.shape, dtype=torch.bool)
    keys = ("observation", "action", ("next", "reward"), ("next", "observation"))
    return [*(data[key] for key in keys), mask]


@each_pooling
def test_every_part_of_a_transition_matters(pooling: str) -> None:
    encoder, data = make_encoder(pooling), some(4)
    for key in list(data.keys(True, True)):
        changed = data.clone()
        changed[key][2] += 1
        assert not torch.allclose(m(encoder, changed), m(encoder, data)), key


def test_attention_may_leave_a_transition_out_and_a_mean_may_not() -> None:
    mean, attention = make_encoder("mean"), make_encoder("attention")
    assert len(attention.module.each[-1].weight) == 1 + len(mean.module.each[-1].weight)


@each_pooling
def test_a_state_and_its_scale_go_through_a_state_dict(pooling: str) -> None:
    encoder = make_encoder(pooling)
    other = make_context_encoder(*DIMS, SIZE, pooling=pooling, num_features=6, num_cells=CELLS)
    other.double().load_state_dict(encoder.state_dict())
    assert torch.equal(m(other, some(5)), m(encoder, some(5)))
    assert torch.equal(m(copy.deepcopy(encoder), some(5)), m(encoder, some(5)))
    assert torch.equal(m(pickle.loads(pickle.dumps(encoder)), some(5)), m(encoder, some(5)))


@each_pooling
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_it_computes_in_the_type_of_the_data(pooling: str, dtype: torch.dtype) -> None:
    encoder = make_encoder(pooling, dtype)
    assert m(encoder, some(5, dtype=dtype)).dtype == dtype
    expected = m(make_encoder(pooling), some(5)).to(dtype)
    torch.testing.assert_close(m(encoder, some(5, dtype=dtype)), expected, rtol=1e-4, atol=1e-5)


@each_pooling
def test_compiling_changes_nothing(pooling: str) -> None:
    network = make_encoder(pooling).module
    compiled = torch.compile(network, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(*inputs(some(2, 5))), network(*inputs(some(2, 5))))


@pytest.mark.parametrize("size", [1, 300])
def test_contexts_of_any_size_are_embedded(size: int) -> None:
    assert embed_context(make_encoder(), some(size)).isfinite().all()


def test_the_average_of_single_embeddings_is_the_context_of_an_encoder_of_transitions() -> None:
    encoder, data = make_task_encoder(*DIMS, num_cells=CELLS).double(), some(3, 5)
    expected = encoder(data.clone())["task_latent"].mean(1).detach()
    torch.testing.assert_close(embed_context(encoder, data), expected)
    assert not embed_context(make_encoder(), data).requires_grad


def test_an_input_is_left_as_it_was() -> None:
    data = some(5)
    keys = set(data.keys(True, True))
    embed_context(make_encoder(), data)
    as_context(data)
    assert set(data.keys(True, True)) == keys


def test_encoders_are_told_apart_by_what_they_read() -> None:
    assert reads_context(make_encoder())
    others = [make_task_encoder(*DIMS), make_one_hot_encoder(2), make_told_encoder(torch.eye(2))]
    assert not any(map(reads_context, others))


# -- what is refused -------------------------------------------------------------------------------


def test_another_pooling_is_refused() -> None:
    with pytest.raises(UnknownNameError, match=r"'max'; valid.*mean, attention"):
        make_context_encoder(*DIMS, pooling="max")


def test_scales_are_those_of_all_data_together() -> None:
    first, second = some(40), some(30, seed=1)
    second["next", "reward"] *= 5
    for data in (first, second):
        data["next", "observation"][:, 2] = data["observation"][:, 2] + 1e-5 * torch.rand(len(data))
    network = make_encoder().module
    network.set_scales(first, second)
    steps = [x["next", "observation"] - x["observation"] for x in (first, second)]
    expected = torch.cat(steps).std(0)
    expected[2] = 1  # a number that hardly moves is not enlarged
    torch.testing.assert_close(network.step_scale, expected)
    reward = torch.cat([x["next", "reward"] for x in (first, second)])
    torch.testing.assert_close(network.reward_loc, reward.mean(0))
    torch.testing.assert_close(network.reward_scale, reward.std(0))


@pytest.mark.parametrize("count", [1, 4])
def test_scales_of_rewards_and_states_that_never_change_are_one(count: int) -> None:
    still = some(1).expand(count).clone()
    still["next", "observation"] = still["observation"]
    network = make_encoder().module
    network.set_scales(still)
    assert network.step_scale.tolist() == [1.0] * 3
    assert network.reward_scale.tolist() == [1.0]
    assert m(make_encoder(), still).isfinite().all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda data: data[:0], r"batch size \[0\]; valid: \[..., K\], K > 0"),
        (lambda data: data[0], r"batch size \[\]; valid"),
        (lambda data: data.exclude("action"), "no 'action'; valid"),
        (lambda data: data.exclude(("next", "reward")), "no .*reward.*; valid"),
        (lambda data: data.set("action", torch.zeros(5, 9)), r"'action': \(5, 9\).*valid"),
    ],
    ids=["empty", "no batch", "no action", "no reward", "another size"],
)
def test_a_context_that_does_not_fit_is_refused(change: Any, says: str) -> None:
    with pytest.raises(BMRLError, match=says):
        embed_context(make_encoder(), change(some(5)))


@pytest.mark.parametrize(
    "mask",
    [torch.ones(4, dtype=torch.bool), torch.ones(5), torch.zeros(5, dtype=torch.bool)],
    ids=["shape", "type", "nothing counts"],
)
def test_a_mask_that_does_not_fit_is_refused(mask: Tensor) -> None:
    with pytest.raises(BMRLError, match=r"the mask is .*valid"):
        as_context(some(5), mask)


@pytest.mark.parametrize("encoder", [make_one_hot_encoder(2), make_told_encoder(torch.eye(2))])
def test_an_encoder_that_reads_no_transitions_has_no_embedding_of_a_context(encoder: Any) -> None:
    with pytest.raises(BMRLError, match=r"reads .'task'.*valid: single transitions"):
        embed_context(encoder, some(5))
    with pytest.raises(BMRLError, match=r"reads .'task'.*valid: single transitions"):
        OnlineTaskLatent(torch.zeros(2), encoder)


def test_sources_of_m_name_the_encoder_that_they_need() -> None:
    with pytest.raises(BMRLError, match=r"context.*valid: single transitions"):
        OnlineTaskLatent(torch.zeros(SIZE), make_encoder())
    with pytest.raises(BMRLError, match=r"context.*valid: single transitions"):
        DemonstrationTaskLatent(some(5), make_encoder())
    with pytest.raises(BMRLError, match="valid: make_context_encoder"):
        ContextTaskLatent(torch.zeros(SIZE), make_task_encoder(*DIMS))


# -- a context that grows --------------------------------------------------------------------------

START = torch.arange(4.0)


def growing(
    pooling: str = "attention", context: TensorDictBase | None = None, *batch: int
) -> tuple[TransformedEnv, Any]:
    encoder = make_encoder(pooling, torch.float32)
    return TransformedEnv(Walk(batch), ContextTaskLatent(START, encoder, context)), encoder


def expected(encoder: Any, past: TensorDictBase, given: TensorDictBase | None = None) -> Tensor:
    """m of all transitions ``[t]`` so far."""
    past = past.select(*some(1).keys(True, True))
    whole = past if given is None else torch.cat([given, past])
    return embed_context(encoder, whole) if len(whole) else START


@each_pooling
@pytest.mark.parametrize("given", [0, 3])
def test_a_growing_context_is_the_whole_context_at_each_step(pooling: str, given: int) -> None:
    torch.manual_seed(0)
    context = some(given, dtype=torch.float32) if given else None
    env, encoder = growing(pooling, context)
    for _ in range(2):  # the second episode begins anew
        played = env.rollout(6)
        for step in range(6):
            latent = expected(encoder, played[:step], context)
            torch.testing.assert_close(played[step]["task_latent"], latent)
            after = expected(encoder, played[: step + 1], context)
            torch.testing.assert_close(played[step]["next", "task_latent"], after)


@each_pooling
@pytest.mark.parametrize("given", [0, 2])
def test_some_of_several_environments_may_be_reset(pooling: str, given: int) -> None:
    torch.manual_seed(0)
    context = some(given, dtype=torch.float32) if given else None
    env, encoder = growing(pooling, context, 3)
    past: list[list[TensorDictBase]] = [[] for _ in range(3)]
    data = env.reset()
    resets = {2: [0], 4: [1, 2], 5: [1], 7: [0, 1, 2]}
    for step in range(10):
        for i in range(3):
            own = torch.stack(past[i]) if past[i] else some(1, dtype=torch.float32)[:0]
            torch.testing.assert_close(data["task_latent"][i], expected(encoder, own, context))
        whole = env.step(env.rand_action(data))
        for i in range(3):
            past[i].append(whole[i].select(*some(1).keys(True, True)).clone())
        data = whole["next"].exclude("reward")
        if step in resets:
            reset = torch.zeros(3, 1, dtype=torch.bool)
            reset[resets[step]] = True
            data = env.reset(data.set("_reset", reset))
            for i in resets[step]:
                past[i] = []


def test_earlier_episodes_do_not_stay_in_memory() -> None:
    env, _ = growing("mean", some(2, dtype=torch.float32), 2)
    env.rollout(40, break_when_any_done=False)  # of 6 steps each
    assert env.transform._kept.shape[-2] <= 2 + 6


def test_a_given_context_may_differ_between_environments() -> None:
    context = some(2, 5, dtype=torch.float32)
    env, encoder = growing("attention", context, 2)
    expected_ = torch.stack([embed_context(encoder, context[i]) for i in range(2)])
    torch.testing.assert_close(env.reset()["task_latent"], expected_)
    with pytest.raises(BMRLError, match=r"batch \(2,\) in an environment of \(3,\); valid"):
        growing("attention", context, 3)[0].reset()


@each_pooling
def test_what_does_not_count_in_a_given_context_is_not_read(pooling: str) -> None:
    torch.manual_seed(0)
    context = some(2, 5, dtype=torch.float32)
    mask = torch.tensor([[True, True, False, False, False], [True, False, True, False, False]])
    context["observation"][~mask] = torch.nan
    encoder = make_encoder(pooling, torch.float32)
    source = ContextTaskLatent(START, encoder, context, mask)
    env = TransformedEnv(Walk((2,)), source)
    data = env.reset()
    for i in range(2):
        own = embed_context(encoder, context[i][mask[i]])
        torch.testing.assert_close(data["task_latent"][i], own)
    reset = torch.tensor([[True], [False]])
    for _ in range(3):  # columns that count nowhere stay where they are
        data = env.step(env.rand_action(data))["next"]
        data = env.reset(data.exclude("reward").set("_reset", reset))
        again = data["task_latent"]
        torch.testing.assert_close(again[0], embed_context(encoder, context[0][mask[0]]))
        assert not torch.equal(again[1], embed_context(encoder, context[1][mask[1]]))
    with pytest.raises(BMRLError, match=r"the mask is torch.bool of shape \[5\]; valid"):
        ContextTaskLatent(START, encoder, context, mask[0])


def test_an_episode_sends_no_gradient_and_the_spec_has_m() -> None:
    env, _ = growing()
    assert not env.rollout(3)["task_latent"].requires_grad
    assert env.observation_spec["task_latent"].shape == (SIZE,)
    with pytest.raises(BMRLError, match="acts in an environment"):
        env.transform(some(2))


def test_the_given_context_moves_and_is_copied_with_the_transform() -> None:
    context = some(3, dtype=torch.float32)
    source = ContextTaskLatent(START, make_encoder(dtype=torch.float32), context)
    assert "given" in dict(source.named_buffers())
    assert source.to("meta").given.device.type == "meta"


@each_pooling
@pytest.mark.parametrize("given", [0, 3])
def test_all_that_an_episode_makes_lies_on_the_data_s_device(pooling: str, given: int) -> None:
    context = some(given, dtype=torch.float32) if given else None
    source = ContextTaskLatent(START, make_encoder(pooling, torch.float32), context).to("meta")
    data = some(2, dtype=torch.float32).to("meta")  # a device that meets no other one
    after = TensorDict({"observation": data["observation"], "reward": data["next", "reward"]}, [2])
    made = [source._reset(None, data.exclude("next"))]
    made += [source._step(data, after.copy()) for _ in range(2)]
    assert {each["task_latent"].device.type for each in made} == {"meta"}
    assert {each["task_latent"].shape for each in made} == {(2, SIZE)}
