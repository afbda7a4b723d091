"""Environments draw themselves on a machine without a display, alone and side by side."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import gymnasium

import torchrl_bmrl.envs  # registers the ids  # noqa: F401
from torchrl_bmrl.envs import rendering, tabletop
from torchrl_bmrl.envs.registration import gymnasium_id
from torchrl_bmrl.envs.tabletop import TabletopEnv
from torchrl_bmrl.envs.vector import TabletopVectorEnv
from torchrl_bmrl.errors import BMRLError, RenderError

pytestmark = pytest.mark.robosuite

ACTIONS = np.random.default_rng(0).uniform(-1, 1, (4, 2, 7))


@pytest.fixture
def library() -> str:
    """What draws here; a machine without one skips, unless it is said to have one."""
    try:
        return rendering.graphics_library()
    except RenderError as error:
        if os.environ.get("BMRL_REQUIRE_BROWSER"):
            raise
        pytest.skip(str(error))


DRAW = """
import mujoco  # first: it has chosen a graphics library by now
import gymnasium, os
env = gymnasium.make("torchrl_bmrl.envs:bmrl/SawyerReach-v0", render_mode="rgb_array")
env.reset(seed=1)
picture = env.render()
from torchrl_bmrl.envs.rendering import graphics_library
print(graphics_library(), *picture.shape, picture.std() > 20, os.environ.get("MUJOCO_GL"))
"""


def drawn(**variables: str) -> list[str]:
    """What a process prints that draws an environment without a display."""
    without = ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM")
    environment = {key: value for key, value in os.environ.items() if key not in without}
    done = subprocess.run(
        [sys.executable, "-c", DRAW],
        env=environment | variables,
        capture_output=True,
        text=True,
        timeout=600,
    )
    return (done.stdout if done.returncode == 0 else done.stderr).splitlines()[-1].split()


def test_a_picture_takes_neither_a_display_nor_a_setting(library: str) -> None:
    said = drawn()
    assert said[0] in ("egl", "osmesa")
    assert said[1:] == ["256", "256", "3", "True", "None"]


@pytest.mark.slow
def test_osmesa_stands_in_where_egl_finds_no_driver(library: str) -> None:
    said = drawn(__EGL_VENDOR_LIBRARY_FILENAMES=os.devnull)
    if "osmesa:" in said:
        pytest.skip("no OSMesa here")
    assert said == ["osmesa", "256", "256", "3", "True", "None"]


def test_a_library_of_ones_own_choice_is_the_only_one_that_is_tried() -> None:
    said = " ".join(drawn(MUJOCO_GL="glfw"))
    assert "RenderError: no pictures can be rendered here (glfw: " in said
    assert "egl" not in said


@pytest.mark.parametrize("make", [TabletopEnv, TabletopVectorEnv])
def test_an_environment_that_cannot_draw_is_refused_at_once(
    make: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def none_works() -> str:
        raise RenderError(["egl: none", "osmesa: none"])

    monkeypatch.setattr(tabletop, "graphics_library", none_works)
    with pytest.raises(RenderError, match="egl: none; osmesa: none"):
        make("reach", render_mode="rgb_array")
    make("reach").close()


def test_episodes_side_by_side_are_drawn_as_each_alone_and_go_on_as_undrawn(library: str) -> None:
    vector = gymnasium.make_vec(gymnasium_id("lift"), num_envs=2, render_mode="rgb_array")
    undrawn = TabletopVectorEnv("lift", num_envs=2)
    with pytest.raises(BMRLError, match="call reset first"):
        vector.render()
    vector.reset(seed=[3, 4])
    undrawn.reset(seed=[3, 4])
    assert undrawn.render() is None
    for action in ACTIONS:
        pictures = vector.render()
        shown, *_ = vector.step(action)
        for name, part in undrawn.step(action)[0].items():
            np.testing.assert_array_equal(shown[name], part)
    pictures = vector.render()
    assert len(pictures) == 2
    for i, picture in enumerate(pictures):
        alone = TabletopEnv("lift", render_mode="rgb_array")
        alone.reset(seed=3 + i)
        for action in ACTIONS[:, i]:
            alone.step(action)
        np.testing.assert_array_equal(picture, alone.render())
        alone.close()
    assert not np.array_equal(*pictures)
    for env in (vector, undrawn):
        env.close()


def test_pictures_may_be_larger_than_mujocos_own_buffer(library: str) -> None:
    env = TabletopEnv("reach", render_mode="rgb_array", image_size=(720, 960))
    env.reset(seed=0)
    assert env.render().shape == (720, 960, 3)
    env.close()


RENDER = """
import sys
import mujoco
try:
    renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 32, 32)
    renderer.close()
except BaseException as error:
    print(f"{type(error).__name__}: {error}")
    sys.exit(77)
import numpy as np
from torchrl_bmrl.envs.tabletop import TabletopEnv
env = TabletopEnv("reach", render_mode="rgb_array", image_size=(256, 320))
env.reset(seed=1)
shown = env.render()
again = env.render()
env.robosuite_env.sim.model.site_rgba[env.robosuite_env._goal_site_id] = 0.0
hidden = env.render()
np.savez(sys.argv[1], shown=shown, again=again, hidden=hidden)
env.close()
"""


def test_the_goal_marker_is_visible_in_the_picture(tmp_path: Path) -> None:
    # A new process, because mujoco reads MUJOCO_GL when it is first imported.
    environment = {"MUJOCO_GL": "egl", **os.environ}
    done = subprocess.run(
        [sys.executable, "-c", RENDER, str(tmp_path / "pictures.npz")],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=600,
    )
    if done.returncode == 77:
        pytest.skip(f"MUJOCO_GL={environment['MUJOCO_GL']} cannot render: {done.stdout.strip()}")
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "pictures.npz") as file:
        shown, again, hidden = file["shown"], file["again"], file["hidden"]
    assert shown.shape == (256, 320, 3)
    assert shown.dtype == np.uint8
    assert np.ptp(hidden) > 50  # a scene, not a blank page
    np.testing.assert_array_equal(shown, again)
    difference = np.abs(shown.astype(int) - hidden).max(-1)
    rows, columns = np.nonzero(difference > 40)
    assert len(rows) > 15
    assert max(np.ptp(rows), np.ptp(columns)) < 15  # one spot


def test_without_render_mode_there_is_no_picture(envs: dict[str, TabletopEnv]) -> None:
    assert envs["reach"].render() is None
