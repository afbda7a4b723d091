"""The two stages as functions on a :class:`Run`: collect, stage 1, stage 2, evaluate, export."""

from torchrl_bmrl.pipeline.collect import collect
from torchrl_bmrl.pipeline.evaluate import evaluate
from torchrl_bmrl.pipeline.export import export
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.settings import (
    BCQSettings,
    CollectSettings,
    DistillSettings,
    EvaluateSettings,
    Settings,
)
from torchrl_bmrl.pipeline.stage1 import stage1
from torchrl_bmrl.pipeline.stage2 import stage2
from torchrl_bmrl.pipeline.two_stage import two_stage

__all__ = [
    "BCQSettings",
    "CollectSettings",
    "DistillSettings",
    "EvaluateSettings",
    "Run",
    "Settings",
    "collect",
    "evaluate",
    "export",
    "stage1",
    "stage2",
    "two_stage",
]
