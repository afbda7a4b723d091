"""Parts of the distillation: m of sets of rows, and terms that compare pairs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F

from torchrl_bmrl import functional
from torchrl_bmrl.context_keys import CONTEXT, transition_keys
from torchrl_bmrl.contrast import contrastive_error, distance_error
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.context_rows import encode_contexts
from torchrl_bmrl.objectives.contexts import Embedded, assign, group_rows, which_count
from torchrl_bmrl.objectives.data import entry, next_key
from torchrl_bmrl.objectives.lessons import Mix, demonstrate
from torchrl_bmrl.objectives.task_rows import draw_others, draw_rows

if TYPE_CHECKING:
    from torchrl_bmrl.objectives.distillation import MetaDistillationLoss


def isometry(loss: MetaDistillationLoss, tensordict: TensorDictBase, alone: Tensor) -> Tensor:
    """Isometry error of each row's m to the other rows of its task, ``(num_tasks, B)``.

    Args:
        loss: the loss.
        tensordict: its data.
        alone: m of each row's own transition, ``(num_tasks, B, m)``: a set has no reward and action
            of its own.
    """
    valid = loss.valid_rows(tensordict, tensordict.batch_size)
    reward = entry(tensordict, next_key(loss.tensor_keys.reward), valid)
    # The latent 0 gives the demonstrator's action without its noise.
    centre = loss.qvalue_loc.new_zeros(*tensordict.batch_size, loss.latent_dim)
    with torch.no_grad():
        action = demonstrate(loss, tensordict, centre).get(loss.tensor_keys.action)
    content = torch.cat([reward / loss.reward_scale[:, None, None], action], -1)
    return functional.isometry_error(alone, content, valid)


def advantage(
    loss: MetaDistillationLoss,
    tensordict: TensorDictBase,
    value: Tensor,
    target: Tensor,
    m: Tensor,
    mix: Mix | None,
) -> Tensor:
    """Error of each row's difference in value between its latent and another, ``(num_tasks, B)``.

    Args:
        loss: the loss.
        tensordict: its data.
        value: the student's value of each row's own latent, ``(num_tasks, B, 1)``.
        target: the teachers', normalised.
        m: embedding of each row, which receives a gradient if it needs one.
        mix: of the tasks, as for the target.
    """
    keys, taught = loss.tensor_keys, loss.teach(tensordict, mix)
    states = taught.select(*loss._teacher_observation_keys)
    given = {keys.action_latent: taught.get(keys.action_latent), keys.task_latent: m}
    with torch.no_grad():
        action = loss._run("student_generator", states, keys.action, None, given)
    given, key = {keys.action: action, keys.task_latent: m}, keys.state_action_value
    other = loss._run("student_qvalue_network", states, key, target, given)
    error = (value - other) - (target - taught.get(key))
    return (error.squeeze(-1) / loss.advantage_scale[:, None]).square()


def check_options(
    loss: MetaDistillationLoss, isometry_weight: float, arranging: Sequence[float]
) -> None:
    """Checks that the options fit the number of tasks and what the encoder reads.

    Args:
        loss: the loss.
        isometry_weight: of the isometry term.
        arranging: weights of the terms that compare tasks.

    Raises:
        BMRLError: naming the option.
    """
    if any(arranging) and loss.num_tasks < 2:
        raise BMRLError(
            "metric_weight, distance_weight, contrastive_weight and mixing_fraction need at least "
            "two tasks"
        )
    if not loss.reads_sets:
        if loss.context == "given":
            raise BMRLError("context is given; valid with an encoder of sets of transitions alone")
        return
    wrong = {
        "context": (loss.context, loss.context in ("set", "given"), "set or given"),
        "context_fraction": (loss.context_fraction, loss.context_fraction == 1, "1"),
        "isometry_weight": (isometry_weight, not isometry_weight, "0"),
    }
    for name, (value, fits, valid) in wrong.items():
        if not fits:
            raise BMRLError(
                f"{name} is {value}, and the encoder reads sets of transitions; valid: {valid}"
            )


def classify(
    loss: MetaDistillationLoss, latent: Tensor, task: Tensor, valid: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Cross-entropy of each row's class, ``(num_tasks, B)``, and the accuracy, ``()``."""
    keys = loss.tensor_keys
    like = latent.new_empty(*task.shape, loss.num_tasks)
    data = TensorDict({keys.task_latent: latent}, batch_size=task.shape)
    logits = loss._run("task_classifier", data, keys.task_logits, like=like)
    flat = F.cross_entropy(logits.flatten(0, 1), task.flatten().long(), reduction="none")
    right = (logits.argmax(-1) == task).to(logits.dtype)
    return flat.view_as(task), functional.average(right, valid)


