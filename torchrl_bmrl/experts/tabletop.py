"""Tasks of the tabletop scene, made of a skill, its expert and an arm.

:func:`make_task` turns a :class:`~torchrl_bmrl.envs.skills.Skill` and the class of its
:class:`~torchrl_bmrl.experts.controllers.Expert` into a :class:`~torchrl_bmrl.tasks.Task`.
Importing this module registers the paper's six tasks; it does not import the simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.envs.skills import SKILLS, Skill, SkillLike
from torchrl_bmrl.errors import BMRLError, ConfigError
from torchrl_bmrl.experts.controllers import EXPERTS, Expert, ExpertGains, make_expert
from torchrl_bmrl.extras import needs
from torchrl_bmrl.run.workers import derive_seed
from torchrl_bmrl.tasks import Task, register_task

if TYPE_CHECKING:
    from torchrl.envs import EnvBase
    from torchrl.envs.transforms import Transform

    from torchrl_bmrl.envs.tabletop import TabletopEnv

STAGE_HORIZON = 100
"""Steps of a composition's episode for each of its tasks."""
OBSERVATION_PARTS = (
    "sin_joint_pos",
    "cos_joint_pos",
    "robot0_gripper_qpos",
    "robot0_joint_vel",
    "robot0_eef_pos",
    "robot0_eef_quat",
    "goal_pos",
)
"""Order of the parts in ``observation``."""
MAX_ATTEMPTS = 100
"""Number of starts that are tried until the tasks before an episode succeed."""


def make_task(
    skill: Skill, expert: type[Expert], *, robot: str = "Sawyer", horizon: int = 200
) -> Task:
    """Returns the task of one skill, for :func:`~torchrl_bmrl.tasks.register_task`.

    Its options are ``skills``, ``robot``, ``gripper``, ``stepper`` and ``horizon`` of
    :class:`~torchrl_bmrl.envs.tabletop.TabletopEnv`. Compositions have :data:`STAGE_HORIZON` steps
    for each skill.

    Args:
        skill: start, goal, reward and success.
        expert: class of the skill's scripted expert.
        robot: the arm.
        horizon: steps of an episode.

    Example:
        >>> from torchrl_bmrl.envs.skills import Lift
        >>> from torchrl_bmrl.experts.controllers import LiftExpert
        >>> task = make_task(Lift(), LiftExpert, robot="Panda")
        >>> task.name, task.horizon, task.options["robot"]
        ('lift', 200, 'Panda')
    """
    options = {"robot": robot, "gripper": "default", "stepper": "fast", "horizon": horizon}
    return _make_task([skill], [expert], options)


def _make_task(
    skills: Sequence[Skill], experts: Sequence[type[Expert]], options: dict[str, Any]
) -> Task:
    return Task(
        name="-".join(skill.name for skill in skills),
        make_env=make_tabletop_env,
        simulator="torchrl_bmrl.envs.vector",
        record=partial(record_episode, experts=tuple(experts)),
        parts=("robot0_joint_pos", *OBSERVATION_PARTS[2:]),
        observation=observation_transforms,
        options={**options, "skills": tuple(skills)},
        horizon=options["horizon"],
        success="success",
        compose=compose_tasks,
    )


def compose_tasks(tasks: Sequence[Task]) -> Task:
    """Returns the composition of several tasks of :func:`make_task`, with the first's options.

    Args:
        tasks: the tasks in their order, all with the same arm.

    Raises:
        ConfigError: if the arms differ.

    Example:
        >>> from torchrl_bmrl.tasks import get_task
        >>> compose_tasks([get_task("reach"), get_task("lift")]).horizon
        200
    """
    robots = {task.options["robot"] for task in tasks}
    if len(robots) > 1:
        names = ", ".join(task.name for task in tasks)
        raise ConfigError(f"{names} have the arms {', '.join(sorted(robots))}; valid: the same arm")
    skills, experts = _chain(tasks)
    options = {**tasks[0].options, "horizon": STAGE_HORIZON * len(skills)}
    return _make_task(skills, experts, options)


