"""robosuite's helpers of rewards and observations, computed faster with the same results.

What robosuite does for every contact or marker in Python takes as long as the physics in some
tasks. A shortcut takes the place of a method in one environment, unless its class has its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np

from torchrl_bmrl.extras import needs

with needs("robosuite"):
    from robosuite.environments.base import MujocoEnv
    from robosuite.environments.manipulation.wipe import Wipe
    from robosuite.models.base import MujocoModel


def take_shortcuts(env: MujocoEnv) -> None:
    """Replaces the slow methods of one environment whose class takes them from robosuite."""
    for name, (stock, faster) in _SHORTCUTS.items():
        if name not in vars(env) and getattr(type(env), name, None) is stock:
            setattr(env, name, faster(env))


def _check_contact(env: MujocoEnv, geoms_1: Any, geoms_2: Any = None) -> bool:
    """As ``MujocoEnv.check_contact``, with one look-up of names for all contacts."""
    data = env.sim.data._data
    if not data.ncon:
        return False
    name_of = env.sim.model._geom_id2name
    first = _names(geoms_1)
    second = None if geoms_2 is None else _names(geoms_2)
    for pair in data.contact.geom.tolist():
        one, other = name_of[pair[0]], name_of[pair[1]]
        if one in first and (second is None or other in second):
            return True
        if other in first and (second is None or one in second):
            return True
    return False


def _names(geoms: str | Iterable[str] | MujocoModel) -> set[str]:
    if isinstance(geoms, str):
        return {geoms}
    return set(geoms.contact_geoms if isinstance(geoms, MujocoModel) else geoms)


class _WipeInformation:
    """As ``Wipe._get_wipe_information``; the running sum adds in its order."""

    def __init__(self, env: Wipe) -> None:
        self.env = env
        self.sim: Any = None

    def __call__(self) -> tuple[float, np.ndarray, np.ndarray]:
        env = self.env
        if self.sim is not env.sim:
            self.sim, self.markers = env.sim, env.model.mujoco_arena.markers
            self.bodies = [env.sim.model.body_name2id(marker.root_body) for marker in self.markers]
        centroid = mean = np.zeros(3)
        radius: Any = 0
        if len(env.wiped_markers) < env.num_markers:
            wiped = set(map(id, env.wiped_markers))
            left = [
                body
                for marker, body in zip(self.markers, self.bodies, strict=True)
                if id(marker) not in wiped
            ]
            positions = env.sim.data.body_xpos[left]
            if left:
                centroid = np.add.accumulate(np.vstack([centroid, positions]))[-1]
            centroid = centroid / max(1, len(left))
            offsets = [centroid - env._get_eef_xpos(arm) for arm in env.robots[0].arms]
            mean = offsets[np.argmin([np.linalg.norm(offset) for offset in offsets])]
            if left:
                radius = np.max(np.linalg.norm(positions - centroid, axis=1))
        return radius, centroid, mean


_SHORTCUTS: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "check_contact": (MujocoEnv.check_contact, lambda env: partial(_check_contact, env)),
    "_get_wipe_information": (Wipe._get_wipe_information, _WipeInformation),
}