def encoded_keys(loss: MetaDistillationLoss) -> list[NestedKey]:
    """Keys of the data that m is computed from."""
    keys = list(loss.task_encoder.in_keys)
    if not loss.reads_sets:
        previous = [unravel_key((loss.tensor_keys.previous, key)) for key in keys]
        return keys + previous * (loss.context == "previous")
    inner = transition_keys(loss.task_encoder)
    return [unravel_key((CONTEXT, key)) for key in inner] if loss.context == "given" else inner


def encode_previous(loss: MetaDistillationLoss, tensordict: TensorDictBase) -> Tensor:
    """m of the transition before each row's.

    Raises:
        BMRLError: for data without ``"previous"``.
    """
    name = loss.tensor_keys.previous
    if tensordict.get(name, None) is None:
        raise BMRLError(
            f"the data have no {name!r}, which context='previous' reads; valid: data of "
            "torchrl_bmrl.data.with_previous, or the context current, random or set"
        )
    return loss._encode(tensordict, under=name)


def embedded(loss: MetaDistillationLoss, tensordict: TensorDictBase) -> Embedded:
    """m of each row, and the points that the arranging terms compare."""
    return embed_sets(loss, tensordict) if loss.reads_sets else embed_rows(loss, tensordict)


def embed_rows(loss: MetaDistillationLoss, tensordict: TensorDictBase) -> Embedded:
    """m of each row from single transitions."""
    alone, valid = loss._encode(tensordict), loss.valid_rows(tensordict, tensordict.batch_size)
    if loss.context == "current":
        return Embedded(alone, alone, valid, alone)
    if loss.context == "previous":
        other = encode_previous(loss, tensordict)
    else:
        # The other rows of a task are draws from its data, and so are its context.
        size = loss.context_size if loss.context == "set" else 1
        other = draw_rows(alone, valid, size).mean(2)
    chosen = torch.rand(alone.shape[:2], device=alone.device) < loss.context_fraction
    latent = torch.where(chosen.unsqueeze(-1), other, alone)
    return Embedded(latent, latent, valid, alone)


def embed_sets(loss: MetaDistillationLoss, tensordict: TensorDictBase) -> Embedded:
    """m of each row from a random set of its task, and m of the sets.

    The sets are groups of the batch's own rows, and a row is not in its set; or groups of the rows
    under ``"context"``, which may be of another behaviour.
    """
    under = CONTEXT if loss.context == "given" else ()
    valid = loss.valid_rows(tensordict, tensordict.batch_size)
    rows = loss._entries(tensordict, transition_keys(loss.task_encoder), under=under)
    contexts, own, filled = group_rows(rows, loss.context_size, valid)
    points = encode_contexts(loss, contexts, rows, under)
    latent = assign(points, own, filled, apart=not under)
    return Embedded(latent, points, which_count(points.shape[1], filled))


def arranging_errors(
    loss: MetaDistillationLoss, points: Tensor, valid: Tensor | None, batch: torch.Size
) -> dict[str, Tensor]:
    """Errors that pull embeddings of a task together and push those of different tasks apart.

    Args:
        loss: the loss.
        points: embeddings, ``(num_tasks, n, m)``.
        valid: which of them count, ``(num_tasks, n)``; ``None`` if all do.
        batch: shape of the rows, ``[num_tasks, B]``.

    Returns:
        for each term with a weight ``(num_tasks, B)``; of sets each row has its task's mean.
    """
    weights = (loss.metric_weight, loss.distance_weight, loss.contrastive_weight)
    if all(weight is None for weight in weights):
        return {}
    near, far = draw_others(points, valid)
    errors = {}
    if loss.metric_weight is not None:
        errors["metric"] = functional.triplet_error(points, near, far, loss.metric_margin)
    if loss.distance_weight is not None:
        errors["distance"] = distance_error(points, near, far)
    if loss.contrastive_weight is not None:
        compared = None if valid is None else valid.any(1)
        errors["contrastive"] = contrastive_error(points, near, loss.temperature, compared)
    if not loss.reads_sets:
        return errors
    count = torch.ones_like(points[..., 0]) if valid is None else valid.to(points.dtype)
    share = count / count.sum(1, keepdim=True).clamp(min=1)
    means = {term: (share * error).sum(1, keepdim=True) for term, error in errors.items()}
    return {term: mean.expand(batch) for term, mean in means.items()}