def _chain(tasks: Sequence[Task]) -> tuple[list[Skill], list[type[Expert]]]:
    """Returns the skills and the experts of several tasks."""
    skills = [skill for task in tasks for skill in task.options["skills"]]
    records = [cast("partial[Episode]", task.record) for task in tasks]
    return skills, [expert for record in records for expert in record.keywords["experts"]]


def make_tabletop_env(
    *,
    skills: SkillLike | Sequence[SkillLike],
    num_envs: int | None = None,
    **options: Any,
) -> EnvBase:
    """Returns a TorchRL environment with the named parts of the observation.

    The tensordict contains ``success``, ``stage`` and each reward term ``reward_<term>``.

    Args:
        skills: as for :class:`~torchrl_bmrl.envs.tabletop.TabletopEnv`.
        num_envs: number of episodes in one simulator, batch ``[num_envs]``; ``None`` for no batch
            dimension.
        **options: options of :class:`~torchrl_bmrl.envs.tabletop.TabletopEnv`.

    Example:
        >>> from torchrl_bmrl.envs.skills import Push
        >>> env = make_tabletop_env(skills=[Push("up")], num_envs=2)
        >>> env.rollout(3)["next", "goal_pos"].shape
        torch.Size([2, 3, 3])
    """
    import torch
    from torchrl.data import Composite, Unbounded
    from torchrl.envs import GymWrapper
    from torchrl.envs.gym_like import default_info_dict_reader

    from torchrl_bmrl.envs.tabletop import TabletopEnv
    from torchrl_bmrl.envs.vector import TabletopVectorEnv

    made = (
        TabletopEnv(skills, **options)
        if num_envs is None
        else TabletopVectorEnv(skills, num_envs, **options)
    )
    env = GymWrapper(made)
    shape = env.batch_size
    spec = Composite(
        success=Unbounded(shape, dtype=torch.bool),
        stage=Unbounded(shape, dtype=torch.int64),
        **{f"reward_{name}": Unbounded(shape, dtype=torch.float64) for name in made.reward_terms},
        shape=shape,
    )
    return env.set_info_dict_reader(default_info_dict_reader(list(spec.keys()), spec=spec))


def observation_transforms() -> list[Transform]:
    """Returns the transforms from the named parts to ``observation``.

    Joint positions become their sines and cosines. For an arm with n joints and a gripper with k,
    ``observation`` has 3n + k + 10 numbers: 33 for Sawyer.

    Example:
        >>> [type(transform).__name__ for transform in observation_transforms()]
        ['SinCosTransform', 'CatTensors']
    """
    from torchrl.envs.transforms import CatTensors

    from torchrl_bmrl.envs.transforms import SinCosTransform

    return [
        SinCosTransform("robot0_joint_pos", "sin_joint_pos", "cos_joint_pos"),
        CatTensors(list(OBSERVATION_PARTS), "observation", dim=-1, sort=False, del_keys=True),
    ]


_last: tuple[Any, TabletopEnv] | None = None


def _env(skills: tuple[Skill, ...], options: dict[str, Any]) -> TabletopEnv:
    # Building the model takes a second, so the last environment is reused.
    global _last
    key = skills, options
    if _last is None or _last[0] != key:
        with needs("robosuite"):
            from torchrl_bmrl.envs.tabletop import TabletopEnv

        if _last is not None:
            _last[1].close()
        _last = key, TabletopEnv(skills, **options)
    return _last[1]


