"""Families of Meta-World's ML1: one environment, and 50 goals that differ between tasks.

Importing this module registers the families of :data:`SPACES`; it does not import Meta-World.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.experts.controllers import ExpertGains
from torchrl_bmrl.extras import needs
from torchrl_bmrl.families import Family, register_family, registered_families
from torchrl_bmrl.run.workers import derive_seed
from torchrl_bmrl.tasks import Task

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

HORIZON = 500
"""Steps of an episode."""
TRAINED, HELD_OUT = 40, 10
"""Numbers of members of a family, in the order in which they are drawn."""

Vector = tuple[float, ...]


@dataclass(frozen=True)
class RandomSpace:
    """Bounds of the numbers that Meta-World draws for a task, its ``rand_vec`` [m].

    Attributes:
        low: lower bounds: of the object's position and the goal's, or of the one object's.
        high: upper bounds.
        shown: positions of the numbers that are a member's parameter.
        apart: smallest horizontal distance of object and goal [m]; Meta-World draws again below
            it.

    Example:
        >>> RandomSpace((0.0, 0.0), (1.0, 0.0), shown=(0,)).draw(np.random.default_rng(0))
        (0.636962, 0.0)
    """

    low: Vector
    high: Vector
    shown: tuple[int, ...]
    apart: float = 0.0

    def draw(self, rng: np.random.Generator) -> Vector:
        """Draws a ``rand_vec``.

        Args:
            rng: source of the random numbers.
        """
        while True:
            vector = _uniform(rng, self.low, self.high)
            if not self.apart or math.dist(vector[:2], vector[3:5]) >= self.apart:
                return tuple(vector.tolist())


def _uniform(rng: np.random.Generator, low: Any, high: Any) -> np.ndarray:
    # Whole micrometres, so that the numbers can be written down.
    return rng.uniform(low, high).round(6)


_CUBE_LOW, _CUBE_HIGH = (-0.1, 0.6, 0.02), (0.1, 0.7, 0.02)
_IN_THE_AIR = RandomSpace(
    (*_CUBE_LOW, -0.1, 0.8, 0.05), (*_CUBE_HIGH, 0.1, 0.9, 0.3), shown=(3, 4, 5), apart=0.15
)
SPACES = {
    "reach-v3": _IN_THE_AIR,
    # The goal lies on the table, whatever height is drawn.
    "push-v3": RandomSpace(
        (*_CUBE_LOW, -0.1, 0.8, 0.01), (*_CUBE_HIGH, 0.1, 0.9, 0.02), shown=(3, 4), apart=0.15
    ),
    "pick-place-v3": _IN_THE_AIR,
    "drawer-close-v3": RandomSpace((-0.1, 0.9, 0.0), (0.1, 0.9, 0.0), shown=(0,)),
    "button-press-v3": RandomSpace((-0.1, 0.85, 0.115), (0.1, 0.9, 0.115), shown=(0, 1)),
}
"""Environments of the registered families: a copy of Meta-World's bounds, which a test compares."""


def make_ml1_family(env: str) -> Family:
    """Returns the family of one of Meta-World's environments, such as ``ml1_push``.

    Its 50 goals are drawn with a fixed seed; the first 40 are trained, the others held out under
    ``"inside"``. A member's parameter is the position of the goal, or of the object where
    Meta-World draws that alone, as far as it differs between members.

    Args:
        env: one of Meta-World's 50 names; one that is not in :data:`SPACES` needs the package.

    Raises:
        UnknownNameError: for another name.
        MissingExtraError: without the package, for an environment that is not in :data:`SPACES`.

    Example:
        >>> family = make_ml1_family("push-v3")
        >>> family.name, family.parameters, len(family.tasks("train"))
        ('ml1_push', ('goal x [m]', 'goal y [m]'), 40)
        >>> family.tasks("inside")[0].name
        'ml1_push_40'
    """
    rng = np.random.default_rng(derive_seed(0, "ml1", env))
    count = TRAINED + HELD_OUT
    if env in SPACES:
        shown = SPACES[env].shown
        vectors = [SPACES[env].draw(rng) for _ in range(count)]
    else:
        shown, vectors = _draw_in(env, rng, count)
    name = "ml1_" + env.removesuffix("-v3").replace("-", "_")
    tasks = {}
    for number, vector in enumerate(vectors):
        parameter = tuple(vector[i] for i in shown)
        tasks[parameter] = make_ml1_task(f"{name}_{number:02d}", env, vector)
    what = "goal" if len(vectors[0]) == 6 else "object"
    members = list(tasks)
    return Family(
        name=name,
        parameters=tuple(f"{what} {'xyz'[i % 3]} [m]" for i in shown),
        members={"train": members[:TRAINED], "inside": members[TRAINED:], "outside": []},
        make=partial(_look_up, tasks),
        title=name.removeprefix("ml1_").replace("_", " ").capitalize() + " (ML1)",
    )


