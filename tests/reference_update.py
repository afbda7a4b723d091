"""The library's side of a comparison with :mod:`reference`: networks, data, noise, one update."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import reference
import torch
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

TOLERANCE = 1e-9
OBSERVATION_DIM, ACTION_DIM, LATENT_DIM, TASK_LATENT_DIM, HIDDEN = 3, 2, 4, 2, 3
ROWS, CANDIDATES, NUM_ACTIONS, TASKS, MAX_LATENT = 6, 5, 4, 3, 2.0
NOISE_SEED = 7
Differences = dict[str, float]
Record = Callable[[str, object], None]


# -- networks: one hidden tanh layer, which is smooth for finite differences -----------------------


class Network(nn.Module):
    def __init__(
        self, in_features: int, out_features: int, head: Callable[[Tensor], Any] | None = None
    ) -> None:
        super().__init__()
        self.hidden = nn.Linear(in_features, HIDDEN)
        self.output = nn.Linear(HIDDEN, out_features)
        self.head = head

    def forward(self, *inputs: Tensor) -> Any:
        output = self.output(self.hidden(torch.cat(inputs, -1)).tanh())
        return output if self.head is None else self.head(output)


def loc_and_scale(output: Tensor) -> tuple[Tensor, Tensor]:
    loc, log_scale = output.chunk(2, -1)
    return loc, log_scale.exp()


def bounded_latent(output: Tensor) -> Tensor:
    return MAX_LATENT * output.tanh()


def module(network: nn.Module, in_keys: list[Any], *out_keys: str) -> TensorDictModule:
    for parameter in network.double().parameters():
        nn.init.normal_(parameter, std=0.6)
    return TensorDictModule(network, in_keys=in_keys, out_keys=list(out_keys))


class Generator(TensorDictModuleBase):
    def __init__(self) -> None:
        super().__init__()
        self.latent_dim = LATENT_DIM
        self.encoder = module(
            Network(OBSERVATION_DIM + ACTION_DIM, 2 * LATENT_DIM, loc_and_scale),
            ["observation", "action"],
            "action_latent_loc",
            "action_latent_scale",
        )
        self.decoder = make_decoder()
        self.in_keys, self.out_keys = self.decoder.in_keys, self.decoder.out_keys


def make_decoder(task_latent_dim: int = 0) -> TensorDictModule:
    network = Network(OBSERVATION_DIM + LATENT_DIM + task_latent_dim, ACTION_DIM, torch.tanh)
    keys = ["observation", "action_latent", *(["task_latent"] if task_latent_dim else [])]
    return module(network, keys, "action")


def make_critic(task_latent_dim: int = 0) -> TensorDictModule:
    network = Network(OBSERVATION_DIM + ACTION_DIM + task_latent_dim, 1)
    keys = ["observation", "action", *(["task_latent"] if task_latent_dim else [])]
    return module(network, keys, "state_action_value")


def make_perturbation_network() -> TensorDictModule:
    network = Network(OBSERVATION_DIM + ACTION_DIM, ACTION_DIM, torch.tanh)
    return module(network, ["observation", "action"], "perturbation")


# Both bounds clip some actions, so that the clipping affects values and gradients.
BOUNDS = (torch.tensor([-0.4, -0.7]).double(), torch.tensor([0.5, 0.6]).double())


# -- data and noise --------------------------------------------------------------------------------


def transitions(*batch: int) -> TensorDict:
    """Rows of which two are terminated and one is truncated."""
    row = torch.arange(batch[-1]).expand(batch).unsqueeze(-1)
    return TensorDict(
        {
            "observation": torch.randn(*batch, OBSERVATION_DIM).double(),
            "action": torch.randn(*batch, ACTION_DIM).double().tanh().clamp(*BOUNDS),
            "next": {
                "observation": torch.randn(*batch, OBSERVATION_DIM).double(),
                "reward": torch.randn(*batch, 1).double(),
                "done": row < 3,
                "terminated": row < 2,
            },
        },
        batch_size=batch,
    )


def plain(data: TensorDict) -> dict[str, np.ndarray]:
    arrays = {key: value.numpy() for key, value in data.exclude("next").items()}
    arrays["next_observation"] = data["next", "observation"].numpy()
    arrays["reward"] = data["next", "reward"].numpy()[..., 0]
    arrays["terminated"] = data["next", "terminated"].numpy()[..., 0].astype(float)
    return arrays


def draws(**shapes: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Standard normal noise in the order in which the library draws it."""
    torch.manual_seed(NOISE_SEED)
    return {name: torch.randn(shape, dtype=torch.float64).numpy() for name, shape in shapes.items()}


