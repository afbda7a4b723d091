"""Texts as they were typed: Hydra makes numbers of what looks like one, 1.1 of ``run_dir=1.10``."""

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
"""Of a list, or of a sweep's values: texts in quotes, and what lies between separators."""


class AsTyped(Callback):
    """Quotes what Hydra would not take for text, in settings that are text.

    One run gets its values anew; a sweep hands the quotes on to its jobs.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Puts right what was composed."""
        parser = OverridesParser.create()
        for line in list(config.hydra.overrides.task):
            if (typed := as_typed(line, config)) != line:
                override = parser.parse_override(typed)
                OmegaConf.update(config, override.key_or_group, override.value())
        self.on_multirun_start(config)

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Puts right what the jobs will be composed of."""
        with open_dict(config.hydra):
            lines = [as_typed(line, config) for line in config.hydra.overrides.task]
            config.hydra.overrides.task = lines


def as_typed(line: str, config: DictConfig) -> str:
    """An override with quotes where its setting is a text, or a list of them, and it has a number.

    Args:
        line: such as ``run_dir=1.10``.
        config: what is composed of it and others, which knows the settings' types.
    """
    override = OverridesParser.create().parse_override(line)
    key, _, text = line.partition("=")
    # What other functions give was not typed.
    if override.is_delete() or text.startswith("{") or "(" in text.removeprefix("choice("):
        return line
    quoted = PARTS.sub(lambda part: _quoted(part[0]), text)
    if quoted == text or not _is_text(config, override.key_or_group):
        return line
    return f"{key}={quoted}"


def _is_text(config: DictConfig, key: str) -> bool:
    """Whether a setting makes texts of other values, alone or in a list."""
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