def _look_up(tasks: Mapping[Vector, Task], *parameter: float) -> Task:
    if parameter not in tasks:
        raise ConfigError(f"no member has the parameter {parameter}; valid: those of members")
    return tasks[parameter]


def _draw_in(
    env: str, rng: np.random.Generator, count: int
) -> tuple[tuple[int, ...], list[Vector]]:
    """Draws as :meth:`RandomSpace.draw`, and lets Meta-World itself refuse draws."""
    with needs("metaworld"):
        from torchrl_bmrl.envs.metaworld import make_metaworld_env

    made = make_metaworld_env(env)
    space = made._random_reset_space
    drawn: list[np.ndarray] = []

    def draw() -> np.ndarray:
        drawn.append(_uniform(rng, space.low, space.high))
        return drawn[-1].copy()

    made._get_state_rand_vec = draw
    vectors = []
    for _ in range(count):
        made.reset_model()
        vectors.append(tuple(drawn[-1].tolist()))
    made.close()
    last = range(space.low.size - 3, space.low.size)
    return tuple(i for i in last if space.low[i] < space.high[i]), vectors


def make_ml1_task(name: str, env: str, rand_vec: Vector) -> Task:
    """Returns a task of ML1 with a goal of your own.

    Its options are ``env``, ``rand_vec`` and ``horizon`` of
    :class:`~torchrl_bmrl.envs.metaworld.MetaWorldEnv`.

    Args:
        name: of the task.
        env: one of Meta-World's 50 names.
        rand_vec: the numbers that Meta-World draws for a task.

    Example:
        >>> task = make_ml1_task("drawer_left", "drawer-close-v3", (-0.1, 0.9, 0.0))
        >>> task.horizon, task.success
        (500, 'success')
    """
    return Task(
        name=name,
        make_env=make_ml1_env,
        simulator="torchrl_bmrl.envs.metaworld",
        record=record_ml1_episode,
        parts=("observation",),
        options={"env": env, "rand_vec": rand_vec, "horizon": HORIZON},
        horizon=HORIZON,
        success="success",
    )


def make_ml1_env(*, num_envs: int | None = None, **options: Any) -> EnvBase:
    """Returns :func:`torchrl_bmrl.envs.metaworld.make_ml1_env`, imported when called.

    Args:
        num_envs: number of environments side by side; ``None`` for one without a batch dimension.
        **options: ``env``, ``rand_vec`` and ``horizon``.

    Example:
        >>> make_ml1_env(env="drawer-close-v3", rand_vec=(0.05, 0.9, 0.0)).action_spec.shape
        torch.Size([4])
    """
    with needs("metaworld"):
        from torchrl_bmrl.envs import metaworld

    return metaworld.make_ml1_env(num_envs=num_envs, **options)


