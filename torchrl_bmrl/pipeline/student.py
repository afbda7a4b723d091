"""The networks of stage 2, and how to build them from a checkpoint."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.transforms import Transform

from torchrl_bmrl.errors import BMRLError, CheckpointError, ConfigError, UnknownNameError
from torchrl_bmrl.modules import (
    BCQPolicy,
    ContextTaskLatent,
    DemonstrationTaskLatent,
    OnlineTaskLatent,
    PrototypeTaskLatent,
    embed_context,
    make_context_encoder,
    make_decoder,
    make_one_hot_encoder,
    make_qvalue_network,
    make_task_classifier,
    make_task_encoder,
    make_told_encoder,
    prototype,
    reads_context,
)
from torchrl_bmrl.modules.context_encoder import ContextNetwork
from torchrl_bmrl.objectives import MetaDistillationLoss
from torchrl_bmrl.pipeline.agents import with_sizes
from torchrl_bmrl.pipeline.metadata import are_statistics, is_number, is_task_name
from torchrl_bmrl.training.checkpoint import load_checkpoint
from torchrl_bmrl.training.networks import build


class Student(nn.Module):
    """The networks of stage 2: encoder M, classifier P, generator Ĝ, critic Q̂.

    Args:
        num_tasks: number of teachers.
        observation_dim: size of the observation.
        action_dim: size of the action.
        task_encoder: ``"transition"``; ``"set_mean"`` or ``"set_attention"``: m of a set of
            transitions; ``"one_hot"``: m is the task's index, one-hot; ``"told"``: m is given by
            :meth:`set_codes`; ``"nothing"``: m is one zero.
        task_latent_dim: size of m, except for the last two.
        code_dim: numbers that the policy is told about a task, see :meth:`set_codes`.
        infers: whether there is a second encoder, which reads sets of any behaviour.
        num_cells: widths of the hidden layers.
        latent_dim: size of the teachers' ``action_latent``; by default twice the action's.

    Attributes:
        prototypes: representative m of each task, ``(num_tasks, m)``; see :meth:`set_prototypes`.

    Raises:
        UnknownNameError: for another encoder.

    Example:
        >>> student = Student(num_tasks=2, observation_dim=3, action_dim=2, num_cells=(8,))
        >>> student.policy(num_candidates=10, latent_clip=0.5).in_keys
        ['observation', 'task_latent']
        >>> student.task_latent_source("prototype", task=1).task_latent
        tensor([0., 0.])
    """

    prototypes: Tensor

    def __init__(
        self,
        *,
        num_tasks: int,
        observation_dim: int,
        action_dim: int,
        task_encoder: str = "transition",
        task_latent_dim: int = 2,
        num_cells: Sequence[int] = (256, 256),
        latent_dim: int | None = None,
        code_dim: int = 1,
        infers: bool = False,
    ) -> None:
        super().__init__()
        dims = (observation_dim, action_dim)
        self.latent_dim = latent_dim = 2 * action_dim if latent_dim is None else latent_dim
        if task_encoder not in TASK_ENCODERS:
            raise UnknownNameError("task encoder", task_encoder, TASK_ENCODERS)
        if task_encoder == "one_hot":
            task_latent_dim = num_tasks
            self.task_encoder = make_one_hot_encoder(num_tasks)
        elif task_encoder in ("told", "nothing"):
            task_latent_dim = code_dim
            self.task_encoder = make_told_encoder(torch.zeros(num_tasks, code_dim))
        elif task_encoder in OF_SETS:
            self.task_encoder = make_context_encoder(
                *dims,
                task_latent_dim,
                pooling=task_encoder.removeprefix("set_"),
                num_cells=num_cells,
            )
        else:
            self.task_encoder = make_task_encoder(*dims, task_latent_dim, num_cells=num_cells)
        self.context_encoder = (
            make_context_encoder(
                *dims, task_latent_dim, num_features=INFERENCE_FEATURES, num_cells=num_cells
            )
            if infers
            else None
        )
        self.task_classifier = make_task_classifier(num_tasks, task_latent_dim)
        self.generator = make_decoder(
            *dims, latent_dim, task_latent_dim=task_latent_dim, num_cells=num_cells
        )
        self.qvalue_network = make_qvalue_network(
            *dims, task_latent_dim=task_latent_dim, num_cells=num_cells
        )
        self.register_buffer("prototypes", torch.zeros(num_tasks, task_latent_dim))

    @torch.no_grad()
    def embed(self, data: TensorDictBase) -> Tensor:
        """Returns the embedding of each transition, ``(*B, task_latent_dim)``.

        Args:
            data: batch ``[*B]`` with the encoder's inputs: a transition, or ``task``.

        Raises:
            BMRLError: for an encoder of sets, which has no embedding of one transition.
        """
        if reads_context(self.task_encoder):
            raise BMRLError("the encoder reads sets of transitions; valid: embed_context")
        return self.task_encoder(data.select(*self.task_encoder.in_keys)).get("task_latent")

    def set_codes(self, codes: Sequence[Sequence[float]]) -> None:
        """Sets what the encoder ``"told"`` writes.

        Args:
            codes: numbers of each task, ``(num_tasks, code_dim)``.

        Raises:
            BMRLError: for another shape.
        """
        held = cast(Tensor, self.task_encoder.module.codes)
        table = torch.tensor(codes, dtype=held.dtype)
        if table.shape != held.shape:
            raise BMRLError(f"codes are of shape {tuple(table.shape)}; valid: {tuple(held.shape)}")
        held.copy_(table)

    def set_scales(self, *datasets: TensorDictBase) -> None:
        """Tells the encoders of sets how large rewards and steps are.

        Args:
            *datasets: transitions of all tasks and behaviours, ``[N_i]`` each.
        """
        for encoder in (self.task_encoder, self.context_encoder):
            if encoder is not None and reads_context(encoder):
                cast(ContextNetwork, encoder.module).set_scales(*datasets)

    def check_embeds(self, what: str) -> None:
        """Checks that single transitions have an embedding.

        Args:
            what: what needs it, for the message.

        Raises:
            ConfigError: for an encoder of sets.
        """
        if reads_context(self.task_encoder):
            raise ConfigError(
                f"{what} needs m of single transitions, and the policy's encoder reads sets of "
                "them; valid: a policy trained with distill.task_encoder=transition"
            )

    def embed_context(self, context: TensorDictBase) -> Tensor:
        """Returns the embedding m of a set of transitions of one task, ``(*B, task_latent_dim)``.

        The task need not be one of those that the student was trained on.

        Args:
            context: normalised transitions, batch ``[*B, K]``.

        Raises:
            BMRLError: as :func:`~torchrl_bmrl.modules.embed_context`.
        """
        return embed_context(self.task_encoder, context)

    def infer(self, context: TensorDictBase) -> Tensor:
        """Returns m of a set of transitions of any behaviour, ``(*B, task_latent_dim)``.

        :meth:`embed_context` reads the task from what a demonstrator does. This reads it from
        rewards and motion, if the student was trained with ``infers``; else it is the same.

        Args:
            context: normalised transitions, batch ``[*B, K]``.

        Raises:
            BMRLError: as :func:`~torchrl_bmrl.modules.embed_context`.
        """
        return embed_context(self.context_encoder or self.task_encoder, context)

    @torch.no_grad()
    def set_prototypes(self, datasets: Sequence[TensorDictBase], kind: str) -> None:
        """Computes each task's prototype from its training data.

        Args:
            datasets: one batch ``[N_i]`` per task, in the order of the tasks.
            kind: ``"mean"`` or ``"medoid"``, see :func:`torchrl_bmrl.modules.prototype`.

        Raises:
            BMRLError: for another kind, or a task without data.
        """
        if reads_context(self.task_encoder):
            points = [self.embed_context(data) for data in datasets]
        else:
            points = [prototype(self.embed(data), kind) for data in datasets]
        self.prototypes.copy_(torch.stack(points))

    @torch.no_grad()
    def accuracy(self, data: TensorDictBase) -> float:
        """Returns the classifier's accuracy, in [0, 1]; with an encoder of sets over whole tasks.

        Args:
            data: batch ``[N]`` with the encoder's inputs and the class index ``task (N,)``.
        """
        task = data.get("task")
        if reads_context(self.task_encoder):
            task = task.unique()
            latent = torch.stack([self.embed_context(data[data.get("task") == i]) for i in task])
        else:
            latent = self.embed(data)
        encoded = TensorDict({"task_latent": latent}, batch_size=task.shape)
        logits = self.task_classifier(encoded).get("task_logits")
        return (logits.argmax(-1) == task).float().mean().item()

    def policy(self, *, num_candidates: int, latent_clip: float | None) -> BCQPolicy:
        """Returns the distilled policy, which reads ``task_latent`` and shares the networks.

        Args:
            num_candidates: proposals per state, at least 1.
            latent_clip: bound on ``action_latent``, ``None`` for none.

        Raises:
            BMRLError: for ``num_candidates`` below one.
        """
        return BCQPolicy(
            self.generator,
            self.qvalue_network,
            latent_dim=self.latent_dim,
            num_candidates=num_candidates,
            latent_clip=latent_clip,
        )

    def task_latent_source(
        self, source: str, task: int, demonstration: TensorDictBase | None = None
    ) -> Transform:
        """Returns the transform that writes ``task_latent`` while the policy acts.

        Args:
            source: ``"prototype"``, ``"online"`` or ``"demonstration"``. With an encoder of sets
                the context grows online, and a demonstration is one context.
            task: class index.
            demonstration: transitions of one episode, batch ``[T]``, for the last source.

        Raises:
            UnknownNameError: for another source.
            BMRLError: without the demonstration that the last source needs, for an encoder that
                reads no transitions, and as :class:`~torchrl_bmrl.modules.DemonstrationTaskLatent`.
        """
        if source == "prototype":
            return PrototypeTaskLatent(self.prototypes[task])
        if source == "demonstration" and demonstration is None:
            raise BMRLError("the source demonstration has none; valid: transitions of one episode")
        sets = reads_context(self.task_encoder)
        if source == "online":
            kind = ContextTaskLatent if sets else OnlineTaskLatent
            return kind(self.prototypes[task], self.context_encoder or self.task_encoder)
        if source == "demonstration":
            assert demonstration is not None
            if sets:
                return PrototypeTaskLatent(self.embed_context(demonstration))
            return DemonstrationTaskLatent(demonstration, self.task_encoder)
        raise UnknownNameError("latent source", source, LATENT_SOURCES)


def make_distillation_loss(
    student: Student,
    teachers: Sequence[BCQPolicy],
    *,
    classification_weight: float | None = 1.0,
    **options: Any,
) -> MetaDistillationLoss:
    """Returns the loss that distils teachers, one per task, into a student without copying it.

    Args:
        student: student for as many tasks as there are teachers.
        teachers: trained agents, for example from :meth:`BCQPolicy.frozen`.
        classification_weight: as :class:`MetaDistillationLoss`; ``None`` for no classifier.
        **options: options of :class:`MetaDistillationLoss` except those of the latent.

    Raises:
        BMRLError: for options that :class:`MetaDistillationLoss` refuses.

    Example:
        >>> from torchrl_bmrl.pipeline.agents import make_bcq_loss
        >>> sizes = {"observation_dim": 3, "action_dim": 2}
        >>> teachers = [BCQPolicy.frozen(make_bcq_loss(**sizes)) for _ in range(2)]
        >>> make_distillation_loss(Student(num_tasks=2, **sizes), teachers).num_tasks
        2
    """
    classifies = classification_weight is not None
    if classification_weight is not None:
        options["classification_weight"] = classification_weight
    return MetaDistillationLoss(
        student.task_encoder,
        student.task_classifier if classifies else None,
        student.generator,
        student.qvalue_network,
        [teacher.generator for teacher in teachers],
        [teacher.qvalue_network for teacher in teachers],
        latent_dim=teachers[0].latent_dim,
        latent_clip=teachers[0].latent_clip,
        **options,
    )


INFERENCE_FEATURES = 128
"""Size of the embedding of one transition in the encoder of any behaviour."""
LATENT_SOURCES = ("prototype", "online", "demonstration")
OF_SETS = ("set_mean", "set_attention")
TASK_ENCODERS = ("transition", *OF_SETS, "one_hot", "told", "nothing")


def load_student(path: Path) -> tuple[Student, dict[str, Any]]:
    """Loads a distilled student and its checkpoint's metadata.

    Args:
        path: the checkpoint.

    Returns:
        the student and the metadata with valid ``tasks``, ``latent_clip``, ``accuracy`` and
        ``statistics``.

    Raises:
        CheckpointError: if the file is missing, damaged, of another kind or of other shapes, or its
            metadata are not valid.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.training.checkpoint import save_checkpoint
        >>> path = Path(tempfile.mkdtemp()) / "a.safetensors"
        >>> options = {"num_tasks": 1, "observation_dim": 33, "action_dim": 7}
        >>> metadata = {"kind": "student", "student": options, "tasks": ["lift"], "accuracy": 0.99}
        >>> metadata |= {"latent_clip": 0.5, "statistics": {"loc": [0.0] * 33, "scale": [1.0] * 33}}
        >>> save_checkpoint(path, {"module": Student(**options).state_dict()}, metadata)
        >>> student, metadata = load_student(path)
        >>> metadata["tasks"]
        ['lift']
    """
    state, metadata = load_checkpoint(path, kind="student")
    metadata["student"] = with_sizes(metadata.get("student"))
    student = build(Student, metadata["student"], state, path)
    number = len(student.prototypes)
    valid: dict[str, tuple[Callable[[Any], bool], str]] = {
        "tasks": (
            lambda x: isinstance(x, list) and all(map(is_task_name, x)) and len(set(x)) == number,
            f"{number} different names, one per prototype",
        ),
        "latent_clip": (lambda x: x is None or (is_number(x) and x > 0), "a number above 0, null"),
        "accuracy": (
            lambda x: x is None or (is_number(x) and 0 <= x <= 1),
            "a number between 0 and 1, or null without a classifier",
        ),
        "statistics": (
            lambda x: are_statistics(x, metadata["student"]["observation_dim"]),
            "loc and scale, a number for each of the observation, scale above 0",
        ),
    }
    for key, (holds, what) in valid.items():
        if not holds(metadata.get(key)):
            raise CheckpointError(
                path, f"{key} is {reprlib.repr(metadata.get(key))}; valid: {what}"
            )
    return student, metadata
