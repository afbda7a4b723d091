"""Keeps text settings as typed; Hydra parses ``run_dir=1.10`` as the number 1.1."""

from __future__ import annotations

import re
from copy import deepcopy
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

PARTS = re.compile(r"""'(?:\\.|[^'])*'|"(?:\\.|[^"])*"|[^][,()'"]+""")
"""The elements of a list or of a sweep: quoted texts, and texts between separators."""


class AsTyped(Callback):
    """Hydra callback that quotes values of text settings that Hydra would parse as numbers.

    A single run is updated with the quoted values; a sweep passes the quotes to its jobs.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Corrects the configuration of a single run."""
        parser = OverridesParser.create()
        for line in task_overrides(config):
            if (typed := as_typed(line, config)) != line:
                override = parser.parse_override(typed)
                OmegaConf.update(config, override.key_or_group, override.value())
        self.on_multirun_start(config)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Corrects the overrides of a sweep."""
        with open_dict(config.hydra):
            lines = [as_typed(line, config) for line in task_overrides(config)]
            config.hydra.overrides.task = lines


def task_overrides(config: DictConfig) -> list[str]:
    """Returns the overrides as typed: each job of a sweep resolves its references itself."""
    lines: Any = OmegaConf.to_container(config.hydra.overrides.task, resolve=False)
    return lines


def as_typed(line: str, config: DictConfig) -> str:
    """Returns an override with quotes around numbers, if its setting is a text or a list of texts.

    Args:
        line: an override, such as ``run_dir=1.10``.
        config: the composed configuration, which defines the settings' types.
    """
    override = OverridesParser.create().parse_override(line)
    key, _, text = line.partition("=")
    # Functions other than choice() compute their values.
    if override.is_delete() or text.startswith("{") or "(" in text.removeprefix("choice("):
        return line
    quoted = PARTS.sub(lambda part: _quoted(part[0]), text)
    if quoted == text or not _is_text(config, override.key_or_group):
        return line
    return f"{key}={quoted}"


def _is_text(config: DictConfig, key: str) -> bool:
    """Whether a setting is a text or a list of texts."""
    for value in (True, [True]):
        probe = deepcopy(config)
        try:
            OmegaConf.update(probe, key, value)
            found = OmegaConf.select(probe, key)
        except OmegaConfBaseException:  # of another type, or a group of settings
            continue
        if isinstance(found, str) or (OmegaConf.is_list(found) and isinstance(found[0], str)):
            return True
    return False


def _quoted(part: str) -> str:
    word = part.strip()
    try:
        value = OverridesParser.create().parse_override(f"key={word}").value()
    except HydraException:
        return part
    return part.replace(word, f"'{word}'") if isinstance(value, bool | int | float) else part
