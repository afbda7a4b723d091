"""What the teachers show a student: of each task, and of what lies between two."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_bmrl.functional import sample_action_latent
from torchrl_bmrl.objectives.task_rows import draw_partners

if TYPE_CHECKING:
    from torchrl_bmrl.objectives.distillation import MetaDistillationLoss


class Mix(NamedTuple):
    """Another task for each task, and how much of it each row gets."""

    partner: Tensor  # (num_tasks,)
    share: Tensor  # of the partner, (num_tasks, B, 1)

    def between(self, values: Tensor) -> Tensor:
        """Each row of ``(num_tasks, B, n)``, mixed with the same row of the partner."""
        return torch.lerp(values, values[self.partner], self.share)


def draw_mix(latent: Tensor, valid: Tensor | None, fraction: float) -> Mix:
    """Draws a shift of the tasks, and a share for a fraction of the rows; 0 for the others.

    Args:
        latent: m, ``(num_tasks, B, m)``.
        valid: which rows count; a row is not mixed with one that does not.
        fraction: of the rows that are mixed.
    """
    partner = draw_partners(len(latent), latent.device)
    share = torch.rand_like(latent[..., :1])
    mixed = torch.rand_like(share) < fraction
    if valid is not None:
        mixed = mixed & valid[partner].unsqueeze(-1)
    return Mix(partner, torch.where(mixed, share, 0.0))


def taught_by(
    loss: MetaDistillationLoss, tensordict: TensorDictBase, mix: Mix | None = None
) -> TensorDictBase:
    """States, fresh latents, and the teachers' actions and normalised values for them.

    Args:
        loss: the loss.
        tensordict: its data.
        mix: of each task with another, whose teacher sees the same states and latents; ``None``
            for each task alone.
    """
    keys = loss.tensor_keys
    shape = (*tensordict.batch_size, loss.latent_dim)
    like = loss._type_and_device
    latent = sample_action_latent(shape, latent_clip=loss.latent_clip, **like)
    taught = _valued(loss, demonstrate(loss, tensordict, latent))
    if mix is None:
        return taught
    asked = taught.select(*loss._teacher_observation_keys, keys.action_latent)
    # The rows of a task go to its partner's teacher, and the answers come back.
    asked = asked[mix.partner.argsort()]
    answers = _valued(loss, _ask(loss, loss.teacher_generators, asked))[mix.partner]
    for key in (keys.action, keys.state_action_value):
        taught.set(key, torch.lerp(taught.get(key), answers.get(key), mix.share))
    return taught


def demonstrate(
    loss: MetaDistillationLoss, tensordict: TensorDictBase, latent: Tensor
) -> TensorDictBase:
    """States, latents, and the actions that the teachers decode from them.

    Args:
        loss: the loss.
        tensordict: its data.
        latent: ``action_latent``, ``(num_tasks, B, latent_dim)``.
    """
    data = loss._entries(tensordict, loss._teacher_observation_keys)
    data = data.copy().set(loss.tensor_keys.action_latent, latent)
    return _ask(loss, loss.teacher_generators, data)


def _valued(loss: MetaDistillationLoss, data: TensorDictBase) -> TensorDictBase:
    """The same with the normalised values of the actions."""
    key = loss.tensor_keys.state_action_value
    data = _ask(loss, loss.teacher_qvalue_networks, data)
    value = data.get(key) - loss.qvalue_loc[:, None, None]
    return data.set(key, value / loss.qvalue_scale[:, None, None])


def _ask(loss: MetaDistillationLoss, teachers: Any, data: TensorDictBase) -> TensorDictBase:
    return teachers(data, randomness=loss.vmap_randomness, loop=loss.deactivate_vmap)
