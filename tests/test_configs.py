"""The losses' Hydra configurations."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import (
    ACTION_DIM,
    CELLS,
    LATENT_DIM,
    NO_UPDATER,
    NUM_ACTIONS,
    OBSERVATION_DIM,
    TASK_LATENT_DIM,
    discrete_transitions,
    guide,
    run,
    task_transitions,
    transitions,
)
from torch import nn

from torchrl_bmrl import objectives
from torchrl_bmrl.modules import (
    ActionFlow,
    ActionMixture,
    ActionVAE,
    BCQPolicy,
    EnsembleCritic,
    as_context,
    make_qvalue_network,
)

pytest.importorskip("hydra")
from hydra import compose, initialize, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import ConfigCompositionException
from hydra.utils import instantiate
from omegaconf import MISSING, MissingMandatoryValue, OmegaConf
from torchrl.trainers.algorithms.configs import MLPConfig, TensorDictModuleConfig

from torchrl_bmrl import configs

pytestmark = [
    pytest.mark.filterwarnings(NO_UPDATER),
    pytest.mark.usefixtures("stored_configurations"),
]

BASES = {"KeyedLoss", "OfflineLoss", "GenerativeLoss"}
LOSSES = sorted(set(objectives.__all__) - BASES)
GROUP = {
    "bcq": "BCQLoss",
    "context_inference": "ContextInferenceLoss",
    "discrete_bcq": "DiscreteBCQLoss",
    "focal": "FOCALLoss",
    "fqe": "FQELoss",
    "mbml": "MBMLLoss",
    "meta_distillation": "MetaDistillationLoss",
    "plas": "PLASLoss",
    "rebrac": "ReBRACLoss",
    "reward_model": "RewardModelLoss",
    "stacked": "StackedLoss",
}
SIZES = {"observation_dim": OBSERVATION_DIM, "action_dim": ACTION_DIM}


def ours(name: str, **arguments: Any) -> dict[str, Any]:
    """A network of this library, as a file of configurations names it."""
    return {"_target_": f"torchrl_bmrl.modules.{name}", **arguments}


def torchrl(in_keys: list[str], out_key: str, in_features: int, out_features: int) -> Any:
    """A network of TorchRL's own configurations."""
    mlp = MLPConfig(in_features=in_features, out_features=out_features, depth=1, num_cells=8)
    return TensorDictModuleConfig(module=mlp, in_keys=in_keys, out_keys=[out_key])


