"""The members of a small family in the embedding, for the tests of the page."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
from explorers import webp

from torchrl_bmrl.families import SPLITS, Family, get_family
from torchrl_bmrl.reports.explorer import StoredExplorer
from torchrl_bmrl.reports.members import Film, Member, explore_members


def film(success: bool | None = True, period: float | None = 0.05) -> Film:
    """Three pictures, ten steps in all."""
    frames = {str(step): base64.b64encode(webp((0, 20 * step, 0))).decode() for step in (0, 5, 10)}
    return Film(frames=frames, episode_return=12.34, success=success, period=period)


def members(family: Family, *, films: bool = True, dim: int = 8) -> list[Member]:
    """All members of a family; their points m lie on a line, in the order of the first number."""
    return [
        Member(
            title=task.title,
            split=split,
            parameter=parameter,
            task_latent=np.linspace(1.0, 0.1, dim) * parameter[0],
            film=film() if films else None,
        )
        for split in SPLITS
        for task, parameter in zip(family.tasks(split), family.members[split], strict=True)
    ]


def lifted(*, films: bool = True, **options: Any) -> StoredExplorer:
    """The explorer of ``lift_to_height``."""
    family = get_family("lift_to_height")
    return explore_members(family, members(family, films=films), **options)
