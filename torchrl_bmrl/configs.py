"""Hydra configurations of the losses, in the form that TorchRL gives its own.

Importing this module stores them in Hydra's group ``loss``, as importing
``torchrl.trainers.algorithms.configs`` does with TorchRL's. It needs hydra-core and omegaconf
(extra ``[recipes]``).

Each configuration has the arguments of its loss, with the same defaults. A network is a
configuration of its own, under ``_target_``, or the module itself. Lists reach the loss as lists
(``_convert_``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchrl_bmrl.extras import needs
from torchrl_bmrl.objectives.distillation import ENCODER_TERMS

with needs("recipes"):
    from hydra.core.config_store import ConfigStore
    from omegaconf import MISSING
    from torchrl.trainers.algorithms.configs.objectives import LossConfig

__all__ = [
    "BCQLossConfig",
    "DiscreteBCQLossConfig",
    "FQELossConfig",
    "MetaDistillationLossConfig",
    "PLASLossConfig",
    "StackedLossConfig",
]


@dataclass
class BCQLossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_bmrl.objectives.BCQLoss`.

    Attributes:
        generator, qvalue_network, perturbation_network: the networks, or their configurations;
            ``qvalue_network`` may be a list of them.
        action_spec, bounds, num_qvalue_nets, num_candidates, lmbda, latent_clip: as in the loss.
        kl_weight, kl_reduction, max_perturbation, value_bounds, target_dtype: as in the loss.
        loss_function, gamma, separate_losses, reduction, deactivate_vmap: as in the loss.
        use_prioritized_weights: as in the loss.
        _target_, _convert_, _partial_: what Hydra makes, and how.

    Example:
        >>> from hydra.utils import instantiate
        >>> sizes = {"observation_dim": 3, "action_dim": 2}
        >>> config = BCQLossConfig(
        ...     generator={"_target_": "torchrl_bmrl.modules.ActionVAE", **sizes},
        ...     qvalue_network={"_target_": "torchrl_bmrl.modules.make_qvalue_network", **sizes},
        ...     bounds=[-1.0, 1.0],
        ...     gamma=0.98,
        ... )
        >>> loss = instantiate(config)
        >>> type(loss).__name__, loss.num_qvalue_nets, loss.gamma
        ('BCQLoss', 2, 0.98)
    """

    generator: Any = MISSING
    qvalue_network: Any = MISSING
    perturbation_network: Any = None
    action_spec: Any = None
    bounds: Any = None
    num_qvalue_nets: int | None = None
    num_candidates: int = 10
    lmbda: float = 0.75
    latent_clip: float | None = 0.5
    kl_weight: float = 0.5
    kl_reduction: str = "mean"
    max_perturbation: float = 0.05
    value_bounds: Any = None
    target_dtype: str | None = None
    loss_function: str = "l2"
    gamma: float = 0.99
    separate_losses: bool = False
    reduction: str | None = "mean"
    deactivate_vmap: bool = False
    use_prioritized_weights: str | bool = "auto"
    _target_: str = "torchrl_bmrl.objectives.BCQLoss"
    _convert_: str = "all"


