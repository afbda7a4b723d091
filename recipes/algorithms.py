"""Offline algorithms: from the sizes of observation and action to a loss and its policy.

TorchRL's losses with their published coefficients, and this library's. All of them read
``observation`` and ``action`` in [-1, 1]; a policy acts without noise under
``ExplorationType.DETERMINISTIC``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

from tensordict.nn import (
    AddStateIndependentNormalScale,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import nn
from torchrl.modules import (
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
)
from torchrl.objectives import BCLoss, CQLLoss, DDPGLoss, IQLLoss, LossModule, TD3BCLoss

from torchrl_bmrl.modules import (
    ActionVAE,
    BCQPolicy,
    PLASPolicy,
    make_latent_actor,
    make_qvalue_network,
)
from torchrl_bmrl.modules.generator import make_mlp
from torchrl_bmrl.objectives import BCQLoss, PLASLoss

Algorithm = tuple[LossModule, Callable[[], TensorDictModuleBase]]
BOUNDS = (-1.0, 1.0)
Cells = Sequence[int]
CELLS = (256, 256)  # of every network


def make_actor(observation_dim: int, action_dim: int, cells: Cells = CELLS) -> TensorDictModule:
    """Deterministic policy."""
    network = nn.Sequential(make_mlp(observation_dim, action_dim, cells), nn.Tanh())
    return TensorDictModule(network, in_keys=["observation"], out_keys=["action"])


def make_critics(
    observation_dim: int, action_dim: int, cells: Cells = CELLS
) -> list[TensorDictModule]:
    """Twin critics."""
    return [make_qvalue_network(observation_dim, action_dim, num_cells=cells) for _ in range(2)]


def ddpg(*dims: int, cells: Cells = CELLS) -> Algorithm:
    """Off-policy: nothing keeps its actions near the batch."""
    actor = make_actor(*dims, cells)
    return DDPGLoss(actor, make_critics(*dims, cells)[0], delay_actor=True), lambda: actor


def bc(*dims: int, cells: Cells = CELLS) -> Algorithm:
    """Imitation."""
    # TorchRL's BCLoss has no targets and does not say so.
    warnings.filterwarnings("ignore", "The name target_actor_network_params wasn't part of")
    actor = make_actor(*dims, cells)
    return BCLoss(actor), lambda: actor


def td3_bc(*dims: int, cells: Cells = CELLS) -> Algorithm:
    """TD3 with an imitation term."""
    actor = make_actor(*dims, cells)
    loss = TD3BCLoss(actor, make_critics(*dims, cells), bounds=BOUNDS, loss_function="l2")
    return loss, lambda: actor


def iql(*dims: int, cells: Cells = CELLS) -> Algorithm:
    """Expectile values and advantage-weighted imitation, with the published coefficients."""
    mean = make_actor(*dims, cells).module
    network = nn.Sequential(mean, AddStateIndependentNormalScale(dims[1]))
    keys = ["loc", "scale"]
    network = TensorDictModule(network, in_keys=["observation"], out_keys=keys)
    actor = ProbabilisticActor(network, in_keys=keys, distribution_class=IndependentNormal)
    value = make_mlp(dims[0], 1, cells)
    value = TensorDictModule(value, in_keys=["observation"], out_keys=["state_value"])
    options = {"temperature": 3.0, "expectile": 0.7, "loss_function": "l2"}
    return IQLLoss(actor, make_critics(*dims, cells), value, **options), lambda: actor


def cql(*dims: int, cells: Cells = CELLS) -> Algorithm:
    """SAC whose critics are held down where the batch has no actions.

    The fixed weight of 5 is the published one without a Lagrange multiplier. TorchRL's
    ``with_lagrange`` leaves the critics' penalty as it is and adds the multiplier's own loss, whose
    gradient reaches the critics and undoes the penalty.
    """
    actor = ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(
                make_mlp(dims[0], 2 * dims[1], cells), ["observation"], ["parameters"]
            ),
            TensorDictModule(NormalParamExtractor(), ["parameters"], ["loc", "scale"]),
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    loss = CQLLoss(
        actor,
        make_critics(*dims, cells),
        min_q_weight=5.0,
        num_random=10,
        target_entropy=-float(dims[1]),
        loss_function="l2",
    )
    return loss, lambda: actor


def plas(*dims: int, cells: Cells = CELLS) -> Algorithm:
    """A policy that chooses the latent of a generator of the batch's actions."""
    generator = ActionVAE(*dims, num_cells=cells)
    # Published: 2. BCQ's 0.5 keeps to latents that so short a training has seen.
    actor = make_latent_actor(dims[0], generator.latent_dim, num_cells=cells, max_latent=0.5)
    loss = PLASLoss(generator, actor, make_critics(*dims, cells), bounds=BOUNDS)
    return loss, lambda: PLASPolicy.frozen(loss)


def bcq(*dims: int, cells: Cells = CELLS) -> Algorithm:
    """The best of what a generator of the batch's actions proposes."""
    loss = BCQLoss(ActionVAE(*dims, num_cells=cells), make_critics(*dims, cells), bounds=BOUNDS)
    return loss, lambda: BCQPolicy.frozen(loss)
