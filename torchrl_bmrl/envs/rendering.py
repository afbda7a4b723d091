"""Pictures of simulator states, with or without a GPU, or a clear word why there are none.

MuJoCo chooses its graphics library once, when it is imported, and a broken one may end the process.
So stored states are rendered in a process of its own, which tries one library after the other, and
an environment uses the library with which such a process made a picture.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.errors import BMRLError, RenderError
from torchrl_bmrl.extras import needs

GOAL_MARKER = "goal_marker"
"""The one site of a scene that is shown; the others are robosuite's own aids."""

_CONTEXTS = ("egl", "osmesa", "glfw")
"""Modules of mujoco with a context for each library, as ``MUJOCO_GL`` names them."""
_TARGET = (-0.1, 0.0, 0.98)  # between table and arm [m]
_DISTANCE, _AZIMUTH, _ELEVATION = 1.4, 180.0, -20.0  # in front of the table [m, deg, deg]


def render_states(
    scenes: Sequence[tuple[str, NDArray[Any]]],
    *,
    size: int = 192,
    report: Callable[[int], Any] = lambda frames: None,
) -> list[NDArray[np.uint8]]:
    """Pictures of simulator states as demonstrations keep them, seen from the front of the table.

    ``MUJOCO_GL`` chooses the graphics library; where it is not set, EGL and OSMesa are tried, and
    GLFW where there is a display.

    Args:
        scenes: For each episode its model as MJCF text and its states, shape ``(T, 1 + nq + nv)``:
            time, joint positions, joint velocities (robosuite's flattened state).
        size: Height and width of a picture [pixels].
        report: Called with the number of pictures made since its last call; negative where a
            library failed and the next one starts anew.

    Returns:
        For each episode its pictures, shape ``(T, size, size, 3)``.

    Raises:
        BMRLError: if states have another shape or are not finite.
        RenderError: if no graphics library works here; it says what each one said.

    Example:
        >>> render_states([])
        []
    """
    for _, states in scenes:
        if states.ndim != 2 or not np.isfinite(states).all():
            raise BMRLError(f"states must be finite, of shape (T, n), got {states.shape}")
    return _rendered(scenes, size, report)[1] if scenes else []


@cache
def graphics_library() -> str:
    """Value of ``MUJOCO_GL`` with which pictures can be made here; "" is MuJoCo's own choice.

    It is tried out in a process of its own, once, which takes about a second.

    Raises:
        RenderError: if no graphics library works here; it says what each one said.
    """
    return _rendered([("<mujoco/>", np.zeros((1, 1)))], 8, lambda frames: None)[0]


def make_renderer(model: Any, height: int, width: int) -> Any:
    """A ``mujoco.Renderer`` with :func:`graphics_library`, whatever mujoco chose at its import.

    Args:
        model: ``mujoco.MjModel``.
        height: of a picture [pixels].
        width: likewise.

    Raises:
        RenderError: if the graphics library does not work in this process.
    """
    with needs("robosuite"):
        import mujoco

    library = graphics_library()
    size = model.vis.global_
    size.offheight, size.offwidth = max(size.offheight, height), max(size.offwidth, width)
    chosen = sys.modules[mujoco.Renderer.__module__].gl_context
    before = getattr(chosen, "GLContext", None)
    try:
        if library in _CONTEXTS:
            chosen.GLContext = import_module(f"mujoco.{library}").GLContext
        return mujoco.Renderer(model, height, width)
    except Exception as error:  # a graphics library raises what it likes
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise RenderError([f"{library or 'the default'}: {reason}"]) from error
    finally:
        chosen.GLContext = before


def _rendered(
    scenes: Sequence[tuple[str, NDArray[Any]]], size: int, report: Callable[[int], Any]
) -> tuple[str, list[NDArray[np.uint8]]]:
    """The first library that works, and each scene's pictures."""
    problems = []
    with tempfile.TemporaryDirectory() as folder:
        task, result = Path(folder, "scenes.npz"), Path(folder, "frames.npz")
        arrays: dict[str, Any] = {f"states{i}": states for i, (_, states) in enumerate(scenes)}
        np.savez(task, models=np.array([model for model, _ in scenes]), size=size, **arrays)
        for library in _libraries():
            problem = _run(library, [str(task), str(result)], report)
            if problem is None:
                with np.load(result) as frames:
                    return library, [frames[f"frames{i}"] for i in range(len(scenes))]
            problems.append(f"{library or 'the default'}: {problem}")
    raise RenderError(problems)


