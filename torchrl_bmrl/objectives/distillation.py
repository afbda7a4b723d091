"""Meta-distillation: many frozen teachers into one student that reads a task embedding."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams, unravel_key
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn import functional as F

from torchrl_bmrl import functional
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.generators import written
from torchrl_bmrl.objectives.base import KeyedLoss
from torchrl_bmrl.objectives.checks import check_choice, check_number
from torchrl_bmrl.objectives.data import check_same_shape, check_tasks, entry, next_key, select
from torchrl_bmrl.objectives.ensemble import FrozenEnsemble
from torchrl_bmrl.objectives.sizes import is_lazy, shapes_of, warm_up
from torchrl_bmrl.objectives.student_terms import advantage, isometry
from torchrl_bmrl.objectives.task_rows import draw_others, draw_rows
from torchrl_bmrl.objectives.teachers import check_teachers, per_task

CONTEXTS = ("current", "previous", "random", "set")
ENCODER_TERMS = ("classification", "generator", "direction", "qvalue", "metric")
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
    another transition of the task and :math:`m^-` one of another task; the isometry term makes
    distances in m equal those in c, the reward and the teacher's action, over all pairs of a task's
    rows; the advantage term compares the values of two latents of a state, since a policy chooses
    only by such differences.
    :math:`\hat Q` is trained at :math:`\hat g` without a gradient into the student's generator.

    The teachers are frozen. Row i of the data belongs to task i. Teachers of equal shapes run as
    one batched ensemble. A perturbation network is not distilled.

    Args:
        task_encoder: M, (observation, action, next reward, next observation) → ``task_latent``.
        task_classifier: P, ``task_latent`` → ``task_logits``.
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
        encoder_terms: terms whose gradient reaches M, of ``"classification"``, ``"generator"``,
            ``"direction"``, ``"qvalue"`` (the advantage term, too) and ``"metric"``; the penalty on
            m and the isometry term always reach it. ``("classification",)`` is the paper's reading.
        context: which transition m is computed from: ``"current"`` (the paper's), ``"previous"``
            (the one before it in the episode, under the key ``"previous"``), ``"random"`` (another
            one of the task in the batch) or ``"set"`` (the mean over ``context_size`` random ones).
        context_fraction: share of each batch that uses ``context``; the rest uses ``"current"``.
        context_size: transitions in a set.
        **options: of :class:`~torchrl_bmrl.objectives.KeyedLoss`: ``reduction``,
            ``deactivate_vmap`` (runs the teachers in a loop), ``use_prioritized_weights``.

    Keys read, batch ``[num_tasks, B]``: ``observation``, ``action``, ``("next", "reward")``,
    ``("next", "observation")``, ``task`` (class index, int64), with ``context="previous"`` the same
    under ``"previous"``. Key written to the input: ``td_error (num_tasks, B)``, the priority: the
    sum of a row's terms.

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
        {"latent_clip", *(f"{x}_weight" for x in (*ENCODER_TERMS, "latent_norm", *OTHER_TERMS))}
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
        reward_scale: Tensor | None = None,
        classification_weight: float = 1.0,
        generator_weight: float = 1.0,
        direction_weight: float = 1.0,
        qvalue_weight: float = 1.0,
        latent_norm_weight: float = 2e-3,
        metric_weight: float = 0.0,
        metric_margin: float = 1.0,
        isometry_weight: float = 0.0,
        advantage_weight: float = 0.0,
        advantage_scale: Tensor | None = None,
        encoder_terms: Sequence[str] = ENCODER_TERMS,
        context: str = "set",
        context_fraction: float = 0.5,
        context_size: int = 8,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        terms = (encoder_terms,) if isinstance(encoder_terms, str) else encoder_terms
        self.encoder_terms = tuple(check_choice("encoder term", x, ENCODER_TERMS) for x in terms)
        if metric_weight and len(teacher_generators) < 2:
            raise BMRLError("metric_weight needs at least two tasks")
        self.num_tasks = len(teacher_generators)
        self.latent_dim = check_number("latent_dim", latent_dim, 1, integer=True)
        self.context = check_choice("context", context, CONTEXTS)
        self.context_fraction = check_number("context_fraction", context_fraction, 0, 1)
        self.context_size = check_number("context_size", context_size, 1, integer=True)
        self.metric_margin = check_number("metric_margin", metric_margin)
        names = ("task_encoder", "task_classifier", "student_generator", "student_qvalue_network")
        networks = (task_encoder, task_classifier, student_generator, student_qvalue_network)
        students = dict(zip(names, networks, strict=True))
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
            classification_weight=classification_weight,
            generator_weight=generator_weight,
            direction_weight=direction_weight,
            qvalue_weight=qvalue_weight,
            latent_norm_weight=latent_norm_weight,
        )
        self.register_coefficients(
            optional=True,
            latent_clip=latent_clip,
            metric_weight=metric_weight or None,
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
            shapes[keys.task_latent] = self._encode(tensordict).shape[2:]
        for name in ("task_classifier", "student_generator", "student_qvalue_network"):
            warm_up(name, getattr(self, name), shapes)

    def read_keys(self) -> list[NestedKey]:
        """The transition that m is computed from, what the teachers read, and the task."""
        keys = [*self.task_encoder.in_keys, *self._teacher_observation_keys]
        keys.append(self.tensor_keys.task)
        if self.isometry_weight is not None:
            reward = next_key(self.tensor_keys.reward)
            keys += [reward] if reward not in keys else []
        if self.context == "previous":
            previous = self.tensor_keys.previous
            keys += [unravel_key((previous, key)) for key in self.task_encoder.in_keys]
        return keys

    def written_keys(self) -> list[str]:
        """The weighted terms, then metrics."""
        terms = ["classification", "generator", "direction", "qvalue", "latent_norm"]
        optional = ("metric", *OTHER_TERMS)
        terms += [x for x in optional if getattr(self, f"{x}_weight") is not None]
        return [*(f"loss_{term}" for term in terms), "accuracy", "latent_norm"]

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
        latent = self._encode(tensordict)
        if self.context == "current":
            return latent
        if self.context == "previous":
            name = self.tensor_keys.previous
            if tensordict.get(name, None) is None:
                raise BMRLError(
                    f"the data have no {name!r}, which context='previous' reads; valid: data of "
                    "torchrl_bmrl.data.with_previous, or the context current, random or set"
                )
            other = self._encode(tensordict, under=name)
        else:
            # The other rows of a task are draws from its data, and so are its context.
            size = self.context_size if self.context == "set" else 1
            other = draw_rows(latent, self.valid_rows(tensordict, latent.shape[:2]), size).mean(2)
        chosen = torch.rand(latent.shape[:2], device=latent.device) < self.context_fraction
        return torch.where(chosen.unsqueeze(-1), other, latent)

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

    @torch.no_grad()
    def teach(self, tensordict: TensorDictBase) -> TensorDictBase:
        """States, fresh latents, and the teachers' actions and normalised values for them."""
        keys = self.tensor_keys
        shape = (*tensordict.batch_size, self.latent_dim)
        clip, like = self.latent_clip, self._type_and_device
        latent = functional.sample_action_latent(shape, latent_clip=clip, **like)
        data = self._ask(self.teacher_qvalue_networks, self._demonstrate(tensordict, latent))
        value = data.get(keys.state_action_value)
        value = (value - self.qvalue_loc[:, None, None]) / self.qvalue_scale[:, None, None]
        return data.set(keys.state_action_value, value)

    def _demonstrate(self, tensordict: TensorDictBase, latent: Tensor) -> TensorDictBase:
        """States, latents, and the actions that the teachers decode from them."""
        data = self._entries(tensordict, self._teacher_observation_keys)
        data = data.copy().set(self.tensor_keys.action_latent, latent)
        return self._ask(self.teacher_generators, data)

    def _ask(self, teachers: Any, data: TensorDictBase) -> TensorDictBase:
        return teachers(data, randomness=self.vmap_randomness, loop=self.deactivate_vmap)

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
        m = self.embed(tensordict)
        # M receives the gradients of the chosen terms only.
        reaching = {term: m if term in self.encoder_terms else m.detach() for term in ENCODER_TERMS}
        logits = self._run(
            "task_classifier",
            TensorDict({keys.task_latent: reaching["classification"]}, batch),
            keys.task_logits,
            like=m.new_empty(*batch, self.num_tasks),
        )
        cross_entropy = F.cross_entropy(
            logits.flatten(0, 1), task.flatten().long(), reduction="none"
        )
        taught = self.teach(tensordict)
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
        norm = m.square().sum(-1)
        terms = {
            "loss_classification": self.classification_weight * cross_entropy.view_as(task),
            "loss_generator": self.generator_weight * functional.squared_error(action, target),
            "loss_direction": self.direction_weight * functional.direction_error(directed, target),
            "loss_qvalue": self.qvalue_weight * error.square(),
            "loss_latent_norm": self.latent_norm_weight * norm,
        }
        if self.metric_weight is not None:
            near, far = draw_others(reaching["metric"], valid)
            triplet = functional.triplet_error(reaching["metric"], near, far, self.metric_margin)
            terms["loss_metric"] = self.metric_weight * triplet
        if self.isometry_weight is not None:
            terms["loss_isometry"] = self.isometry_weight * isometry(self, tensordict)
        if self.advantage_weight is not None:
            error = advantage(self, tensordict, value, target_value, reaching["qvalue"])
            terms["loss_advantage"] = self.advantage_weight * error
        priority = sum(terms.values()).detach()
        tensordict.set(self.tensor_keys.priority, functional.unpadded(priority, valid))
        losses = {name: self.reduce(term, tensordict) for name, term in terms.items()}
        losses["accuracy"] = functional.average((logits.argmax(-1) == task).to(logits.dtype), valid)
        losses["latent_norm"] = functional.average(norm, valid).sqrt()
        return TensorDict(losses)
