"""MuJoCo's library: the one that is loaded, and those that robosuite fails with."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

import mujoco

from torchrl_bmrl.envs import control_period
from torchrl_bmrl.envs.physics import check_mujoco, mujoco_library
from torchrl_bmrl.errors import MissingExtraError

pytestmark = pytest.mark.robosuite

LIBRARIES = {
    "linux": "libmujoco.so.3.8.1",
    "darwin": "libmujoco.3.8.1.dylib",
    "win32": "mujoco.dll",
}
DECOYS = [
    "libmujoco.so",
    "libmujoco.so.3.8.10",
    "libmujoco.so.4.0.0",
    "libmujoco.4.0.0.dylib",
    "mujoco_core.dll",
]


@pytest.mark.parametrize("platform", LIBRARIES)
def test_the_library_is_that_of_the_imported_version_whatever_lies_beside_it(
    platform: str, tmp_path: Path
) -> None:
    for name in DECOYS:
        (tmp_path / name).touch()
    reason = mujoco_library(tmp_path, "3.8.1", platform)
    assert isinstance(reason, str)
    assert LIBRARIES[platform] in reason
    assert all(name in reason for name in DECOYS)
    (tmp_path / LIBRARIES[platform]).touch()
    assert mujoco_library(tmp_path, "3.8.1", platform) == tmp_path / LIBRARIES[platform]


def test_only_the_library_of_the_imported_mujoco_is_loaded() -> None:
    """A second one, of another version, ends the process."""
    found = mujoco_library(Path(mujoco.__file__).parent, mujoco.__version__, sys.platform)
    assert found == control_period.LIBRARY
    assert isinstance(found, Path)
    assert found.is_file()


MISSING_LIBRARY = """
import sys, warnings
import mujoco
mujoco.__version__ = "3.7.77"
from torchrl_bmrl.envs.tabletop import TabletopEnv
env = TabletopEnv("reach")
env.reset(seed=0)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    env.step(env.action_space.sample())
print(*[str(warning.message) for warning in caught], sep="\\n")
"""


@pytest.mark.slow
def test_without_that_library_robosuites_step_stands_in_and_a_warning_names_those_there() -> None:
    done = subprocess.run(
        [sys.executable, "-c", MISSING_LIBRARY], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    assert "slow steps with robosuite's own code" in line
    assert "no libmujoco" in line
    assert mujoco.__version__ in line


@pytest.mark.parametrize("version", ["3.10.0", "3.12.1", "4.0.0", "10.0.0"])
def test_a_mujoco_that_robosuite_fails_with_is_refused_in_one_line(version: str) -> None:
    for good in ("3.4.0", "3.8.1", "3.9.9"):
        check_mujoco(good)
    with pytest.raises(MissingExtraError, match=rf"no usable mujoco \({version} is installed"):
        check_mujoco(version)
    with pytest.raises(MissingExtraError, match="files are missing"):
        check_mujoco(None)


UNSUPPORTED = """
import mujoco
mujoco.__version__ = "4.0.0"
import torchrl_bmrl.envs.tabletop
"""


def test_an_unsupported_mujoco_is_refused_at_import() -> None:
    done = subprocess.run(
        [sys.executable, "-c", UNSUPPORTED], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 1
    assert "MissingExtraError: no usable mujoco (4.0.0" in done.stderr.splitlines()[-1]
