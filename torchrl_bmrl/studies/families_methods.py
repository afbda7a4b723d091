"""Policies that the study of held-out members compares, and what each is given of a member."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_bmrl.data.episodes import as_tensordict
from torchrl_bmrl.data.robomimic import keep_episode, read_kept_episode
from torchrl_bmrl.envs.transforms import transform_data
from torchrl_bmrl.evaluation.rollout import rollout_episodes
from torchrl_bmrl.experts.collect import WANDERING, others_than, record_success
from torchrl_bmrl.modules import BCQPolicy, PathTaskLatent
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.student import load_student
from torchrl_bmrl.run.settings import setting
from torchrl_bmrl.studies.families_peers import FocalSettings, MBMLSettings, load_focal
from torchrl_bmrl.studies.imitation import clone_behaviour
from torchrl_bmrl.tasks import Task

METHODS = {
    "told": "told the parameter",
    "demonstration": "m of one demonstration",
    "behaviour": "m of one episode of another behaviour",
    "one_shot": "m of its own first episode",
    "first": "the first episode itself",
    "one_hot": "one-hot code of the nearest trained member",
    "teacher": "agent of the nearest trained member",
    "no_context": "told nothing",
    "cloning": "behaviour cloning of one demonstration",
    "focal": "FOCAL, given one demonstration",
    "focal_one_shot": "FOCAL, given its own first episode",
    "mbml": "MBML, given one demonstration",
    "mbml_one_shot": "MBML, given its own first episode",
}
"""Policies that are compared; the nearest member is known by the true parameter."""
OWN = "student"
"""The policy that the run distilled, among the learners."""
_WAYS = {
    "told": ("told", "parameter"),
    "demonstration": (OWN, "demonstration"),
    "behaviour": (OWN, "behaviour"),
    "one_shot": (OWN, "one_shot"),
    "first": (OWN, "first"),
    "one_hot": ("one_hot", "nearest"),
    "no_context": ("no_context", "nothing"),
    "focal": ("focal", "demonstration"),
    "focal_one_shot": ("focal", "one_shot"),
    "mbml": ("mbml", "demonstration"),
    "mbml_one_shot": ("mbml", "one_shot"),
}
"""Of each method that acts by m: who learned it, and what m is made of."""


@dataclass
class FamilySettings:
    """Settings of :func:`torchrl_bmrl.studies.families.generalise`."""

    episodes: int = setting(5, above=0)  # of each held-out member with each method
    demonstrations: int = setting(1, above=0)  # episodes of a context
    methods: list[str] = setting(list(METHODS), choices=tuple(METHODS), unique=True)  # to compare
    cloning_updates: int = setting(2000, above=0)  # of behaviour cloning on the demonstration
    focal: FocalSettings = field(default_factory=FocalSettings)  # training of FOCAL
    mbml: MBMLSettings = field(default_factory=MBMLSettings)  # training of MBML
    folder: ClassVar[str] = "families"  # of the study, below the run's

    @property
    def learners(self) -> tuple[str, ...]:
        """Who acts by m in the methods that are compared, each once."""
        return tuple(dict.fromkeys(_WAYS[name][0] for name in self.methods if name in _WAYS))


@dataclass(frozen=True)
class Learner:
    """A policy that acts by m.

    Attributes:
        policy: reads ``task_latent``, writes ``action``.
        prototypes: m of each trained member, ``(num_tasks, m)``.
        embed: m of transitions ``[K]`` of a demonstration.
        infer: m of transitions ``[K]`` of any behaviour.
    """

    policy: TensorDictModuleBase
    prototypes: Tensor
    embed: Callable[[TensorDictBase], Tensor]
    infer: Callable[[TensorDictBase], Tensor]


def load_learner(run: Run, settings: FamilySettings, name: str) -> Learner:
    """A policy that was trained.

    Args:
        run: the run.
        settings: of the study.
        name: :data:`OWN`, or a folder of the study.

    Raises:
        CheckpointError: if it is missing or damaged.
    """
    path = run.folder / settings.folder / name / "checkpoint.safetensors"
    if name == "focal":
        focal = load_focal(path)
        return Learner(focal.policy(), focal.prototypes, focal.embed_context, focal.embed_context)
    student, metadata = run.student() if name == OWN else load_student(path)
    policy = student.policy(
        num_candidates=run.settings.evaluate.num_candidates, latent_clip=metadata["latent_clip"]
    )
    return Learner(policy, student.prototypes, student.embed_context, student.infer)


def make_method(
    run: Run, settings: FamilySettings, task: Task, method: str
) -> tuple[TensorDictModuleBase, Tensor]:
    """The policy of a method on a member, and its m: ``(m,)``, or ``(T, m)`` step by step.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        method: one of :data:`METHODS`.
    """
    if method == "cloning":
        data = context(run, settings, task, "demonstration")
        seed = run.seed("families", "cloning", task.name)
        return clone_behaviour(data, updates=settings.cloning_updates, seed=seed), torch.zeros(1)
    code = torch.tensor(run.family.told(task.name), dtype=torch.float32)
    codes = torch.tensor(run.codes(), dtype=torch.float32)
    nearest = int((codes - code).norm(dim=-1).argmin())
    if method == "teacher":
        count = run.settings.evaluate.num_candidates
        teacher = BCQPolicy.frozen(run.teacher(run.names[nearest]), num_candidates=count)
        return teacher, torch.zeros(1)
    name, given = _WAYS[method]
    learner = load_learner(run, settings, name)
    made: dict[str, Callable[[], Tensor]] = {
        "parameter": lambda: code,
        "nearest": lambda: learner.prototypes[nearest],
        "nothing": lambda: learner.prototypes[0],
        "first": lambda: first_latents(run, learner.prototypes, task, 0),
        "demonstration": lambda: learner.embed(context(run, settings, task, given)),
        "behaviour": lambda: learner.infer(context(run, settings, task, given)),
        "one_shot": lambda: learner.infer(first_episodes(run, settings, task, learner)),
    }
    return learner.policy, made[given]()


def first_latents(run: Run, prototypes: Tensor, task: Task, index: int) -> Tensor:
    """m of an episode before anything is known: of some trained members in turn, ``(T, m)``.

    Args:
        run: the run.
        prototypes: m of each trained member, ``(num_tasks, m)``.
        task: the member.
        index: number of the episode.
    """
    generator = torch.Generator().manual_seed(run.seed("families", "sweep", task.name, index))
    chosen = torch.randperm(len(prototypes), generator=generator)[:WANDERING]
    horizon = run.horizon(task)
    step = torch.arange(horizon) * len(chosen) // horizon
    return prototypes[chosen[step]]


def first_episodes(
    run: Run, settings: FamilySettings, task: Task, learner: Learner
) -> TensorDictBase:
    """A policy's own first episodes of a member, ``[K]``: it knows nothing of the parameter.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        learner: the policy.
    """
    episodes = []
    for i in range(settings.demonstrations):
        latents = PathTaskLatent(first_latents(run, learner.prototypes, task, i))
        seed = run.seed("families", "first", task.name, i)
        with closing(run.make_env(task, latents, num_envs=1)) as env:
            played = rollout_episodes(env, learner.policy, seed=[seed], max_steps=run.horizon(task))
        episodes.append(played.reshape(-1))
    return torch.cat(episodes)


def context(run: Run, settings: FamilySettings, task: Task, given: str) -> TensorDictBase:
    """Recorded transitions of a member that a policy is given, ``[K]``, normalised.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        given: ``"demonstration"`` or ``"behaviour"``.
    """
    episodes = []
    for i in range(settings.demonstrations):
        record: Callable[[Path], None] = partial(_record, run, task, given, i)
        file = f"{settings.folder}/contexts/{task.name}-{given}-{i}.npz"
        episode = run.once(file, read_kept_episode, record)
        episodes.append(transform_data(as_tensordict(episode), task, run.statistics))
    return torch.cat(episodes)


def _record(run: Run, task: Task, method: str, index: int, path: Path) -> None:
    """Records an episode of the member's expert that succeeds, or of another member's expert."""
    expert = run.settings.collect.experts_of(task.name)[0]
    seed_of = partial(run.seed, "families", method, task.name, index)
    if method == "demonstration":
        return keep_episode(path, record_success(task, expert, seed_of))
    assert task.record is not None
    seed = run.seed("families", "like", task.name, index)
    like = others_than(run.tasks, "", seed=seed)
    given = {"noise": expert.noise, "gains": expert.gains, "like": like, **task.options}
    keep_episode(path, task.record(seed_of(0), **given))
