"""The ids are there for gymnasium without an import of this package by its user."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

pytest.importorskip("gymnasium")

from torchrl_bmrl.envs.hidden import HIDDEN
from torchrl_bmrl.envs.registration import gymnasium_id
from torchrl_bmrl.envs.skills import SKILLS

GROUP = "gymnasium.envs"
IDS = [gymnasium_id(task) for task in (*SKILLS, "reach-lift", *HIDDEN)]


def declared() -> EntryPoint:
    """The plugin that the distribution declares."""
    text = (Path(__file__).parents[1] / "pyproject.toml").read_text()
    _, _, table = text.partition(f'[project.entry-points."{GROUP}"]\n')
    ((name, value),) = re.findall(r'^(\w+) = "(.+)"$', table.partition("\n[")[0], re.MULTILINE)
    return EntryPoint(name, value, GROUP)


AS_A_PLUGIN = """
import sys
import gymnasium.envs.registration as registration
from importlib.metadata import EntryPoint
# As while gymnasium is imported, which is when those before 1.0 load plugins.
whole = sys.modules.pop("gymnasium")
sys.modules["gymnasium"] = type(sys)("gymnasium")
sys.modules["gymnasium"].__path__ = whole.__path__
sys.modules["gymnasium"].envs = whole.envs
EntryPoint({name!r}, {value!r}, "gymnasium.envs").load()()
for loaded in ("torch", "robosuite", "mujoco", "numba"):
    assert loaded not in sys.modules, loaded
print(*[name for name in registration.registry if name.startswith("{name}/")])
"""


def test_the_plugin_registers_every_task_and_loads_no_simulator() -> None:
    plugin = declared()
    assert plugin.name == IDS[0].partition("/")[0]  # the namespace that gymnasium gives it
    code = AS_A_PLUGIN.format(name=plugin.name, value=plugin.value)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == IDS


BY_MODULE = """
import sys, gymnasium
assert "torchrl_bmrl" not in sys.modules
print(gymnasium.make("torchrl_bmrl.envs:{id}").spec.id)
"""


@pytest.mark.robosuite
def test_an_id_that_names_its_module_needs_no_import() -> None:
    code = BY_MODULE.format(id=IDS[0])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.stdout.split() == [IDS[0]], done.stderr
