"""Runs a function of the package as a command; every recipe imports this module first."""

from __future__ import annotations

import logging
import os

import torchrl_bmrl.run.as_command  # noqa: F401 (first: it turns errors at import into one line)
from torchrl_bmrl.extras import needs

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

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
from torchrl_bmrl.pipeline import Run, Settings
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.folder import deciding, flat, read_settings
from torchrl_bmrl.run.logs import log_to_stderr
from torchrl_bmrl.run.settings import check_settings

log = logging.getLogger("torchrl_bmrl.recipes")

NAMES = ("preset", "ablation")
"""Settings that stand for many others."""
OF_THE_COMMAND = ("run_dir", "base", "only", "workers", "verbose")
"""Settings that a later command in the same folder does not take over."""
OUT_OF_MEMORY = (
    "lower bcq.batch_size or bcq.seeds in stage 1 (bcq.stacked=false trains one agent at a time), "
    "distill.batch_size in stage 2"
)
_sections: dict[str, type] = {}


def add_section(name: str, settings: type) -> None:
    """Adds the settings of a study to those of a run, for the command line.

    Args:
        name: of the section.
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
    """Calls ``function(run)`` or ``function(run, settings)`` and prints the text it returns.

    Errors and signals end the process as a command should.

    Args:
        config: as Hydra composed it.
        function: of the package.
        section: name of a study's settings, which are the second argument.
        splits: whether the function does the tasks of ``only`` alone.
        trains: whether the function needs the run's ``device`` on this machine.
    """
    with exit_codes(out_of_memory=OUT_OF_MEMORY):
        log_to_stderr(verbose=config.get("verbose") is True)
        try:
            composed, config = config, with_folders_settings(config)
            values = OmegaConf.to_object(config)
        except OmegaConfBaseException as error:  # for example a reference to nothing
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
                print(result)


def with_folders_settings(config: DictConfig) -> DictConfig:
    """Takes the settings that the command line does not give from the folder's run.

    The folder must be given, too: a default name does not select an earlier run. Settings that
    are given are compared with the folder's when it is opened.

    Args:
        config: as composed of the command line and the preset.

    Raises:
        BMRLError: if the folder has no name, its settings are damaged, or the command gives
            another preset or ablation with other settings.
    """
    if not config.run_dir:
        raise ConfigError("run_dir is ''; valid: a folder, such as . for the present one")
    given, run_dir = _given(config), Path(config.run_dir)
    if not given.get("run_dir") or not (run_dir / "config.yaml").exists():
        return config
    theirs = read_settings(run_dir)
    mine: Any = OmegaConf.to_container(config, resolve=True)
    for name in NAMES:
        if name in given and mine[name] != theirs.get(name):
            if deciding(mine) == deciding(theirs):
                return config
            raise ConfigError(
                f"{run_dir}: {name} is {mine[name]} here and {theirs.get(name)} in the folder's "
                "run; give the same settings to go on, or another run_dir"
            )
    taken = deepcopy(config)
    taken.run_dir = str(run_dir)  # it may refer to a setting that is taken
    tasks = theirs.pop("tasks", None)
    # References in a file are not followed.
    if tasks is not None and "tasks" not in given and "${" not in str(tasks):
        taken.tasks = tasks
    for key, value in flat(theirs):
        if not _is_any(key, [*given, *OF_THE_COMMAND]) and "${" not in str(value):
            # Settings that no longer exist are skipped; invalid values are refused later.
            with suppress(OmegaConfBaseException):
                group = key.rpartition(".")[0]
                by_task = bool(group) and OmegaConf.get_type(OmegaConf.select(taken, group)) is dict
                OmegaConf.update(taken, key, value, force_add=by_task)
    if taken != config:
        log.info("%s: settings that were not given are those of its config.yaml", run_dir)
    return taken


def _is_any(key: str, names: Iterable[str]) -> bool:
    """Whether a dotted name is one of the names, or below one."""
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _given(config: DictConfig) -> Mapping[str, Any]:
    """Settings that the command line gives, by dotted names; none outside of Hydra."""
    if not HydraConfig.initialized():
        return {}
    lines = list(HydraConfig.get().overrides.task)
    overrides = OverridesParser.create().parse_overrides(lines)
    given = dict(flat({override.key_or_group: override.value() for override in overrides}))
    # Hydra keeps the overrides of its last command; this configuration may be made in code.
    own: Any = OmegaConf.to_container(config, resolve=False)
    return given if own["run_dir"] == given.get("run_dir") else {}


OmegaConf.register_new_resolver(
    "name", lambda preset, ablation: preset if ablation == "none" else f"{preset}-{ablation}"
)
ConfigStore.instance().store(name="schema", node=Settings)
