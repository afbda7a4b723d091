"""Meta-distillation: many frozen teachers into one student that reads a task embedding."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_bmrl import functional
from torchrl_bmrl.context_keys import reads_context
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.base import KeyedLoss
from torchrl_bmrl.objectives.checks import check_choice, check_number
from torchrl_bmrl.objectives.data import check_same_shape, check_tasks, entry, next_key, select
from torchrl_bmrl.objectives.ensemble import FrozenEnsemble
from torchrl_bmrl.objectives.lessons import draw_mix, taught_by
from torchrl_bmrl.objectives.sizes import is_lazy, shapes_of, warm_up
from torchrl_bmrl.objectives.student_terms import (
    advantage,
    arranging_errors,
    check_options,
    classify,
    embedded,
    encoded_keys,
    isometry,
)
from torchrl_bmrl.objectives.teachers import check_teachers, per_task

CONTEXTS = ("current", "previous", "random", "set", "given")
ENCODER_TERMS = ("classification", "generator", "direction", "qvalue", "metric")
ARRANGING_TERMS = ("metric", "distance", "contrastive")
OTHER_TERMS = ("isometry", "advantage")


class MetaDistillationLoss(KeyedLoss):
    r"""Distils one generator and one critic per task into a single pair conditioned on m.

    Reference: *Compositional Skill Learning Using Batch Meta RL*, section 6.2. With
    :math:`m = M(s, a, r, s')`, one latent z for teacher and student alike,
    :math:`g = G_i(s, z)`, :math:`\hat g = \hat G(s, z, m)`:

    .. math::
        L = w_c\, \mathrm{CE}(P(m), y) + w_g \lVert \hat g - g \rVert_2^2
          + w_d \left(1 - \frac{\hat g \cdot g}{\lVert\hat g\rVert \lVert g\rVert}\right)
          + w_q \left(\hat Q(s, \hat g, m) - \tilde Q_i(s, g)\right)^2
          + w_m \lVert m \rVert_2^2
          + w_t \max(0, \lVert m - m^+ \rVert - \lVert m - m^- \rVert + \alpha)
          + w_s \left(\lVert m - m^+ \rVert - \lVert c - c^+ \rVert\right)^2
          + w_a \left((\hat Q - \hat Q') - (\tilde Q_i - \tilde Q_i')\right)^2 / \kappa_i^2,
          \quad c = (r / \rho_i, G_i(s, 0))

    Deviations from the paper are the penalty on m, the normalised :math:`\tilde Q_i = (Q_i -
    \mu_i)/\sigma_i` and ``context``; docs/distillation.md explains them. The last three terms
    are off by default: in the triplet loss (https://arxiv.org/abs/1909.11373) :math:`m^+` embeds
    another transition or set of the task and :math:`m^-` one of another task; the isometry term
    makes distances in m equal those in c, the reward and the teacher's action, over all pairs of a
    task's rows; the advantage term compares the values of two latents of a state, since a policy
    chooses only by such differences. Two more arrange m as the triplet loss does:
    :func:`~torchrl_bmrl.contrast.distance_error` and
    :func:`~torchrl_bmrl.contrast.contrastive_error`.
    An encoder of sets (:func:`~torchrl_bmrl.modules.make_context_encoder`) embeds groups of a
    task's rows instead, for unseen tasks.
    :math:`\hat Q` is trained at :math:`\hat g` without a gradient into the student's generator.

    The teachers are frozen. Row i of the data belongs to task i. Teachers of equal shapes run as
    one batched ensemble. A perturbation network is not distilled.

    Args:
        task_encoder: M, (observation, action, next reward, next observation) → ``task_latent``.
        task_classifier: P, ``task_latent`` → ``task_logits``; ``None`` for no classification.
        student_generator: Ĝ, a decoder of observation, ``action_latent``, ``task_latent``.
        student_qvalue_network: Q̂, of observation, action, ``task_latent``.
        teacher_generators: one decoder per task (observation, ``action_latent`` → action).
        teacher_qvalue_networks: one critic per task.

    Keyword Args:
        latent_dim: size of ``action_latent``.
        latent_clip: bound on z, the one that the teachers act with; ``None`` for none.
        qvalue_loc: μ_i, ``(num_tasks,)``; ``None`` for 0.
        qvalue_scale, reward_scale, advantage_scale: σ_i, ρ_i and κ_i, ``(num_tasks,)``, positive;
            ``None`` for 1.
        classification_weight, generator_weight, direction_weight: w_c, w_g, w_d.
        qvalue_weight, latent_norm_weight: w_q, w_m.
        metric_weight, isometry_weight, advantage_weight: w_t, w_s, w_a; 0 leaves the term out.
        metric_margin: α, in units of m.
        distance_weight, contrastive_weight: of FOCAL's distance and of InfoNCE; likewise.
        temperature: τ of InfoNCE.
        encoder_terms: terms whose gradient reaches M, of ``"classification"``, ``"generator"``,
            ``"direction"``, ``"qvalue"`` (the advantage term, too) and ``"metric"`` (distance and
            InfoNCE, too); the penalty on m and the isometry term always reach it.
            ``("classification",)`` is the paper's reading.
        context: which transition m is computed from: ``"current"`` (the paper's), ``"previous"``
            (the one before it in the episode, under the key ``"previous"``), ``"random"`` (another
            one of the task in the batch) or ``"set"`` (the mean over ``context_size`` random ones).
            An encoder of sets reads ``"set"``, groups of the batch's rows without the row itself,
            or ``"given"``, groups of the rows under ``"context"``, perhaps of another behaviour.
        context_fraction: share of each batch that uses ``context``; the rest uses ``"current"``.
            With an encoder of sets 1.
        context_size: transitions in a set; for an encoder of sets the largest number.
        mixing_fraction: share of the rows whose m and targets are mixed with another task's:
            :math:`\lambda m_i + (1 - \lambda) m_j` learns :math:`\lambda g_i + (1 - \lambda) g_j`
            and the same of the values, λ uniform in [0, 1].
        **options: of :class:`~torchrl_bmrl.objectives.KeyedLoss`: ``reduction``,
            ``deactivate_vmap`` (runs the teachers in a loop), ``use_prioritized_weights``.

    Keys read, batch ``[num_tasks, B]``: ``observation``, ``action``, ``("next", "reward")``,
    ``("next", "observation")``, ``task`` (class index, int64), with ``context="previous"`` the same
    under ``"previous"``, with ``"given"`` under ``"context"``. Key written to the input:
    ``td_error (num_tasks, B)``, the priority: the sum of a row's terms.

    Raises:
        BMRLError: for invalid teachers or options; and at a call for data without one row per
            teacher, with missing keys or, on CPU and not compiled, numbers that are not finite.

    Example:
        >>> from torchrl_bmrl import modules
        >>> loss = MetaDistillationLoss(
        ...     modules.make_task_encoder(3, 2),
        ...     modules.make_task_classifier(4),
        ...     modules.make_decoder(3, 2, 4, task_latent_dim=2),
        ...     modules.make_qvalue_network(3, 2, task_latent_dim=2),
        ...     [modules.ActionVAE(3, 2).decoder for _ in range(4)],
        ...     [modules.make_qvalue_network(3, 2) for _ in range(4)],
        ...     latent_dim=4,
        ... )
        >>> after = {"observation": torch.randn(4, 8, 3), "reward": torch.randn(4, 8, 1)}
        >>> data = {"observation": torch.randn(4, 8, 3), "action": torch.zeros(4, 8, 2)}
        >>> data |= {"task": torch.arange(4).unsqueeze(-1).expand(4, 8), "next": after}
        >>> losses = loss(TensorDict(data, batch_size=[4, 8]))
        >>> sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename."""

        action: NestedKey = "action"  # of the data, and the decoders' output
        action_latent: NestedKey = "action_latent"  # the VAE's z
        task_latent: NestedKey = "task_latent"  # the embedding m
        task_logits: NestedKey = "task_logits"  # the classifier's output
        task: NestedKey = "task"  # class index y
        reward: NestedKey = "reward"  # under "next"; the loss reads it for isometry_weight only
        state_action_value: NestedKey = "state_action_value"  # the critics' output
        previous: NestedKey = "previous"  # contains the previous transition
        priority: NestedKey = "td_error"  # written to the input
        priority_weight: NestedKey = "priority_weight"  # read from the input where present

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset(
        {"latent_clip", "latent_norm_weight"}
        | {f"{x}_weight" for x in (*ENCODER_TERMS, *ARRANGING_TERMS, *OTHER_TERMS)}
    )
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
        task_classifier: TensorDictModule | None,
        student_generator: TensorDictModule,
        student_qvalue_network: TensorDictModule,
        teacher_generators: Sequence[TensorDictModule],
        teacher_qvalue_networks: Sequence[TensorDictModule],
        *,
        latent_dim: int,
        latent_clip: float | None = 0.5,
        qvalue_loc: Tensor | None = None,
        qvalue_scale: Tensor | None = None,
        reward_scale: Tensor | None = None,
        classification_weight: float = 1.0,
        generator_weight: float = 1.0,
        direction_weight: float = 1.0,
        qvalue_weight: float = 1.0,
        latent_norm_weight: float = 2e-3,
        metric_weight: float = 0.0,
        metric_margin: float = 1.0,
        distance_weight: float = 0.0,
        contrastive_weight: float = 0.0,
        temperature: float = 0.1,
        isometry_weight: float = 0.0,
        advantage_weight: float = 0.0,
        advantage_scale: Tensor | None = None,
        encoder_terms: Sequence[str] = ENCODER_TERMS,
        context: str = "set",
        context_fraction: float = 0.5,
        context_size: int = 8,
        mixing_fraction: float = 0.0,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        terms = (encoder_terms,) if isinstance(encoder_terms, str) else encoder_terms
        self.encoder_terms = tuple(check_choice("encoder term", x, ENCODER_TERMS) for x in terms)
        self.num_tasks = len(teacher_generators)
        self.latent_dim = check_number("latent_dim", latent_dim, 1, integer=True)
        self.context = check_choice("context", context, CONTEXTS)
        self.context_fraction = check_number("context_fraction", context_fraction, 0, 1)
        self.context_size = check_number("context_size", context_size, 1, integer=True)
        self.mixing_fraction = check_number("mixing_fraction", mixing_fraction, 0, 1)
        self.metric_margin = check_number("metric_margin", metric_margin)
        self.temperature = check_number("temperature", temperature, 1e-6)
        self.reads_sets = reads_context(task_encoder)
        arranging = (metric_weight, distance_weight, contrastive_weight, mixing_fraction)
        check_options(self, isometry_weight, arranging)
        names = ("task_encoder", "task_classifier", "student_generator", "student_qvalue_network")
        networks = (task_encoder, task_classifier, student_generator, student_qvalue_network)
        pairs = zip(names, networks, strict=True)
        students = {name: network for name, network in pairs if network is not None}
        self.classifies = task_classifier is not None
        teachers = (teacher_generators, teacher_qvalue_networks)
        check_teachers(students, *teachers, self.tensor_keys.action_latent, self.latent_dim)
        self._cold = any(map(is_lazy, students.values()))
        for name, module in students.items():
            self.convert_to_functional(module, name, create_target_params=False)
        self.teacher_generators, self.teacher_qvalue_networks = map(FrozenEnsemble, teachers)
        like = next(student_generator.parameters()).new_zeros(self.num_tasks)
        self.register_buffer("qvalue_loc", per_task("qvalue_loc", qvalue_loc, like))
        scales = {"qvalue": qvalue_scale, "reward": reward_scale, "advantage": advantage_scale}
        for name, scale in scales.items():
            name = f"{name}_scale"
            self.register_buffer(name, per_task(name, scale, like + 1))
        self.register_coefficients(
            generator_weight=generator_weight,
            direction_weight=direction_weight,
            qvalue_weight=qvalue_weight,
            latent_norm_weight=latent_norm_weight,
        )
        self.register_coefficients(
            optional=True,
            latent_clip=latent_clip,
            classification_weight=classification_weight if self.classifies else None,
            metric_weight=metric_weight or None,
            distance_weight=distance_weight or None,
            contrastive_weight=contrastive_weight or None,
            isometry_weight=isometry_weight or None,
            advantage_weight=advantage_weight or None,
        )
        self.keep_keys()

    def _warm_up(self, tensordict: TensorDictBase) -> None:
        """Gives lazy networks their parameters, by the sizes of the first batch."""
        self._cold = False
        keys = self.tensor_keys
        shapes = shapes_of(tensordict, self.in_keys, 2) | {keys.action_latent: (self.latent_dim,)}
        warm_up("task_encoder", self.task_encoder, shapes)
        with torch.no_grad():
            shapes[keys.task_latent] = self.embed(tensordict).shape[2:]
        classifier = ("task_classifier",) if self.classifies else ()
        for name in (*classifier, "student_generator", "student_qvalue_network"):
            warm_up(name, getattr(self, name), shapes)

    def read_keys(self) -> list[NestedKey]:
        """The transition that m is computed from, what the teachers read, and the task."""
        keys = [*encoded_keys(self), *self._teacher_observation_keys, self.tensor_keys.task]
        if self.isometry_weight is not None:
            reward = next_key(self.tensor_keys.reward)
            keys += [reward] if reward not in keys else []
        return keys

    def written_keys(self) -> list[str]:
        """The weighted terms, then metrics."""
        first = ["classification"] * self.classifies
        optional = (*ARRANGING_TERMS, *OTHER_TERMS)
        chosen = [x for x in optional if getattr(self, f"{x}_weight") is not None]
        terms = [*first, "generator", "direction", "qvalue", "latent_norm", *chosen]
        return [*(f"loss_{x}" for x in terms), *["accuracy"] * self.classifies, "latent_norm"]

    @property
    def _teacher_observation_keys(self) -> list[NestedKey]:
        made = (self.tensor_keys.action_latent, self.tensor_keys.action)
        keys = [*self.teacher_generators.in_keys, *self.teacher_qvalue_networks.in_keys]
        return [key for key in dict.fromkeys(keys) if key not in made]

    # -- the parts of the objective --------------------------------------------------------------

    def embed(self, tensordict: TensorDictBase) -> Tensor:
        """Embedding m of each row's context, ``(num_tasks, B, m)``.

        Raises:
            BMRLError: for missing keys, and for ``context="previous"`` without ``"previous"``.
        """
        return self._embed(tensordict).latent

    _embed = embedded  # a function of the loss and its data, which a subclass may replace

    def _entries(
        self, tensordict: TensorDictBase, keys: Iterable[NestedKey], under: NestedKey = ()
    ) -> TensorDictBase:
        """Checked entries; zeros in the rows that a mask leaves out."""
        batch = tensordict.batch_size
        valid = self.valid_rows(tensordict, batch)
        return select(tensordict, keys, batch, valid, under=under, readers=self.readers)

    def _encode(self, tensordict: TensorDictBase, under: NestedKey = ()) -> Tensor:
        """Embedding m of each row's transition, or of the one ``under`` a key."""
        data = self._entries(tensordict, self.task_encoder.in_keys, under)
        return self._run("task_encoder", data, self.tensor_keys.task_latent)

    def _run(
        self, name: str, data: Any, key: NestedKey, like: Tensor | None = None, extra: Any = None
    ) -> Tensor:
        """Output of a trained network for data and extra entries, with the shape of ``like``."""
        for entry_key, value in (extra or {}).items():
            data = data.copy().set(entry_key, value)
        output = written(self.call(name, data), key, getattr(self, name))
        if like is not None:
            check_same_shape(key, like, output)
        return output

    teach = torch.no_grad()(taught_by)  # the same

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the weighted terms; the class lists the keys.

        Raises:
            BMRLError: for data that do not fit.
        """
        self.check_names()
        if self._cold:
            self._warm_up(tensordict)
        batch, keys = tensordict.batch_size, self.tensor_keys
        if len(batch) != 2 or batch[0] != self.num_tasks:
            valid_batch = f"[{self.num_tasks}, B], one row per teacher"
            raise BMRLError(f"the data's batch size is {list(batch)}; valid: {valid_batch}")
        valid = self.valid_rows(tensordict, batch)
        task = entry(tensordict, keys.task, valid)
        check_tasks(keys.task, task, batch, valid)
        m, points, points_valid, alone = self._embed(tensordict)
        mix = draw_mix(m, valid, self.mixing_fraction) if self.mixing_fraction else None
        own, m = m, m if mix is None else mix.between(m)
        # M receives the gradients of the chosen terms only.
        reaching = {term: m if term in self.encoder_terms else m.detach() for term in ENCODER_TERMS}
        terms, metrics = {}, {}
        if self.classifies:
            read = own if "classification" in self.encoder_terms else own.detach()
            error, metrics["accuracy"] = classify(self, read, task, valid)
            terms["loss_classification"] = self.classification_weight * error
        taught = self.teach(tensordict, mix)
        states = taught.select(*self._teacher_observation_keys)
        target, target_value = taught.get(keys.action), taught.get(keys.state_action_value)

        def imitate(m: Tensor) -> Tensor:
            given = {keys.action_latent: taught.get(keys.action_latent), keys.task_latent: m}
            return self._run("student_generator", states, keys.action, target, given)

        action = directed = imitate(reaching["generator"])
        if reaching["direction"] is not reaching["generator"]:
            directed = imitate(reaching["direction"])
        given = {keys.action: action.detach(), keys.task_latent: reaching["qvalue"]}
        key = keys.state_action_value
        value = self._run("student_qvalue_network", states, key, target_value, given)
        error = (value - target_value).squeeze(-1)
        norm = own.square().sum(-1)
        terms |= {
            "loss_generator": self.generator_weight * functional.squared_error(action, target),
            "loss_direction": self.direction_weight * functional.direction_error(directed, target),
            "loss_qvalue": self.qvalue_weight * error.square(),
            "loss_latent_norm": self.latent_norm_weight * norm,
        }
        if "metric" not in self.encoder_terms:
            points = points.detach()
        for term, error in arranging_errors(self, points, points_valid, batch).items():
            terms[f"loss_{term}"] = getattr(self, f"{term}_weight") * error
        if self.isometry_weight is not None:
            assert alone is not None  # the term is refused with encoders of sets
            terms["loss_isometry"] = self.isometry_weight * isometry(self, tensordict, alone)
        if self.advantage_weight is not None:
            error = advantage(self, tensordict, value, target_value, reaching["qvalue"], mix)
            terms["loss_advantage"] = self.advantage_weight * error
        priority = sum(terms.values()).detach()
        tensordict.set(self.tensor_keys.priority, functional.unpadded(priority, valid))
        losses = {name: self.reduce(term, tensordict) for name, term in terms.items()}
        metrics["latent_norm"] = functional.average(norm, valid).sqrt()
        return TensorDict(losses | metrics)