GENERATOR = ours("ActionVAE", **SIZES, latent_dim=LATENT_DIM, num_cells=list(CELLS))
CRITIC = ours("make_qvalue_network", **SIZES, num_cells=list(CELLS))
TORCHRL_CRITIC = torchrl(
    ["observation", "action"], "state_action_value", OBSERVATION_DIM + ACTION_DIM, 1
)
STUDENT = {"task_latent_dim": TASK_LATENT_DIM, "num_cells": list(CELLS)}
SET_ENCODER = ours("make_context_encoder", **SIZES, **STUDENT)
STUDENTS = {
    "student_generator": ours("make_decoder", **SIZES, latent_dim=LATENT_DIM, **STUDENT),
    "student_qvalue_network": ours("make_qvalue_network", **SIZES, **STUDENT),
    "teacher_generators": [ours("make_decoder", **SIZES, latent_dim=LATENT_DIM)] * 2,
    "teacher_qvalue_networks": [CRITIC, CRITIC],
    "latent_dim": LATENT_DIM,
}
REWARD_MODELS = ours("make_reward_models", num_tasks=2, **SIZES)
NETWORKS: dict[str, dict[str, Any]] = {
    "ContextInferenceLoss": {
        "context_encoder": SET_ENCODER,
        "task_latents": [[0.0] * TASK_LATENT_DIM, [1.0] * TASK_LATENT_DIM],
    },
    "FOCALLoss": {
        "task_encoder": SET_ENCODER,
        "actor_network": ours("make_gaussian_actor", **SIZES, **STUDENT),
        "divergence_network": ours("make_qvalue_network", **SIZES, **STUDENT),
        "qvalue_network": ours("make_qvalue_network", **SIZES, **STUDENT),
        "bounds": [-1.0, 1.0],
        "context_size": 2,
    },
    "MBMLLoss": {
        "task_encoder": SET_ENCODER,
        "reward_models": REWARD_MODELS,
        "context_size": 2,
        **STUDENTS,
    },
    "RewardModelLoss": {"reward_models": REWARD_MODELS},
    "BCQLoss": {"generator": GENERATOR, "qvalue_network": [CRITIC, CRITIC], "bounds": [-1, 1]},
    "DiscreteBCQLoss": {
        "generator": torchrl(["observation"], "logits", OBSERVATION_DIM, NUM_ACTIONS),
        "qvalue_network": torchrl(["observation"], "action_value", OBSERVATION_DIM, NUM_ACTIONS),
    },
    "FQELoss": {
        "policy": torchrl(["observation"], "action", OBSERVATION_DIM, ACTION_DIM),
        "qvalue_network": [CRITIC, TORCHRL_CRITIC],
    },
    "MetaDistillationLoss": {
        "task_encoder": ours("make_task_encoder", **SIZES, **STUDENT),
        "task_classifier": ours("make_task_classifier", num_tasks=2),
        **STUDENTS,
        "qvalue_loc": [0.0, 1.0],
        "encoder_terms": ["classification", "qvalue"],
    },
    "PLASLoss": {
        "generator": GENERATOR,
        "actor_network": ours("make_latent_actor", observation_dim=3, latent_dim=LATENT_DIM),
        "qvalue_network": TORCHRL_CRITIC,
        "perturbation_network": ours("make_perturbation_network", **SIZES),
        "action_spec": {
            "_target_": "torchrl.data.Bounded",
            "low": -1.0,
            "high": 1.0,
            "shape": [ACTION_DIM],
        },
    },
    "ReBRACLoss": {
        "actor_network": torchrl(["observation"], "action", OBSERVATION_DIM, ACTION_DIM),
        "qvalue_network": [CRITIC, TORCHRL_CRITIC],
        "bounds": [-1.0, 1.0],
    },
    "StackedLoss": {
        "losses": [
            {
                "_target_": "torchrl_bmrl.objectives.BCQLoss",
                "generator": GENERATOR,
                "qvalue_network": CRITIC,
                "bounds": [-1.0, 1.0],
            }
        ]
        * 2,
        "names": ["reach", "lift"],
    },
}
DATA = {
    "ContextInferenceLoss": lambda: as_context(transitions(2, 3, 4, dtype=torch.float32)),
    "FOCALLoss": lambda: task_transitions(2, 4, dtype=torch.float32),
    "MBMLLoss": lambda: task_transitions(2, 4, dtype=torch.float32),
    "RewardModelLoss": lambda: task_transitions(2, 4, dtype=torch.float32),
    "BCQLoss": lambda: transitions(4, dtype=torch.float32),
    "DiscreteBCQLoss": lambda: discrete_transitions(4, dtype=torch.float32),
    "FQELoss": lambda: transitions(4, dtype=torch.float32),
    "MetaDistillationLoss": lambda: task_transitions(2, 4, dtype=torch.float32),
    "PLASLoss": lambda: transitions(4, dtype=torch.float32),
    "ReBRACLoss": lambda: guide().next_actions(4, dtype=torch.float32),
    "StackedLoss": lambda: transitions(2, 4, dtype=torch.float32),
}

each_loss = pytest.mark.parametrize("name", LOSSES)


def config_of(name: str) -> Any:
    return getattr(configs, f"{name}Config")


def arguments(loss: type) -> dict[str, Any]:
    """The arguments of a loss with their defaults; ``**options`` are those of the class above."""
    found: dict[str, Any] = {}
    for name, parameter in inspect.signature(loss).parameters.items():
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            above = arguments(loss.__mro__[1])
            found |= {key: value for key, value in above.items() if key not in found}
        else:
            found[name] = MISSING if parameter.default is parameter.empty else parameter.default
    return found


@pytest.fixture
def composer() -> Iterator[None]:
    with initialize(version_base="1.3", config_path=None):
        yield


def test_every_loss_has_a_configuration_and_a_name_in_the_group_of_losses() -> None:
    assert sorted(configs.__all__) == [f"{name}Config" for name in LOSSES]
    assert sorted(GROUP.values()) == LOSSES


@each_loss
def test_a_configuration_has_the_arguments_of_its_loss_with_their_defaults(name: str) -> None:
    expected = arguments(getattr(objectives, name))
    fields = dataclasses.fields(config_of(name))
    found = {x.name: x.default for x in fields if not x.name.startswith("_")}
    assert found == expected
    assert list(found) == list(expected)


@each_loss
def test_hydra_makes_the_loss_from_nested_configurations_and_lists(name: str) -> None:
    loss = instantiate(config_of(name)(**NETWORKS[name]))
    assert type(loss) is getattr(objectives, name)
    assert (
        sum(x for key, x in run(loss, DATA[name]()).items() if key[:5] == "loss_").isfinite().all()
    )


