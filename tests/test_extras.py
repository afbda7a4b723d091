"""Whatever extra is missing, one line says which: in every module, recipe and command."""

from __future__ import annotations

import ast
import json
import pickle
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import torchrl_bmrl
from torchrl_bmrl.errors import BMRLError, MissingExtraError
from torchrl_bmrl.extras import needs

ROOT = Path(__file__).parents[1]
PACKAGE = Path(torchrl_bmrl.__file__).parent
RECIPES = ROOT / "recipes"
HIDDEN = {
    "robosuite": ["gymnasium", "llvmlite", "mujoco", "numba", "robosuite"],
    "data": ["h5py", "minari", "pyarrow", "tqdm"],
    "metaworld": ["gymnasium", "metaworld"],
    "recipes": ["filelock", "hydra", "omegaconf", "onnx", "onnxscript", "safetensors", "yaml"],
    "reports": ["PIL", "jinja2", "matplotlib", "scipy", "sklearn", "threadpoolctl"],
    "everything": ["pytest", "tensorboard", "wandb"],
}
"""Packages that are hidden together; some are in several extras."""
HIDDEN["everything"] = sorted({name for names in HIDDEN.values() for name in names})
CORE = {"numpy", "tensordict", "torch", "torchrl"}
FIRST = {"torchrl_bmrl.testing": "pytest"}
"""Packages whose __init__ names the extra for all that lies below it."""
MESSAGE = re.compile(r'no (usable )?[\w.]+( \(.*\))?; valid: pip install "torchrl_bmrl\[(\w+)\]"')


def extras() -> set[str]:
    text = (ROOT / "pyproject.toml").read_text().partition("[project.optional-dependencies]")[2]
    return set(re.findall(r"^(\w+) = \[", text.partition("\n[")[0], re.MULTILINE))


def modules() -> list[str]:
    """Every module of the package but commands."""
    paths = [path.relative_to(PACKAGE.parent).with_suffix("") for path in PACKAGE.rglob("*.py")]
    names = {".".join(path.parts).removesuffix(".__init__") for path in paths}
    return sorted(name for name in names if "__main__" not in name)


# -- the message -----------------------------------------------------------------------------------


def test_a_missing_package_is_this_librarys_error_and_an_import_error() -> None:
    with pytest.raises(MissingExtraError) as caught, needs("data"):
        import no_such_package.part  # noqa: F401
    error = caught.value
    assert isinstance(error, BMRLError)
    assert isinstance(error, ImportError)
    assert (error.package, error.extra, error.reason) == ("no_such_package", "data", None)
    assert error.name == "no_such_package"
    assert str(error) == 'no no_such_package; valid: pip install "torchrl_bmrl[data]"'
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_package_that_is_there_and_fails_says_why() -> None:
    gone = r"no usable numpy \(cannot import name 'no_such_name'"
    with pytest.raises(MissingExtraError, match=gone), needs("data"):
        from numpy import no_such_name  # noqa: F401
    broken = r"no usable package of \[data\] \(libz.so: gone\); valid"
    with pytest.raises(MissingExtraError, match=broken), needs("data"):
        raise ImportError("libz.so: gone\nand more")


def test_a_mistake_of_this_library_and_an_extra_named_below_are_left_as_they_are() -> None:
    with pytest.raises(ImportError, match="no_such_name") as caught, needs("data"):
        from torchrl_bmrl.errors import no_such_name  # noqa: F401
    assert not isinstance(caught.value, MissingExtraError)
    below = r"torchrl_bmrl\[recipes\]"
    with pytest.raises(MissingExtraError, match=below), needs("data"), needs("recipes"):
        import no_such_package  # noqa: F401


# -- every import ----------------------------------------------------------------------------------


def bare_imports(node: ast.AST, inside: bool = False) -> Iterator[str]:
    """Packages beside the core that are imported outside of ``needs``."""
    for child in ast.iter_child_nodes(node):
        names = []
        if isinstance(child, ast.Import):
            names = [alias.name for alias in child.names]
        elif isinstance(child, ast.ImportFrom) and child.level == 0:
            names = [child.module or ""]
        tops = {name.partition(".")[0] for name in names}
        if not inside:
            yield from tops - CORE - {"torchrl_bmrl"} - set(sys.stdlib_module_names)
        named = isinstance(child, ast.With) and any(
            ast.unparse(item.context_expr).startswith("needs(") for item in child.items
        )
        typing = isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"
        yield from bare_imports(child, inside or named or typing)


