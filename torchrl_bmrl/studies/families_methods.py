"""Policies that the study of held-out members compares, and what each is given of a member."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.envs.transforms import Transform

from torchrl_bmrl.data.episodes import as_tensordict
from torchrl_bmrl.data.robomimic import keep_episode, read_kept_episode
from torchrl_bmrl.envs.transforms import transform_data
from torchrl_bmrl.evaluation.rollout import rollout_episodes, still_playing
from torchrl_bmrl.experts.collect import others_than, record_success
from torchrl_bmrl.modules import (
    BCQPolicy,
    ContextTaskLatent,
    PathTaskLatent,
    PrototypeTaskLatent,
    embed_context,
)
from torchrl_bmrl.pipeline.collect import read_episode
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
TRIED = 10
"""Trained members whose m a first episode tries."""
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


def nearest_code(codes: Tensor, code: Tensor, repeats: Sequence[float] | None) -> int:
    """Position of the trained member that is nearest to a parameter.

    Args:
        codes: of the trained members, ``(num_tasks, n)``.
        code: of the parameter, ``(n,)``.
        repeats: after which each number means the same again; ``None``: never.

    Example:
        >>> nearest_code(torch.tensor([[-1.0], [0.0], [1.0]]), torch.tensor([1.3]), [2.4])
        0
    """
    apart = codes - code
    if repeats is not None:
        turn = torch.tensor(repeats)
        apart = torch.remainder(apart + turn / 2, turn) - turn / 2
    return int(apart.norm(dim=-1).argmin())


@dataclass
class FamilySettings:
    """Settings of :func:`torchrl_bmrl.studies.families.generalise`."""

    episodes: int = setting(5, above=0)  # of each held-out member with each method
    demonstrations: int = setting(1, above=0)  # episodes that a policy is given in each of them
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
        encoder: m of a demonstration.
        infers: m of any behaviour.
    """

    policy: TensorDictModuleBase
    prototypes: Tensor
    encoder: TensorDictModule
    infers: TensorDictModule


def learner_path(run: Run, settings: FamilySettings, name: str) -> Path:
    """Checkpoint of a policy that was trained: :data:`OWN`, or a folder of the study."""
    if name == OWN:
        return run.student_path
    return run.folder / settings.folder / name / "checkpoint.safetensors"


def checkpoints_of(run: Run, settings: FamilySettings, method: str) -> list[Path]:
    """Checkpoints of the policy of a method, as far as the method names one."""
    return [learner_path(run, settings, _WAYS[method][0])] if method in _WAYS else []


def load_learner(run: Run, settings: FamilySettings, name: str) -> Learner:
    """A policy that was trained.

    Args:
        run: the run.
        settings: of the study.
        name: :data:`OWN`, or a folder of the study.

    Raises:
        CheckpointError: if it is missing or damaged.
    """
    path = learner_path(run, settings, name)
    if name == "focal":
        focal = load_focal(path)
        return Learner(focal.policy(), focal.prototypes, focal.encoder, focal.encoder)
    student, metadata = run.student() if name == OWN else load_student(path)
    policy = student.policy(
        num_candidates=run.settings.evaluate.num_candidates, latent_clip=metadata["latent_clip"]
    )
    encoder = student.task_encoder
    return Learner(policy, student.prototypes, encoder, student.context_encoder or encoder)


def make_method(
    run: Run, settings: FamilySettings, task: Task, method: str
) -> tuple[TensorDictModuleBase, Transform]:
    """The policy of a method on a member, and where it has m from in the episodes of the study.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        method: one of :data:`METHODS`.
    """
    if method == "cloning":
        data = context(run, settings, task, "demonstration", 0)
        seed = run.seed("families", "cloning", task.name)
        policy = clone_behaviour(data, updates=settings.cloning_updates, seed=seed)
        return policy, PrototypeTaskLatent(torch.zeros(1))
    code = torch.tensor(run.family.told(task.name), dtype=torch.float32)
    codes = torch.tensor(run.codes(), dtype=torch.float32)
    nearest = nearest_code(codes, code, run.family.repeats)
    if method == "teacher":
        count = run.settings.evaluate.num_candidates
        teacher = BCQPolicy.frozen(run.teacher(run.names[nearest]), num_candidates=count)
        return teacher, PrototypeTaskLatent(torch.zeros(1))
    name, given = _WAYS[method]
    learner = load_learner(run, settings, name)
    if given in ("parameter", "nearest", "nothing"):
        points = {"parameter": code, "nearest": learner.prototypes[nearest]}
        return learner.policy, PrototypeTaskLatent(points.get(given, learner.prototypes[0]))
    if given == "first":
        return learner.policy, trying(run, settings, task, learner)
    if given == "one_shot":
        return learner.policy, after_first_episodes(run, settings, task, learner)
    encoder = learner.encoder if given == "demonstration" else learner.infers
    contexts = [context(run, settings, task, given, i) for i in range(settings.episodes)]
    latents = torch.stack([embed_context(encoder, each) for each in contexts])
    return learner.policy, PathTaskLatent(latents.unsqueeze(1))


