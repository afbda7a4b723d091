"""Fixtures that several test files share; they import the packages that they need when used."""

from __future__ import annotations

import gc
import logging
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


def pytest_collection_finish() -> None:
    """What was imported stays; robosuite would search all of it whenever an environment closes."""
    gc.freeze()


@pytest.hookimpl(tryfirst=True)  # before the items are chosen by their marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks checks of torchrl_bmrl.testing, which knows no marks of this project's own."""
    for item in items:
        if "KeyedLossContract" in {
            base.__name__ for base in getattr(getattr(item, "cls", None), "__mro__", ())
        }:
            if "compiled" in item.name:
                item.add_marker("slow")
            if "cuda" in item.name or "gpu" in item.name:
                item.add_marker("gpu")


@pytest.fixture(autouse=True)
def own_logging() -> Iterator[None]:
    """Every test has the library's logger as a program does: without a command's handler."""
    logger = logging.getLogger("torchrl_bmrl")

    def reset() -> None:
        logger.handlers.clear()
        logger.setLevel(logging.WARNING)  # Hydra changes the level of the root logger

    reset()
    yield
    reset()


@pytest.fixture
def converted(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Source files of the conversions that a test makes, in order."""
    from torchrl_bmrl.data import datasets

    sources: list[Path] = []
    convert = datasets._convert

    def record(source: Path, *args: Any) -> None:
        sources.append(source)
        convert(source, *args)

    monkeypatch.setattr(datasets, "_convert", record)
    return sources


@pytest.fixture
def minari_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder in which Minari and TorchRL look for data sets."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari"


@pytest.fixture(scope="module")
def walk_family() -> Iterator[None]:
    """The family of ``tiny_family.py`` is registered."""
    import tiny_family

    from torchrl_bmrl.tasks import FAMILIES

    tiny_family.register()
    yield
    del FAMILIES[tiny_family.FAMILY.name]


@pytest.fixture(scope="session")
def recipes() -> Iterator[Any]:
    """Module ``command`` of the recipes, which are importable as for a script beside them."""
    with pytest.MonkeyPatch.context() as patch:
        from small_runs import RECIPES

        patch.syspath_prepend(str(RECIPES))
        import command

        yield command


@pytest.fixture(scope="session")
def run(recipes: Any) -> Any:
    """Runs a function of the pipeline or a study as its recipe does, in this process."""
    pytest.importorskip("robosuite", exc_type=ImportError)
    from small_runs import SMALL, configured

    def run(folder: Path, function: Any, *overrides: str, section: str | None = None) -> Path:
        config = configured(*SMALL, f"run_dir={folder}", "workers=1", *overrides)
        recipes.run_recipe(config, function, section=section)
        return folder

    return run


@pytest.fixture(scope="session")
def finished(run: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of all stages that was never stopped. Tests only read it."""
    from torchrl_bmrl.pipeline import two_stage

    return run(tmp_path_factory.mktemp("finished"), two_stage)


@pytest.fixture
def finished_copy(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, which a test may change."""
    return shutil.copytree(finished, tmp_path / "run")


@pytest.fixture
def collected_run(finished: Path, tmp_path: Path) -> Path:
    """A run folder that contains the finished run's demonstrations and nothing else."""
    shutil.copytree(finished / "data", tmp_path / "run" / "data")
    return tmp_path / "run"


@pytest.fixture(scope="session")
def envs() -> Iterator[dict[str, Any]]:
    """The environment of each of the six tasks. Tests reset it before they use it."""
    from torchrl_bmrl.envs.skills import SKILLS
    from torchrl_bmrl.envs.tabletop import TabletopEnv

    made = {task: TabletopEnv(task) for task in SKILLS}
    yield made
    for env in made.values():
        env.close()
