"""Stage 2: distils the agents of all tasks into one policy, conditioned on a learned embedding."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.optim import Adam

from torchrl_bmrl.data import make_multi_task_replay_buffer, with_previous
from torchrl_bmrl.functional import nonzero_scale
from torchrl_bmrl.modules import BCQPolicy, reads_context
from torchrl_bmrl.modules.scales import unmarked
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS
from torchrl_bmrl.objectives import ContextInferenceLoss
from torchrl_bmrl.pipeline.context_data import ContextSampler
from torchrl_bmrl.pipeline.learners import sizes_of
from torchrl_bmrl.pipeline.rewards import models_for_contexts
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.settings import DistillSettings
from torchrl_bmrl.pipeline.student import Student, make_distillation_loss
from torchrl_bmrl.pipeline.training import make_update
from torchrl_bmrl.pipeline.training_data import deviation
from torchrl_bmrl.run.loggers import close_logger, log_metrics, make_logger
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.training.checkpoint import resume_training, save_training
from torchrl_bmrl.training.fit import Every, fit
from torchrl_bmrl.training.health import check_metrics, check_proposals, largest_metric
from torchrl_bmrl.training.update import (
    accelerate,
    decay,
    gradient_step,
    keep_freed_memory,
    make_adam,
)

log = logging.getLogger(__name__)

OF_THE_STUDENT = ("task_encoder", "task_latent_dim", "num_cells")
OF_THE_TRAINING = (
    "updates",
    "inference_updates",
    "reward_updates",
    "batch_size",
    "lr",
    "cosine",
    "normalise_qvalue",
    "prototype",
)


def stage2(run: Run, *, beside: Sequence[tuple[Callable[..., Any], Any]] = ()) -> None:
    """Trains the student of the run's agents, or resumes from its checkpoint.

    Args:
        run: an open run, with the agents of every task.
        beside: ``(function, job)``, work for the run's other workers, which call
            ``function((run, job), report)``; the student is trained in a worker, too, then.

    Raises:
        ConfigError: for agents that propose chunks of actions, or terms that compare tasks if
            there is only one.
        BMRLError: if an agent is missing, or the training diverges.

    Example:
        >>> from torchrl_bmrl.pipeline import Settings
        >>> stage2(Run(Settings(tasks=["reach"])))
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: runs/mine is not open; valid: with Run(settings) as run: ...
    """
    run.settings.check_distillation(run.names)
    run.jobs(
        _call,
        [(train_student, StudentJob(run.settings.distill, "distill")), *beside],
        workers=None if beside else 1,
        total=all_updates(run.settings.distill),
        description="stage 2: distilling",
        unit="update",
    )


def _call(job: tuple[Run, tuple[Callable[..., Any], Any]], report: Report) -> None:
    run, (function, of_it) = job
    # The progress is the student's; the others only say that they go on.
    function((run, of_it), report if function is train_student else lambda units: report(0))


def value_statistics(
    teachers: list[BCQPolicy], datasets: list[TensorDictBase]
) -> tuple[Tensor, Tensor]:
    """Returns mean and deviation of each teacher's value on its own data, ``(num_tasks,)``."""
    values = [
        teacher.qvalue_network(data.select("observation", "action")).get("state_action_value")
        for teacher, data in zip(teachers, datasets, strict=True)
    ]
    return torch.stack([v.mean() for v in values]), torch.stack([deviation(v) for v in values])


