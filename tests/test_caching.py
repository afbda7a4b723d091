"""Compiled code is kept once per user, and compiled anew when what it stands for changes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)

from torchrl_bmrl.envs import caching
from torchrl_bmrl.envs.control_period import control_period

pytestmark = pytest.mark.robosuite

STEPS = """
import sys, time
import numpy as np
import robosuite.utils.control_utils as control
{change}
from torchrl_bmrl.envs.tabletop import STEPPERS, TabletopEnv
from torchrl_bmrl.envs.control_period import control_period
joints = []
for stepper in STEPPERS:
    env = TabletopEnv("reach", stepper=stepper)
    env.reset(seed=0)
    started = time.monotonic()
    for _ in range(10):
        observation, *_ = env.step(np.full(7, 0.5))
    joints.append(observation["robot0_joint_pos"])
    seconds = locals().get("seconds", time.monotonic() - started)  # of the fast steps
assert env._fast is None
assert np.array_equal(*joints), np.abs(joints[0] - joints[1]).max()
print(sum(control_period.stats.cache_misses.values()), seconds, *joints[0])
"""
CHANGES = {
    "as it is": "",
    # robosuite's step reads the module's attribute at every call
    "another function": """
import numba
import robosuite.controllers.parts.arm.osc as osc
@numba.njit(cache=False)
def error_of(desired, current):
    return 0.5 * stock(desired, current)
stock = control.orientation_error
control.orientation_error = osc.orientation_error = error_of
""",
    "another function below it": """
import numba
import robosuite.controllers.parts.arm.osc as osc
@numba.njit(cache=False)
def factor():
    return 0.25
@numba.njit(cache=False)
def error_of(desired, current):
    return factor() * stock(desired, current)
stock = control.orientation_error
control.orientation_error = osc.orientation_error = error_of
""",
}
CHANGES["another constant below it"] = CHANGES["another function below it"].replace("0.25", "0.75")


def played(folder: Path, change: str) -> tuple[int, float, list[float]]:
    """How often the step was compiled, the seconds of ten steps, where the arm is then."""
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(folder)
    done = subprocess.run(
        [sys.executable, "-c", STEPS.format(change=change)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    misses, seconds, *joints = done.stdout.split()
    return int(misses), float(seconds), [float(joint) for joint in joints]


@pytest.mark.slow
def test_only_the_first_run_of_a_user_compiles(tmp_path: Path) -> None:
    (first, compiling, _), (second, loading, _) = (played(tmp_path, "") for _ in range(2))
    assert (first, second) == (1, 0)
    assert loading < compiling / 3
    assert list((tmp_path / "torchrl_bmrl" / "numba").rglob("*control_period*"))


@pytest.mark.slow
def test_a_changed_function_of_robosuite_is_compiled_anew_and_followed(tmp_path: Path) -> None:
    """In one cache, and each time to the bit what robosuite itself does with that function."""
    reached = {}
    for name, change in CHANGES.items():
        misses, _, reached[name] = played(tmp_path, change)
        assert misses == 1, name
    assert len({tuple(joints) for joints in reached.values()}) == len(CHANGES)
    for name, change in CHANGES.items():
        misses, _, joints = played(tmp_path, change)
        assert (misses, joints) == (0, reached[name]), name


def test_another_version_or_place_of_a_package_is_another_cache(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(caching, "_environment", caching._environment.__wrapped__)
    seen = [caching.fingerprint(control_period)]
    assert caching.fingerprint(control_period) == seen[0]
    for package in ("robosuite", "mujoco", "numba", "llvmlite", "numpy", "scipy"):
        for name, other in {
            "version": lambda name, package=package: "0" if name == package else "1",
            "find_spec": lambda name, package=package: SimpleNamespace(origin=name == package),
        }.items():
            with monkeypatch.context() as patch:
                patch.setattr(caching, name, other)
                seen.append(caching.fingerprint(control_period))
    monkeypatch.setattr(sys, "prefix", "/another/environment")
    seen.append(caching.fingerprint(control_period))
    assert len(set(seen)) == len(seen)


def test_another_file_with_the_same_function_is_another_cache(tmp_path: Path) -> None:
    """The order of a named tuple's fields is compiled in, and no function contains it."""
    found = set()
    for fields in ("a: float; b: float", "b: float; a: float"):
        file = tmp_path / f"{len(found)}.py"
        file.write_text(
            f"from typing import NamedTuple\nclass P(NamedTuple): {fields}\ndef f(p): return p.a\n"
        )
        module: dict[str, Any] = {"__name__": "places"}
        exec(compile(file.read_text(), file, "exec"), module)
        found.add(caching.fingerprint(module["f"]))
    assert len(found) == 2


