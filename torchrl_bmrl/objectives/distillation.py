"""Meta-distillation: many frozen teachers into one student conditioned on a task embedding."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F
from torchrl.objectives.common import LossModule
from torchrl.objectives.utils import _vmap_func

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import (
    direction_error,
    sample_action_latent,
    squared_error,
)

REDUCTIONS = ("mean", "sum", "none")
CONTEXTS = ("current", "previous", "random", "set")


class MetaDistillationLoss(LossModule):
    r"""Distils one generator and one critic per task into a single pair conditioned on m.

    Reference: *Compositional Skill Learning Using Batch Meta RL*, section 6.2. With
    :math:`m = M(s, a, r, s')`, one latent z for teacher and student alike,
    :math:`g = G_i(s, z)`, :math:`\hat g = \hat G(s, z, m)`:

    .. math::
        L = w_c\, \mathrm{CE}(P(m), y) + w_g \lVert \hat g - g \rVert_2^2
          + w_d \left(1 - \frac{\hat g \cdot g}{\lVert\hat g\rVert \lVert g\rVert}\right)
          + w_q \left(\hat Q(s, \hat g, m) - \tilde Q_i(s, g)\right)^2
          + w_m \lVert m \rVert_2^2

    Deviations from the paper, each of which a weight or an argument turns off: the penalty on m
    (cross-entropy alone lets m grow without bound), :math:`\tilde Q_i = (Q_i - \mu_i)/\sigma_i`
    (the teachers' values differ in scale), and ``context`` (an acting policy does not have the
    present transition). :math:`\hat Q` is trained at :math:`\hat g` without a gradient into the
    student's generator.

    The teachers are frozen and run as one batched ensemble: row i of the data is task i.

    Args:
        task_encoder: M, (observation, action, next reward, next observation) → ``task_latent``.
        task_classifier: P, ``task_latent`` → ``task_logits``.
        student_generator: Ĝ, a decoder of observation, ``action_latent``, ``task_latent``.
        student_qvalue_network: Q̂, of observation, action, ``task_latent``.
        teacher_generators: one decoder per task (observation, ``action_latent`` → action).
        teacher_qvalue_networks: one critic per task.

    Keyword Args:
        latent_dim: size of ``action_latent``.
        latent_clip: bound on z; ``None`` for none. Default 0.5, as the teachers act.
        qvalue_loc: μ_i, ``(num_tasks,)``. Default 0.
        qvalue_scale: σ_i, ``(num_tasks,)``, positive. Default 1.
        classification_weight: w_c.
        generator_weight: w_g.
        direction_weight: w_d.
        qvalue_weight: w_q.
        latent_norm_weight: w_m.
        context: which transition m is computed from: ``"current"`` (the paper's), ``"previous"``
            (the one before it in the episode, under the key ``"previous"``), ``"random"`` (another
            one of the task in the batch) or ``"set"`` (the mean over ``context_size`` such).
        context_fraction: share of each batch whose m comes from ``context``; the rest is
            ``"current"``.
        context_size: transitions in a set.
        detach_task_latent: cross-entropy (and the penalty on m) alone train M.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.
        deactivate_vmap: run the teachers in a loop.
        use_prioritized_weights: as in TorchRL's losses.

    Keys read, batch ``[num_tasks, B]``: ``observation``, ``action``, ``("next", "reward")``,
    ``("next", "observation")``, ``task`` (class index, int64), and with ``context="previous"`` the
    same transition keys under ``"previous"``. Nothing is written to the input.

    Raises:
        BMRLError: for numbers of teachers that differ, an unknown context or a share or size of it
            out of range, data whose first dimension is not the number of teachers, or data without
            ``"previous"`` where the context needs it.

    Example:
        >>> from torchrl_bmrl.modules import (
        ...     ActionVAE,
        ...     make_decoder,
        ...     make_qvalue_network,
        ...     make_task_classifier,
        ...     make_task_encoder,
        ... )
        >>> loss = MetaDistillationLoss(
        ...     make_task_encoder(3, 2),
        ...     make_task_classifier(4),
        ...     make_decoder(3, 2, 4, task_latent_dim=2),
        ...     make_qvalue_network(3, 2, task_latent_dim=2),
        ...     [ActionVAE(3, 2).decoder for _ in range(4)],
        ...     [make_qvalue_network(3, 2) for _ in range(4)],
        ...     latent_dim=4,
        ... )
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(4, 8, 3),
        ...         "action": torch.rand(4, 8, 2) * 2 - 1,
        ...         "task": torch.arange(4).unsqueeze(-1).expand(4, 8),
        ...         "next": {"observation": torch.randn(4, 8, 3), "reward": torch.randn(4, 8, 1)},
        ...     },
        ...     batch_size=[4, 8],
        ... )
        >>> losses = loss(data)
        >>> sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename.

        Attributes:
            action: action of the data, and the decoders' output.
            action_latent: the VAE's z.
            task_latent: the embedding m.
            task_logits: the classifier's output.
            task: class index y.
            state_action_value: the critics' output.
            previous: where the previous transition lies.
            priority_weight: read from the input where present.
        """

        action: NestedKey = "action"
        action_latent: NestedKey = "action_latent"
        task_latent: NestedKey = "task_latent"
        task_logits: NestedKey = "task_logits"
        task: NestedKey = "task"
        state_action_value: NestedKey = "state_action_value"
        previous: NestedKey = "previous"
        priority: NestedKey = "priority"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = [  # noqa: RUF012 (TorchRL's convention)
        "loss_classification",
        "loss_generator",
        "loss_direction",
        "loss_qvalue",
        "loss_latent_norm",
        "accuracy",
        "latent_norm",
    ]

    task_encoder: TensorDictModule
    task_encoder_params: TensorDictParams
    target_task_encoder_params: TensorDictParams
    task_classifier: TensorDictModule
    task_classifier_params: TensorDictParams
    target_task_classifier_params: TensorDictParams
    student_generator: TensorDictModule
    student_generator_params: TensorDictParams
    target_student_generator_params: TensorDictParams
    student_qvalue_network: TensorDictModule
    student_qvalue_network_params: TensorDictParams
    target_student_qvalue_network_params: TensorDictParams

    def __init__(
        self,
        task_encoder: TensorDictModule,
        task_classifier: TensorDictModule,
        student_generator: TensorDictModule,
        student_qvalue_network: TensorDictModule,
        teacher_generators: Sequence[TensorDictModule],
        teacher_qvalue_networks: Sequence[TensorDictModule],
        *,
        latent_dim: int,
        latent_clip: float | None = 0.5,
        qvalue_loc: Tensor | None = None,
        qvalue_scale: Tensor | None = None,
        classification_weight: float = 1.0,
        generator_weight: float = 1.0,
        direction_weight: float = 1.0,
        qvalue_weight: float = 1.0,
        latent_norm_weight: float = 2e-3,
        context: str = "set",
        context_fraction: float = 0.5,
        context_size: int = 8,
        detach_task_latent: bool = False,
        reduction: str = "mean",
        deactivate_vmap: bool = False,
        use_prioritized_weights: str | bool = "auto",
    ) -> None:
        super().__init__()
        if len(teacher_generators) != len(teacher_qvalue_networks):
            raise BMRLError(
                f"{len(teacher_generators)} teacher_generators and {len(teacher_qvalue_networks)} "
                "teacher_qvalue_networks; valid: one of each per task"
            )
        if reduction not in REDUCTIONS:
            raise UnknownNameError("reduction", reduction, REDUCTIONS)
        if context not in CONTEXTS:
            raise UnknownNameError("context", context, CONTEXTS)
        if not 0.0 <= context_fraction <= 1.0:
            raise BMRLError(f"context_fraction is {context_fraction}; valid: between 0 and 1")
        if context_size < 1:
            raise BMRLError(f"context_size is {context_size}; valid: at least 1")
        self._in_keys: list[NestedKey] | None = None
        self.num_tasks = len(teacher_generators)
        self.latent_dim = latent_dim
        self.context = context
        self.context_fraction = context_fraction
        self.context_size = context_size
        self.detach_task_latent = detach_task_latent
        self.reduction = reduction
        self.deactivate_vmap = deactivate_vmap
        self.use_prioritized_weights = use_prioritized_weights

        for name, module in (
            ("task_encoder", task_encoder),
            ("task_classifier", task_classifier),
            ("student_generator", student_generator),
            ("student_qvalue_network", student_qvalue_network),
        ):
            self.convert_to_functional(module, name, create_target_params=False)
        # Teachers enter as buffers: no optimizer finds them, no gradient reaches them. Outside
        # _modules so that their first members, kept for their structure, are not state of the loss.
        self.teacher_generator_params = _frozen_stack(teacher_generators)
        self.teacher_qvalue_network_params = _frozen_stack(teacher_qvalue_networks)
        self.__dict__["_teacher_generator"] = teacher_generators[0]
        self.__dict__["_teacher_qvalue_network"] = teacher_qvalue_networks[0]

        reference = next(student_generator.parameters())
        zeros = torch.zeros(self.num_tasks, device=reference.device, dtype=reference.dtype)
        self.register_buffer("qvalue_loc", zeros if qvalue_loc is None else qvalue_loc.to(zeros))
        self.register_buffer(
            "qvalue_scale", zeros + 1 if qvalue_scale is None else qvalue_scale.to(zeros)
        )
        for name, value in (
            ("latent_clip", latent_clip),
            ("classification_weight", classification_weight),
            ("generator_weight", generator_weight),
            ("direction_weight", direction_weight),
            ("qvalue_weight", qvalue_weight),
            ("latent_norm_weight", latent_norm_weight),
        ):
            self.register_coeff_buffer(name, value, device=reference.device, dtype=reference.dtype)
        self._make_vmap()

    def _make_vmap(self) -> None:
        self._vmap_teacher_generator, self._vmap_teacher_qvalue_network = (
            _vmap_func(
                module,
                (0, 0),
                randomness=self.vmap_randomness,
                pseudo_vmap=self.deactivate_vmap,
            )
            for module in (self._teacher_generator, self._teacher_qvalue_network)
        )

    def _forward_value_estimator_keys(self, **kwargs: object) -> None:
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys read from the input, in a stable order."""
        if self._in_keys is None:
            keys = [*self.task_encoder.in_keys, *self._teacher_observation_keys]
            keys.append(self.tensor_keys.task)
            if self.context == "previous":
                previous = self.tensor_keys.previous
                keys += [unravel_key((previous, key)) for key in self.task_encoder.in_keys]
            self._in_keys = list(dict.fromkeys(keys))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def _teacher_observation_keys(self) -> list[NestedKey]:
        latent = self.tensor_keys.action_latent
        return [key for key in self._teacher_generator.in_keys if key != latent]

    # -- the parts of the objective --------------------------------------------------------------

    def embed(self, tensordict: TensorDictBase) -> Tensor:
        """Embedding m of each row's context, ``(num_tasks, B, m)``."""
        keys = self.task_encoder.in_keys
        current = tensordict.select(*keys)
        latent = self._encode(current)
        if self.context == "current":
            return latent
        if self.context == "previous":
            previous = tensordict.get(self.tensor_keys.previous, None)
            if previous is None:
                raise BMRLError(
                    f"the data have no {self.tensor_keys.previous!r}, which context='previous' "
                    "reads; valid: data of torchrl_bmrl.data.with_previous, or another context: "
                    + ", ".join(name for name in CONTEXTS if name != "previous")
                )
            other = self._encode(previous.select(*keys))
        else:
            # Rows of a task are draws from its data: others of the same row are its context.
            size = self.context_size if self.context == "set" else 1
            rows = latent.shape[1]
            index = torch.randint(rows, (rows, size), device=latent.device)
            other = latent[:, index].mean(2)
        chosen = torch.rand(latent.shape[:2], device=latent.device) < self.context_fraction
        return torch.where(chosen.unsqueeze(-1), other, latent)

    def _encode(self, transition: TensorDictBase) -> Tensor:
        with self.task_encoder_params.to_module(self.task_encoder, preserve_module_state=False):
            return self.task_encoder(transition).get(self.tensor_keys.task_latent)

    @torch.no_grad()
    def teach(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Teachers' actions and normalised values for freshly drawn latents.

        Returns:
            batch ``[num_tasks, B]`` with ``observation``, ``action_latent``, ``action`` and
            ``state_action_value (num_tasks, B, 1)``.
        """
        keys = self.tensor_keys
        data = tensordict.select(*self._teacher_observation_keys)
        latent = sample_action_latent(
            (*data.batch_size, self.latent_dim),
            latent_clip=self.latent_clip,
            device=self.qvalue_loc.device,
            dtype=self.qvalue_loc.dtype,
        )
        data = data.copy().set(keys.action_latent, latent)
        data = self._vmap_teacher_generator(data, self.teacher_generator_params)
        data = self._vmap_teacher_qvalue_network(data, self.teacher_qvalue_network_params)
        value = data.get(keys.state_action_value)
        value = (value - self.qvalue_loc[:, None, None]) / self.qvalue_scale[:, None, None]
        return data.set(keys.state_action_value, value)

    def imitate(self, taught: TensorDictBase, task_latent: Tensor) -> TensorDictBase:
        """Student's action and value for the teachers' observations and latents."""
        keys = self.tensor_keys
        data = taught.select(*self._teacher_observation_keys, keys.action_latent).copy()
        data.set(keys.task_latent, task_latent)
        with self.student_generator_params.to_module(
            self.student_generator, preserve_module_state=False
        ):
            data = self.student_generator(data)
        judged = data.select(*self.student_qvalue_network.in_keys).copy()
        judged.set(keys.action, judged.get(keys.action).detach())
        with self.student_qvalue_network_params.to_module(
            self.student_qvalue_network, preserve_module_state=False
        ):
            judged = self.student_qvalue_network(judged)
        return data.set(keys.state_action_value, judged.get(keys.state_action_value))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the weighted terms; see the class for keys."""
        if tensordict.ndim != 2 or tensordict.batch_size[0] != self.num_tasks:
            raise BMRLError(
                f"the data's batch size is {list(tensordict.batch_size)}; valid: "
                f"[{self.num_tasks}, B], one row per teacher"
            )
        keys = self.tensor_keys
        task = tensordict.get(keys.task)
        task_latent = self.embed(tensordict)
        with self.task_classifier_params.to_module(
            self.task_classifier, preserve_module_state=False
        ):
            classified = self.task_classifier(
                TensorDict({keys.task_latent: task_latent}, tensordict.batch_size)
            )
        logits = classified.get(keys.task_logits)
        taught = self.teach(tensordict)
        student = self.imitate(
            taught, task_latent.detach() if self.detach_task_latent else task_latent
        )
        action, target = student.get(keys.action), taught.get(keys.action)
        value = student.get(keys.state_action_value) - taught.get(keys.state_action_value)
        norm = task_latent.square().sum(-1)
        cross_entropy = F.cross_entropy(
            logits.flatten(0, 1), task.flatten(), reduction="none"
        ).view_as(task)
        weights = self._maybe_get_priority_weight(tensordict)
        terms = {
            "loss_classification": self.classification_weight * cross_entropy,
            "loss_generator": self.generator_weight * squared_error(action, target),
            "loss_direction": self.direction_weight * direction_error(action, target),
            "loss_qvalue": self.qvalue_weight * value.squeeze(-1).square(),
            "loss_latent_norm": self.latent_norm_weight * norm,
        }
        losses = {
            name: self._reduce_loss(term, tensordict=tensordict, weights=weights)
            for name, term in terms.items()
        }
        losses["accuracy"] = (logits.argmax(-1) == task).to(logits.dtype).mean()
        losses["latent_norm"] = norm.detach().mean().sqrt()
        self._clear_weakrefs(tensordict, taught, student, "student_generator_params")
        return TensorDict(losses)


def _frozen_stack(modules: Sequence[TensorDictModule]) -> TensorDictParams:
    """Parameters of equally shaped modules stacked along a new first dimension, as buffers."""
    stacked = TensorDict.from_modules(*modules, as_module=False).data.clone()
    return TensorDictParams(stacked, no_convert=True)
