"""Offline algorithms with their published coefficients and order of updates.

BC, TD3+BC, IQL and CQL are TorchRL's losses, ReBRAC is this library's. They read ``observation``
and ``action`` in [-1, 1]. A policy acts without noise under ``ExplorationType.DETERMINISTIC``.
"""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import (
    AddStateIndependentNormalScale,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.modules import (
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
)
from torchrl.objectives import BCLoss, CQLLoss, IQLLoss, LossModule, TD3BCLoss

from torchrl_bmrl.data import best_episodes, with_next_action
from torchrl_bmrl.data.n_step import STEPS_KEY
from torchrl_bmrl.errors import ConfigError, UnknownNameError
from torchrl_bmrl.modules import make_qvalue_network
from torchrl_bmrl.modules.generator import make_mlp
from torchrl_bmrl.objectives import ReBRACLoss

Algorithm = tuple[LossModule, TensorDictModuleBase]
"""A loss and the policy that it trains."""
Objective = Callable[[Any, TensorDictBase], Tensor]
"""From a loss and a batch to the value that one optimizer minimises."""
CELLS = (256, 256)
"""Widths of every network's hidden layers by default."""
ACTOR_INTERVAL = 2
"""Updates of the critics of TD3+BC and ReBRAC for each update of their actor and targets."""
IMITATION = 0.04
"""Share of CQL's updates, at the start, in which the actor imitates."""


def make_actor(
    observation_dim: int, action_dim: int, cells: Sequence[int] = CELLS
) -> TensorDictModule:
    """A deterministic policy with actions in [-1, 1]."""
    network = nn.Sequential(make_mlp(observation_dim, action_dim, cells), nn.Tanh())
    return TensorDictModule(network, in_keys=["observation"], out_keys=["action"])


def make_critics(
    observation_dim: int,
    action_dim: int,
    cells: Sequence[int] = CELLS,
    *,
    layer_norm: bool = False,
) -> list[TensorDictModule]:
    """Two critics, as published."""
    options: dict[str, Any] = {"num_cells": cells, "layer_norm": layer_norm}
    return [make_qvalue_network(observation_dim, action_dim, **options) for _ in range(2)]


def bc(observation_dim: int, action_dim: int, cells: Sequence[int] = CELLS) -> Algorithm:
    """Behaviour cloning with the squared error."""
    # TorchRL's BCLoss has no targets and warns about it.
    warnings.filterwarnings("ignore", "The name target_actor_network_params wasn't part of")
    actor = make_actor(observation_dim, action_dim, cells)
    return BCLoss(actor), actor


def td3_bc(
    observation_dim: int,
    action_dim: int,
    cells: Sequence[int] = CELLS,
    *,
    layer_norm: bool = False,
    alpha: float = 2.5,
) -> Algorithm:
    """TD3 with an imitation term."""
    actor = make_actor(observation_dim, action_dim, cells)
    critics = make_critics(observation_dim, action_dim, cells, layer_norm=layer_norm)
    options: dict[str, Any] = {"bounds": (-1.0, 1.0), "alpha": alpha, "loss_function": "l2"}
    return TD3BCLoss(actor, critics, **options), actor


def rebrac(
    observation_dim: int,
    action_dim: int,
    cells: Sequence[int] = CELLS,
    *,
    actor_penalty: float = 0.1,
    critic_penalty: float = 0.1,
) -> Algorithm:
    """TD3 with penalties on actor and critics; the critics always have layer normalisation."""
    actor = make_actor(observation_dim, action_dim, cells)
    critics = make_critics(observation_dim, action_dim, cells, layer_norm=True)
    options: dict[str, Any] = {"actor_penalty": actor_penalty, "critic_penalty": critic_penalty}
    return ReBRACLoss(actor, critics, bounds=(-1.0, 1.0), **options), actor


def iql(
    observation_dim: int,
    action_dim: int,
    cells: Sequence[int] = CELLS,
    *,
    layer_norm: bool = False,
    temperature: float = 3.0,
    expectile: float = 0.7,
) -> Algorithm:
    """Expectile values and advantage-weighted imitation."""
    mean = make_actor(observation_dim, action_dim, cells).module
    network = nn.Sequential(mean, AddStateIndependentNormalScale(action_dim))
    keys = ["loc", "scale"]
    network = TensorDictModule(network, in_keys=["observation"], out_keys=keys)
    actor = ProbabilisticActor(network, in_keys=keys, distribution_class=IndependentNormal)
    critics = make_critics(observation_dim, action_dim, cells, layer_norm=layer_norm)
    value = make_mlp(observation_dim, 1, cells, layer_norm=layer_norm)
    value = TensorDictModule(value, in_keys=["observation"], out_keys=["state_value"])
    options = {"temperature": temperature, "expectile": expectile, "loss_function": "l2"}
    return IQLLoss(actor, critics, value, **options), actor


def cql(
    observation_dim: int,
    action_dim: int,
    cells: Sequence[int] = CELLS,
    *,
    layer_norm: bool = False,
    min_q_weight: float = 5.0,
) -> Algorithm:
    """SAC with a penalty on the critics' values of actions that the data does not contain.

    The fixed weight of 5 is the published one without a Lagrange multiplier. TorchRL's
    ``with_lagrange`` does not scale the critics' penalty: it adds the multiplier's own loss, whose
    gradient reaches the critics and cancels the penalty.
    """
    actor = ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(
                make_mlp(observation_dim, 2 * action_dim, cells), ["observation"], ["parameters"]
            ),
            TensorDictModule(NormalParamExtractor(), ["parameters"], ["loc", "scale"]),
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    loss = CQLLoss(
        actor,
        make_critics(observation_dim, action_dim, cells, layer_norm=layer_norm),
        min_q_weight=min_q_weight,
        num_random=10,
        target_entropy=-float(action_dim),
        loss_function="l2",
    )
    return loss, actor


ALGORITHMS: Mapping[str, Callable[..., Algorithm]] = {
    "bc": bc,
    "bc_best": bc,
    "td3_bc": td3_bc,
    "rebrac": rebrac,
    "iql": iql,
    "cql": cql,
}
"""Functions of the sizes of observation and action that return a loss and its policy, by name."""
DATA: Mapping[str, Callable[..., TensorDictBase]] = {
    "bc_best": best_episodes,
    "rebrac": with_next_action,
}
"""Functions that turn a task's transitions into the training data; the others need none."""


# -- coefficients ----------------------------------------------------------------------------------


def published(algorithm: str) -> dict[str, float]:
    """The coefficients of an algorithm with their published values, and ReBRAC's with 0.1.

    ReBRAC has other published values for each data set. The values are the numbers among the
    defaults of the functions in :data:`ALGORITHMS` and :data:`DATA`.

    Example:
        >>> published("iql"), published("bc_best"), published("bcq_one_hot")
        ({'temperature': 3.0, 'expectile': 0.7}, {'share': 0.1}, {})
    """
    found = {}
    for functions in (ALGORITHMS, DATA):
        if algorithm in functions:
            for name, parameter in inspect.signature(functions[algorithm]).parameters.items():
                if isinstance(parameter.default, float):
                    found[name] = parameter.default
    return found


def check_coefficients(given: Mapping[str, Mapping[str, Any]], prefix: str) -> None:
    """Checks the names and values of coefficients.

    Args:
        given: coefficients by name, by algorithm.
        prefix: name of the setting, for messages.

    Raises:
        UnknownNameError: for an unknown algorithm.
        ConfigError: for an unknown coefficient, or a value that is not a number of at least 0; a
            share and an expectile are at most 1.

    Example:
        >>> check_coefficients({"td3_bc": {"beta": 1.0}}, "coefficients")
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.ConfigError: coefficients.td3_bc has 'beta'; valid: alpha
    """
    for algorithm, values in given.items():
        if algorithm not in ALGORITHMS:
            raise UnknownNameError(f"algorithm of {prefix}", algorithm, ALGORITHMS)
        known = published(algorithm)
        for name, value in values.items():
            if name not in known:
                valid = ", ".join(known) or "none"
                raise ConfigError(f"{prefix}.{algorithm} has {name!r}; valid: {valid}")
            number = isinstance(value, int | float) and not isinstance(value, bool)
            high = 1.0 if name in ("share", "expectile") else math.inf
            if not number or not math.isfinite(value) or not 0 <= value <= high:
                span = f"between 0 and {high:g}" if high < math.inf else "at least 0"
                raise ConfigError(f"{prefix}.{algorithm}.{name} is {value!r}; valid: {span}")


def make_loss(
    algorithm: str,
    sizes: Mapping[str, int],
    cells: Sequence[int],
    coefficients: Mapping[str, float],
    *,
    gamma: float,
    layer_norm: bool = False,
) -> Algorithm:
    """Makes an algorithm's loss and policy.

    Args:
        algorithm: one of :data:`ALGORITHMS`.
        sizes: ``observation_dim`` and ``action_dim``.
        cells: widths of every network's hidden layers.
        coefficients: those that differ from the published ones, by name.
        gamma: discount of the critics' target.
        layer_norm: whether the critics' hidden layers are normalised.
    """
    build = ALGORITHMS[algorithm]
    options = {**coefficients, "layer_norm": layer_norm}
    loss, actor = build(**sizes, cells=cells, **_of(build, options))
    if "qvalue_network" in OBJECTIVES[algorithm]:
        loss.make_value_estimator(gamma=gamma)
    if algorithm == "iql":
        # TorchRL's loss drops what lies beside "next", such as the number of steps.
        loss.value_estimator.set_keys(steps_to_next_obs=("next", STEPS_KEY))
    return loss, actor


def training_data(
    algorithm: str,
    data: TensorDictBase,
    coefficients: Mapping[str, float],
) -> TensorDictBase:
    """The transitions that an algorithm learns from.

    Args:
        algorithm: one of :data:`ALGORITHMS`.
        data: a task's transitions in order of time, ``[N]``.
        coefficients: those that differ from the published ones, by name.
    """
    if algorithm not in DATA:
        return data
    change = DATA[algorithm]
    return change(data, **_of(change, coefficients))


def _of(function: Callable[..., Any], options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that a function takes."""
    known = inspect.signature(function).parameters
    return {name: value for name, value in options.items() if name in known}


# -- updates ---------------------------------------------------------------------------------------


def _method(name: str) -> Objective:
    return lambda loss, batch: getattr(loss, name)(batch)[0]


def _bc_actor(loss: LossModule, batch: TensorDictBase) -> Tensor:
    return loss(batch)["loss_bc"]


def _cql_critics(loss: CQLLoss, batch: TensorDictBase) -> Tensor:
    """Error of the critics, and the penalty."""
    error = loss.q_loss(batch)[0]  # writes keys that the penalty reads
    return error + loss.cql_loss(batch)[0]


def _cql_actor(loss: CQLLoss, batch: TensorDictBase, *, imitates: bool = False) -> Tensor:
    """Loss of the actor, and that of the temperature, whose gradient reaches no network."""
    value, info = loss.actor_loss(batch)
    if imitates:
        value = loss.actor_bc_loss(batch)[0]
    return value + loss.alpha_loss(info, mask_tensordict=batch)[0]


_ACTOR_CRITIC = {"qvalue_network": _method("qvalue_loss"), "actor_network": _method("actor_loss")}
OBJECTIVES: Mapping[str, Mapping[str, Objective]] = {
    "bc": {"actor_network": _bc_actor},
    "bc_best": {"actor_network": _bc_actor},
    "td3_bc": _ACTOR_CRITIC,
    "rebrac": _ACTOR_CRITIC,
    "iql": {
        "value_network": _method("value_loss"),
        "actor_network": _method("actor_loss"),
        "qvalue_network": _method("qvalue_loss"),
    },
    "cql": {"qvalue_network": _cql_critics, "actor_network": _cql_actor},
}
"""The objective of each network in the order of the updates, by algorithm."""


def objectives(algorithm: str, update: int, total: int) -> dict[str, Objective]:
    """The networks that one update trains, in their order, each with its objective.

    Args:
        algorithm: one of :data:`ALGORITHMS`.
        update: number of the update; the first is 1.
        total: number of the last update.

    Example:
        >>> [list(objectives("td3_bc", update, total=100)) for update in (1, 2)]
        [['qvalue_network'], ['qvalue_network', 'actor_network']]
    """
    chosen = dict(OBJECTIVES[algorithm])
    if algorithm in ("td3_bc", "rebrac") and update % ACTOR_INTERVAL:
        del chosen["actor_network"]
    if algorithm == "cql" and update <= IMITATION * total:
        chosen["actor_network"] = partial(_cql_actor, imitates=True)
    return chosen
