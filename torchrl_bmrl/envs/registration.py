"""gymnasium ids of the tabletop tasks; importing :mod:`torchrl_bmrl.envs` registers them."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any

from torchrl_bmrl.envs.hidden import HIDDEN, HIDDEN_HORIZONS
from torchrl_bmrl.envs.skills import SKILLS, make_skills
from torchrl_bmrl.extras import needs

if TYPE_CHECKING:
    from torchrl_bmrl.envs.tabletop import TabletopEnv
    from torchrl_bmrl.envs.vector import TabletopVectorEnv


def gymnasium_id(task: str) -> str:
    """Returns the registered id of a task; all compositions share one id.

    Args:
        task: names of :data:`~torchrl_bmrl.envs.skills.SKILLS`, joined by ``-``; or the name of a
            family of :mod:`torchrl_bmrl.envs.hidden`.

    Raises:
        UnknownNameError: if one of them is not a skill.

    Example:
        >>> gymnasium_id("push_left"), gymnasium_id("reach-lift")
        ('bmrl/SawyerPushLeft-v0', 'bmrl/SawyerComposition-v0')
    """
    name = "composition" if task not in HIDDEN and len(make_skills(task)) > 1 else task
    return f"bmrl/Sawyer{name.title().replace('_', '')}-v0"


def make_member(family: str, num_envs: int | None = None, **options: Any) -> Any:
    """Makes the environment of a member of a family, the entry point of the families' ids.

    Args:
        family: a key of :data:`torchrl_bmrl.envs.hidden.HIDDEN`.
        num_envs: number of episodes side by side; ``None`` for one environment.
        **options: the member's parameter, and options of
            :class:`~torchrl_bmrl.envs.tabletop.TabletopEnv`.

    Raises:
        BMRLError: for a parameter that is not a finite number.

    Example:
        >>> make_member("push_towards", direction=45).task
        'push_towards_45'
    """
    from torchrl_bmrl.envs.tabletop import TabletopEnv
    from torchrl_bmrl.envs.vector import TabletopVectorEnv

    kind: Any = HIDDEN[family]
    names = [each.name for each in fields(kind)]
    skill = kind(**{name: options.pop(name) for name in names if name in options})
    made: TabletopEnv | TabletopVectorEnv = (
        TabletopEnv(skill, **options)
        if num_envs is None
        else TabletopVectorEnv(skill, num_envs, **options)
    )
    return made


def register() -> None:
    """Registers ``bmrl/SawyerReach-v0``, its five siblings, compositions, families (idempotent).

    ``gymnasium.make(id, robot="Panda")`` selects another arm. For the compositions' id,
    ``skills=`` selects other skills. The ids of families take the parameter, such as
    ``gymnasium.make("bmrl/SawyerPushTowards-v0", direction=45)``.

    Example:
        >>> register()
        >>> import gymnasium
        >>> gymnasium.spec("bmrl/SawyerReach-v0").kwargs["horizon"]
        200

    Raises:
        MissingExtraError: without gymnasium.
    """
    with needs("robosuite"):
        # gymnasium calls this plugin while it is being imported itself.
        from gymnasium.envs import registration

    for task, horizon in {**dict.fromkeys(SKILLS, 200), "reach-lift-reach": 300}.items():
        if gymnasium_id(task) not in registration.registry:
            registration.register(
                gymnasium_id(task),
                entry_point="torchrl_bmrl.envs.tabletop:TabletopEnv",
                vector_entry_point="torchrl_bmrl.envs.vector:TabletopVectorEnv",
                # gymnasium's TimeLimit would restart its count when a state is restored.
                kwargs={"skills": task, "horizon": horizon},
                disable_env_checker=True,
            )
    defaults = {"push_towards": {"direction": 0}, "reach_hidden": {"x": 0, "y": 0, "z": 20},
                "lift_to_height": {"height": 10}, "reach_at_speed": {"speed": 80}}  # fmt: skip
    for family, parameter in defaults.items():
        if gymnasium_id(family) not in registration.registry:
            registration.register(
                gymnasium_id(family),
                entry_point="torchrl_bmrl.envs.registration:make_member",
                vector_entry_point="torchrl_bmrl.envs.registration:make_member",
                kwargs={"family": family, "horizon": HIDDEN_HORIZONS[family], **parameter},
                disable_env_checker=True,
            )
