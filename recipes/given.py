"""What a command gives, and what the folder of its run knows already."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.run.folder import deciding, flat, read_settings

log = logging.getLogger("torchrl_bmrl.recipes")

CHOICES = ("preset", "ablation")
"""Names of many settings."""
OF_THE_COMMAND = ("run_dir", "base", "only", "workers", "verbose")
"""Settings of one command or machine, which no later command takes over."""


def with_folders_settings(settings: DictConfig) -> DictConfig:
    """Settings for a command on a run's folder: what the command does not give is the folder's.

    What it gives stays as given, and is compared when the folder is opened. The folder must be
    given, too: a default name is no reason to take over what somebody once ran under it.

    Args:
        settings: as composed of the command line and the preset.

    Raises:
        BMRLError: if the folder has no name, the command gives another preset or ablation, with
            other settings, or the folder's are damaged.
    """
    if not settings.run_dir:
        raise ConfigError("run_dir is ''; valid: a folder, . for the one that one is in")
    given, run_dir = _given(settings), Path(settings.run_dir)
    if not given.get("run_dir") or not (run_dir / "config.yaml").exists():
        return settings
    theirs = read_settings(run_dir)
    mine = OmegaConf.to_container(settings, resolve=True)
    for name in CHOICES:
        if name in given and mine[name] != theirs.get(name):
            if deciding(mine) == deciding(theirs):
                return settings
            raise ConfigError(
                f"{run_dir}: {name} is {mine[name]} here and {theirs.get(name)} in the folder's "
                "run; give the same settings to go on, or another run_dir"
            )
    taken = deepcopy(settings)
    taken.run_dir = str(run_dir)  # may refer to what is taken
    for key, value in flat(theirs):
        # Nothing in a file is a reference.
        if not _is_any(key, [*given, *OF_THE_COMMAND]) and "${" not in str(value):
            # None of today's settings, or no value of it, is refused by its name later on.
            with suppress(OmegaConfBaseException):
                group = key.rpartition(".")[0]
                by_task = bool(group) and OmegaConf.get_type(OmegaConf.select(taken, group)) is dict
                OmegaConf.update(taken, key, value, force_add=by_task)
    if taken != settings:
        log.info(f"{run_dir}: settings that were not given are those of its config.yaml")
    return taken


def _is_any(key: str, names: Iterable[str]) -> bool:
    """Whether a dotted name is one of those, or within one."""
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _given(settings: DictConfig) -> dict[str, Any]:
    """Settings and choices that the command line gives, by dotted names; none outside of Hydra."""
    if not HydraConfig.initialized():
        return {}
    lines = list(HydraConfig.get().overrides.task)
    overrides = OverridesParser.create().parse_overrides(lines)
    given = dict(flat({override.key_or_group: override.value() for override in overrides}))
    # Hydra keeps those of the process's last command; these settings may be made in code.
    own = OmegaConf.to_container(settings, resolve=False)["run_dir"] == given.get("run_dir")
    return given if own else {}
