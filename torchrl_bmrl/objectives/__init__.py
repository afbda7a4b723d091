"""Offline losses in TorchRL's contract."""

from torchrl_bmrl.objectives.base import KeyedLoss
from torchrl_bmrl.objectives.bcq import BCQLoss
from torchrl_bmrl.objectives.common import OfflineLoss
from torchrl_bmrl.objectives.discrete_bcq import DiscreteBCQLoss
from torchrl_bmrl.objectives.distillation import MetaDistillationLoss
from torchrl_bmrl.objectives.focal import FOCALLoss
from torchrl_bmrl.objectives.fqe import FQELoss
from torchrl_bmrl.objectives.generative import GenerativeLoss
from torchrl_bmrl.objectives.inference import ContextInferenceLoss
from torchrl_bmrl.objectives.mbml import MBMLLoss
from torchrl_bmrl.objectives.plas import PLASLoss
from torchrl_bmrl.objectives.rebrac import ReBRACLoss
from torchrl_bmrl.objectives.relabel import RewardModelLoss
from torchrl_bmrl.objectives.stacked import StackedLoss

__all__ = [
    "BCQLoss",
    "ContextInferenceLoss",
    "DiscreteBCQLoss",
    "FOCALLoss",
    "FQELoss",
    "GenerativeLoss",
    "KeyedLoss",
    "MBMLLoss",
    "MetaDistillationLoss",
    "OfflineLoss",
    "PLASLoss",
    "ReBRACLoss",
    "RewardModelLoss",
    "StackedLoss",
]
