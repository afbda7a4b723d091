"""gymnasium ids of the tabletop tasks; importing :mod:`torchrl_bmrl.envs` registers them."""

from __future__ import annotations

from torchrl_bmrl.envs.skills import SKILLS, make_skills
from torchrl_bmrl.extras import needs


def gymnasium_id(task: str) -> str:
    """Returns the registered id of a task; all compositions share one id.

    Args:
        task: names of :data:`~torchrl_bmrl.envs.skills.SKILLS`, joined by ``-``.

    Raises:
        UnknownNameError: if one of them is not a skill.

    Example:
        >>> gymnasium_id("push_left"), gymnasium_id("reach-lift")
        ('bmrl/SawyerPushLeft-v0', 'bmrl/SawyerComposition-v0')
    """
    name = "composition" if len(make_skills(task)) > 1 else task
    return f"bmrl/Sawyer{name.title().replace('_', '')}-v0"


def register() -> None:
    """Registers ``bmrl/SawyerReach-v0``, its five siblings and the compositions (idempotent).

    ``gymnasium.make(id, robot="Panda")`` selects another arm. For the compositions' id,
    ``skills=`` selects other skills.

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
