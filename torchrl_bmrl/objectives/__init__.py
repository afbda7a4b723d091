"""Offline losses in TorchRL's contract."""

from torchrl_bmrl.objectives.bcq import BCQLoss
from torchrl_bmrl.objectives.distillation import MetaDistillationLoss

__all__ = ["BCQLoss", "MetaDistillationLoss"]
