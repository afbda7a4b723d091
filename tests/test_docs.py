"""What the README and the docs show is executed: code as it is, commands by what they call."""

from __future__ import annotations

import importlib
import os
import re
import shlex
import sys
import types
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import pytest
from helpers import NO_UPDATER, shown_files

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FILES = re.compile(r"<!-- file: \S+ -->\n```\w+\n.*?```", re.DOTALL)
"""Files that a page shows: test_own_tasks.py and test_own_family.py write and use them."""
BLOCKS = {
    page: re.findall(r"```python\n(.*?)```", FILES.sub("", page.read_text()), re.DOTALL)
    for page in PAGES
}
NEEDS = {page: re.findall(r"<!-- needs: (\w+) -->", page.read_text()) for page in PAGES}


@pytest.mark.filterwarnings(NO_UPDATER)
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(
            page,
            id=page.stem,
            marks=[pytest.mark.robosuite] if "robosuite" in NEEDS[page] else [],
        )
        for page in PAGES
        if BLOCKS[page]
    ],
)
def test_examples_of_a_page_run_one_after_the_other(
    page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in NEEDS[page]:
        pytest.importorskip(package)
    module = types.ModuleType("example")  # dataclasses look up their module
    monkeypatch.setitem(sys.modules, "example", module)
    for block in BLOCKS[page]:
        exec(compile(block, page.name, "exec"), module.__dict__)


def test_readme_shows_a_loss_in_use() -> None:
    assert any("BCQLoss(" in block for block in BLOCKS[ROOT / "README.md"])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_to_files_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target


def test_the_page_of_runs_names_every_setting_that_is_free_to_change() -> None:
    pytest.importorskip("yaml")
    from torchrl_bmrl.run.folder import FREE_TO_CHANGE

    text = (ROOT / "docs" / "runs.md").read_text()
    _, _, rest = text.partition("You may change ")
    named = re.findall(r"`([\w.]+)`", rest.partition(".\n")[0])
    assert sorted(named) == sorted(FREE_TO_CHANGE)


# -- names in the text -----------------------------------------------------------------------------

QUOTED = [
    (page, text)
    for page in [*PAGES, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs" / "api").glob("*.md"))]
    for text in re.findall(
        r"(?<!`)`([^`\n]+)`(?!`)", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    )
]
"""Text between single backticks, outside blocks of code."""


@pytest.mark.skipif(
    not (ROOT / "torchrl_bmrl").exists(), reason="the package's sources are not beside the tests"
)
def test_files_that_a_page_quotes_exist() -> None:
    pattern = r"(?:python )?((?:recipes|docs|tests|torchrl_bmrl|\.ci)/[\w./-]*)"
    found = [(page, found[1]) for page, text in QUOTED if (found := re.match(pattern, text))]
    assert len(found) > 30
    missing = [(page.name, path) for page, path in found if not (ROOT / path).exists()]
    assert not missing


def test_settings_that_a_page_quotes_exist(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("hydra", "gymnasium", "h5py", "safetensors", "scipy", "tqdm"):
        pytest.importorskip(package)
    monkeypatch.syspath_prepend(str(ROOT / "recipes"))
    import command

    for recipe in (ROOT / "recipes").glob("*.py"):
        importlib.import_module(recipe.stem)  # adds the settings of its study
    kinds = get_type_hints(command.Settings) | command._sections
    sections = {name: kind for name, kind in kinds.items() if is_dataclass(kind)}
    found = [
        (page, section, name)
        for page, text in QUOTED
        for section, name in re.findall(r"^(\w+)\.(\w+)(?:=.*)?$", text)
        if section in sections and name not in ("csv", "html", "py")
    ]
    assert len(found) > 30
    for page, section, name in found:
        known = {each.name for each in fields(sections[section])}
        assert name in known, f"{page.name}: {section}.{name}"


# -- commands --------------------------------------------------------------------------------------

COMMANDS = [
    (page, line)
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]
    for block in re.findall(r"```bash\n(.*?)```", page.read_text(), re.DOTALL)
    for whole in block.replace("\\\n", " ").splitlines()
    for line in whole.split("&&")
    if line.strip()
]


def parts(command: str) -> list[str]:
    return shlex.split(command, comments=True)


def test_every_command_is_of_a_kind_that_a_test_or_the_checks_of_a_change_run() -> None:
    known = {
        "pip",
        "pytest",
        "ruff",
        "mypy",
        "lint-imports",
        "pre-commit",
        "export",
        ".",
        "python3",
        "sphinx-build",
    }
    for page, line in COMMANDS:
        words = parts(line)
        is_python = words[0] == "python" and (
            (words[1] == "-m" and words[2] == "torchrl_bmrl.data")
            or (ROOT / words[1]).is_file()
            or f"<!-- file: {words[1]} -->" in page.read_text()  # test_own_tasks.py runs it
        )
        assert words[0] in known or is_python, f"{page.name}: {line}"


def test_every_install_names_extras_that_there_are() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    extras = set(
        re.findall(r"^(\w+) = \[", text.partition("optional-dependencies]")[2], re.MULTILINE)
    )
    installs = [parts(line) for _, line in COMMANDS if parts(line)[:2] == ["pip", "install"]]
    assert len(installs) > 5
    for install in installs:
        assert (install[2], install[4]) == ("-c", "-e")
        assert install[3] in ("constraints.txt", "constraints-2.14.txt")
        named = re.fullmatch(r"\.(?:\[(.*)\])?", install[5])
        assert named is not None
        assert set(filter(None, (named[1] or "").split(","))) <= extras


RECIPES = [(page, parts(line)) for page, line in COMMANDS if "python recipes/" in line]


@pytest.mark.parametrize(
    ("page", "words"),
    RECIPES,
    ids=[f"{page.stem}-{' '.join(words[1:])}" for page, words in RECIPES],
)
def test_every_command_of_a_recipe_gives_settings_that_it_takes(
    page: Path, words: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Only settings are checked here; test_recipes.py and its like run small recipes."""
    recipe = Path(words[1]).stem
    for package in ("hydra", "gymnasium", "h5py", "safetensors", "scipy", "tqdm"):
        pytest.importorskip(package)
    from hydra import compose, initialize_config_dir
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from omegaconf import OmegaConf

    from torchrl_bmrl.pipeline import Run
    from torchrl_bmrl.run.settings import check_settings

    monkeypatch.syspath_prepend(str(ROOT / "recipes"))
    monkeypatch.syspath_prepend(str(tmp_path))
    for name, text in shown_files(page).items():
        (tmp_path / name).write_text(text)
    if "@hydra.main" not in (ROOT / words[1]).read_text():  # it reads finished runs
        importlib.import_module(recipe).read_options(words[2:])
        return
    pytest.importorskip("robosuite", exc_type=ImportError)
    import command

    # Importing it adds the settings of its study, of which another test may have left others.
    monkeypatch.delitem(sys.modules, recipe, raising=False)
    importlib.import_module(recipe)
    # test_command_line.py reads the help, test_multirun.py runs the launchers.
    options = [word for word in words[2:] if not word.startswith(("--help", "hydra/", "hydra."))]
    if "--multirun" in options:
        options.remove("--multirun")
        sweep = OverridesParser.create().parse_overrides(options)
        assert any(override.is_sweep_override() for override in sweep)
        options = [
            f"{override.key_or_group}={next(override.sweep_string_iterator())}"
            if override.is_sweep_override()
            else option
            for override, option in zip(sweep, options, strict=True)
        ]
    with initialize_config_dir(version_base="1.3", config_dir=str(ROOT / "recipes" / "config")):
        # Set first: what it is otherwise is Hydra's to say, in a command.
        config = compose("recipe", overrides=["run_dir=runs/mine", *options])
    values = OmegaConf.to_object(config)
    settings = command.Settings(
        **{each.name: getattr(values, each.name) for each in fields(command.Settings)}
    )
    settings.check(device=False)  # there may be no GPU
    for name in command._sections:
        check_settings(getattr(values, name), f"{name}.")
    if not isinstance(settings.tasks, str):  # a page's own file of tasks
        Run(settings)


@pytest.mark.robosuite
@pytest.mark.parametrize(
    "page", [ROOT / "README.md", ROOT / "docs" / "data.md"], ids=lambda p: p.stem
)
def test_commands_for_data_do_what_the_page_says(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside a recording of robosuite's and a file of a run."""
    for package in ("h5py", "minari", "pyarrow", "tqdm"):
        pytest.importorskip(package)
    pytest.importorskip("robosuite", exc_type=ImportError)
    from episode_files import TASK_PARTS, make_episode
    from recordings import record

    from torchrl_bmrl.data.__main__ import main
    from torchrl_bmrl.data.robomimic import write_episodes

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    ours = tmp_path / "runs/two_stage-quick-seed0/data/lift.hdf5"
    ours.parent.mkdir(parents=True)
    episodes = [make_episode(seed, parts=TASK_PARTS) for seed in range(2)]
    args = {"env_name": "BMRLSawyerLift", "type": 1, "env_kwargs": {"control_freq": 20}}
    write_episodes(ours, episodes, env_args=args, masks={"train": [0], "valid": [1]})
    write_episodes(tmp_path / "own.hdf5", episodes, env_args=args)
    record(tmp_path / "demo.hdf5", "lift", 30)
    arguments = [
        parts(line)[3:]
        for at, line in COMMANDS
        if at == ROOT / page and "-m torchrl_bmrl.data" in line
    ]
    assert len(arguments) >= 2
    for words in arguments:
        assert main([os.path.expanduser(word) for word in words]) == 0, words
        target = os.path.expanduser(words[1 if words[0] == "check" else 2])
        assert capsys.readouterr().out.startswith(f"{target}: ")
        assert Path(target).exists()
