"""Terms of the distillation that compare pairs: rows of a task, and latents of a state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl import functional
from torchrl_bmrl.objectives.data import entry, next_key

if TYPE_CHECKING:
    from torchrl_bmrl.objectives.distillation import MetaDistillationLoss


def isometry(loss: MetaDistillationLoss, tensordict: TensorDictBase) -> Tensor:
    """Isometry error of each row's m to the other rows of its task, ``(num_tasks, B)``.

    Args:
        loss: the loss.
        tensordict: its data.
    """
    valid = loss.valid_rows(tensordict, tensordict.batch_size)
    reward = entry(tensordict, next_key(loss.tensor_keys.reward), valid)
    # The latent 0 gives the demonstrator's action without its noise.
    centre = loss.qvalue_loc.new_zeros(*tensordict.batch_size, loss.latent_dim)
    with torch.no_grad():
        action = loss._demonstrate(tensordict, centre).get(loss.tensor_keys.action)
    content = torch.cat([reward / loss.reward_scale[:, None, None], action], -1)
    # Not embed(): a set has no reward and action of its own.
    return functional.isometry_error(loss._encode(tensordict), content, valid)


def advantage(
    loss: MetaDistillationLoss,
    tensordict: TensorDictBase,
    value: Tensor,
    target: Tensor,
    m: Tensor,
) -> Tensor:
    """Error of each row's difference in value between its latent and another, ``(num_tasks, B)``.

    Args:
        loss: the loss.
        tensordict: its data.
        value: the student's value of each row's own latent, ``(num_tasks, B, 1)``.
        target: the teachers', normalised.
        m: embedding of each row, which receives a gradient if it needs one.
    """
    keys, taught = loss.tensor_keys, loss.teach(tensordict)
    states = taught.select(*loss._teacher_observation_keys)
    given = {keys.action_latent: taught.get(keys.action_latent), keys.task_latent: m}
    with torch.no_grad():
        action = loss._run("student_generator", states, keys.action, None, given)
    given, key = {keys.action: action, keys.task_latent: m}, keys.state_action_value
    other = loss._run("student_qvalue_network", states, key, target, given)
    error = (value - other) - (target - taught.get(key))
    return (error.squeeze(-1) / loss.advantage_scale[:, None]).square()