def record_episode(
    seed: int,
    *,
    skills: Sequence[Skill],
    experts: Sequence[type[Expert]],
    horizon: int,
    noise: float,
    gains: ExpertGains | None = None,
    after: Sequence[Task] = (),
    like: Sequence[Task] = (),
    **options: Any,
) -> Episode:
    """Records one episode of the scripted expert; ``seed`` reproduces it.

    Args:
        seed: seed of start and noise.
        skills: one skill, or those of a composition.
        experts: the class of each skill's expert.
        horizon: steps of the episode.
        noise: standard deviation of the Gaussian noise on each action dimension.
        gains: gains of the experts; ``None`` for the defaults.
        after: tasks whose experts act first; the episode starts in the state in which the last of
            them succeeded. If empty, it starts in the skill's own starting state.
        like: tasks with the same kind of skill, whose experts act instead, each for its share of
            the episode: a behaviour that does not know what this task asks for.
        **options: ``robot``, ``gripper`` and ``stepper`` of
            :class:`~torchrl_bmrl.envs.tabletop.TabletopEnv`.

    Returns:
        the episode with the extras ``successes``, ``states`` and, for one skill, ``phases``, or for
        a composition ``stages``. The attribute ``env_args`` is robomimic's.

    Raises:
        BMRLError: if the experts of ``after`` fail from 100 starts, or ``like`` has other skills or
            comes with ``after``.

    Example:
        >>> from torchrl_bmrl.tasks import get_task
        >>> task = get_task("reach")
        >>> episode = task.record(0, noise=0.2, **task.options)
        >>> len(episode), bool(episode.extras["successes"].any())
        (200, True)
    """
    from torchrl_bmrl.envs.robosuite_names import robosuite_metadata

    acted = [skill for task in like for skill in task.options["skills"]]
    if acted and (len(skills) > 1 or {type(skill) for skill in acted} != {type(skills[0])}):
        raise BMRLError(
            f"like is {', '.join(task.name for task in like)}; valid: tasks with the same kind of "
            f"skill as {'-'.join(skill.name for skill in skills)}, which must be one"
        )
    if acted and after:
        names = (", ".join(task.name for task in tasks) for tasks in (like, after))
        raise BMRLError("like is {} and after {}; valid: one of them".format(*names))
    before, experts_before = _chain(after)
    env = _env((*before, *skills), options)
    scene = env.robosuite_env
    rng = np.random.default_rng(derive_seed(seed, "action noise"))

    def act() -> np.ndarray:
        # float32, so that the executed action is the stored one to the bit.
        return np.clip(expert() + noise * rng.standard_normal(7), -1.0, 1.0).astype(np.float32)

    for attempt in range(MAX_ATTEMPTS):
        observation, _ = env.reset(seed=derive_seed(seed, "again", attempt) if attempt else seed)
        expert = make_expert(scene, gains, experts=[*experts_before, *experts])
        while scene.stage < len(before) and scene.timestep < STAGE_HORIZON * len(before):
            observation, *_ = env.step(act())
        if scene.stage == len(before):
            break
    else:
        raise BMRLError(
            f"the experts of {'-'.join(skill.name for skill in before)} failed from {MAX_ATTEMPTS} "
            "starts; valid in after: tasks that their experts solve"
        )
    # A composition's experts have different phases; its stages are stored instead.
    alone = len(skills) == 1
    observations = {name: [part] for name, part in observation.items()}
    model_file = scene.scene_xml()
    actions, rewards, successes, phases, states, stages = [], [], [], [], [], []
    for step in range(horizon):
        if acted:
            assert isinstance(expert, Expert)
            expert.skill = acted[step * len(acted) // horizon]
        action = act()
        phases.append(expert.phase)
        states.append(scene.sim.get_state().flatten())
        stages.append(scene.stage - len(before))
        observation, reward, _, _, info = env.step(action)
        for name, part in observation.items():
            observations[name].append(part)
        actions.append(action)
        rewards.append(reward)
        successes.append(scene.skill_success() if before else info["success"])
    parts = {name: np.stack(rows) for name, rows in observations.items()}
    return Episode(
        observations={name: part[:-1] for name, part in parts.items()},
        next_observations={name: part[1:] for name, part in parts.items()},
        actions=np.stack(actions),
        rewards=np.array(rewards),
        terminated=np.zeros(len(actions), dtype=bool),
        extras={
            "successes": np.array(successes),
            **({"phases": np.array(phases, dtype=np.int8)} if alone else {}),
            "states": np.stack(states),
            **({} if alone else {"stages": np.array(stages, dtype=np.int8)}),
        },
        # robomimic needs the model to play back the states.
        attributes={
            "seed": seed,
            **({"phase_names": list(expert.phases)} if alone else {}),
            "model_file": model_file,
            **({"after": "-".join(skill.name for skill in before)} if before else {}),
            **({"like": ", ".join(task.name for task in like)} if like else {}),
            "env_args": robosuite_metadata(
                skills, options.get("robot", "Sawyer"), options.get("gripper", "default")
            ),
        },
    )


for _skill in SKILLS.values():
    register_task(make_task(_skill, EXPERTS[type(_skill)]))
