"""The core needs torch, tensordict and torchrl only."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

EXTRAS = (
    "gymnasium",
    "h5py",
    "hydra",
    "jinja2",
    "matplotlib",
    "minari",
    "mujoco",
    "omegaconf",
    "robosuite",
    "safetensors",
    "scipy",
    "sklearn",
    "tensorboard",
    "tqdm",
    "wandb",
    "yaml",
)
CORE = (
    "objectives",
    "modules",
    "data",
    "data.replay",
    "functional",
    "errors",
    "tasks",
    "training.update",
)

# What TorchRL and its own dependencies import is theirs; the rest is made impossible to import.
CODE = f"""
import importlib, json, sys
import tensordict.nn, torch.func, torchrl.data, torchrl.envs, torchrl.modules
import torchrl.objectives.value
before = set(sys.modules)
blocked = [name for name in {EXTRAS!r} if name not in before]
sys.modules.update(dict.fromkeys(blocked))
for name in {CORE!r}:
    importlib.import_module("torchrl_bmrl." + name)
after = {{name for name, module in sys.modules.items() if module is not None}}
print(json.dumps({{"new": sorted(after - before), "blocked": blocked}}))
"""


@pytest.mark.slow
def test_the_core_imports_without_any_extra() -> None:
    result = subprocess.run(
        [sys.executable, "-c", CODE], capture_output=True, text=True, timeout=600, check=False
    )
    assert result.returncode == 0, result.stderr
    answer = json.loads(result.stdout.splitlines()[-1])
    assert {"h5py", "hydra", "robosuite", "safetensors", "wandb"} <= set(answer["blocked"])
    tops = {name.partition(".")[0] for name in answer["new"]}
    assert "torchrl_bmrl" in tops
    assert not tops & set(EXTRAS)
    heavy = {"configs", "envs", "evaluation", "experts", "pipeline", "reports", "run.workers"}
    heavy |= {"run.folder", "training.checkpoint"}
    assert not {f"torchrl_bmrl.{name}" for name in heavy} & set(answer["new"])