@each_loss
def test_a_configuration_without_its_networks_names_what_is_missing(name: str) -> None:
    required = next(x.name for x in dataclasses.fields(config_of(name)) if x.default == MISSING)
    with pytest.raises(MissingMandatoryValue, match=f"Missing mandatory value: {required}"):
        instantiate(config_of(name)())


@each_loss
def test_a_partial_configuration_waits_for_its_networks(name: str) -> None:
    networks = instantiate(NETWORKS[name], _convert_="all")
    make = instantiate(config_of(name)(_partial_=True))
    assert isinstance(make, functools.partial)
    assert type(make(**networks)) is getattr(objectives, name)


def test_a_configured_loss_computes_what_one_made_in_python_does() -> None:
    options = {
        "gamma": 0.9,
        "value_bounds": [0.0, 10.0],
        "kl_reduction": "sum",
        "num_candidates": 3,
    }
    torch.manual_seed(0)
    loss = instantiate(configs.BCQLossConfig(**NETWORKS["BCQLoss"], **options))
    torch.manual_seed(0)
    expected = objectives.BCQLoss(
        ActionVAE(**SIZES, latent_dim=LATENT_DIM, num_cells=CELLS),
        [make_qvalue_network(**SIZES, num_cells=CELLS) for _ in range(2)],
        bounds=(-1.0, 1.0),
        **options,
    )
    data = transitions(4, dtype=torch.float32)
    torch.testing.assert_close(run(loss, data), run(expected, data.clone()), rtol=0, atol=0)


@pytest.mark.parametrize("generator", [ActionFlow, ActionMixture])
def test_hydra_makes_a_loss_over_each_generator_with_an_ensemble_of_critics(generator: Any) -> None:
    networks = NETWORKS["BCQLoss"] | {
        "generator": ours(generator.__name__, **SIZES, num_cells=list(CELLS)),
        "qvalue_network": [CRITIC | {"layer_norm": True}] * 4,
    }
    loss = instantiate(configs.BCQLossConfig(**networks, target_rule="mean", acting_rule="min"))
    assert (type(loss.generator), loss.num_qvalue_nets) == (generator, 4)
    assert run(loss, DATA["BCQLoss"]())["loss_qvalue"].isfinite()
    policy = BCQPolicy.frozen(loss)
    assert isinstance(policy.qvalue_network, EnsembleCritic)
    assert any(isinstance(layer, nn.LayerNorm) for layer in policy.modules())


def test_networks_made_in_python_are_trained_themselves_and_not_as_copies() -> None:
    generator = ActionVAE(**SIZES)
    critics = [make_qvalue_network(**SIZES) for _ in range(2)]
    networks = {"generator": generator, "qvalue_network": critics}
    own = {id(parameter) for parameter in generator.parameters()}
    for loss in (
        instantiate(configs.BCQLossConfig(bounds=[-1.0, 1.0]), **networks),
        instantiate(configs.BCQLossConfig(bounds=[-1.0, 1.0], **networks)),
    ):
        assert {id(parameter) for parameter in loss.generator_params.parameters()} == own


@pytest.mark.parametrize(("name", "loss"), GROUP.items())
def test_a_loss_is_chosen_by_its_name_beside_those_of_torchrl(
    composer: None, name: str, loss: str
) -> None:
    assert {f"{name}.yaml", "sac.yaml", "iql.yaml"} <= set(ConfigStore.instance().repo["loss"])
    chosen = compose(overrides=[f"+loss={name}"]).loss
    assert chosen == OmegaConf.structured(config_of(loss))


def test_the_file_that_the_page_shows_makes_a_loss_of_networks_of_both_libraries(
    tmp_path: Path,
) -> None:
    page = Path(__file__).parents[1] / "docs" / "api" / "configs.md"
    (block,) = re.findall(r"```yaml\n(.*?)```", page.read_text(), re.DOTALL)
    (tmp_path / "config.yaml").write_text(block)
    with initialize_config_dir(version_base="1.3", config_dir=str(tmp_path)):
        loss = instantiate(compose("config", overrides=["loss.lmbda=1"]).loss)
    assert (loss.gamma, loss.lmbda, loss.num_qvalue_nets) == (0.98, 1.0, 2)
    assert run(loss, DATA["BCQLoss"]())["loss_qvalue"].isfinite()


@pytest.mark.parametrize("override", ["num_candidates=many", "gama=0.9", "latent_clip=wide"])
def test_a_wrong_option_is_refused_before_anything_is_made(composer: None, override: str) -> None:
    option = override.partition("=")[0]
    with pytest.raises(ConfigCompositionException) as caught:
        compose(overrides=["+loss=bcq", f"loss.{override}"])
    assert option in f"{caught.value} {caught.value.__cause__}"