def _libraries() -> list[str]:
    """Values of ``MUJOCO_GL`` to try; "" is MuJoCo's own choice."""
    if chosen := os.environ.get("MUJOCO_GL"):
        return [chosen]
    if sys.platform != "linux":
        return [""]
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return [*_CONTEXTS[:2], *(_CONTEXTS[2:] if display else ())]


def _run(library: str, arguments: list[str], report: Callable[[int], Any]) -> str | None:
    """Renders with one library; returns what went wrong."""
    environment = {**os.environ, "MUJOCO_GL": library}
    # PyOpenGL must load the same library, or it finds no context.
    environment |= {"PYOPENGL_PLATFORM": library} if library in ("egl", "osmesa") else {}
    # The package lies beside this one wherever the process was started.
    paths = [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH")]
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            [sys.executable, "-m", __name__, *arguments],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as process,
    ):
        assert process.stdout is not None
        made = 0
        try:
            for _ in process.stdout:
                made += 1
                report(1)
        except BaseException:
            process.kill()
            raise
        if process.wait() == 0:
            return None
        report(-made)
        errors.seek(0)
        lines = errors.read().strip().splitlines()
    return lines[-1] if lines else f"the process ended with code {process.returncode}"


def _render(task: str, result: str) -> None:
    """The process: pictures of all scenes, one line of output for each."""
    with needs("robosuite"):
        import mujoco

    camera = mujoco.MjvCamera()
    camera.lookat[:] = _TARGET
    camera.distance, camera.azimuth, camera.elevation = _DISTANCE, _AZIMUTH, _ELEVATION
    options = mujoco.MjvOption()
    options.geomgroup[0] = 0  # collision shapes
    known: dict[str, tuple[Any, Any, Any]] = {}
    frames = {}
    with np.load(task) as scenes:
        size = int(scenes["size"])
        for number, text in enumerate(scenes["models"]):
            # Scenes differ in the place of the marker alone: compiling each would take seconds.
            root = ET.fromstring(str(text))
            marker = root.find(f".//site[@name='{GOAL_MARKER}']")
            place = None if marker is None else np.array(marker.get("pos", "0 0 0").split(), float)
            if marker is not None:
                marker.set("pos", "1 1 1")  # MuJoCo never moves a site compiled at the origin
            key = ET.tostring(root, encoding="unicode")
            if key not in known:
                known[key] = _make_renderer(mujoco, key, size)
            model, data, renderer = known[key]
            if place is not None:
                model.site(GOAL_MARKER).pos[:] = place
            pictures = []
            for state in scenes[f"states{number}"]:
                data.qpos[:] = state[1 : 1 + model.nq]
                mujoco.mj_fwdPosition(model, data)  # lights, too
                renderer.update_scene(data, camera=camera, scene_option=options)
                # Reset by update_scene. On a processor they are most of the time.
                for effect in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                    renderer.scene.flags[effect] = 0
                pictures.append(renderer.render())
                print(flush=True)
            frames[f"frames{number}"] = np.array(pictures, np.uint8).reshape(-1, size, size, 3)
    np.savez(result, **frames)


def _make_renderer(mujoco: Any, text: str, size: int) -> tuple[Any, Any, Any]:
    model = mujoco.MjModel.from_xml_string(text)
    model.vis.quality.offsamples = 0  # smooth edges, at three times the time
    for index in range(model.nsite):
        if model.site(index).name != GOAL_MARKER:
            model.site_rgba[index, 3] = 0.0
    return model, mujoco.MjData(model), mujoco.Renderer(model, size, size)


if __name__ == "__main__":
    _render(*sys.argv[1:])
