"""Multi-task batch RL with metric learning (MBML) as a TorchRL loss module."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl import functional
from torchrl_bmrl.context_keys import CONTEXT
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.objectives.checks import check_network, check_number
from torchrl_bmrl.objectives.context_rows import context_keys, encode_contexts
from torchrl_bmrl.objectives.contexts import Embedded, assign, group_rows, which_count
from torchrl_bmrl.objectives.data import next_key
from torchrl_bmrl.objectives.distillation import MetaDistillationLoss
from torchrl_bmrl.objectives.relabel import predict, read_reward
from torchrl_bmrl.objectives.task_rows import draw_partners


class MBMLLoss(MetaDistillationLoss):
    r"""Distils teachers, and separates tasks whose contexts differ in their rewards alone.

    Reference: Li, Vuong, Liu, Liu, Ciosek, Christensen and Su, *Multi-task Batch Reinforcement
    Learning with Metric Learning*, NeurIPS 2020, https://arxiv.org/abs/1909.11373, algorithm 2.

    Rewards of task j's transitions are relabelled by the models of task i, so that a context
    :math:`c_{j \to i}` differs from :math:`c_j` in its rewards and from :math:`c_i` in all else.
    The encoder M therefore has to read the task from the rewards. For each task i one other task j
    is drawn, and only transitions count whose predictions' standard deviation over the ensemble is
    below ``max_deviation``:

    .. math::
        L = w_g \lVert \hat g - g \rVert_2^2
          + w_q \left(\hat Q(s, \hat g, m) - \tilde Q_i(s, g)\right)^2 + w_m \lVert m \rVert_2^2
          + w_t \max(0, \lVert M(c_{j \to i}) - M(c_i) \rVert
            - \lVert M(c_{j \to i}) - M(c_j) \rVert + \alpha)

    with m = M(context), and a context of own transitions together with relabelled ones. The terms
    and symbols are those of :class:`~torchrl_bmrl.objectives.MetaDistillationLoss`, without a
    classifier. As published, the last two terms and the value train M, the action's does not.

    :attr:`published` has the settings of the published code (https://github.com/Ji4chenLi/Multi-
    Task-Batch-RL). Deviations from it: m is a point, where the publication has a product of
    Gaussians. So distances are Euclidean, not divergences (of Gaussians of unit variance a
    divergence is half the squared distance, so that of 2 is a distance of 2), and a penalty on m
    replaces the divergence from the prior. One other task is drawn for each task, not all. The
    critic is distilled at the student's action for a latent, not at the data's action, and
    normalised: published values are not, and outweigh the triplet's term. So try weights below the
    published 1, such as 0.1, if the actions do not follow m. Perturbation networks are not
    distilled. Rewards alone are relabelled, not next observations (published for Walker only).

    Args:
        task_encoder: M, of sets that contain the reward (``make_context_encoder``).
        student_generator, student_qvalue_network: as for ``MetaDistillationLoss``.
        teacher_generators, teacher_qvalue_networks: as for ``MetaDistillationLoss``.
        reward_models: trained by :class:`~torchrl_bmrl.objectives.RewardModelLoss`; copied, frozen.

    Keyword Args:
        triplet_weight, triplet_margin: w_t and α.
        max_deviation: largest standard deviation of a relabelled reward that counts, as a share of
            ``reward_scale``; published: 0.02 to 0.2 for rewards that are not scaled.
        context_size: largest number of own transitions in a context, and of relabelled ones.
        direction_weight: w_d of ``MetaDistillationLoss``, which the publication has not.
        encoder_terms: other terms whose gradient reaches M.
        **options: of ``MetaDistillationLoss``.

    Keys read and written: as ``MetaDistillationLoss``, and what the reward models read.

    Raises:
        BMRLError: as ``MetaDistillationLoss``, and for an encoder that does not read rewards of
            sets, or less than two tasks.

    Example:
        >>> from torchrl_bmrl import modules
        >>> loss = MBMLLoss(
        ...     modules.make_context_encoder(3, 2, 5, pooling="mean"),
        ...     modules.make_decoder(3, 2, 4, task_latent_dim=5),
        ...     modules.make_qvalue_network(3, 2, task_latent_dim=5),
        ...     [modules.ActionVAE(3, 2).decoder for _ in range(6)],
        ...     [modules.make_qvalue_network(3, 2) for _ in range(6)],
        ...     modules.make_reward_models(6, 3, 2),
        ...     latent_dim=4,
        ...     context_size=4,
        ... )
        >>> after = {"observation": torch.randn(6, 8, 3), "reward": torch.randn(6, 8, 1)}
        >>> data = {"observation": torch.randn(6, 8, 3), "action": torch.zeros(6, 8, 2)}
        >>> data |= {"task": torch.arange(6).unsqueeze(-1).expand(6, 8), "next": after}
        >>> losses = loss(TensorDict(data, batch_size=[6, 8]))
        >>> sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    """

    @dataclass
    class _AcceptedKeys(MetaDistillationLoss._AcceptedKeys):
        """Keys that ``set_keys`` can rename."""

        reward_prediction: NestedKey = "reward_prediction"  # the reward models' output

    default_keys = _AcceptedKeys
    frozen_networks = ("reward_models",)
    fixed_options = (
        "classification_weight",
        "metric_weight",
        "metric_margin",
        "distance_weight",
        "contrastive_weight",
        "temperature",
        "isometry_weight",
        "context",
        "context_fraction",
    )
    published: ClassVar[dict[str, Any]] = {
        "learning_rate": 3e-4,
        "updates": 100_000,
        "tasks_per_update": 10,  # all; Walker: 30
        "batch_size": 128,  # transitions of a task in an update
        "context_size": 64,  # own transitions, and as many relabelled ones
        "task_latent_dim": 20,
        "encoder_num_cells": (200, 200, 200),
        "generator_num_cells": (1024,) * 7,
        "qvalue_num_cells": (1024,) * 9,
        "perturbation_num_cells": (1024,) * 8,
        "triplet_weight": 1.0,
        "triplet_margin": 2.0,
        "prior_divergence_weight": 0.1,
        "reward_models": 20,
        "reward_model_num_cells": (128,),
        "reward_model_updates": 4000,
        "max_deviation": 0.1,  # half cheetah 0.05, humanoid 0.2, maze 0.02
        "num_candidates": 10,  # of the policy
    }
    """Settings of the published code."""

    _schedulable_buffers = MetaDistillationLoss._schedulable_buffers | {"triplet_weight"}
    reward_models: TensorDictModule
    reward_models_params: TensorDictParams
    target_reward_models_params: TensorDictParams

    def __init__(
        self,
        task_encoder: TensorDictModule,
        student_generator: TensorDictModule,
        student_qvalue_network: TensorDictModule,
        teacher_generators: Sequence[TensorDictModule],
        teacher_qvalue_networks: Sequence[TensorDictModule],
        reward_models: TensorDictModule,
        *,
        triplet_weight: float = 1.0,
        triplet_margin: float = 2.0,
        max_deviation: float = 0.1,
        direction_weight: float = 0.0,
        encoder_terms: Sequence[str] = ("qvalue",),
        context_size: int = 16,
        **options: Any,
    ) -> None:
        super().__init__(
            task_encoder,
            None,
            student_generator,
            student_qvalue_network,
            teacher_generators,
            teacher_qvalue_networks,
            direction_weight=direction_weight,
            encoder_terms=encoder_terms,
            context="set",
            context_fraction=1.0,
            context_size=context_size,
            **options,
        )
        if self.num_tasks < 2:
            raise BMRLError("the teachers are of one task; valid: two tasks or more")
        context_keys(task_encoder)  # for its check
        self.triplet_margin = check_number("triplet_margin", triplet_margin)
        self.max_deviation = check_number("max_deviation", max_deviation)
        check_network("reward_models", reward_models)
        frozen = deepcopy(reward_models).eval().requires_grad_(False)
        self.convert_to_functional(frozen, "reward_models", create_target_params=False)
        self.register_coefficients(triplet_weight=triplet_weight)
        self._in_keys = self._out_keys = None  # computed by the base without these parts
        self.keep_keys()

    def read_keys(self) -> list[NestedKey]:
        """What the base reads, the reward, and what the reward models read."""
        reward = next_key(self.tensor_keys.reward)
        made = self.__dict__.get("reward_models")  # the base's constructor has none yet
        return [*super().read_keys(), reward, *([] if made is None else made.in_keys)]

    def written_keys(self) -> list[str]:
        """The base's, then the triplet's loss."""
        return [*super().written_keys(), "loss_triplet"]

    # -- contexts --------------------------------------------------------------------------------

    def _embed(self, tensordict: TensorDictBase) -> Embedded:
        rows, valid = self._transitions(tensordict)
        contexts, own, filled = group_rows(rows, self.context_size, valid)
        relabelled, _ = self._relabelled(tensordict, rows, valid)
        both = torch.cat([contexts.get(CONTEXT), relabelled], -1)
        points = self._points(both, rows)
        latent = assign(points, own, filled, apart=True)
        return Embedded(latent, points, which_count(points.shape[1], filled))

    def _transitions(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor | None]:
        keys = context_keys(self.task_encoder)
        reward = next_key(self.tensor_keys.reward)
        if reward not in keys:
            raise BMRLError(
                f"task_encoder reads {keys} of a transition; valid: an "
                f"encoder that also reads {reward!r}"
            )
        valid = self.valid_rows(tensordict, tensordict.batch_size)
        rows = self._entries(tensordict, keys)
        read_reward(self, tensordict, valid)  # for its checks
        return rows, valid

    def _points(self, contexts: TensorDictBase, rows: TensorDictBase) -> Tensor:
        whole = TensorDict({CONTEXT: contexts}, batch_size=contexts.batch_size[:2])
        return encode_contexts(self, whole, rows)

    @torch.no_grad()
    def _relabelled(
        self, tensordict: TensorDictBase, rows: TensorDictBase, valid: Tensor | None
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Contexts of another task, ``[num_tasks, C, context_size]``: relabelled, and as they are.

        The mask of both has the transitions alone whose new reward counts, and may be empty.
        """
        device = rows.get(next_key(self.tensor_keys.reward)).device
        lender = draw_partners(self.num_tasks, device)
        read = self._entries(tensordict, self.reward_models.in_keys)[lender]
        prediction = predict(self, read, None)
        limit = self.max_deviation * self.reward_scale.unsqueeze(-1)
        counts = prediction.std(-1) <= limit
        counts = counts if valid is None else counts & valid[lender]
        lent = rows[lender].copy()
        # Both are grouped with the transitions that they belong to.
        lent.set("_reward", prediction.mean(-1, keepdim=True)).set("_counts", counts)
        grouped = group_rows(lent, self.context_size)[0].get(CONTEXT)
        reward, counts = grouped.pop("_reward"), grouped.pop("_counts")
        grouped.set("mask", grouped.get("mask") & counts)
        return grouped.copy().set(next_key(self.tensor_keys.reward), reward), grouped

    def _triplet_error(self, tensordict: TensorDictBase) -> Tensor:
        """Error of the relabelled contexts, ``(num_tasks, B)``: each row has its task's mean."""
        rows, valid = self._transitions(tensordict)
        contexts, _, filled = group_rows(rows, self.context_size, valid)
        positive = contexts.get(CONTEXT)
        anchor, negative = self._relabelled(tensordict, rows, valid)
        mask = anchor.get("mask")
        own, known = which_count(positive.shape[1], filled), mask.any(-1)
        mask = mask | ~known.unsqueeze(-1)  # an empty context must not be pooled
        parts = [anchor.copy().set("mask", mask), positive, negative.copy().set("mask", mask)]
        points, near, far = self._points(torch.cat(parts, 1), rows).chunk(3, 1)
        error = functional.triplet_error(points, near, far, self.triplet_margin)
        pairs = known if own is None else known & own
        error = torch.where(pairs, error, 0.0).sum(-1) / pairs.sum(-1).clamp(min=1)
        return error.unsqueeze(-1).expand(tensordict.batch_size)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the weighted terms; the class lists the keys.

        Raises:
            BMRLError: for data that do not fit.
        """
        losses = super().forward(tensordict)
        error = self.triplet_weight * self._triplet_error(tensordict)
        key, valid = self.tensor_keys.priority, self.valid_rows(tensordict, error.shape)
        own = functional.unpadded(error.detach(), valid)
        tensordict.set(key, tensordict.get(key) + own)
        return losses.set("loss_triplet", self.reduce(error, tensordict))