@dataclass
class DiscreteBCQLossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_bmrl.objectives.DiscreteBCQLoss`.

    Attributes:
        generator, qvalue_network: the networks, or their configurations; ``qvalue_network`` may
            be a list of them.
        action_space, num_qvalue_nets, threshold, logits_weight: as in the loss.
        loss_function, gamma, separate_losses, reduction, deactivate_vmap: as in the loss.
        use_prioritized_weights: as in the loss.
        _target_, _convert_, _partial_: what Hydra makes, and how.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl.trainers.algorithms.configs import MLPConfig, TensorDictModuleConfig
        >>> def network(key):
        ...     mlp = MLPConfig(in_features=4, out_features=2, depth=1, num_cells=16)
        ...     return TensorDictModuleConfig(module=mlp, in_keys=["observation"], out_keys=[key])
        >>> config = DiscreteBCQLossConfig(
        ...     generator=network("logits"), qvalue_network=network("action_value")
        ... )
        >>> type(instantiate(config)).__name__
        'DiscreteBCQLoss'
    """

    generator: Any = MISSING
    qvalue_network: Any = MISSING
    action_space: str = "one-hot"
    num_qvalue_nets: int | None = None
    threshold: float = 0.3
    logits_weight: float = 1e-2
    loss_function: str = "smooth_l1"
    gamma: float = 0.99
    separate_losses: bool = False
    reduction: str | None = "mean"
    deactivate_vmap: bool = False
    use_prioritized_weights: str | bool = "auto"
    _target_: str = "torchrl_bmrl.objectives.DiscreteBCQLoss"
    _convert_: str = "all"


@dataclass
class FQELossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_bmrl.objectives.FQELoss`.

    Attributes:
        policy, qvalue_network: the policy that is evaluated, which stays as it is, and its critics,
            or their configurations; ``qvalue_network`` may be a list of them.
        num_qvalue_nets, gamma, loss_function, separate_losses, reduction: as in the loss.
        deactivate_vmap, use_prioritized_weights: as in the loss.
        _target_, _convert_, _partial_: what Hydra makes, and how.

    Example:
        >>> from hydra.utils import instantiate
        >>> from tensordict.nn import TensorDictModule
        >>> from torch.nn import Linear
        >>> from torchrl_bmrl.modules import make_qvalue_network
        >>> policy = TensorDictModule(Linear(3, 2), in_keys=["observation"], out_keys=["action"])
        >>> networks = {"policy": policy, "qvalue_network": make_qvalue_network(3, 2)}
        >>> type(instantiate(FQELossConfig(gamma=0.98), **networks)).__name__
        'FQELoss'
    """

    policy: Any = MISSING
    qvalue_network: Any = MISSING
    num_qvalue_nets: int | None = None
    gamma: float = 0.99
    loss_function: str = "l2"
    separate_losses: bool = False
    reduction: str | None = "mean"
    deactivate_vmap: bool = False
    use_prioritized_weights: str | bool = "auto"
    _target_: str = "torchrl_bmrl.objectives.FQELoss"
    _convert_: str = "all"


@dataclass
class PLASLossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_bmrl.objectives.PLASLoss`.

    Attributes:
        generator, actor_network, qvalue_network, perturbation_network: the networks, or their
            configurations; ``qvalue_network`` may be a list of them.
        action_spec, bounds, num_qvalue_nets, lmbda: as in the loss.
        kl_weight, kl_reduction, max_perturbation: as in the loss.
        loss_function, gamma, separate_losses, reduction, deactivate_vmap: as in the loss.
        use_prioritized_weights: as in the loss.
        _target_, _convert_, _partial_: what Hydra makes, and how.

    Example:
        >>> from hydra.utils import instantiate
        >>> from torchrl_bmrl.modules import ActionVAE, make_latent_actor, make_qvalue_network
        >>> config = PLASLossConfig(bounds=[-1.0, 1.0], lmbda=1.0)
        >>> networks = {
        ...     "generator": ActionVAE(3, 2, latent_dim=4),
        ...     "actor_network": make_latent_actor(3, 4),
        ...     "qvalue_network": [make_qvalue_network(3, 2) for _ in range(2)],
        ... }
        >>> float(instantiate(config, **networks).lmbda)
        1.0
    """

    generator: Any = MISSING
    actor_network: Any = MISSING
    qvalue_network: Any = MISSING
    perturbation_network: Any = None
    action_spec: Any = None
    bounds: Any = None
    num_qvalue_nets: int | None = None
    lmbda: float = 0.75
    kl_weight: float = 0.5
    kl_reduction: str = "mean"
    max_perturbation: float = 0.05
    loss_function: str = "l2"
    gamma: float = 0.99
    separate_losses: bool = False
    reduction: str | None = "mean"
    deactivate_vmap: bool = False
    use_prioritized_weights: str | bool = "auto"
    _target_: str = "torchrl_bmrl.objectives.PLASLoss"
    _convert_: str = "all"


