"""One full update of each loss agrees with an independent numpy implementation to 1e-9.

The library and :mod:`reference` start from the same weights, data and noise, and go through one
update in the published order. Values, every gradient and every weight and target afterwards are
compared; ``pytest -s`` prints the largest difference.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import reference
import torch
from helpers import NO_UPDATER
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

from torchrl_bmrl.objectives import BCQLoss, DiscreteBCQLoss, MetaDistillationLoss, PLASLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)

TOLERANCE = 1e-9
OBSERVATION_DIM, ACTION_DIM, LATENT_DIM, TASK_LATENT_DIM, HIDDEN = 3, 2, 4, 2, 3
ROWS, CANDIDATES, NUM_ACTIONS, TASKS, MAX_LATENT = 6, 5, 4, 3, 2.0
NOISE_SEED = 7

Differences = dict[str, float]
Record = Callable[[str, object], None]


# -- networks: one hidden tanh layer, no kink for a finite difference to meet ------------------


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


# Both bounds cut some actions, so the clipping has its share in values and gradients.
BOUNDS = (torch.tensor([-0.4, -0.7]).double(), torch.tensor([0.5, 0.6]).double())


# -- data and noise ----------------------------------------------------------------------------


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


# -- the library's update ----------------------------------------------------------------------


def snapshot(
    loss: LossModule, read: Callable[[Tensor], Tensor] = lambda leaf: leaf.detach()
) -> dict[str, np.ndarray]:
    """Copies of what is read of every weight, under the reference's names."""
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


# -- comparison --------------------------------------------------------------------------------


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
    """Notes the differences, which ``pytest -s`` shows, and holds them to the tolerance."""
    for kind, value in found.items():
        record_property(f"{name} {kind}", value)
    each = ", ".join(f"{kind} {value:.0e}" for kind, value in found.items())
    print(f"\n{name}: largest difference {max(found.values()):.0e} ({each})")
    assert max(found.values()) < TOLERANCE, each


def name_of(options: dict[str, Any]) -> str:
    return ",".join(f"{key}={value}" for key, value in options.items()) or "base"


# -- BCQ ---------------------------------------------------------------------------------------

GENERATIVE = {
    "gamma": 0.97,
    "lmbda": 0.75,
    "kl_weight": 0.5,
    "kl_reduction": "mean",
    "max_perturbation": 0.3,
    "loss_function": "l2",
}
BCQ = {**GENERATIVE, "latent_clip": 0.5, "value_bounds": None}
BCQ_VARIANTS = [
    {},
    {"perturbation": True},
    {"latent_clip": None},
    {"kl_reduction": "sum"},
    {"loss_function": "smooth_l1"},
    {"loss_function": "l1"},
    {"value_bounds": (-0.3, 0.3)},
    {"num_critics": 1},
    {"num_critics": 3, "lmbda": 0.4},
    {
        "perturbation": True,
        "latent_clip": None,
        "kl_reduction": "sum",
        "loss_function": "smooth_l1",
        "value_bounds": (-0.3, 0.3),
    },
]


def compare_bcq(
    *,
    perturbation: bool = False,
    num_critics: int = 2,
    wrong: dict[str, Any] | None = None,
    **options: Any,
) -> Differences:
    """The library against the reference, of which ``wrong`` options may differ."""
    torch.manual_seed(20)  # next values lie on both sides of both value_bounds
    loss = BCQLoss(
        Generator(),
        [make_critic() for _ in range(num_critics)],
        make_perturbation_network() if perturbation else None,
        num_candidates=CANDIDATES,
        bounds=BOUNDS,
        **(BCQ | options),
    )
    data = transitions(ROWS)
    parts = {"generator": ("generator",), "qvalue": ("qvalue_network",)}
    if perturbation:
        parts["perturbation"] = ("perturbation_network",)
    library = library_update(loss, data, parts)
    noise = draws(
        posterior=(ROWS, LATENT_DIM),
        candidates=(ROWS, CANDIDATES, LATENT_DIM),
        proposal=(ROWS, LATENT_DIM),
    )
    expected = reference.bcq(
        library.state,
        plain(data),
        noise,
        bounds=tuple(bound.numpy() for bound in BOUNDS),
        **(BCQ | options | (wrong or {})),
    )
    return differences(library, snapshot(loss), expected)


@pytest.mark.parametrize("options", BCQ_VARIANTS, ids=name_of)
def test_one_update_of_bcq_is_that_of_the_equations(
    options: dict[str, Any], record_property: Record
) -> None:
    report("BCQLoss", compare_bcq(**options), record_property)


@pytest.mark.parametrize(
    "wrong",
    [
        {"gamma": 0.96},
        {"lmbda": 0.74},
        {"latent_clip": 0.6},
        {"kl_weight": 0.51},
        {"kl_reduction": "sum"},
        {"max_perturbation": 0.31},
        {"value_bounds": (-0.3, 0.3)},
        {"loss_function": "smooth_l1"},
    ],
    ids=name_of,
)
def test_a_slightly_different_bcq_does_not_agree(wrong: dict[str, Any]) -> None:
    assert max(compare_bcq(perturbation=True, wrong=wrong).values()) > 1e-5