def trying(run: Run, settings: FamilySettings, task: Task, learner: Learner) -> PathTaskLatent:
    """m of episodes before anything is known: of some trained members in turn.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        learner: the policy.
    """
    paths, horizon = [], run.horizon(task)
    for i in range(settings.episodes):
        generator = torch.Generator().manual_seed(run.seed("families", "sweep", task.name, i))
        chosen = torch.randperm(len(learner.prototypes), generator=generator)[:TRIED]
        step = torch.arange(horizon) * len(chosen) // horizon
        paths.append(learner.prototypes[chosen[step]])
    return PathTaskLatent(torch.stack(paths))


def after_first_episodes(
    run: Run, settings: FamilySettings, task: Task, learner: Learner
) -> ContextTaskLatent:
    """m of a context that starts with a policy's own first episode, and grows in the second.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        learner: the policy, which in its first episode knows nothing of the member.

    Raises:
        BMRLError: for an encoder of single transitions.
    """
    first = trying(run, settings, task, learner)
    seeds = [run.seed("families", "first", task.name, i) for i in range(settings.episodes)]
    with closing(run.make_env(task, first, num_envs=len(seeds))) as env:
        played = rollout_episodes(env, learner.policy, seed=seeds, max_steps=run.horizon(task))
    start = learner.prototypes[0]  # of no episode: each has a context
    return ContextTaskLatent(start, learner.infers, played, still_playing(played))


def context(
    run: Run, settings: FamilySettings, task: Task, given: str, index: int
) -> TensorDictBase:
    """Recorded transitions of a member that a policy is given in an episode, ``[K]``, normalised.

    Args:
        run: the run.
        settings: of the study.
        task: the member.
        given: ``"demonstration"`` or ``"behaviour"``.
        index: number of the episode.
    """
    episodes = []
    for i in range(index * settings.demonstrations, (index + 1) * settings.demonstrations):
        record: Callable[[Path], None] = partial(_record, run, task, given, i)
        file = f"{settings.folder}/contexts/{task.name}-{given}-{i}.npz"
        episode = run.once(file, read_kept_episode, record)
        episodes.append(transform_data(as_tensordict(episode), task, run.statistics))
    return torch.cat(episodes)


def wanted(settings: FamilySettings) -> set[str]:
    """What the methods are given of a member: ``"demonstration"``, ``"behaviour"``.

    Args:
        settings: of the study.
    """
    given = {"cloning": "demonstration", **{name: way for name, (_, way) in _WAYS.items()}}
    return {given.get(name, "") for name in settings.methods} & {"demonstration", "behaviour"}


def has_demonstrations(settings: FamilySettings, task: Task) -> bool:
    """Whether a member has demonstrations; without a method that is given one, none are needed.

    Args:
        settings: of the study.
        task: the member.
    """
    if task.files is None or "demonstration" in wanted(settings):
        return True
    return Path(task.files.path).expanduser().exists()


def check_files(run: Run, settings: FamilySettings, tasks: Sequence[Task]) -> None:
    """Checks that the files of members have the episodes that the methods are given.

    Args:
        run: the run.
        settings: of the study.
        tasks: the members.

    Raises:
        DataError: naming the file that is missing or damaged, or has too few episodes.
    """
    last = settings.episodes * settings.demonstrations - 1
    for task in tasks:
        if task.files is None:
            continue
        if has_demonstrations(settings, task):
            read_episode(run, task, last)
        if "behaviour" in wanted(settings):
            read_episode(run, task, last, context=True)


def _record(run: Run, task: Task, method: str, index: int, path: Path) -> None:
    """Stores an episode of the member's file or expert, or of another behaviour."""
    if task.record is None:
        episode = read_episode(run, task, index, context=method == "behaviour")
        return keep_episode(path, episode)
    expert = run.settings.collect.experts_of(task.name)[0]
    seed_of = partial(run.seed, "families", method, task.name, index)
    if method == "demonstration":
        return keep_episode(path, record_success(task, expert, seed_of))
    seed = run.seed("families", "like", task.name, index)
    like = others_than(run.tasks, "", seed=seed)
    given = {"noise": expert.noise, "gains": expert.gains, "like": like, **task.options}
    keep_episode(path, task.record(seed_of(0), **given))
