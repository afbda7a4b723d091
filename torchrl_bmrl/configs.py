"""Hydra configurations of the losses, in the form of TorchRL's own.

Importing this module stores them in Hydra's group ``loss``, as importing
``torchrl.trainers.algorithms.configs`` does with TorchRL's. It needs hydra-core and omegaconf
(extra ``[recipes]``).

Each configuration is generated from the signature of its loss: same arguments, same defaults. A
network is a configuration of its own, with ``_target_``, or the module itself. Lists reach the loss
as lists (``_convert_``).
"""

from __future__ import annotations

import inspect
import re
from dataclasses import field, make_dataclass
from functools import reduce
from operator import or_
from types import NoneType
from typing import Any

from torchrl_bmrl import objectives
from torchrl_bmrl.extras import needs

with needs("recipes"):
    from hydra.core.config_store import ConfigStore
    from omegaconf import MISSING
    from torchrl.trainers.algorithms.configs.objectives import LossConfig

__all__ = [
    "BCQLossConfig",
    "ContextInferenceLossConfig",
    "DiscreteBCQLossConfig",
    "FOCALLossConfig",
    "FQELossConfig",
    "MBMLLossConfig",
    "MetaDistillationLossConfig",
    "PLASLossConfig",
    "ReBRACLossConfig",
    "RewardModelLossConfig",
    "StackedLossConfig",
]

_PLAIN = {"int": int, "float": float, "str": str, "bool": bool, "None": NoneType}
"""Types that Hydra checks; a field of another type takes anything."""


def _type(annotation: str) -> Any:
    """The type of a field, such as ``float | None``; ``Any`` for what is not a plain value."""
    parts = annotation.split(" | ")
    if not set(parts) <= _PLAIN.keys():
        return Any
    return reduce(or_, (_PLAIN[part] for part in parts))


def _configuration(loss: type) -> Any:
    """The configuration of a loss, a dataclass, which is stored in Hydra's group."""
    name, parameters = f"{loss.__name__}Config", inspect.signature(loss).parameters
    fields: list[Any] = []
    for key, parameter in parameters.items():
        default = MISSING if parameter.default is parameter.empty else parameter.default
        fields.append((key, _type(parameter.annotation), field(default=default)))
    fields.append(("_target_", str, field(default=f"torchrl_bmrl.objectives.{loss.__name__}")))
    fields.append(("_convert_", str, field(default="all")))
    required = [key for key, x in parameters.items() if x.default is x.empty]
    doc = f"""Hydra configuration of :class:`~torchrl_bmrl.objectives.{loss.__name__}`.

    Attributes:
        {", ".join(parameters)}: as in the loss.
        _target_, _convert_, _partial_: of Hydra: what it makes, and how.

    Example:
        >>> from omegaconf import OmegaConf
        >>> config = OmegaConf.structured({name})
        >>> [name for name in config if OmegaConf.is_missing(config, name)]
        {required}
    """
    config = make_dataclass(
        name, fields, bases=(LossConfig,), namespace={"__module__": __name__, "__doc__": doc}
    )
    group = re.sub(r"(?<=[a-z]{2})(?=[A-Z])|(?<=BCQ)(?=L)", "_", loss.__name__).lower()
    group = group.removesuffix("_loss").removesuffix("loss")
    store = ConfigStore.instance()
    store.store(group="loss", name=group, node=config, provider="torchrl_bmrl")
    return config


BCQLossConfig = _configuration(objectives.BCQLoss)
ContextInferenceLossConfig = _configuration(objectives.ContextInferenceLoss)
DiscreteBCQLossConfig = _configuration(objectives.DiscreteBCQLoss)
FOCALLossConfig = _configuration(objectives.FOCALLoss)
FQELossConfig = _configuration(objectives.FQELoss)
MBMLLossConfig = _configuration(objectives.MBMLLoss)
MetaDistillationLossConfig = _configuration(objectives.MetaDistillationLoss)
PLASLossConfig = _configuration(objectives.PLASLoss)
ReBRACLossConfig = _configuration(objectives.ReBRACLoss)
RewardModelLossConfig = _configuration(objectives.RewardModelLoss)
StackedLossConfig = _configuration(objectives.StackedLoss)