# -- PLAS --------------------------------------------------------------------------------------

PLAS_VARIANTS = [
    {},
    {"perturbation": True},
    {"kl_reduction": "sum"},
    {"loss_function": "smooth_l1"},
    {"num_critics": 1},
    {"perturbation": True, "kl_reduction": "sum", "loss_function": "smooth_l1", "num_critics": 3},
]


def compare_plas(
    *,
    perturbation: bool = False,
    num_critics: int = 2,
    wrong: dict[str, Any] | None = None,
    **options: Any,
) -> Differences:
    torch.manual_seed(2)
    actor = Network(OBSERVATION_DIM, LATENT_DIM, bounded_latent)
    loss = PLASLoss(
        Generator(),
        module(actor, ["observation"], "action_latent"),
        [make_critic() for _ in range(num_critics)],
        make_perturbation_network() if perturbation else None,
        bounds=BOUNDS,
        **(GENERATIVE | options),
    )
    data = transitions(ROWS)
    trained = ("actor_network", *(["perturbation_network"] if perturbation else []))
    parts = {"generator": ("generator",), "qvalue": ("qvalue_network",), "actor": trained}
    library = library_update(loss, data, parts)
    expected = reference.plas(
        library.state,
        plain(data),
        draws(posterior=(ROWS, LATENT_DIM)),
        max_latent=MAX_LATENT,
        bounds=tuple(bound.numpy() for bound in BOUNDS),
        **(GENERATIVE | options | (wrong or {})),
    )
    return differences(library, snapshot(loss), expected)


@pytest.mark.parametrize("options", PLAS_VARIANTS, ids=name_of)
def test_one_update_of_plas_is_that_of_the_equations(
    options: dict[str, Any], record_property: Record
) -> None:
    report("PLASLoss", compare_plas(**options), record_property)


@pytest.mark.parametrize(
    "wrong",
    [
        {"gamma": 0.96},
        {"lmbda": 0.74},
        {"kl_weight": 0.51},
        {"kl_reduction": "sum"},
        {"max_perturbation": 0.31},
        {"loss_function": "smooth_l1"},
    ],
    ids=name_of,
)
def test_a_slightly_different_plas_does_not_agree(wrong: dict[str, Any]) -> None:
    assert max(compare_plas(perturbation=True, wrong=wrong).values()) > 1e-5


# -- discrete BCQ ------------------------------------------------------------------------------

DISCRETE = {"gamma": 0.97, "threshold": 0.3, "logits_weight": 0.01, "loss_function": "smooth_l1"}
DISCRETE_VARIANTS = [
    {},
    {"num_critics": 2},
    {"num_critics": 2, "loss_function": "l2"},
    {"action_space": "categorical", "threshold": 0.6, "logits_weight": 0.5},
    {"threshold": 0.0},
]


def compare_discrete_bcq(
    *,
    num_critics: int = 1,
    action_space: str = "one-hot",
    wrong: dict[str, Any] | None = None,
    **options: Any,
) -> Differences:
    torch.manual_seed(3)
    generator, *critics = (
        module(Network(OBSERVATION_DIM, NUM_ACTIONS), ["observation"], name)
        for name in ("logits", *["action_value"] * num_critics)
    )
    loss = DiscreteBCQLoss(generator, critics, action_space=action_space, **(DISCRETE | options))
    data = transitions(ROWS)
    index = torch.randint(NUM_ACTIONS, (ROWS,))
    one_hot = nn.functional.one_hot(index, NUM_ACTIONS).double()
    data["action"] = one_hot if action_space == "one-hot" else index
    parts = {"generator": ("generator",), "qvalue": ("qvalue_network",)}
    library = library_update(loss, data, parts)
    expected = reference.discrete_bcq(
        library.state,
        plain(data) | {"action": index.numpy()},
        **(DISCRETE | options | (wrong or {})),
    )
    return differences(library, snapshot(loss), expected)


@pytest.mark.parametrize("options", DISCRETE_VARIANTS, ids=name_of)
def test_one_update_of_discrete_bcq_is_that_of_the_equations(
    options: dict[str, Any], record_property: Record
) -> None:
    report("DiscreteBCQLoss", compare_discrete_bcq(**options), record_property)


@pytest.mark.parametrize(
    "wrong",
    [{"gamma": 0.96}, {"threshold": 0.0}, {"logits_weight": 0.011}, {"loss_function": "l2"}],
    ids=name_of,
)
def test_a_slightly_different_discrete_bcq_does_not_agree(wrong: dict[str, Any]) -> None:
    assert max(compare_discrete_bcq(num_critics=2, wrong=wrong).values()) > 1e-5


# -- meta-distillation -------------------------------------------------------------------------

