"""Renders simulator states, with or without a GPU.

MuJoCo chooses its graphics library once, at import, and a broken library may kill the process.
Therefore stored states are rendered in a subprocess for each library until one works, and an
environment uses the library that worked.
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
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from torchrl_bmrl.envs.assets import find_assets
from torchrl_bmrl.envs.compiling import compile_scene, end_with_parent
from torchrl_bmrl.errors import BMRLError, RenderError
from torchrl_bmrl.extras import needs

GOAL_MARKER = "goal_marker"
"""The only visible site of a scene; the others are auxiliary sites of robosuite."""

_CONTEXTS = ("egl", "osmesa", "glfw")
"""Modules of mujoco with a GL context; the names are also values of ``MUJOCO_GL``."""
_NOT_A_SCENE = 3
"""Exit code of the subprocess."""
_START = f"""
import sys
from importlib.util import module_from_spec, spec_from_file_location
package, *sys.path[:] = sys.argv[1:-3]
spec = spec_from_file_location("torchrl_bmrl", package + "/__init__.py")
sys.modules["torchrl_bmrl"] = module_from_spec(spec)
spec.loader.exec_module(sys.modules["torchrl_bmrl"])
from {__name__} import _render
_render(*sys.argv[-3:])
"""
"""Program of the subprocess: this very package, and others from the paths that are given."""
_TARGET = (-0.1, 0.0, 0.98)  # between table and arm [m]
_DISTANCE, _AZIMUTH, _ELEVATION = 1.4, 180.0, -20.0  # in front of the table [m, deg, deg]


def render_states(
    scenes: Sequence[tuple[str, NDArray[Any]]],
    *,
    size: int = 192,
    report: Callable[[int], Any] = lambda frames: None,
) -> list[NDArray[np.uint8]]:
    """Renders the simulator states of demonstrations, seen from the front of the table.

    ``MUJOCO_GL`` selects the graphics library. If it is not set, EGL and OSMesa are tried, and GLFW
    if there is a display.

    Args:
        scenes: the model of each episode as MJCF text and its states, shape ``(T, 1 + nq + nv)``:
            time, joint positions, joint velocities (robosuite's flattened state).
        size: height and width of a picture [pixels].
        report: called with the number of new pictures; with a negative number if a library failed
            and the next one starts again.

    Returns:
        the pictures of each episode, shape ``(T, size, size, 3)``.

    Raises:
        BMRLError: if a model does not compile, or states have another shape or are not finite.
        DataError: naming a mesh or texture that is missing.
        RenderError: with each library's error, if none works.

    Example:
        >>> render_states([])
        []
    """
    for _, states in scenes:
        if states.ndim != 2 or not np.isfinite(states).all():
            raise BMRLError(f"states must be finite, of shape (T, n), got {states.shape}")
    # Before any library is tried: a missing mesh is none's fault.
    found = [(find_assets(model), states) for model, states in scenes]
    return _rendered(found, size, report)[1] if found else []


@cache
def graphics_library() -> str:
    """Returns a value of ``MUJOCO_GL`` that works on this machine; "" is MuJoCo's default.

    The first call tests the libraries in a subprocess, which takes about a second.

    Raises:
        RenderError: with each library's error, if none works.
    """
    return _rendered([("<mujoco/>", np.zeros((1, 1)))], 8, lambda frames: None)[0]


def make_renderer(model: Any, height: int, width: int) -> Any:
    """Returns a ``mujoco.Renderer`` that uses :func:`graphics_library`.

    Args:
        model: ``mujoco.MjModel``.
        height: height of a picture [pixels].
        width: width of a picture [pixels].

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
    except Exception as error:  # graphics libraries raise errors of any type
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise RenderError([f"{library or 'the default'}: {reason}"]) from error
    finally:
        chosen.GLContext = before


def _rendered(
    scenes: Sequence[tuple[str, NDArray[Any]]], size: int, report: Callable[[int], Any]
) -> tuple[str, list[NDArray[np.uint8]]]:
    """Returns the first library that works, and each scene's pictures."""
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
    """Values of ``MUJOCO_GL`` to try; "" is MuJoCo's default."""
    if chosen := os.environ.get("MUJOCO_GL"):
        return [chosen]
    if sys.platform != "linux":
        return [""]
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    return [*_CONTEXTS[:2], *(_CONTEXTS[2:] if display else ())]


def _run(library: str, arguments: list[str], report: Callable[[int], Any]) -> str | None:
    """Renders with one library in a subprocess; returns its error, or ``None``."""
    environment = {**os.environ, "MUJOCO_GL": library}
    # PyOpenGL must load the same library, or it finds no context.
    environment |= {"PYOPENGL_PLATFORM": library} if library in ("egl", "osmesa") else {}
    # The subprocess imports what this process would, and nothing from the current folder, which
    # may hold a stranger's files; in a clone, this package itself lies there.
    here, package = Path.cwd(), str(Path(__file__).parents[1])
    paths = [path for path in sys.path if path and Path(path).resolve() != here]
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            [sys.executable, "-I", "-c", _START, package, *paths, str(os.getpid()), *arguments],
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
        if process.returncode == _NOT_A_SCENE:
            raise BMRLError(lines[-1])
    return lines[-1] if lines else f"the process ended with code {process.returncode}"


def _render(parent: str, task: str, result: str) -> None:
    """Main function of the subprocess: renders all scenes, one line of output for each picture."""
    end_with_parent(int(parent))
    with needs("robosuite"):
        import mujoco

    camera = mujoco.MjvCamera()
    camera.lookat[:] = _TARGET
    camera.distance, camera.azimuth, camera.elevation = _DISTANCE, _AZIMUTH, _ELEVATION
    options = mujoco.MjvOption()
    options.geomgroup[0] = 0  # collision shapes
    known = made = None  # the last scene's: each takes half a gigabyte
    frames = {}
    with np.load(task) as scenes:
        size = int(scenes["size"])
        for number, text in enumerate(scenes["models"]):
            # Compiling takes seconds, and scenes differ only in the marker's position.
            root = ET.fromstring(str(text))
            marker = root.find(f".//site[@name='{GOAL_MARKER}']")
            place = None if marker is None else np.array(marker.get("pos", "0 0 0").split(), float)
            if marker is not None:
                marker.set("pos", "1 1 1")  # MuJoCo never moves a site compiled at the origin
            key = ET.tostring(root, encoding="unicode")
            if key != known:
                if made is not None:
                    made[-1].close()
                known, made = key, None
                try:
                    model = compile_scene(key)
                except ValueError as error:
                    reason = " ".join(str(error).split())
                    _refuse(f"the model of a scene does not compile ({reason})")
                made = _make_renderer(mujoco, model, size)
            assert made is not None
            states, width = scenes[f"states{number}"], 1 + made[0].nq + made[0].nv
            if states.shape[1] != width:
                _refuse(f"states are of shape {states.shape}; valid: (T, {width}) for their model")
            if place is not None:
                made[0].site(GOAL_MARKER).pos[:] = place
            pictures = _pictures(mujoco, made, states, camera, options)
            frames[f"frames{number}"] = np.array(pictures, np.uint8).reshape(-1, size, size, 3)
    np.savez(result, **frames)


def _refuse(message: str) -> NoReturn:
    """Ends the subprocess: the scene is at fault, and no other library would draw it."""
    print(message, file=sys.stderr)
    sys.exit(_NOT_A_SCENE)


def _pictures(
    mujoco: Any, made: tuple[Any, Any, Any], states: NDArray[Any], camera: Any, options: Any
) -> list[NDArray[np.uint8]]:
    model, data, renderer = made
    pictures = []
    for state in states:
        data.qpos[:] = state[1 : 1 + model.nq]
        mujoco.mj_fwdPosition(model, data)  # also places the lights
        renderer.update_scene(data, camera=camera, scene_option=options)
        # update_scene resets these flags. On a CPU they take most of the time.
        for effect in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderer.scene.flags[effect] = 0
        pictures.append(renderer.render())
        print(flush=True)
    return pictures


def _make_renderer(mujoco: Any, model: Any, size: int) -> tuple[Any, Any, Any]:
    model.vis.quality.offsamples = 0  # no antialiasing: a third of the time
    model.vis.quality.shadowsize = 0  # 64 MB for shadows that are not drawn
    for index in range(model.nsite):
        if model.site(index).name != GOAL_MARKER:
            model.site_rgba[index, 3] = 0.0
    return model, mujoco.MjData(model), mujoco.Renderer(model, size, size)
