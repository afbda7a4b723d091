"""Settings of one scripted expert, and mixtures of several experts."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.experts.controllers import ExpertGains
from torchrl_bmrl.run.settings import check_settings, setting

Experts = Mapping[str, Sequence[Mapping[str, float]]]
"""By task, or ``"default"``, a list of changes to noise and gains; each entry is one expert."""
CHANGES = ("noise", *(field.name for field in dataclasses.fields(ExpertGains)))
"""Valid keys of a change."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExpertSettings:
    """Action noise and gains of one expert.

    Attributes:
        noise: standard deviation of the Gaussian noise on each action dimension.
        gains: gains and limits; ``None`` for the defaults.

    Example:
        >>> ExpertSettings(noise=0.4).gains is None
        True
    """

    noise: float = setting(0.2, at_least=0)
    gains: ExpertGains | None = None


def experts_of(
    task: str, experts: Experts, *, noise: float, gains: ExpertGains | None = None
) -> list[ExpertSettings]:
    """Returns the experts that demonstrate a task; the episodes use them in turn.

    Args:
        task: name of the task.
        experts: by task, or ``"default"`` for the other tasks, a list of changes to ``noise`` and
            to the fields of :class:`~torchrl_bmrl.experts.controllers.ExpertGains`.
        noise: noise of an expert that does not change it.
        gains: gains of an expert that does not change them; ``None`` for the defaults.

    Returns:
        at least one expert; exactly one, without changes, for a task without entries.

    Raises:
        ConfigError: for an empty list, a key that is neither ``noise`` nor a gain, and a value
            outside its limits.

    Example:
        >>> mixture = {"default": [{}, {"noise": 0.5, "speed_limit": 0.3}]}
        >>> [expert.noise for expert in experts_of("lift", mixture, noise=0.2)]
        [0.2, 0.5]
    """
    key = task if task in experts else "default"
    plain = ExpertSettings(noise=noise, gains=gains)
    if key not in experts:
        return [plain]
    name = f"collect.experts.{key}"
    if not experts[key]:
        raise ConfigError(f"{name} is []; valid: at least one entry, such as {{}}")
    return [_change(plain, entry, f"{name}[{i}]") for i, entry in enumerate(experts[key])]


def _change(plain: ExpertSettings, entry: Mapping[str, float], name: str) -> ExpertSettings:
    for key, value in entry.items():
        if key not in CHANGES:
            raise ConfigError(f"{name} changes {key!r}; valid: {', '.join(CHANGES)}")
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise ConfigError(f"{name}.{key} is {value!r}; valid: a number")
    changes = dict(entry)
    noise, gains = changes.pop("noise", plain.noise), plain.gains
    check_settings(ExpertSettings(noise=noise), f"{name}.")
    if changes:
        gains = dataclasses.replace(gains or ExpertGains(), **changes)  # type: ignore[arg-type]
        check_settings(gains, f"{name}.")
    return ExpertSettings(noise=noise, gains=gains)