ALL_TERMS = ("classification", "generator", "direction", "qvalue", "metric")
DISTILLATION = {
    "latent_clip": 0.5,
    "classification_weight": 0.7,
    "generator_weight": 1.3,
    "direction_weight": 0.9,
    "qvalue_weight": 1.1,
    "latent_norm_weight": 0.05,
    "metric_weight": 0.0,
    "metric_margin": 1.0,
    "encoder_terms": ALL_TERMS,
}
DISTILLATION_VARIANTS = [
    {},
    {"latent_clip": None},
    {"metric_weight": 0.6},
    {"encoder_terms": ("classification",), "metric_weight": 0.6},
    {"encoder_terms": ("generator", "metric"), "metric_weight": 0.6},
    {"encoder_terms": ("direction", "qvalue")},
]
QVALUE_LOC, QVALUE_SCALE = np.array([0.3, -0.2, 0.5]), np.array([0.8, 1.5, 2.5])


def compare_distillation(
    *, wrong: dict[str, Any] | None = None, **options: Any
) -> tuple[Differences, bool]:
    """The largest differences, and whether the teachers stayed as they were."""
    torch.manual_seed(4)
    transition = 2 * OBSERVATION_DIM + ACTION_DIM + 1
    keys = ["observation", "action", ("next", "reward"), ("next", "observation")]
    teachers = {
        "teacher_generators": [make_decoder() for _ in range(TASKS)],
        "teacher_qvalue_networks": [make_critic() for _ in range(TASKS)],
    }
    loss = MetaDistillationLoss(
        module(Network(transition, TASK_LATENT_DIM), keys, "task_latent"),
        module(nn.Linear(TASK_LATENT_DIM, TASKS), ["task_latent"], "task_logits"),
        make_decoder(TASK_LATENT_DIM),
        make_critic(TASK_LATENT_DIM),
        *teachers.values(),
        latent_dim=LATENT_DIM,
        qvalue_loc=torch.as_tensor(QVALUE_LOC),
        qvalue_scale=torch.as_tensor(QVALUE_SCALE),
        context="current",
        **(DISTILLATION | options),
    )
    data = transitions(TASKS, ROWS)
    data["task"] = torch.arange(TASKS).unsqueeze(-1).expand(TASKS, ROWS).clone()
    frozen = {
        f"{name}.{i}.{key.removeprefix('module.')}": value.numpy().copy()
        for name, networks in teachers.items()
        for i, each in enumerate(networks)
        for key, value in each.state_dict().items()
    }

    library = reference.Update(snapshot(loss))
    held = {key: value.clone() for key, value in loss.state_dict().items() if "teacher" in key}
    arrays = plain(data)
    arrays["reward"] = arrays["reward"][..., None]
    optimizer = torch.optim.SGD(loss.parameters(), lr=reference.LEARNING_RATE)
    torch.manual_seed(NOISE_SEED)
    output = loss(data)
    total = sum(value for key, value in output.items() if key.startswith("loss_"))
    total.backward()
    library.values = {key: value.detach().numpy() for key, value in output.items()}
    library.values |= {"td_error": data["td_error"].numpy(), "loss_total": total.detach().numpy()}
    library.gradients = {"total": snapshot(loss, slope)}
    optimizer.step()
    after = loss.state_dict()
    unchanged = bool(held) and all(torch.equal(value, after[key]) for key, value in held.items())

    noise = draws(latent=(TASKS, ROWS, LATENT_DIM))
    # The triplet's rows are drawn after the latents, as cyclic shifts.
    shift = torch.randint(1, ROWS, (ROWS,)).numpy()
    noise["near_row"] = (np.arange(ROWS) + shift) % ROWS
    shift = torch.randint(1, TASKS, (TASKS, ROWS)).numpy()
    noise["far_task"] = (np.arange(TASKS)[:, None] + shift) % TASKS
    noise["far_row"] = torch.randint(ROWS, (TASKS, ROWS)).numpy()
    normalisation = {"qvalue_loc": QVALUE_LOC, "qvalue_scale": QVALUE_SCALE}
    expected = reference.meta_distillation(
        library.state | frozen,
        arrays,
        noise,
        **(normalisation | DISTILLATION | options | (wrong or {})),
    )
    return differences(library, snapshot(loss), expected), unchanged


@pytest.mark.parametrize("options", DISTILLATION_VARIANTS, ids=name_of)
def test_one_update_of_meta_distillation_is_that_of_the_equations(
    options: dict[str, Any], record_property: Record
) -> None:
    found, teachers_unchanged = compare_distillation(**options)
    assert teachers_unchanged
    report("MetaDistillationLoss", found, record_property)


@pytest.mark.parametrize(
    "wrong",
    [
        {"latent_clip": None},
        {"qvalue_loc": QVALUE_LOC + 0.01},
        {"qvalue_scale": QVALUE_SCALE + 0.01},
        *({f"{name}_weight": 0.61} for name in (*ALL_TERMS, "latent_norm")),
        {"metric_margin": 1.01},
        *(
            {"encoder_terms": tuple(term for term in ALL_TERMS if term != name)}
            for name in ALL_TERMS
        ),
    ],
    ids=name_of,
)
def test_a_slightly_different_meta_distillation_does_not_agree(wrong: dict[str, Any]) -> None:
    found, _ = compare_distillation(metric_weight=0.6, wrong=wrong)
    assert max(found.values()) > 1e-5