def record_ml1_episode(
    seed: int,
    *,
    env: str,
    rand_vec: Sequence[float],
    horizon: int,
    noise: float,
    gains: ExpertGains | None = None,
    after: Sequence[Task] = (),
    like: Sequence[Task] = (),
) -> Episode:
    """Records one episode of Meta-World's scripted policy; ``seed`` reproduces it.

    The policy is shown the goal, which the recorded observation does not contain. Its action is
    clipped to [-1, 1] before and after the noise is added. All episodes of a task start in the same
    state: without noise they are equal.

    Args:
        seed: seed of the noise.
        env: as for :class:`~torchrl_bmrl.envs.metaworld.MetaWorldEnv`.
        rand_vec: as for :class:`~torchrl_bmrl.envs.metaworld.MetaWorldEnv`.
        horizon: steps of the episode.
        noise: standard deviation of the Gaussian noise on each action dimension.
        gains: ``None`` or the defaults, since scripted policies have none.
        after: nothing, since tasks of Meta-World cannot follow each other.
        like: tasks of the same environment whose goals the policy is shown instead, each for its
            share of the episode. A policy that looks at the object alone acts as without them.

    Returns:
        the episode with the part ``observation`` and the extra ``successes``.

    Raises:
        ConfigError: for ``gains``, ``after`` or a ``like`` of another environment, and as
            :class:`~torchrl_bmrl.envs.metaworld.MetaWorldEnv`.

    Example:
        >>> task = make_ml1_family("drawer-close-v3").tasks("train")[0]
        >>> episode = task.record(0, noise=0.1, **task.options)
        >>> len(episode), episode.succeeded
        (500, True)
    """
    with needs("metaworld"):
        from metaworld.policies import ENV_POLICY_MAP

        from torchrl_bmrl.envs.metaworld import MetaWorldEnv

    if gains not in (None, ExpertGains()):
        raise ConfigError(f"gains of {env} are {gains}; valid: the defaults, which have no effect")
    if after:
        names = ", ".join(task.name for task in after)
        raise ConfigError(f"{env} comes after {names}; valid: nothing before a task of Meta-World")
    goals = []
    for task in like:
        if task.options.get("env") != env:
            raise ConfigError(f"like is {task.name}; valid: tasks of {env}")
        goals.append(_goal_of(env, tuple(task.options["rand_vec"])))
    made = MetaWorldEnv(env, rand_vec, horizon)
    rng = np.random.default_rng(derive_seed(seed, "action noise"))
    policy = ENV_POLICY_MAP[env]()
    observation, _ = made.reset()
    observations, actions, rewards, successes = [observation], [], [], []
    with warnings.catch_warnings():
        # The policy warns of actions that are clipped.
        warnings.filterwarnings("ignore", message="Constant", category=UserWarning)
        for step in range(horizon):
            shown = made.observation_with_goal()
            if goals:
                shown[-3:] = goals[step * len(goals) // horizon]
            action = np.clip(policy.get_action(shown), -1.0, 1.0)
            action = np.clip(action + noise * rng.standard_normal(4), -1.0, 1.0)
            # float32, so that the executed action is the stored one to the bit.
            actions.append(action.astype(np.float32))
            observation, reward, _, _, info = made.step(actions[-1])
            observations.append(observation)
            rewards.append(reward)
            successes.append(bool(info["success"]))
    made.close()
    whole = np.stack(observations)
    return Episode(
        observations={"observation": whole[:-1]},
        next_observations={"observation": whole[1:]},
        actions=np.stack(actions),
        rewards=np.array(rewards),
        terminated=np.zeros(horizon, dtype=bool),
        extras={"successes": np.array(successes)},
        attributes={
            "seed": seed,
            **({"like": ", ".join(task.name for task in like)} if like else {}),
            "env_args": {
                "env_name": env,
                "type": 2,
                "env_version": version("metaworld"),
                "env_kwargs": {"rand_vec": list(rand_vec)},
            },
        },
    )


@cache  # a simulator takes as long to make as a third of an episode
def _goal_of(env: str, rand_vec: Vector) -> np.ndarray:
    """Where the goal of a task lies [m]."""
    from torchrl_bmrl.envs.metaworld import MetaWorldEnv

    made = MetaWorldEnv(env, rand_vec)
    made.reset()
    goal = made.observation_with_goal()[-3:]
    made.close()
    goal.flags.writeable = False
    return goal


registered_families()  # the Sawyer's come first, whatever is imported first
for _env in SPACES:
    register_family(make_ml1_family(_env))
