"""Offline algorithms of TorchRL with their published coefficients and order of updates.

Their losses read ``observation`` and ``action`` in [-1, 1]. A policy acts without noise under
``ExplorationType.DETERMINISTIC``.
"""

from __future__ import annotations

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

from torchrl_bmrl.modules import make_qvalue_network
from torchrl_bmrl.modules.generator import make_mlp

Algorithm = tuple[LossModule, TensorDictModuleBase]
"""A loss and the policy that it trains."""
Objective = Callable[[Any, TensorDictBase], Tensor]
"""From a loss and a batch to the value that one optimizer minimises."""
CELLS = (256, 256)
"""Widths of every network's hidden layers by default."""
ACTOR_INTERVAL = 2
"""Updates of TD3+BC's critics for each update of its actor and its targets."""
IMITATION = 0.04
"""Share of CQL's updates, at the start, in which the actor imitates."""


def make_actor(
    observation_dim: int, action_dim: int, cells: Sequence[int] = CELLS
) -> TensorDictModule:
    """A deterministic policy with actions in [-1, 1]."""
    network = nn.Sequential(make_mlp(observation_dim, action_dim, cells), nn.Tanh())
    return TensorDictModule(network, in_keys=["observation"], out_keys=["action"])


def make_critics(
    observation_dim: int, action_dim: int, cells: Sequence[int] = CELLS
) -> list[TensorDictModule]:
    """Two critics."""
    return [make_qvalue_network(observation_dim, action_dim, num_cells=cells) for _ in range(2)]


def bc(observation_dim: int, action_dim: int, cells: Sequence[int] = CELLS) -> Algorithm:
    """Behaviour cloning with the squared error."""
    # TorchRL's BCLoss has no targets and warns about it.
    warnings.filterwarnings("ignore", "The name target_actor_network_params wasn't part of")
    actor = make_actor(observation_dim, action_dim, cells)
    return BCLoss(actor), actor


def td3_bc(observation_dim: int, action_dim: int, cells: Sequence[int] = CELLS) -> Algorithm:
    """TD3 with an imitation term."""
    actor = make_actor(observation_dim, action_dim, cells)
    critics = make_critics(observation_dim, action_dim, cells)
    return TD3BCLoss(actor, critics, bounds=(-1.0, 1.0), loss_function="l2"), actor


def iql(observation_dim: int, action_dim: int, cells: Sequence[int] = CELLS) -> Algorithm:
    """Expectile values and advantage-weighted imitation."""
    mean = make_actor(observation_dim, action_dim, cells).module
    network = nn.Sequential(mean, AddStateIndependentNormalScale(action_dim))
    keys = ["loc", "scale"]
    network = TensorDictModule(network, in_keys=["observation"], out_keys=keys)
    actor = ProbabilisticActor(network, in_keys=keys, distribution_class=IndependentNormal)
    value = make_mlp(observation_dim, 1, cells)
    value = TensorDictModule(value, in_keys=["observation"], out_keys=["state_value"])
    options = {"temperature": 3.0, "expectile": 0.7, "loss_function": "l2"}
    return IQLLoss(actor, make_critics(observation_dim, action_dim, cells), value, **options), actor


def cql(observation_dim: int, action_dim: int, cells: Sequence[int] = CELLS) -> Algorithm:
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
        make_critics(observation_dim, action_dim, cells),
        min_q_weight=5.0,
        num_random=10,
        target_entropy=-float(action_dim),
        loss_function="l2",
    )
    return loss, actor


ALGORITHMS = {build.__name__: build for build in (bc, td3_bc, iql, cql)}
"""Functions of the sizes of observation and action that return a loss and its policy, by name."""


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


OBJECTIVES: Mapping[str, Mapping[str, Objective]] = {
    "bc": {"actor_network": _bc_actor},
    "td3_bc": {"qvalue_network": _method("qvalue_loss"), "actor_network": _method("actor_loss")},
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
    if algorithm == "td3_bc" and update % ACTOR_INTERVAL:
        del chosen["actor_network"]
    if algorithm == "cql" and update <= IMITATION * total:
        chosen["actor_network"] = partial(_cql_actor, imitates=True)
    return chosen
