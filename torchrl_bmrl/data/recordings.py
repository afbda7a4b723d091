"""Reads recorded simulator states together with the model that defines them.

The model is the recording's own MJCF without its meshes, which are seldom distributed: joints,
bodies and simple shapes suffice for forward kinematics.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_bmrl.data.hdf5 import read_array, read_attributes
from torchrl_bmrl.envs.compiling import compile_scene
from torchrl_bmrl.errors import DataError
from torchrl_bmrl.extras import needs

with needs("data"):
    import h5py

if TYPE_CHECKING:
    import mujoco

_LEFT_OUT = (
    *("attach", "camera", "composite", "flexcomp"),
    *("include", "light", "plugin", "replicate"),
)
"""Elements of bodies that read files, multiply other elements, or are not seen."""
MAX_GAP = 0.1
"""Longest time between two recorded rows [s] that is interpolated over."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recorded demonstration: states (T, 1 + nq + nv) and their model."""

    path: Path
    demo: str
    states: np.ndarray
    model: mujoco.MjModel

    def error(self, message: str, key: str = "") -> DataError:
        """Makes an error that names the file and the demonstration."""
        return DataError(self.path, self.demo + key, message)


def read_recording(path: Path, file: h5py.File, name: str) -> Recording:
    """Reads and checks a demonstration's states and model.

    Raises:
        DataError: naming file, key and row.
    """
    demo = f"data/{name}"
    states = read_array(path, file, f"{demo}/states")
    attributes = read_attributes(path, file, demo)
    if not isinstance(attributes.get("model_file"), str):
        message = "missing attribute; valid: a file in models/, or XML text"
        raise DataError(path, f"{demo}/model_file", message)
    model = _compile(path, f"{demo}/model_file", attributes["model_file"])
    recording = Recording(path=path, demo=demo, states=states.astype(np.float64), model=model)
    _check_states(recording)
    return recording


def _compile(path: Path, key: str, model_file: str) -> mujoco.MjModel:
    """Compiles the model of a recording from XML text or the name of a file in ``models/``."""
    text: str | bytes = model_file
    label = "the XML text"
    try:
        if not model_file.lstrip().startswith("<"):
            model_path = path.parent / "models" / Path(model_file).name
            label = str(model_path)
            if model_path.is_symlink() or model_path.parent.is_symlink():
                message = f"{label} is behind a link; valid: a file in a folder beside {path.name}"
                raise DataError(path, key, message)
            if not model_path.is_file():
                there = ", ".join(sorted(file.name for file in model_path.parent.glob("*.xml")))
                raise DataError(path, key, f"{label} is missing; there: {there or 'no models'}")
            text = model_path.read_bytes()
        return compile_scene(_kinematic_xml(text), seconds=4, memory=2**26)  # takes 0.03 s
    except DataError:
        raise
    except (ElementTree.ParseError, OSError, RecursionError, ValueError) as error:
        raise DataError(path, key, f"{label} does not compile ({error})") from error


def _kinematic_xml(text: str | bytes) -> str:
    """Reduces an MJCF to bodies, joints, sites and simple shapes, which need no other files.

    The states of a recording that needs what is left out do not fit its model.
    """
    root = ElementTree.fromstring(text)
    for child in list(root):
        if child.tag not in ("compiler", "default", "worldbody"):
            root.remove(child)
    compilers = root.findall("compiler") or [ElementTree.SubElement(root, "compiler")]
    for compiler in compilers:
        units = {key: value for key, value in compiler.items() if key in ("angle", "eulerseq")}
        compiler.attrib.clear()
        # Bodies need a mass, also without their mesh; forward kinematics does not use it.
        compiler.attrib.update(units, boundmass="1e-6", boundinertia="1e-9", balanceinertia="true")
    for parent in list(root.iter()):
        parent.attrib.pop("material", None)
        for child in list(parent):
            mesh = "mesh" in child.attrib or child.get("type") == "mesh"
            if child.tag in _LEFT_OUT or (child.tag == "geom" and mesh):
                parent.remove(child)
    return ElementTree.tostring(root, encoding="unicode")


def _check_states(recording: Recording) -> None:
    model, states = recording.model, recording.states
    width = 1 + model.nq + model.nv
    if states.ndim != 2 or states.shape[1] != width:
        valid = f"(T, {width}): time, {model.nq} positions, {model.nv} velocities of its model"
        raise recording.error(f"shape {states.shape}; valid: {valid}", "/states")
    if len(states) < 2:
        raise recording.error(f"rows: {len(states)}; valid: at least 2", "/states")
    if len(bad := np.argwhere(~np.isfinite(states))):
        raise recording.error(f"a value that is not finite in row {bad[0][0]}", "/states")
    times = states[:, 0]
    gaps = np.diff(times)
    # The tolerance accepts a gap of exactly that length despite rounding.
    if len(bad := np.flatnonzero((gaps < 0) | (gaps > MAX_GAP + 1e-9))):
        message = f"time goes from {times[bad[0]]:.3f} to {times[bad[0] + 1]:.3f} s in row "
        message += f"{bad[0] + 1}; valid: forward, by {MAX_GAP} s at most"
        raise recording.error(message, "/states")
    for column in _quaternion_columns(model):
        norms = np.linalg.norm(states[:, column : column + 4], axis=1)
        if len(bad := np.flatnonzero(np.abs(norms - 1) > 0.01)):
            message = f"columns {column} to {column + 3} are not a unit quaternion in row {bad[0]}"
            raise recording.error(message, "/states")


def _quaternion_columns(model: mujoco.MjModel) -> list[int]:
    """Columns of the states where the free joints' quaternions begin."""
    with needs("robosuite"):
        import mujoco

    free = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
    return [1 + int(model.jnt_qposadr[joint]) + 3 for joint in free]


def resample(recording: Recording, frequency: float) -> np.ndarray:
    """Interpolates states (N, 1 + nq + nv) at the control rate, from the first row on."""
    # Of several rows at the same time, the last is used.
    states = recording.states[np.append(np.diff(recording.states[:, 0]) > 0, True)].copy()
    times = states[:, 0]
    # The small number keeps the last row if rounding puts it just before its grid point.
    count = int((times[-1] - times[0]) * frequency + 1e-6) + 1
    if count < 2:
        raise recording.error(f"rows at {frequency} Hz: {count}; valid: at least 2", "/states")
    quaternions = _quaternion_columns(recording.model)
    for column in quaternions:
        # q and -q are the same rotation: neighbours get the same sign before interpolation.
        part = states[:, column : column + 4]
        part[1:] *= np.cumprod(np.where((part[1:] * part[:-1]).sum(1) < 0, -1, 1))[:, None]
    grid = times[0] + np.arange(count) / frequency
    rows = np.stack([np.interp(grid, times, column) for column in states.T], axis=1)
    for column in quaternions:
        part = rows[:, column : column + 4]
        part /= np.linalg.norm(part, axis=1, keepdims=True)
    return rows
