"""One update of each offline loss agrees with an independent numpy implementation to 1e-9.

The library and :mod:`reference` start from the same weights, data and noise, and go through one
update in the published order. Values, every gradient and every weight and target afterwards are
compared; ``pytest -s`` prints the largest difference.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import reference
import torch
from helpers import NO_UPDATER
from reference_rebrac import rebrac
from reference_update import (
    ACTION_DIM,
    BOUNDS,
    CANDIDATES,
    LATENT_DIM,
    MAX_LATENT,
    NUM_ACTIONS,
    OBSERVATION_DIM,
    ROWS,
    Differences,
    Generator,
    Network,
    Record,
    bounded_latent,
    differences,
    draws,
    library_update,
    make_critic,
    make_perturbation_network,
    module,
    name_of,
    plain,
    report,
    snapshot,
    transitions,
)
from torch import nn

from torchrl_bmrl.objectives import BCQLoss, DiscreteBCQLoss, PLASLoss, ReBRACLoss

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)


# -- BCQ -------------------------------------------------------------------------------------------

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
    """Differences between the library and the reference, whose options ``wrong`` replaces."""
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


BCQ_WRONG = [
    {"gamma": 0.96},
    {"lmbda": 0.74},
    {"latent_clip": 0.6},
    {"kl_weight": 0.51},
    {"kl_reduction": "sum"},
    {"max_perturbation": 0.31},
    {"value_bounds": (-0.3, 0.3)},
    {"loss_function": "smooth_l1"},
]


# -- PLAS ------------------------------------------------------------------------------------------

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


PLAS_WRONG = [
    {"gamma": 0.96},
    {"lmbda": 0.74},
    {"kl_weight": 0.51},
    {"kl_reduction": "sum"},
    {"max_perturbation": 0.31},
    {"loss_function": "smooth_l1"},
]


# -- ReBRAC ----------------------------------------------------------------------------------------

REBRAC = {
    "gamma": 0.97,
    "actor_penalty": 0.3,
    "critic_penalty": 0.2,
    "normalise_q": True,
    "policy_noise": 0.4,
    "noise_clip": 0.5,
    "loss_function": "l2",
}
REBRAC_VARIANTS = [
    {},
    {"normalise_q": False},
    {"actor_penalty": 0.0, "critic_penalty": 0.0},
    {"num_critics": 1},
    {"num_critics": 3, "loss_function": "smooth_l1"},
]


def compare_rebrac(
    *, num_critics: int = 2, wrong: dict[str, Any] | None = None, **options: Any
) -> Differences:
    torch.manual_seed(5)
    actor = Network(OBSERVATION_DIM, ACTION_DIM, torch.tanh)
    loss = ReBRACLoss(
        module(actor, ["observation"], "action"),
        [make_critic() for _ in range(num_critics)],
        bounds=BOUNDS,
        **(REBRAC | options),
    )
    data = transitions(ROWS)
    data["next", "action"] = transitions(ROWS)["action"]
    parts = {"qvalue": ("qvalue_network",), "actor": ("actor_network",)}
    library = library_update(loss, data, parts)
    expected = rebrac(
        library.state,
        plain(data) | {"next_action": data["next", "action"].numpy()},
        draws(action=(ROWS, ACTION_DIM)),
        bounds=tuple(bound.numpy() for bound in BOUNDS),
        **(REBRAC | options | (wrong or {})),
    )
    return differences(library, snapshot(loss), expected)


REBRAC_WRONG = [
    {"gamma": 0.96},
    {"actor_penalty": 0.31},
    {"critic_penalty": 0.21},
    {"normalise_q": False},
    {"policy_noise": 0.41},
    {"noise_clip": 0.3},
    {"loss_function": "smooth_l1"},
]


# -- discrete BCQ ----------------------------------------------------------------------------------

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


DISCRETE_WRONG = [
    {"gamma": 0.96},
    {"threshold": 0.0},
    {"logits_weight": 0.011},
    {"loss_function": "l2"},
]


# -- all of them -----------------------------------------------------------------------------------

LOSSES: dict[str, tuple[Callable[..., Differences], Any, Any, dict[str, Any]]] = {
    "BCQLoss": (compare_bcq, BCQ_VARIANTS, BCQ_WRONG, {"perturbation": True}),
    "PLASLoss": (compare_plas, PLAS_VARIANTS, PLAS_WRONG, {"perturbation": True}),
    "ReBRACLoss": (compare_rebrac, REBRAC_VARIANTS, REBRAC_WRONG, {}),
    "DiscreteBCQLoss": (
        compare_discrete_bcq,
        DISCRETE_VARIANTS,
        DISCRETE_WRONG,
        {"num_critics": 2},
    ),
}
"""For each loss its comparison, the options that agree, wrong ones, and the options with these."""


def cases(index: int) -> list[Any]:
    """Each loss with each of its options, those that agree (1) or the wrong ones (2)."""
    return [
        pytest.param(loss, options, id=f"{loss}-{name_of(options)}")
        for loss, entry in LOSSES.items()
        for options in entry[index]
    ]


@pytest.mark.parametrize(("loss", "options"), cases(1))
def test_one_update_is_that_of_the_equations(
    loss: str, options: dict[str, Any], record_property: Record
) -> None:
    report(loss, LOSSES[loss][0](**options), record_property)


@pytest.mark.parametrize(("loss", "wrong"), cases(2))
def test_a_slightly_different_update_does_not_agree(loss: str, wrong: dict[str, Any]) -> None:
    compare, _, _, options = LOSSES[loss]
    assert max(compare(**options, wrong=wrong).values()) > 1e-5
