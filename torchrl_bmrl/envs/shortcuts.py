"""robosuite's helpers of rewards and observations, computed faster with the same results.

What robosuite does for every contact or marker in Python takes as long as the physics in some
tasks. A shortcut takes the place of a method in one environment, unless its class has its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from torchrl_bmrl.extras import needs

with needs("robosuite"):
    from robosuite.environments.base import MujocoEnv
    from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
    from robosuite.environments.manipulation.wipe import Wipe
    from robosuite.models.base import MujocoModel
    from robosuite.models.grippers import GripperModel


def take_shortcuts(env: MujocoEnv) -> None:
    """Replaces the slow methods of one environment whose class takes them from robosuite."""
    contacts = _Contacts(env)
    shortcuts: dict[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
        "check_contact": (MujocoEnv.check_contact, contacts.check_contact),
        "_check_grasp": (ManipulationEnv._check_grasp, contacts.check_grasp),
        "_gripper_to_target": (ManipulationEnv._gripper_to_target, contacts.gripper_to_target),
        "_get_wipe_information": (Wipe._get_wipe_information, _WipeInformation(env)),
    }
    for name, (stock, faster) in shortcuts.items():
        if name not in vars(env) and getattr(type(env), name, None) is stock:
            setattr(env, name, faster)


class _Contacts:
    """Contacts of an environment, with one look-up of names for all of them."""

    def __init__(self, env: MujocoEnv) -> None:
        self.env = env
        self.gripper: GripperModel | None = None  # the last that was looked at

    def check_contact(self, geoms_1: Any, geoms_2: Any = None) -> bool:
        """As ``MujocoEnv.check_contact``."""
        if not self.env.sim.data._data.ncon:
            return False
        name_of = self.env.sim.model._geom_id2name
        first, second = _names(geoms_1), None if geoms_2 is None else _names(geoms_2)
        for pair in self.env.sim.data._data.contact.geom.tolist():
            one, other = name_of[pair[0]], name_of[pair[1]]
            if one in first and (second is None or other in second):
                return True
            if other in first and (second is None or one in second):
                return True
        return False

    def check_grasp(self, gripper: Any, object_geoms: Any) -> bool:
        """As ``ManipulationEnv._check_grasp``."""
        model = _only_gripper(gripper)
        if model is None:
            return ManipulationEnv._check_grasp(self.env, gripper, object_geoms)
        self._look_at(model)
        names = _names(object_geoms)
        return all(self.env.check_contact(pad, names) for pad in self.pads)

    def gripper_to_target(
        self, gripper: Any, target: Any, target_type: str = "body", return_distance: bool = False
    ) -> Any:
        """As ``ManipulationEnv._gripper_to_target``."""
        model = _only_gripper(gripper)
        if model is None or isinstance(target, MujocoModel):
            return ManipulationEnv._gripper_to_target(
                self.env, gripper, target, target_type, return_distance
            )
        self._look_at(model)
        data = self.env.sim.data
        find = {"body": data.get_body_xpos, "site": data.get_site_xpos}
        position = find.get(target_type, data.get_geom_xpos)(target)
        difference = position - data.get_site_xpos(self.site)
        return np.linalg.norm(difference) if return_distance else difference

    def _look_at(self, model: GripperModel) -> None:
        # robosuite puts all names of a gripper together anew at each look.
        if self.gripper is not model:
            geoms = model.important_geoms
            self.pads = [_names(geoms[f"{side}_fingerpad"]) for side in ("left", "right")]
            self.site = model.important_sites["grip_site"]
            self.gripper = model


def _only_gripper(gripper: Any) -> GripperModel | None:
    if isinstance(gripper, dict) and len(gripper) == 1:
        (gripper,) = gripper.values()
    return gripper if isinstance(gripper, GripperModel) else None


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