def doubled(x: float) -> float:
    return 2 * x


def compiled_anew(x: float = 1.0) -> int:
    """How often one call of :func:`doubled` compiles, in a process that starts."""
    made = caching.cached_njit(doubled)
    assert made(x) == 2 * x
    return sum(made.stats.cache_misses.values())


@pytest.mark.parametrize("kind", ["*.nbi", "*.nbc"])
@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "a folder"])
def test_damaged_compiled_code_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, damage: str
) -> None:
    monkeypatch.setattr(caching.config, "CACHE_DIR", str(tmp_path))
    assert compiled_anew() == 1
    assert compiled_anew() == 0
    (file,) = tmp_path.rglob(kind)
    content = file.read_bytes()
    if damage == "a folder":
        file.unlink()
        file.mkdir()
    else:
        middle = len(content) // 2
        changed = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        file.write_bytes({"cut": content[:-40], "changed": changed, "empty": b""}[damage])
    assert compiled_anew() == 1
    if damage != "a folder":  # which nobody but its owner removes
        assert compiled_anew() == 0


def test_processes_that_begin_at_once_do_not_take_each_others_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(caching.config, "CACHE_DIR", str(tmp_path))
    file = caching.cached_njit(doubled)._cache._cache_file
    assert file._data_name(1) != file._data_name(1)


def test_a_user_without_a_home_has_a_cache_for_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(caching.config, "CACHE_DIR", "")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(caching.tempfile, "tempdir", str(tmp_path))

    def nobody() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nobody)
    folder = caching.numba_cache_dir()
    assert folder.parent == tmp_path
    assert folder == caching.numba_cache_dir()
    assert compiled_anew() == 1
    assert compiled_anew() == 0


def test_a_home_that_cannot_be_written_is_replaced_by_a_cache_for_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "home").write_text("a file")
    monkeypatch.setattr(caching.config, "CACHE_DIR", str(tmp_path / "home" / "cache"))
    monkeypatch.setattr(caching.tempfile, "tempdir", str(tmp_path))
    assert caching.numba_cache_dir().name.startswith("torchrl_bmrl-")


OFFSET = 1.0
TABLE = np.zeros(3)
CONSTANTS = ModuleType("constants")
CONSTANTS.FACTOR = 1.0  # type: ignore[attr-defined]


def law(x: float, gain: float = 2.0, *, shift: float = 0.0) -> float:
    def inner(x: float) -> float:
        return x + INNER

    return gain * helper(inner(x)) + OFFSET + TABLE[0] + shift + CONSTANTS.FACTOR


INNER = 0.0


def helper(x: float) -> float:
    return x + 1


def test_a_fingerprint_sees_code_defaults_constants_and_what_is_called() -> None:
    seen = {caching.fingerprint(law)}
    assert {caching.fingerprint(law)} == seen
    here = globals()
    for name, value in {
        "OFFSET": 1.5,
        "TABLE": np.ones(3),
        "helper": lambda x: x + 2,
        "INNER": 0.5,
        "law.__defaults__": (3.0,),
        "law.__kwdefaults__": {"shift": 0.5},
        "CONSTANTS.FACTOR": 2.0,
    }.items():
        with pytest.MonkeyPatch.context() as patch:
            owner, _, attribute = name.rpartition(".")
            if owner:
                patch.setattr(here[owner], attribute, value)
            else:
                patch.setitem(here, name, value)
            seen.add(caching.fingerprint(law))
    assert len(seen) == 8


def test_a_fingerprint_sees_what_a_function_closes_over() -> None:
    def scaled(factor: float) -> Any:
        return lambda x: factor * x

    assert caching.fingerprint(scaled(1.0)) == caching.fingerprint(scaled(1.0))
    assert caching.fingerprint(scaled(1.0)) != caching.fingerprint(scaled(2.0))


def test_other_packages_caches_stay_where_they_are() -> None:
    before = caching.config.CACHE_DIR
    with caching.user_numba_cache(law):
        inside = caching.config.CACHE_DIR
    assert Path(inside).name == caching.fingerprint(law)
    assert before == caching.config.CACHE_DIR
