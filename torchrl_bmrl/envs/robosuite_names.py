"""Environments as files of demonstrations name them, for ``robosuite.make``.

robosuite finds an environment by its class's name once its module has been imported.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl_bmrl.envs.scene import TabletopScene
from torchrl_bmrl.envs.skills import Push, SkillLike, describe_skill, make_skills
from torchrl_bmrl.envs.table import CONTROL_FREQUENCY
from torchrl_bmrl.extras import needs

with needs("robosuite"):
    import robosuite


class BMRLSawyerReach(TabletopScene):
    """The reach task; ``robosuite.make("BMRLSawyerReach")``."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("reach", **kwargs)


class BMRLSawyerLift(TabletopScene):
    """The lift task; ``robosuite.make("BMRLSawyerLift")``."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("lift", **kwargs)


class BMRLSawyerPush(TabletopScene):
    """The push tasks; ``robosuite.make("BMRLSawyerPush", direction="left")``."""

    def __init__(self, direction: str, **kwargs: Any) -> None:
        super().__init__(Push(direction), **kwargs)


class BMRLSawyerComposition(TabletopScene):
    """Compositions; ``robosuite.make("BMRLSawyerComposition", stages=["reach", "lift"])``."""

    def __init__(self, stages: Sequence[str], **kwargs: Any) -> None:
        super().__init__(stages, **kwargs)


def robosuite_metadata(
    skills: SkillLike | Sequence[SkillLike], robot: str = "Sawyer", gripper: str = "default"
) -> dict[str, Any]:
    """robomimic's ``env_args``: how ``robosuite.make`` rebuilds the environment of demonstrations.

    Args:
        skills: as for :class:`TabletopScene`.
        robot: the arm.
        gripper: as for :class:`~torchrl_bmrl.envs.tabletop.TabletopEnv`.

    Example:
        >>> robosuite_metadata("push_up")["env_name"]
        'BMRLSawyerPush'
    """
    described = [describe_skill(skill) for skill in make_skills(skills)]
    name: str = "TabletopScene"
    kwargs: dict[str, Any] = {"skills": described}
    if robot == "Sawyer" and all(isinstance(each, str) for each in described):
        name, kwargs = _sawyer_names(described)
    if gripper != "default":
        kwargs = kwargs | {"gripper_types": gripper}
    return {
        "env_name": name,
        "type": 1,
        "env_version": robosuite.__version__,
        "env_kwargs": kwargs | {"robots": robot, "control_freq": CONTROL_FREQUENCY},
    }


def _sawyer_names(names: list[Any]) -> tuple[str, dict[str, Any]]:
    if len(names) > 1:
        return "BMRLSawyerComposition", {"stages": names}
    kind, _, direction = names[0].partition("_")
    return f"BMRLSawyer{kind.title()}", {"direction": direction} if direction else {}