@pytest.mark.parametrize("name", modules())
def test_every_import_of_an_extras_package_names_the_extra(name: str) -> None:
    path = PACKAGE.parent.joinpath(*name.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    tree = ast.parse(path.read_text())
    above = {package for top, package in FIRST.items() if name.startswith(f"{top}.")}
    assert not set(bare_imports(tree)) - above
    named = re.findall(r"\bneeds\(\"(\w+)\"\)", path.read_text())
    assert set(named) <= extras()


# -- every module and recipe, with packages hidden -------------------------------------------------

HIDE = """
import sys
class Hidden:
    names = set({hidden!r})
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name.partition(".")[0] in cls.names:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
import torch, tensordict, torchrl.data, torchrl.envs, torchrl.objectives
for name in [name for name in sys.modules if name.partition(".")[0] in Hidden.names]:
    del sys.modules[name]
sys.meta_path.insert(0, Hidden)
"""
IMPORT_ALL = """
import importlib, json
told = {{}}
for name in {modules!r}:
    try:
        importlib.import_module(name)
    except Exception as error:
        told[name] = [type(error).__name__, str(error)]
print(json.dumps(told))
"""


def run(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=RECIPES,
        capture_output=True,
        text=True,
        timeout=600,
    )


@pytest.fixture(scope="module")
def told() -> Any:
    """What importing each module says with a group of packages hidden, read once."""
    known: dict[str, dict[str, list[str]]] = {}

    def read(group: str) -> dict[str, list[str]]:
        if group not in known:
            code = HIDE.format(hidden=HIDDEN[group]) + IMPORT_ALL.format(modules=modules())
            done = run(code)
            assert done.returncode == 0, done.stderr
            known[group] = json.loads(done.stdout.splitlines()[-1])
        return known[group]

    return read


@pytest.mark.slow
@pytest.mark.parametrize("group", HIDDEN)
def test_every_module_imports_or_names_the_extra(told: Any, group: str) -> None:
    for name, (kind, message) in told(group).items():
        assert kind == "MissingExtraError", f"{name}: {kind}: {message}"
        match = MESSAGE.fullmatch(message)
        assert match, f"{name}: {message}"
        assert match[3] in extras()


@pytest.mark.slow
def test_the_core_imports_with_everything_hidden_and_the_rest_does_not(told: Any) -> None:
    failed = told("everything")
    core = ("objectives", "modules", "data", "data.replay", "data.episodes", "functional")
    assert not {f"torchrl_bmrl.{name}" for name in core} & failed.keys()
    rest = (
        "pipeline.agents",
        "pipeline.student",
        "training.checkpoint",
        "configs",
        "data.hdf5",
        "envs.tabletop",
    )
    assert {f"torchrl_bmrl.{name}" for name in (*rest, "reports", "run.folder")} <= failed.keys()


COMMANDS = sorted(
    str(path.relative_to(ROOT)) for path in RECIPES.glob("*.py") if "__main__" in path.read_text()
)
ENTRY = """
import runpy
command = sys.argv[1]
sys.path.insert(0, {recipes!r})
sys.argv = [command, *sys.argv[2:]]
if command.endswith(".py"):
    runpy.run_path(command, run_name="__main__")
else:
    runpy.run_module(command, run_name="__main__", alter_sys=True)
"""


def command(name: str, hidden: list[str], *arguments: str) -> subprocess.CompletedProcess[str]:
    code = HIDE.format(hidden=hidden) + ENTRY.format(recipes=str(RECIPES))
    return run(code, str(ROOT / name) if name.endswith(".py") else name, *arguments)


def assert_one_line(done: subprocess.CompletedProcess[str]) -> None:
    lines = [line for line in done.stderr.splitlines() if "WARNING" not in line]
    assert done.returncode == 1, done.stdout + done.stderr
    assert len(lines) == 1, done.stderr
    assert MESSAGE.fullmatch(lines[0].removeprefix("error: ")), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", [*COMMANDS, "torchrl_bmrl.data"])
def test_a_command_without_its_packages_is_one_line_and_exit_code_1(name: str) -> None:
    assert_one_line(command(name, HIDDEN["everything"]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "package", ["filelock", "h5py", "hydra", "matplotlib", "safetensors", "tqdm"]
)
def test_a_recipe_without_one_of_its_packages_is_one_line(package: str) -> None:
    for needed in ("hydra", "robosuite", "matplotlib"):  # what comes first would be named instead
        pytest.importorskip(needed, exc_type=ImportError)
    done = command("recipes/two_stage.py", [package], "--help")
    assert_one_line(done)
    assert f"no {package}; " in done.stderr


@pytest.mark.slow
def test_a_run_without_gymnasium_is_one_line(tmp_path: Path) -> None:
    for needed in ("hydra", "robosuite", "matplotlib"):
        pytest.importorskip(needed, exc_type=ImportError)
    settings = ["preset=smoke", "workers=1", f"run_dir={tmp_path / 'run'}"]
    done = command("recipes/two_stage.py", ["gymnasium"], *settings)
    assert_one_line(done)
    assert "no gymnasium; " in done.stderr
    assert not (tmp_path / "run").exists()


def test_another_error_of_a_command_keeps_its_traceback() -> None:
    done = run("import torchrl_bmrl.run.as_command\n1 / 0")
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "ZeroDivisionError" in done.stderr
