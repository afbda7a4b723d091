"""gymnasium ids of the six tasks; importing :mod:`torchrl_bmrl.envs` registers them."""

from __future__ import annotations

from torchrl_bmrl.extras import needs
from torchrl_bmrl.names import TASKS, gymnasium_id, horizon_of

with needs("robosuite"):
    # As a plugin this is called while gymnasium itself is imported.
    from gymnasium.envs import registration


def register() -> None:
    """Registers ``bmrl/SawyerReach-v0``, its five siblings and the compositions (idempotent).

    Example:
        >>> register()
        >>> import gymnasium
        >>> gymnasium.spec("bmrl/SawyerReach-v0").kwargs["horizon"]
        200
    """
    for task in (*TASKS, "reach-lift-reach"):
        if gymnasium_id(task) not in registration.registry:
            registration.register(
                gymnasium_id(task),
                entry_point="torchrl_bmrl.envs.sawyer:SawyerEnv",
                vector_entry_point="torchrl_bmrl.envs.vector:SawyerVectorEnv",
                # Not gymnasium's TimeLimit: its count is not part of a state that one returns to.
                kwargs={"task": task, "horizon": horizon_of(task)},
                disable_env_checker=True,
            )
