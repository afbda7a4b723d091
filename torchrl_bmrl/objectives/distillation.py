"""Meta-distillation: many frozen teachers into one student conditioned on a task embedding."""

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

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.functional import (
    direction_error,
    isometry_error,
    sample_action_latent,
    squared_error,
    triplet_error,
)
from torchrl_bmrl.objectives.base import KeyedLoss, average, unpadded
from torchrl_bmrl.objectives.checks import (
    agreed_sizes,
    check_fit,
    check_index,
    check_network,
    check_number,
    check_rows_of_tasks,
    check_same_shape,
    entry,
    is_lazy,
    next_key,
    output,
    read,
    warm_up,
)
from torchrl_bmrl.objectives.ensemble import FrozenEnsemble
from torchrl_bmrl.objectives.swap import holding
from torchrl_bmrl.ownership import check_trained

CONTEXTS = ("current", "previous", "random", "set")
ENCODER_TERMS = ("classification", "generator", "direction", "qvalue", "metric")


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
          + w_s \left(\lVert m - m^+ \rVert - \lVert c - c^+ \rVert\right)^2,
          \quad c = (r / \rho_i, G_i(s, 0))

    Deviations from the paper, each of which a weight or an argument turns off: the penalty on m
    (cross-entropy alone lets m grow without bound), :math:`\tilde Q_i = (Q_i - \mu_i)/\sigma_i`
    (the teachers' values differ in scale), and ``context`` (an acting policy does not have the
    present transition). Off by default is the triplet loss of *Multi-task Batch Reinforcement
    Learning with Metric Learning* (https://arxiv.org/abs/1909.11373), where :math:`m^+` embeds
    another transition of the task and :math:`m^-` one of another task. Off by default, too, is
    the last term: two transitions of a task lie as far apart in m as in c, their reward and the
    teacher's action there, so that m tells how far the task has come (over all pairs of a task's
    rows, m of the present transitions). :math:`\hat Q` is trained at :math:`\hat g` without a
    gradient into the student's generator.

    The teachers are frozen: row i of the data is task i. Any decoder and critic will do, those of
    :class:`~torchrl_bmrl.objectives.BCQLoss` and :class:`~torchrl_bmrl.objectives.PLASLoss` alike;
    equally shaped ones run as one batched ensemble. A perturbation network is not distilled.

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
        reward_scale: ρ_i, ``(num_tasks,)``, positive. Default 1.
        classification_weight: w_c.
        generator_weight: w_g.
        direction_weight: w_d.
        qvalue_weight: w_q.
        latent_norm_weight: w_m.
        metric_weight: w_t. Default 0, which leaves the term out.
        metric_margin: α, in units of m.
        isometry_weight: w_s. Default 0, which leaves the term out.
        encoder_terms: terms whose gradient reaches M, of ``"classification"``, ``"generator"``,
            ``"direction"``, ``"qvalue"`` and ``"metric"``; by default all. The penalty on m and
            the isometry term always do. ``("classification",)`` is the paper's reading.
        context: which transition m is computed from: ``"current"`` (the paper's), ``"previous"``
            (the one before it in the episode, under the key ``"previous"``), ``"random"`` (another
            one of the task in the batch) or ``"set"`` (the mean over ``context_size`` such).
        context_fraction: share of each batch whose m comes from ``context``; the rest is
            ``"current"``.
        context_size: transitions in a set.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``; ``None`` is ``"mean"``.
        deactivate_vmap: run the teachers in a loop.
        use_prioritized_weights: as in TorchRL's losses.

    Keys read, batch ``[num_tasks, B]``: ``observation``, ``action``, ``("next", "reward")``,
    ``("next", "observation")``, ``task`` (class index, int64), and with ``context="previous"`` the
    same transition keys under ``"previous"``. Key written to the input: ``td_error
    (num_tasks, B)``, the priority: the sum of a row's terms.

    Raises:
        BMRLError: for numbers of teachers that differ, an unknown context or term, a share or size
            out of range; and at a call for data whose first dimension is not the number of
            teachers, with missing keys or, on CPU and not compiled, numbers that are not finite.

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
            reward: under ``"next"``; read with ``isometry_weight`` alone.
            state_action_value: the critics' output.
            previous: where the previous transition lies.
            priority: written to the input.
            priority_weight: read from the input where present.
        """

        action: NestedKey = "action"
        action_latent: NestedKey = "action_latent"
        task_latent: NestedKey = "task_latent"
        task_logits: NestedKey = "task_logits"
        task: NestedKey = "task"
        reward: NestedKey = "reward"
        state_action_value: NestedKey = "state_action_value"
        previous: NestedKey = "previous"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _schedulable_buffers = frozenset(
        {
            *(f"{term}_weight" for term in ("classification", "generator", "direction", "qvalue")),
            *("latent_norm_weight", "metric_weight", "isometry_weight", "latent_clip"),
        }
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
        encoder_terms: Sequence[str] = ENCODER_TERMS,
        context: str = "set",
        context_fraction: float = 0.5,
        context_size: int = 8,
        reduction: str | None = "mean",
        deactivate_vmap: bool = False,
        use_prioritized_weights: str | bool = "auto",
    ) -> None:
        super().__init__(
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
        )
        if len(teacher_generators) != len(teacher_qvalue_networks):
            raise BMRLError(
                f"{len(teacher_generators)} teacher_generators and {len(teacher_qvalue_networks)} "
                "teacher_qvalue_networks; valid: one of each per task"
            )
        if context not in CONTEXTS:
            raise UnknownNameError("context", context, CONTEXTS)
        context_fraction = check_number("context_fraction", context_fraction, 0, 1)
        context_size = check_number("context_size", context_size, 1, integer=True)
        latent_dim = check_number("latent_dim", latent_dim, 1, integer=True)
        if not teacher_generators:
            raise BMRLError("no teachers; valid: at least one generator and critic")
        encoder_terms = (encoder_terms,) if isinstance(encoder_terms, str) else encoder_terms
        for term in encoder_terms:
            if term not in ENCODER_TERMS:
                raise UnknownNameError("encoder term", term, ENCODER_TERMS)
        metric_weight = check_number("metric_weight", metric_weight)
        isometry_weight = check_number("isometry_weight", isometry_weight)
        if metric_weight and len(teacher_generators) < 2:
            raise BMRLError("metric_weight needs at least two tasks, one to be away from")
        self.num_tasks = len(teacher_generators)
        self.latent_dim = latent_dim
        self.context = context
        self.context_fraction = context_fraction
        self.context_size = context_size
        self.encoder_terms = tuple(encoder_terms)
        self.metric_margin = check_number("metric_margin", metric_margin)

        students = {
            "task_encoder": task_encoder,
            "task_classifier": task_classifier,
            "student_generator": student_generator,
            "student_qvalue_network": student_qvalue_network,
        }
        teachers = [("a teacher's generator", x) for x in teacher_generators]
        teachers += [("a teacher's critic", x) for x in teacher_qvalue_networks]
        for name, module in [*students.items(), *teachers]:
            check_network(name, module)
        for name, module in teachers:
            check_trained(name, module)
        sizes = agreed_sizes([*students.items(), *teachers])
        said = sizes.setdefault(self.tensor_keys.action_latent, latent_dim)
        if said != latent_dim:
            raise BMRLError(
                f"latent_dim is {latent_dim}; valid: {said}, the size that the decoders read"
            )
        for name, module in [*students.items(), *teachers]:
            check_fit(name, module, sizes)
        for name, module in teachers:
            warm_up(name, module, sizes)  # a frozen copy is made of it now
        self._cold = any(map(is_lazy, students.values()))
        _check_equal_bounds([("student_generator", student_generator), *teachers])
        for name, module in students.items():
            self.convert_to_functional(module, name, create_target_params=False)
        self.teacher_generators = FrozenEnsemble(teacher_generators)
        self.teacher_qvalue_networks = FrozenEnsemble(teacher_qvalue_networks)
        reference = next(student_generator.parameters())
        zeros = torch.zeros(self.num_tasks, device=reference.device, dtype=reference.dtype)
        for name, given, default in (
            ("qvalue_loc", qvalue_loc, zeros),
            ("qvalue_scale", qvalue_scale, zeros + 1),
            ("reward_scale", reward_scale, zeros + 1),
        ):
            buffer = default if given is None else torch.as_tensor(given).to(zeros)
            valid = buffer.isfinite() & ((buffer > 0) | (name == "qvalue_loc"))
            if buffer.shape != zeros.shape or not valid.all():
                raise BMRLError(
                    f"{name} is {buffer.tolist()}; valid: a finite number for each of the "
                    f"{self.num_tasks} tasks{', above 0' * name.endswith('scale')}"
                )
            self.register_buffer(name, buffer)
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
        )
        self.keep_keys()

    def _warm_up(self, tensordict: TensorDictBase) -> None:
        """Gives lazy networks their parameters, by the sizes of the first batch."""
        self._cold = False
        keys = self.tensor_keys
        data = {key: tensordict.get(key, None) for key in self.in_keys}
        shapes = {key: x.shape[2:] for key, x in data.items() if x is not None}
        shapes |= {keys.action_latent: (self.latent_dim,)}
        warm_up("task_encoder", self.task_encoder, shapes)
        with torch.no_grad():
            shapes[keys.task_latent] = self._encode(
                self._entries(tensordict, self.task_encoder.in_keys)
            ).shape[2:]
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
        return [
            "loss_classification",
            "loss_generator",
            "loss_direction",
            "loss_qvalue",
            "loss_latent_norm",
            *(["loss_metric"] if self.metric_weight is not None else []),
            *(["loss_isometry"] if self.isometry_weight is not None else []),
            "accuracy",
            "latent_norm",
        ]

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
        keys = self.task_encoder.in_keys
        latent = self._encode(self._entries(tensordict, keys))
        if self.context == "current":
            return latent
        if self.context == "previous":
            name = self.tensor_keys.previous
            if tensordict.get(name, None) is None:
                raise BMRLError(
                    f"the data have no {name!r}, which context='previous' "
                    "reads; valid: data of torchrl_bmrl.data.with_previous, or another context: "
                    + ", ".join(name for name in CONTEXTS if name != "previous")
                )
            other = self._encode(self._entries(tensordict, keys, under=name))
        else:
            # Rows of a task are draws from its data: others of the same row are its context.
            size = self.context_size if self.context == "set" else 1
            valid = self.valid_rows(tensordict, latent.shape[:2])
            other = _drawn(latent, valid, size).mean(2)
        chosen = torch.rand(latent.shape[:2], device=latent.device) < self.context_fraction
        return torch.where(chosen.unsqueeze(-1), other, latent)

    def _entries(
        self, tensordict: TensorDictBase, keys: Iterable[NestedKey], under: NestedKey = ()
    ) -> TensorDictBase:
        """Some entries, zeros in the rows that a mask leaves out."""
        batch = tensordict.batch_size
        valid = self.valid_rows(tensordict, batch)
        entries = {key: entry(tensordict, unravel_key((under, key)), valid) for key in keys}
        if valid is None:
            return (tensordict.get(under) if under else tensordict).select(*entries)
        result = TensorDict({}, batch)
        for key, value in entries.items():
            result.set(key, value)
        return result

    def _encode(self, transition: TensorDictBase) -> Tensor:
        return self._run("task_encoder", transition, self.tensor_keys.task_latent)

    def _run(self, name: str, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        """What one of the trained networks writes under a key."""
        network = getattr(self, name)
        with holding(network, getattr(self, f"{name}_params")):
            return output(read(network, tensordict), key, network)

    @torch.no_grad()
    def teach(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Teachers' actions and normalised values for freshly drawn latents.

        Returns:
            batch ``[num_tasks, B]`` with ``observation``, ``action_latent``, ``action`` and
            ``state_action_value (num_tasks, B, 1)``.
        """
        keys = self.tensor_keys
        data = self._entries(tensordict, self._teacher_observation_keys)
        latent = sample_action_latent(
            (*data.batch_size, self.latent_dim),
            latent_clip=self.latent_clip,
            device=self.qvalue_loc.device,
            dtype=self.qvalue_loc.dtype,
        )
        data = data.copy().set(keys.action_latent, latent)
        data = self._ask(self.teacher_qvalue_networks, self._ask(self.teacher_generators, data))
        value = data.get(keys.state_action_value)
        value = (value - self.qvalue_loc[:, None, None]) / self.qvalue_scale[:, None, None]
        return data.set(keys.state_action_value, value)

    def _ask(self, teachers: Any, data: TensorDictBase) -> TensorDictBase:
        return teachers(data, randomness=self.vmap_randomness, loop=self.deactivate_vmap)

    def imitate(self, taught: TensorDictBase, task_latent: Tensor) -> Tensor:
        """Student's action for the teachers' observations and latents.

        Args:
            taught: of :meth:`teach`.
            task_latent: m, ``(num_tasks, B, m)``.

        Returns:
            ``(num_tasks, B, action_dim)``.
        """
        data = taught.select(*self._teacher_observation_keys, self.tensor_keys.action_latent)
        data = data.copy().set(self.tensor_keys.task_latent, task_latent)
        action = self._run("student_generator", data, self.tensor_keys.action)
        check_same_shape(self.tensor_keys.action, taught.get(self.tensor_keys.action), action)
        return action

    def judge(self, taught: TensorDictBase, action: Tensor, task_latent: Tensor) -> Tensor:
        """Student's value of its own action, without a gradient into the action.

        Args:
            taught: of :meth:`teach`.
            action: of :meth:`imitate`.
            task_latent: m, ``(num_tasks, B, m)``.

        Returns:
            ``(num_tasks, B, 1)``.
        """
        keys = self.tensor_keys
        data = taught.select(*self._teacher_observation_keys).copy()
        data.set(keys.action, action.detach()).set(keys.task_latent, task_latent)
        value = self._run("student_qvalue_network", data, keys.state_action_value)
        check_same_shape(keys.state_action_value, taught.get(keys.state_action_value), value)
        return value

    def classify(self, task_latent: Tensor) -> Tensor:
        """Logits of the task, ``(num_tasks, B, num_tasks)``.

        Args:
            task_latent: m, ``(num_tasks, B, m)``.

        Raises:
            BMRLError: if the classifier knows another number of tasks.
        """
        keys = self.tensor_keys
        data = TensorDict({keys.task_latent: task_latent}, task_latent.shape[:-1])
        logits = self._run("task_classifier", data, keys.task_logits)
        if logits.shape[-1] != self.num_tasks:
            raise BMRLError(
                f"{keys.task_logits!r} has the shape {tuple(logits.shape)}; valid: "
                f"{(*task_latent.shape[:-1], self.num_tasks)}, a number for each task"
            )
        return logits

    def separate(self, task_latent: Tensor, valid: Tensor | None = None) -> Tensor:
        """Triplet error of each row's m against another row of its task and one of another.

        Args:
            task_latent: m, ``(num_tasks, B, m)``.
            valid: which rows count, ``(num_tasks, B)``; ``None`` if all do.

        Returns:
            ``(num_tasks, B)``.
        """
        num_tasks, rows = task_latent.shape[:2]
        device = task_latent.device
        # A cyclic shift by 1 to n - 1 is never the row, or the task, itself.
        if valid is None:
            shift = torch.randint(1, max(rows, 2), (rows,), device=device)
            near = task_latent[:, (torch.arange(rows, device=device) + shift) % rows]
            far = task_latent
        else:
            near, far = (_drawn(task_latent, valid, 1).squeeze(2) for _ in range(2))
        shift = torch.randint(1, num_tasks, (num_tasks, rows), device=device)
        task = (torch.arange(num_tasks, device=device).unsqueeze(-1) + shift) % num_tasks
        row = torch.randint(rows, (num_tasks, rows), device=device)
        return triplet_error(task_latent, near, far[task, row], self.metric_margin)

    def spread_out(self, tensordict: TensorDictBase) -> Tensor:
        """Error of each row's distances in m to its task's other rows, ``(num_tasks, B)``."""
        valid = self.valid_rows(tensordict, tensordict.batch_size)
        reward = entry(tensordict, next_key(self.tensor_keys.reward), valid)
        with torch.no_grad():
            # What the demonstrator did, without its noise.
            data = self._entries(tensordict, self._teacher_observation_keys)
            centre = self.qvalue_loc.new_zeros(*data.batch_size, self.latent_dim)
            data = data.copy().set(self.tensor_keys.action_latent, centre)
            action = self._ask(self.teacher_generators, data).get(self.tensor_keys.action)
        content = torch.cat([reward / self.reward_scale[:, None, None], action], -1)
        # Not embed's: m of a set has no reward and action of its own.
        m = self._encode(self._entries(tensordict, self.task_encoder.in_keys))
        return isometry_error(m, content, valid)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Computes the weighted terms; see the class for keys.

        Raises:
            BMRLError: for data that do not fit, as the class says.
        """
        self.check_names()
        if self._cold:
            self._warm_up(tensordict)
        if tensordict.ndim != 2 or tensordict.batch_size[0] != self.num_tasks:
            raise BMRLError(
                f"the data's batch size is {list(tensordict.batch_size)}; valid: "
                f"[{self.num_tasks}, B], one row per teacher"
            )
        valid = self.valid_rows(tensordict, tensordict.batch_size)
        task = entry(tensordict, self.tensor_keys.task, valid)
        if task.shape != tensordict.batch_size:
            raise BMRLError(
                f"{self.tensor_keys.task!r} has the shape {tuple(task.shape)}; valid: "
                f"{tuple(tensordict.batch_size)}"
            )
        check_index(self.tensor_keys.task, task, self.num_tasks)
        check_rows_of_tasks(self.tensor_keys.task, task, valid)
        m = self.embed(tensordict)
        reaching = {term: m if term in self.encoder_terms else m.detach() for term in ENCODER_TERMS}
        logits = self.classify(reaching["classification"])
        cross_entropy = F.cross_entropy(
            logits.flatten(0, 1), task.flatten().long(), reduction="none"
        )
        taught = self.teach(tensordict)
        target = taught.get(self.tensor_keys.action)
        action = {"generator": self.imitate(taught, reaching["generator"])}
        action["direction"] = (
            action["generator"]
            if reaching["direction"] is reaching["generator"]
            else self.imitate(taught, reaching["direction"])
        )
        value = self.judge(taught, action["generator"], reaching["qvalue"])
        error = (value - taught.get(self.tensor_keys.state_action_value)).squeeze(-1)
        norm = m.square().sum(-1)
        terms = {
            "loss_classification": self.classification_weight * cross_entropy.view_as(task),
            "loss_generator": self.generator_weight * squared_error(action["generator"], target),
            "loss_direction": self.direction_weight * direction_error(action["direction"], target),
            "loss_qvalue": self.qvalue_weight * error.square(),
            "loss_latent_norm": self.latent_norm_weight * norm,
        }
        if self.metric_weight is not None:
            terms["loss_metric"] = self.metric_weight * self.separate(reaching["metric"], valid)
        if self.isometry_weight is not None:
            terms["loss_isometry"] = self.isometry_weight * self.spread_out(tensordict)
        priority = sum(terms.values()).detach()
        tensordict.set(self.tensor_keys.priority, unpadded(priority, valid))
        losses = {name: self.reduce(term, tensordict) for name, term in terms.items()}
        losses["accuracy"] = average((logits.argmax(-1) == task).to(logits.dtype), valid)
        losses["latent_norm"] = average(norm, valid).sqrt()
        self._clear_weakrefs(tensordict, taught, "student_generator_params")
        return TensorDict(losses)


def _drawn(task_latent: Tensor, valid: Tensor | None, number: int) -> Tensor:
    """For each row the m of some rows of its task, ``(num_tasks, B, number, m)``."""
    num_tasks, rows, size = task_latent.shape
    if valid is None:
        return task_latent[:, torch.randint(rows, (rows, number), device=task_latent.device)]
    # The rows that count come first; a task without one draws its first row, which counts nowhere.
    order = (~valid).to(torch.uint8).argsort(dim=-1, stable=True)
    count = valid.sum(-1, keepdim=True).clamp(min=1)
    share = torch.rand(num_tasks, rows * number, device=task_latent.device)
    index = order.gather(1, (share * count).long().clamp(max=rows - 1))
    chosen = task_latent.gather(1, index.unsqueeze(-1).expand(-1, -1, size))
    return chosen.view(num_tasks, rows, number, size)


def _check_equal_bounds(networks: Sequence[tuple[str, Any]]) -> None:
    """Refuses decoders that say different bounds of the action."""
    said = [(name, x.bounds) for name, x in networks if getattr(x, "bounds", None) is not None]
    for name, bounds in said[1:]:
        first, other = said[0]
        for one, two in zip(other, bounds, strict=True):
            pair = torch.broadcast_tensors(one.double(), two.double())
            if not torch.allclose(pair[0], pair[1]):
                raise BMRLError(
                    f"the actions of {name} end at {two.tolist()}, those of {first} at "
                    f"{one.tolist()}; valid: equal bounds"
                )
