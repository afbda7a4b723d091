"""Runs a function of the package as a command; every recipe imports this module first."""

from __future__ import annotations

import logging

import torchrl_bmrl.run.as_command  # first: it turns errors at import into one line
import torchrl_bmrl.run.early_server  # noqa: F401 (before torch)
from torchrl_bmrl.extras import needs

# isort: split
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from copy import deepcopy
from dataclasses import field, fields, make_dataclass
from pathlib import Path
from typing import Any

with needs("recipes"):
    from hydra.core.config_store import ConfigStore
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.files import printable
from torchrl_bmrl.pipeline import Run, Settings
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.folder import deciding, flat, other_setting, read_settings
from torchrl_bmrl.run.logs import log_to_stderr
from torchrl_bmrl.run.settings import check_settings

log = logging.getLogger("torchrl_bmrl.recipes")

NAMES = ("preset", "ablation")
"""Settings that select other settings."""
OF_THE_COMMAND = ("run_dir", "base", "only", "workers", "verbose")
"""Settings that a command does not read from the run folder."""
OUT_OF_MEMORY = (
    "lower bcq.batch_size or bcq.seeds in stage 1 (bcq.stacked=false trains one agent at a time), "
    "distill.batch_size in stage 2"
)
_sections: dict[str, type] = {}


def add_section(name: str, settings: type) -> None:
    """Adds a section with the settings of a study to the command line.

    Args:
        name: name of the section.
        settings: a dataclass.
    """
    _sections[name] = settings
    added = [(key, kind, field(default_factory=kind)) for key, kind in _sections.items()]
    schema = make_dataclass("Schema", added, bases=(Settings,))
    ConfigStore.instance().store(name="schema", node=schema)


def run_recipe(
    config: DictConfig,
    function: Callable[..., object],
    *,
    section: str | None = None,
    splits: bool = False,
    trains: bool = True,
) -> None:
    """Calls ``function(run)`` or ``function(run, settings)`` and prints the returned text.

    Errors and signals become exit codes (:func:`~torchrl_bmrl.run.command_line.exit_codes`).

    Args:
        config: Hydra's configuration.
        function: a function of the package.
        section: section of the settings that are the second argument.
        splits: whether the function supports ``only``.
        trains: whether the function needs the run's ``device``.
    """
    with exit_codes(out_of_memory=OUT_OF_MEMORY):
        log_to_stderr(verbose=config.get("verbose") is True)
        try:
            composed, config = config, with_folders_settings(config, section)
            values = OmegaConf.to_object(config)
        except OmegaConfBaseException as error:  # for example a reference to an unknown name
            raise ConfigError(str(error).partition("\n")[0]) from error
        settings = Settings(**{each.name: getattr(values, each.name) for each in fields(Settings)})
        settings.check(device=trains or config is composed)
        if settings.only is not None and not splits:
            raise ConfigError(f"only is {settings.only}; valid: null, except with train_bcq.py")
        arguments = []
        if section is not None:
            arguments.append(getattr(values, section))
            check_settings(arguments[0], f"{section}.")
        with Run(settings) as run:
            log.debug("%s: %s, %s", run.folder, function.__name__, settings.preset)
            result = function(run, *arguments)
            if isinstance(result, str):
                print(printable(result, lines=True))


def with_folders_settings(config: DictConfig, section: str | None = None) -> DictConfig:
    """Fills in the settings of an existing run folder that the command line does not set.

    This requires an explicit ``run_dir``. Settings of the command line are compared with those of
    the folder when the run is opened. The settings of a study are those of its own folder.

    Args:
        config: configuration of the command line and the preset.
        section: section of the study's settings.

    Raises:
        BMRLError: if ``run_dir`` is empty, a folder's settings are damaged, or another preset or
            ablation is given whose settings differ.
    """
    if not config.run_dir:
        raise ConfigError("run_dir is ''; valid: a folder, such as . for the current one")
    given, run_dir = _given(config), Path(config.run_dir)
    if not given.get("run_dir") or not (run_dir / "config.yaml").exists():
        return config
    theirs = read_settings(run_dir)
    mine: Any = OmegaConf.to_container(config, resolve=True)
    for name in NAMES:
        if name in given and mine[name] != theirs.get(name):
            if deciding(mine) == deciding(theirs):
                return config
            raise other_setting(run_dir, name, mine[name], theirs.get(name))
    taken = deepcopy(config)
    taken.run_dir = str(run_dir)  # it may refer to a setting that changes
    _fill(taken, theirs, given, run_dir)
    if section is not None:
        study: Any = OmegaConf.to_object(taken[section])
        folder = run_dir / study.folder
        if (folder / "config.yaml").exists():
            _fill(taken, {section: read_settings(folder)}, given, folder)
    return taken


def _fill(
    config: DictConfig, theirs: Mapping[str, Any], given: Iterable[str], folder: Path
) -> None:
    """Fills in a folder's settings, except those that are given or belong to the command."""
    before = deepcopy(config)
    tasks = theirs.get("tasks")
    # References in a file are ignored.
    if tasks is not None and "tasks" not in given and "${" not in str(tasks):
        config.tasks = tasks
    for key, value in flat({name: x for name, x in theirs.items() if name != "tasks"}):
        if not _is_any(key, [*given, *OF_THE_COMMAND]) and "${" not in str(value):
            # Settings that no longer exist are skipped; invalid values raise an error later.
            with suppress(OmegaConfBaseException):
                group = key.rpartition(".")[0]
                kind = OmegaConf.get_type(OmegaConf.select(config, group)) if group else None
                OmegaConf.update(config, key, value, force_add=kind is dict)
    if config != before:
        log.info("%s: other settings are read from its config.yaml", folder)


def _is_any(key: str, names: Iterable[str]) -> bool:
    """Whether a dotted name is one of the names, or below one."""
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _given(config: DictConfig) -> Mapping[str, Any]:
    """Returns the settings of the command line, by dotted names; none outside of Hydra."""
    if not HydraConfig.initialized():
        return {}
    # References stay, as in the configuration below.
    lines: Any = OmegaConf.to_container(HydraConfig.get().overrides.task, resolve=False)
    overrides = OverridesParser.create().parse_overrides(lines)
    given = dict(flat({override.key_or_group: override.value() for override in overrides}))
    # Hydra still has the overrides of its last command if this configuration is made in code.
    own: Any = OmegaConf.to_container(config, resolve=False)
    return given if own["run_dir"] == given.get("run_dir") else {}


OmegaConf.register_new_resolver(
    "name", lambda preset, ablation: preset if ablation == "none" else f"{preset}-{ablation}"
)
ConfigStore.instance().store(name="schema", node=Settings)
