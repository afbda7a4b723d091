"""Scenes of strangers: compiled within limits, of known files, by processes that end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("h5py")
pytest.importorskip("robosuite", exc_type=ImportError)

import mujoco

from torchrl_bmrl.data.recordings import _kinematic_xml
from torchrl_bmrl.envs import rendering
from torchrl_bmrl.envs.assets import find_assets
from torchrl_bmrl.envs.compiling import compile_scene
from torchrl_bmrl.errors import DataError

pytestmark = [
    pytest.mark.robosuite,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that are copies"),
]
ASSETS = Path(next(iter(find_spec("robosuite").submodule_search_locations)), "models", "assets")


def test_a_scene_is_compiled_as_in_this_process() -> None:
    text = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    model, here = compile_scene(text), mujoco.MjModel.from_xml_string(text)
    assert (model.nq, model.nbody, model.body_mass.tolist()) == (7, 2, here.body_mass.tolist())


def test_a_scene_that_does_not_compile_gives_mujoco_s_reason() -> None:
    with pytest.raises(ValueError, match="unrecognized element"):
        compile_scene("<mujoco><nothing/></mujoco>")


def endless(_: str) -> None:
    while True:
        pass


def large(_: str) -> None:
    np.ones(2**28, np.uint8).sum()


LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux limits memory and has prctl")


@pytest.mark.parametrize(
    ("compiles", "says"),
    [(endless, "takes more than"), pytest.param(large, "allocate", marks=LINUX)],
)
def test_a_compilation_ends_at_its_limits(
    monkeypatch: pytest.MonkeyPatch, compiles: Any, says: str
) -> None:
    monkeypatch.setattr(mujoco, "MjModel", SimpleNamespace(from_xml_string=compiles))
    with pytest.raises(ValueError, match=says):
        compile_scene("<mujoco/>", seconds=1, memory=2**26)


WAITS = """
import os, sys, time, types
def waits(text):
    print(os.getpid(), flush=True)
    time.sleep(60)
stand_in = types.ModuleType("mujoco")
stand_in.mj_saveModel = print
stand_in.MjModel = types.SimpleNamespace(from_xml_string=waits)
sys.modules["mujoco"] = stand_in
from torchrl_bmrl.envs.compiling import compile_scene
compile_scene("<mujoco/>")
"""


@LINUX
def test_a_compilation_ends_with_the_process_that_started_it() -> None:
    with subprocess.Popen([sys.executable, "-c", WAITS], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.send_signal(signal.SIGKILL)
    for _ in range(100):
        state = Path(f"/proc/{child}/stat")
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.1)
    os.kill(child, signal.SIGKILL)
    pytest.fail("it goes on")


# -- files that scenes read ------------------------------------------------------------------------


def scene(name: str, file: str) -> str:
    return f"<mujoco><asset><mesh {name}='{file}'/></asset></mujoco>"


@pytest.mark.parametrize("name", ["file", "fileright"])
def test_a_scene_reads_files_of_the_installed_simulator_alone(name: str, tmp_path: Path) -> None:
    find_assets(scene(name, f"{ASSETS}/arenas/../textures/ceramic.png"))
    own = tmp_path / "own.stl"
    for file in (own, "own.stl", f"{ASSETS}/../../../own.stl", f"{ASSETS}/../../__init__.py"):
        with pytest.raises(DataError, match=r"not a file of robosuite, .*; valid: files in robo"):
            find_assets(scene(name, str(file)))


def test_a_recording_s_model_keeps_no_element_that_reads_files_or_multiplies_others() -> None:
    kept = "<body name='a'><geom size='1'/><joint/><site/></body>"
    rest = "<flexcomp file='x'/><replicate count='9'><body/></replicate><attach model='m'/>"
    assets = "<asset><model file='x'/></asset><include file='y'/>"
    text = f"<mujoco>{assets}<worldbody>{kept}{rest}<body>{rest}</body></worldbody></mujoco>"
    tags = {element.tag for element in ET.fromstring(_kinematic_xml(text)).iter()}
    assert tags == {"mujoco", "compiler", "worldbody", "body", "geom", "joint", "site"}


def test_drawing_imports_nothing_from_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("numpy", "mujoco", "torchrl_bmrl"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), *sys.path])
    problem = rendering._run("egl", ["no scenes", "no result"], lambda frames: None)
    assert problem is not None
    assert "no scenes" in problem
    assert not (tmp_path / "executed").exists()