@dataclass
class MetaDistillationLossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_bmrl.objectives.MetaDistillationLoss`.

    Attributes:
        task_encoder, task_classifier, student_generator, student_qvalue_network: the networks that
            are trained, or their configurations.
        teacher_generators, teacher_qvalue_networks: lists of networks or configurations, one per
            task.
        latent_dim, latent_clip, qvalue_loc, qvalue_scale, reward_scale: as in the loss.
        classification_weight, generator_weight, direction_weight, qvalue_weight: as in the loss.
        latent_norm_weight, metric_weight, metric_margin, isometry_weight: as in the loss.
        encoder_terms, context, context_fraction, context_size: as in the loss.
        reduction, deactivate_vmap, use_prioritized_weights: as in the loss.
        _target_, _convert_, _partial_: what Hydra makes, and how.

    Example:
        >>> from omegaconf import OmegaConf
        >>> config = OmegaConf.structured(MetaDistillationLossConfig(latent_dim=4))
        >>> config.encoder_terms = ["classification"]
        >>> config.latent_dim, config.encoder_terms
        (4, ['classification'])
    """

    task_encoder: Any = MISSING
    task_classifier: Any = MISSING
    student_generator: Any = MISSING
    student_qvalue_network: Any = MISSING
    teacher_generators: Any = MISSING
    teacher_qvalue_networks: Any = MISSING
    latent_dim: int = MISSING
    latent_clip: float | None = 0.5
    qvalue_loc: Any = None
    qvalue_scale: Any = None
    reward_scale: Any = None
    classification_weight: float = 1.0
    generator_weight: float = 1.0
    direction_weight: float = 1.0
    qvalue_weight: float = 1.0
    latent_norm_weight: float = 2e-3
    metric_weight: float = 0.0
    metric_margin: float = 1.0
    isometry_weight: float = 0.0
    encoder_terms: Any = ENCODER_TERMS
    context: str = "set"
    context_fraction: float = 0.5
    context_size: int = 8
    reduction: str | None = "mean"
    deactivate_vmap: bool = False
    use_prioritized_weights: str | bool = "auto"
    _target_: str = "torchrl_bmrl.objectives.MetaDistillationLoss"
    _convert_: str = "all"


@dataclass
class StackedLossConfig(LossConfig):
    """Hydra configuration of :class:`~torchrl_bmrl.objectives.StackedLoss`.

    Attributes:
        losses: list of the members' configurations; one that is named twice is made twice.
        names, deactivate_vmap: as in the loss.
        _target_, _convert_, _partial_: what Hydra makes, and how.

    Example:
        >>> from hydra.utils import instantiate
        >>> sizes = {"observation_dim": 3, "action_dim": 2}
        >>> member = BCQLossConfig(
        ...     generator={"_target_": "torchrl_bmrl.modules.ActionVAE", **sizes},
        ...     qvalue_network={"_target_": "torchrl_bmrl.modules.make_qvalue_network", **sizes},
        ...     bounds=[-1.0, 1.0],
        ... )
        >>> stack = instantiate(StackedLossConfig(losses=[member, member], names=["reach", "lift"]))
        >>> stack.generator_params.batch_size
        torch.Size([2])
    """

    losses: Any = MISSING
    names: Any = None
    deactivate_vmap: bool | None = None
    _target_: str = "torchrl_bmrl.objectives.StackedLoss"
    _convert_: str = "all"


for _name, _config in (
    ("bcq", BCQLossConfig),
    ("discrete_bcq", DiscreteBCQLossConfig),
    ("fqe", FQELossConfig),
    ("meta_distillation", MetaDistillationLossConfig),
    ("plas", PLASLossConfig),
    ("stacked", StackedLossConfig),
):
    ConfigStore.instance().store(group="loss", name=_name, node=_config, provider="torchrl_bmrl")