# -- the library's update --------------------------------------------------------------------------


def snapshot(
    loss: LossModule, read: Callable[[Tensor], Tensor] = lambda leaf: leaf.detach()
) -> dict[str, np.ndarray]:
    """Copies of ``read(weight)`` for every weight, under the reference's names."""
    state = {}
    for child, params in loss.named_children():
        if not isinstance(params, TensorDictParams):
            continue
        name = child.removesuffix("_params")
        for key, leaf in params.items(True, True):
            end = ".".join(part for part in key if part not in ("module", "critics"))
            value = read(leaf).numpy().copy()
            if name.removeprefix("target_") == "qvalue_network" and "critics" not in key:
                state |= {f"{name}.{j}.{end}": critic for j, critic in enumerate(value)}
            else:
                state[f"{name}.{end}"] = value
    return state


def slope(leaf: Tensor) -> Tensor:
    return torch.zeros_like(leaf.detach()) if leaf.grad is None else leaf.grad


def move_targets(loss: LossModule) -> None:
    for name, params in loss.named_children():
        if name.startswith("target_"):
            for value in params.values(True, True):
                value.data.add_(torch.randn_like(value), alpha=0.3)


def library_update(
    loss: LossModule, data: TensorDict, parts: dict[str, tuple[str, ...]]
) -> reference.Update:
    """The library's update in the published order; ``parts`` are losses and what they train."""
    updater = SoftUpdate(loss, tau=reference.TAU)  # sets the targets to the networks
    move_targets(loss)
    update = reference.Update(snapshot(loss))
    torch.manual_seed(NOISE_SEED)
    for name, networks in parts.items():
        trained = [p for each in networks for p in getattr(loss, f"{each}_params").parameters()]
        optimizer = torch.optim.SGD(trained, lr=reference.LEARNING_RATE)
        value, info = getattr(loss, f"{name}_loss")(data)
        update.values |= {f"loss_{name}": value.detach().numpy()}
        update.values |= {key: entry.numpy() for key, entry in info.items()}
        loss.zero_grad()
        value.backward()
        update.gradients[name] = snapshot(loss, slope)
        optimizer.step()
    updater.step()
    return update


# -- comparison ------------------------------------------------------------------------------------


def furthest(a: dict[str, Any], b: dict[str, Any]) -> float:
    assert a.keys() == b.keys()
    for key in a:
        assert np.shape(a[key]) == np.shape(b[key]), key
    return max(float(np.abs(a[key] - b[key]).max()) for key in a)


def differences(
    library: reference.Update, after: dict[str, np.ndarray], expected: reference.Update
) -> Differences:
    """Largest absolute differences; a network that a loss does not train has gradient zero."""
    nothing = {key: np.zeros_like(value) for key, value in after.items()}
    assert library.gradients.keys() == expected.gradients.keys()
    return {
        "values": furthest(library.values, expected.values),
        "gradients": max(
            furthest(found, nothing | dict(expected.gradients[name]))
            for name, found in library.gradients.items()
        ),
        "parameters": furthest(after, {key: expected.state[key] for key in after}),
    }


def report(name: str, found: Differences, record_property: Record) -> None:
    """Records and prints the differences, and asserts that they are within the tolerance."""
    for kind, value in found.items():
        record_property(f"{name} {kind}", value)
    each = ", ".join(f"{kind} {value:.0e}" for kind, value in found.items())
    print(f"\n{name}: largest difference {max(found.values()):.0e} ({each})")
    assert max(found.values()) < TOLERANCE, each


def name_of(options: dict[str, Any]) -> str:
    return ",".join(f"{key}={value}" for key, value in options.items()) or "base"
