"""Networks have the shapes, bounds and inputs that they declare."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    CELLS,
    DIMS,
    LATENT_DIM,
    OBSERVATION_DIM,
    TASK_LATENT_DIM,
    observations,
    transitions,
)
from recomputed import numpy_mlp
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from torchrl_bmrl.modules import (
    ActionVAE,
    make_decoder,
    make_perturbation_network,
    make_qvalue_network,
    make_task_classifier,
    make_task_encoder,
)
from torchrl_bmrl.modules.generator import Network, make_mlp

# -- the generator ---------------------------------------------------------------------------------


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


# -- critics, perturbations, encoders --------------------------------------------------------------


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


# -- any batch, and states that are expanded over their candidates ---------------------------------


def a_mlp() -> nn.Module:
    torch.manual_seed(0)
    return make_mlp(9, 2, (16, 16)).double()


def candidate_inputs(*batch: int, parts: int) -> tuple[list[Tensor], list[Tensor]]:
    """Inputs for five candidates and contiguous copies; the second differs between candidates."""
    torch.manual_seed(1)
    sizes = {2: (6, 3), 3: (4, 3, 2)}[parts]
    inputs = [
        torch.randn(*batch, 5 if i == 1 else 1, size, dtype=torch.float64).expand(*batch, 5, size)
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


def test_an_autoencoder_lists_the_encoder_s_parameters_first() -> None:
    """In this order the checkpoints of older runs contain the optimizer's state."""
    names = [name.split(".")[0] for name, _ in ActionVAE(3, 2).named_parameters()]
    half = len(names) // 2
    assert names == ["encoder"] * half + ["decoder"] * half