@torch.no_grad()
def advantage_scale(
    teachers: list[BCQPolicy], datasets: list[TensorDictBase], qvalue_scale: Tensor | None
) -> Tensor:
    """Returns the deviation of each teacher's value among the proposals of a state.

    Args:
        teachers: one per task.
        datasets: the states, ``[N_i]`` each; of 1024 and more, 512 to 1023 are used.
        qvalue_scale: deviations that the values are divided by; ``None`` for 1.

    Returns:
        ``(num_tasks,)``; 1 where all proposals have one value.
    """
    scales = []
    for teacher, data in zip(teachers, datasets, strict=True):
        states = data[:: max(1, len(data) // 512)].select("observation")
        value = teacher.qvalue_network(teacher.propose(states)).get("state_action_value")
        spread = value.var(-2).mean().sqrt()
        scales.append(nonzero_scale(spread, value.abs().max(), value.dtype))
    scale = torch.stack(scales)
    return scale if qvalue_scale is None else scale / qvalue_scale


def all_updates(distill: DistillSettings) -> int:
    """Returns the number of all updates of stage 2."""
    return distill.updates + distill.inference_updates + distill.reward_updates


@dataclass(frozen=True)
class StudentJob:
    """A student to train.

    Attributes:
        settings: of stage 2.
        folder: of its checkpoint, below the run's folder.
    """

    settings: DistillSettings
    folder: str


def loss_options(settings: DistillSettings) -> dict[str, Any]:
    """Returns the settings that are options of :class:`.MetaDistillationLoss`."""
    others = OF_THE_STUDENT + OF_THE_TRAINING
    return {name: x for name, x in vars(settings).items() if name not in others}


def make_sampler(
    run: Run, distill: DistillSettings, train: list[TensorDictBase]
) -> Callable[[], TensorDictBase]:
    """Returns a function that returns a batch ``[num_tasks, batch_size]``, with its context.

    Args:
        run: the run.
        distill: settings of stage 2. With ``context="given"`` each row has a transition under
            ``"context"``: in a third of the batches a task's are demonstrations alone, in a third
            another behaviour's alone, in the others both.
        train: the demonstrations, ``[N_i]`` each.
    """
    options: dict[str, Any] = {"batch_size": distill.batch_size, "device": run.settings.device}
    buffer = make_multi_task_replay_buffer(train, **options)
    if distill.context != "given":
        return buffer.sample
    own = [data.select(*TRANSITION_KEYS) for data in train]
    others = [run.transitions(name, "context").select(*TRANSITION_KEYS) for name in run.names]
    buffers = [make_multi_task_replay_buffer(data, **options) for data in (own, others)]

    def sample() -> TensorDictBase:
        # With a single demonstrated transition the encoder does not have to look at rewards.
        first, second = (contexts.sample().exclude("index") for contexts in buffers)
        share = (3 * torch.rand(len(train), 1, device=first.device) - 1).clamp(0, 1)
        chosen = torch.rand(first.batch_size, device=first.device) < share
        return buffer.sample().set("context", torch.where(chosen, first, second))

    return sample


def warn_of_marks(train: list[TensorDictBase]) -> None:
    """Warns if agents of one task have not seen the states of another, in which mixing asks them.

    Args:
        train: the demonstrations of each task, ``[N_i]``.
    """
    read = unmarked(*train)
    if (marks := int((read == 0).sum())) > 0:
        log.warning(
            "distill.mixing_fraction asks agents of other tasks in a task's states, and at the "
            "start %d of %d numbers of the observation differ between the tasks; valid where these "
            "numbers do not matter to the agents, otherwise 0",
            marks,
            len(read),
        )


def train_student(job: tuple[Run, StudentJob], report: Report) -> None:
    """Trains a student, or resumes from its checkpoint."""
    run, student_job = job
    keep_freed_memory()
    settings, distill = run.settings, student_job.settings
    train, valid = (
        [run.transitions(name, split) for name in run.names] for split in ("train", "valid")
    )
    if distill.context == "previous":
        train = [with_previous(data, TRANSITION_KEYS) for data in train]
    torch.manual_seed(run.seed("batches"))  # a buffer that prefetches draws from it
    sample = make_sampler(run, distill, train)
    if distill.mixing_fraction:
        warn_of_marks(train)
    largest = largest_metric(*(data["next", "reward"] for data in train))

    torch.manual_seed(run.seed("distill"))
    losses = [run.teacher(name) for name in run.names]
    teachers = [BCQPolicy.frozen(loss) for loss in losses]
    options = {
        "num_tasks": len(run.names),
        **{name: getattr(distill, name) for name in OF_THE_STUDENT},
        "latent_dim": teachers[0].latent_dim,
        **({"code_dim": len(run.codes()[0])} if distill.task_encoder == "told" else {}),
        **({"infers": True} if distill.inference_updates else {}),
        **sizes_of(train[0]),
    }
    student = Student(**options)
    if distill.task_encoder == "told":
        student.set_codes(run.codes())
    others = (
        [run.transitions(name, "context") for name in run.names]
        if distill.inference_updates
        else []
    )
    student.set_scales(*train, *others)
    student.to(settings.device)  # its buffers, too; the loss would move its parameters alone
    normalisation = value_statistics(teachers, train) if distill.normalise_qvalue else (None, None)
    loss = make_distillation_loss(
        student,
        teachers,
        qvalue_loc=normalisation[0],
        qvalue_scale=normalisation[1],
        advantage_scale=advantage_scale(teachers, train, normalisation[1])
        if distill.advantage_weight
        else None,
        reward_scale=torch.stack([deviation(data["next", "reward"]) for data in train]),
        **loss_options(distill),
    ).to(settings.device)
    optimizers = {"student": make_adam(loss.parameters(), lr=distill.lr)}
    if student.context_encoder is not None:
        optimizers["inference"] = make_adam(student.context_encoder.parameters(), lr=distill.lr)
    path = run.folder / student_job.folder / "checkpoint.safetensors"
    saved = resume_training(path, student, optimizers, kind="student", device=settings.device)
    done = saved["updates"] if saved else 0
    if done:
        log.debug("distillation: resumed from update %d", done)
        report(done)
    end = distill.updates + distill.inference_updates
    if done == end:
        if distill.reward_updates:
            report(distill.reward_updates)
        return
    accelerated = accelerate(
        make_update(loss, optimizers["student"]),
        compiled=settings.compile,
        captured=settings.cudagraphs,
        device=settings.device,
    )

    def step(number: int, batch: TensorDictBase) -> dict[str, Tensor]:
        if distill.cosine:
            decay(optimizers["student"], distill.lr, number, distill.updates)
        return accelerated(batch.select(*loss.in_keys))

    def check(
        number: int, metrics: dict[str, Tensor], batch: TensorDictBase, logging: bool
    ) -> None:
        where = f"distillation, update {number}"
        check_metrics(metrics, where, largest=largest)
        some = batch[:, :32]
        proposed = proposals(student, some, teachers[0].latent_clip, settings.device)
        check_proposals(proposed, some["action"], where)
        log_metrics(logger if logging else None, metrics, number)

    def check_inference(
        number: int, metrics: dict[str, Tensor], batch: TensorDictBase, logging: bool
    ) -> None:
        check_metrics(metrics, f"inference of m, update {number}")
        log_metrics(logger if logging else None, metrics, number)

    def save(number: int) -> None:
        own = student if settings.device == "cpu" else deepcopy(student).to("cpu")
        own.set_prototypes(train, distill.prototype)
        classifies = distill.classification_weight is not None
        accuracy = own.accuracy(torch.cat(valid)) if classifies else None
        metadata = {
            "kind": "student",
            "tasks": list(run.names),
            "student": options,
            "latent_clip": teachers[0].latent_clip,
            "updates": number,
            "accuracy": accuracy,
            "settings": settings.deciding(),
            "statistics": run.statistics.to_lists(),
        }
        save_training(
            path,
            own,
            optimizers,
            metadata,
            device=settings.device,
            keep=settings.keep_checkpoints,
        )
        said = "" if accuracy is None else f", accuracy {accuracy:.1%}"
        log.debug("distillation: update %d saved%s", number, said)

    with ExitStack() as stack:
        logger = make_logger(
            settings.logger, run.folder, student_job.folder.replace("/", "_"), done
        )
        stack.callback(close_logger, logger)
        options_of_fit: dict[str, Any] = {
            "every": Every(log=settings.log_interval, save=settings.checkpoint_interval),
            "save": save,
            "report": report,
        }
        if done < distill.updates:
            fit(step, sample, start=done, total=distill.updates, check=check, **options_of_fit)
        if distill.inference_updates:
            here = [data.to(settings.device) for data in train]
            student.set_prototypes(here, distill.prototype)
            models = None
            if distill.reward_updates:
                every = [torch.cat(both) for both in zip(train, others, strict=True)]
                models = models_for_contexts(run, student_job.folder, distill, every, report)
            contexts = ContextSampler(train, others, distill.context_size, models)
            inference = Inference(student, optimizers["inference"], distill)
            start = max(done, distill.updates)
            fit(
                inference.step,
                contexts,
                start=start,
                total=end,
                check=check_inference,
                **options_of_fit,
            )


class Inference:
    """Trains a student's encoder of any behaviour, after its policy is trained.

    Args:
        student: with prototypes.
        optimizer: of its ``context_encoder``.
        distill: settings of stage 2.
    """

    def __init__(self, student: Student, optimizer: Adam, distill: DistillSettings) -> None:
        assert student.context_encoder is not None
        self.optimizer, self.distill = optimizer, distill
        self.loss = ContextInferenceLoss(student.context_encoder, student.prototypes)

    def step(self, number: int, batch: TensorDictBase) -> dict[str, Tensor]:
        """Does the update of a number, which goes on after those of the distillation."""
        distill = self.distill
        if distill.cosine:
            decay(self.optimizer, distill.lr, number - distill.updates, distill.inference_updates)
        losses = self.loss(batch.to(self.loss.task_latents.device))
        gradient_step(self.optimizer, losses["loss_inference"])
        return {name: value.detach() for name, value in losses.items()}


@torch.no_grad()
def proposals(
    student: Student, batch: TensorDictBase, latent_clip: float | None, device: str
) -> Tensor:
    """Returns candidates of the student, ``(num_tasks, B, candidates, action_dim)``."""
    if reads_context(student.task_encoder):
        m = student.embed_context(batch).unsqueeze(1).expand(*batch.batch_size, -1)
    else:
        m = student.embed(batch)
    policy = student.policy(num_candidates=10, latent_clip=latent_clip)
    on_gpu = torch.device(device).type == "cuda"
    # Training draws the same random numbers with and without this check.
    with torch.random.fork_rng([torch.device(device)] if on_gpu else []):
        return policy.propose(batch.select("observation").set("task_latent", m))["action"]
