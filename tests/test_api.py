"""What the API pages list is there, described, shown in use and annotated."""

from __future__ import annotations

import ast
import dataclasses
import doctest
import functools
import importlib
import inspect
import pkgutil
import re
import sys
import textwrap
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import pytest
from tensordict.nn import TensorDictModuleBase
from torchrl.objectives.common import LossModule

import torchrl_bmrl
from torchrl_bmrl import errors

ROOT = Path(__file__).parents[1]
API = "".join(page.read_text() for page in sorted((ROOT / "docs" / "api").glob("*.md")))
DIRECTIVE = re.compile(r"^\.\. automodule:: (\S+)\n(?:   :members:(.*)\n)?", re.MULTILINE)
LISTED = {name: members.replace(",", " ").split() for name, members in DIRECTIVE.findall(API)}
"""By module the members that a page names; none for all that the module has."""
PAGES = [ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")]
PAGES += sorted((ROOT / "docs").glob("*.md"))
GUIDES = "".join(page.read_text() for page in PAGES)
REFERENCES = sorted(set(re.findall(r"\btorchrl_bmrl(?:\.\w+)+", GUIDES)))
"""Dotted names in the guides."""
TORCHRL = re.compile(r"tensordict|\w+_spec|xml_str")
"""Parameters of methods that TorchRL or robosuite calls; the class says what lies in them."""

each_module = pytest.mark.parametrize("name", sorted(LISTED))


# -- what is public --------------------------------------------------------------------------------


@functools.cache
def source(name: str) -> list[ast.stmt]:
    """The statements of a module, which is not imported."""
    path = Path(torchrl_bmrl.__file__).parent.joinpath(*name.split(".")[1:])
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(path.read_text()).body


def constants(name: str) -> dict[str, str]:
    """What a module assigns, with the docstring below it; names without one are left out."""
    texts = {}
    for statement, below in pairwise(source(name)):
        target = getattr(statement, "target", getattr(statement, "targets", [None])[0])
        if isinstance(target, ast.Name) and isinstance(below, ast.Expr):
            text = getattr(below.value, "value", None)
            texts |= {target.id: text} if isinstance(text, str) else {}
    return texts


def told(name: str, constant: str) -> str:
    """The docstring of a constant, where it is assigned."""
    for statement in source(name):
        names = [x.name for x in statement.names] if isinstance(statement, ast.ImportFrom) else []
        if constant in names:
            return told(statement.module, constant)
    return constants(name).get(constant, "")


def public(name: str) -> list[str]:
    """Names of a module that are public."""
    if LISTED[name]:
        return LISTED[name]
    for statement in source(name):
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "__all__":
            return list(ast.literal_eval(statement.value))
    defined = [x.name for x in source(name) if isinstance(x, ast.FunctionDef | ast.ClassDef)]
    return [x for x in (*defined, *constants(name)) if not x.startswith("_")]


def load(name: str) -> ModuleType:
    """The module; skips where an extra that it needs is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        if (error.name or "").startswith("torchrl_bmrl"):
            raise
        pytest.skip(f"{name} needs {error.name or error}")


def members(name: str) -> dict[str, Any]:
    """Public functions and classes of a module."""
    values = {member: getattr(load(name), member, None) for member in public(name)}
    return {key: x for key, x in values.items() if isinstance(x, FunctionType | type)}


def methods(cls: type) -> Iterator[tuple[str, FunctionType]]:
    """Public methods and properties that a class defines itself."""
    for name, value in vars(cls).items():
        value = getattr(value, "fget", getattr(value, "__func__", value))
        value = inspect.unwrap(value) if callable(value) else value
        if not name.startswith("_") and isinstance(value, FunctionType):
            yield name, value


def functions(name: str) -> dict[str, FunctionType]:
    """Public functions and methods of a module, and constructors of its classes."""
    found = {}
    for member, value in members(name).items():
        if not isinstance(value, type):
            found[member] = inspect.unwrap(value)
            continue
        init = inspect.unwrap(value.__init__)  # type: ignore[misc]
        if isinstance(init, FunctionType) and init.__module__.startswith("torchrl_bmrl"):
            found[f"{member}.__init__"] = init
        found |= {f"{member}.{method}": function for method, function in methods(value)}
    return found


def docstring(value: Any) -> str:
    """The docstring that a function or class has itself."""
    text = value.__doc__ if isinstance(value, FunctionType) else vars(value).get("__doc__")
    made = isinstance(value, type) and (text or "").startswith(f"{value.__name__}(")  # dataclass
    return "" if made else inspect.cleandoc(text or "")


def described(name: str) -> Iterator[tuple[str, FunctionType, str]]:
    """The functions of a module with the docstrings that describe their parameters and errors."""
    for key, function in functions(name).items():
        owner, _, method = key.rpartition(".")
        if method == "__init__":
            yield key, function, docstring(members(name)[owner])
            continue
        bases = members(name)[owner].__mro__ if owner else ()
        # What a method overrides describes its parameters, too.
        overridden = [vars(base)[method] for base in bases[1:] if method in vars(base)]
        own = [
            each
            for each in overridden
            if getattr(each, "__module__", "").startswith("torchrl_bmrl")
        ]
        yield key, function, "\n".join([docstring(function), *map(docstring, own)])


def section(text: str, *titles: str) -> str:
    """The content of sections of a docstring."""
    pattern = rf"^(?:{'|'.join(titles)}):\n((?:(?: .*)?\n)*)"
    return "".join(re.findall(pattern, f"{text}\n", re.MULTILINE))


def entries(text: str) -> set[str]:
    """Parameters that a docstring describes."""
    content = section(text, "Args", "Keyword Args", "Attributes")
    lines = re.findall(r"^    (\w+(?:, \w+)*):", content, re.MULTILINE)
    return {name for line in lines for name in line.split(", ")}


def commented(cls: type) -> set[str]:
    """Fields of a dataclass of settings that a comment describes, on their line or before it."""
    if not (dataclasses.is_dataclass(cls) and cls.__name__.endswith("Settings")):
        return set()
    lines = inspect.getsource(cls).splitlines()
    return {
        line.partition(":")[0].strip()
        for before, line in pairwise(lines)
        if "  # " in line or before.strip().startswith("# ")
    }


def raised(function: FunctionType) -> set[str]:
    """The library's errors that a function raises itself."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    calls = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise)]
    names = {ast.unparse(call.func) for call in calls if isinstance(call, ast.Call)}
    return {name for name in names if name in vars(errors)}


# -- properties ------------------------------------------------------------------------------------


def test_the_pages_list_much_and_the_guides_refer_to_some_of_it() -> None:
    assert len(LISTED) == API.count("automodule::")
    assert len({member for name in LISTED for member in public(name)}) > 100
    assert len(REFERENCES) > 10


@pytest.mark.parametrize("name", ["torchrl_bmrl.objectives", "torchrl_bmrl.modules"])
def test_the_pages_list_all_losses_and_networks(name: str) -> None:
    """A loss or a network that is defined in the package and has a public name."""
    package = load(name)
    for info in pkgutil.iter_modules(package.__path__):
        importlib.import_module(f"{name}.{info.name}")
    kind = LossModule if name.endswith("objectives") else TensorDictModuleBase
    defined = {
        key
        for module in list(sys.modules.values())
        if module is not None and getattr(module, "__name__", "").startswith(f"{name}.")
        for key, x in vars(module).items()
        if isinstance(x, type) and issubclass(x, kind) and x.__module__.startswith(f"{name}.")
        if not key.startswith("_")
    }
    assert defined - {"Ensemble", "Network"} <= set(public(name))  # bases of others


@each_module
def test_every_listed_name_exists(name: str) -> None:
    module = load(name)
    assert [member for member in public(name) if not hasattr(module, member)] == []


@each_module
def test_everything_public_has_a_docstring(name: str) -> None:
    known = members(name)
    texts = {key: docstring(x) for key, x in known.items()}
    texts |= {key: told(name, key) for key in public(name) if key not in known}
    texts |= {key: text for key, _, text in described(name)}
    assert [key for key, text in texts.items() if not text] == []


@each_module
def test_every_function_and_class_shows_an_example_that_runs(name: str) -> None:
    parser = doctest.DocTestParser()
    texts = {key: section(docstring(x), "Example") for key, x in members(name).items()}
    examples = {key: parser.get_examples(text) for key, text in texts.items()}
    skip = doctest.SKIP
    shown = {key for key, x in examples.items() if x and not any(skip in y.options for y in x)}
    assert sorted(texts.keys() - shown) == []


@each_module
def test_every_parameter_is_described(name: str) -> None:
    missing = []
    for key, function, text in described(name):
        method = "." in key and not key.endswith("__init__")
        known = entries(text)
        if key.endswith(".__init__"):
            known |= commented(members(name)[key.partition(".")[0]])
        for parameter in inspect.signature(function).parameters.values():
            usual = parameter.name in ("self", "cls") or parameter.kind in (
                inspect.Parameter.VAR_POSITIONAL,
                inspect.Parameter.VAR_KEYWORD,
            )
            usual = usual or (method and TORCHRL.fullmatch(parameter.name) is not None)
            if not usual and parameter.name not in known:
                missing.append(f"{key}({parameter.name})")
    assert missing == []


@each_module
def test_every_parameter_and_result_is_annotated(name: str) -> None:
    missing, empty = [], inspect.Parameter.empty
    for key, function in functions(name).items():
        signature = inspect.signature(function)
        missing += [
            f"{key}({parameter.name})"
            for parameter in signature.parameters.values()
            if parameter.annotation is empty and parameter.name not in ("self", "cls")
        ]
        missing += [f"{key}() -> "] if signature.return_annotation is empty else []
    assert missing == []


@each_module
def test_every_error_that_is_raised_is_named(name: str) -> None:
    missing = []
    for key, function, text in described(name):
        if function.__code__.co_filename.startswith("<"):  # a dataclass's __init__
            continue
        for error in raised(function):
            named = [base.__name__ for base in getattr(errors, error).__mro__]
            if not any(base in section(text, "Raises") for base in named if base in vars(errors)):
                missing.append(f"{key}: {error}")
    assert missing == []


@pytest.mark.parametrize("reference", REFERENCES)
def test_names_in_the_guides_lead_somewhere(reference: str) -> None:
    value: Any = torchrl_bmrl
    path, *parts = reference.split(".")
    for part in parts:
        path = f"{path}.{part}"
        value = getattr(value, part) if hasattr(value, part) else load(path)
