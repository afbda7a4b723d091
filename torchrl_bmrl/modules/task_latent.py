"""The task embedding m: its encoder, and transforms that write it for an acting policy.

Training embeds a transition (s, a, r, s'). An acting policy does not have the present transition
yet, so an environment transform writes ``task_latent`` for it: :class:`PrototypeTaskLatent`,
:class:`OnlineTaskLatent`, :class:`PathTaskLatent` or :class:`DemonstrationTaskLatent`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.modules.generator import Network, make_mlp

TRANSITION_KEYS = ("observation", "action", ("next", "reward"), ("next", "observation"))
"""Keys that the task encoder reads, in this order."""


def make_task_encoder(
    observation_dim: int,
    action_dim: int,
    task_latent_dim: int = 2,
    *,
    num_cells: Sequence[int] = (256, 256),
) -> TensorDictModule:
    r"""Encoder :math:`M` of a transition :math:`(s, a, r, s')`.

    Reads ``observation (*B, obs_dim)``, ``action (*B, action_dim)``, ``("next", "reward")
    (*B, 1)``, ``("next", "observation")``; writes ``task_latent (*B, task_latent_dim)``.

    Reference: *Compositional Skill Learning Using Batch Meta RL*, section 6.2.

    Args:
        observation_dim: size of the observation.
        action_dim: size of the action.
        task_latent_dim: size of m.
        num_cells: widths of the hidden layers.

    Example:
        >>> make_task_encoder(3, 2).out_keys
        ['task_latent']
    """
    network = make_mlp(2 * observation_dim + action_dim + 1, task_latent_dim, num_cells)
    sizes = {"observation": observation_dim, "action": action_dim, "task_latent": task_latent_dim}
    return Network(network, in_keys=list(TRANSITION_KEYS), out_keys=["task_latent"], sizes=sizes)


def make_one_hot_encoder(num_tasks: int) -> TensorDictModule:
    """Encoder that writes the task's index, one-hot, as m; it has no parameters.

    It replaces :func:`make_task_encoder` in an ablation. It reads ``task (*B,)``, int64, and writes
    ``task_latent (*B, num_tasks)``.

    Args:
        num_tasks: number of tasks; ``task`` is smaller.

    Example:
        >>> make_one_hot_encoder(3)(TensorDict({"task": torch.tensor([2])}, [1])).get("task_latent")
        tensor([[0., 0., 1.]])
    """
    sizes = {"task_latent": num_tasks}
    return Network(_OneHot(num_tasks), in_keys=["task"], out_keys=["task_latent"], sizes=sizes)


class _OneHot(torch.nn.Module):
    def __init__(self, num_tasks: int) -> None:
        super().__init__()
        self.num_tasks = num_tasks

    def forward(self, task: Tensor) -> Tensor:
        return torch.nn.functional.one_hot(task, self.num_tasks).to(torch.get_default_dtype())


def make_task_classifier(num_tasks: int, task_latent_dim: int = 2) -> TensorDictModule:
    """Classifier :math:`P`: one linear layer from ``task_latent`` to ``task_logits``.

    Reference: *Compositional Skill Learning Using Batch Meta RL*, section 6.2.

    Args:
        num_tasks: number of tasks and of logits.
        task_latent_dim: size of m.

    Example:
        >>> make_task_classifier(6).out_keys
        ['task_logits']
    """
    return Network(
        torch.nn.Linear(task_latent_dim, num_tasks),
        in_keys=["task_latent"],
        out_keys=["task_logits"],
        sizes={"task_latent": task_latent_dim},
    )


def prototype(task_latent: Tensor, kind: str = "mean") -> Tensor:
    """One point that represents a task.

    Args:
        task_latent: embeddings of the task's transitions, ``(N, m)``.
        kind: ``"mean"``, or ``"medoid"``: the embedding nearest to the coordinate-wise median.

    Returns:
        ``(m,)``.

    Raises:
        BMRLError: for another kind or no embeddings.

    Example:
        >>> prototype(torch.tensor([[0.0], [1.0], [5.0]]), "medoid")
        tensor([1.])
    """
    if not len(task_latent):
        raise BMRLError("a prototype needs at least one embedding")
    if kind == "mean":
        return task_latent.mean(0)
    if kind == "medoid":
        centre = task_latent.median(0).values
        return task_latent[(task_latent - centre).norm(dim=-1).argmin()]
    raise UnknownNameError("prototype", kind, ("mean", "medoid"))


class PrototypeTaskLatent(Transform):
    """Writes the same ``task_latent`` at every step.

    Args:
        task_latent: the point, ``(m,)``.

    Raises:
        BMRLError: for anything but a tensor.

    Example:
        >>> transform = PrototypeTaskLatent(torch.zeros(2))
        >>> transform(TensorDict({}, [])).get("task_latent")
        tensor([0., 0.])
    """

    task_latent: Tensor

    def __init__(self, task_latent: Tensor) -> None:
        super().__init__(in_keys=[], out_keys=["task_latent"])
        if not isinstance(task_latent, Tensor):
            raise BMRLError(
                f"task_latent is a {type(task_latent).__name__}; valid: a tensor (m,), before the "
                "encoder where there is one"
            )
        self.register_buffer("task_latent", task_latent.detach().clone())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the point into a batch of any shape."""
        shape = (*tensordict.batch_size, self.task_latent.shape[-1])
        return tensordict.set("task_latent", self.task_latent.expand(shape).clone())

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds ``task_latent``."""
        shape = (*observation_spec.shape, self.task_latent.shape[-1])
        observation_spec["task_latent"] = Unbounded(shape, device=observation_spec.device)
        return observation_spec


def check_reads_transitions(encoder: TensorDictModule) -> None:
    """Checks that an encoder of m reads single transitions and nothing else.

    Args:
        encoder: of m.

    Raises:
        BMRLError: naming what it reads.
    """
    others = [key for key in encoder.in_keys if key not in TRANSITION_KEYS]
    if others:
        raise BMRLError(f"the encoder reads {others}; valid: single transitions, {TRANSITION_KEYS}")


def last_transition(tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDict:
    """The transition that an environment has just taken, with the keys that the encoder reads."""
    return TensorDict(
        {
            "observation": tensordict.get("observation"),
            "action": tensordict.get("action"),
            "next": next_tensordict.select("observation", "reward"),
        },
        batch_size=tensordict.batch_size,
    )


def only_in_environments(self: Transform, tensordict: TensorDictBase) -> TensorDictBase:
    """Not defined outside an environment, because the transform needs an episode.

    Raises:
        BMRLError: always.
    """
    raise BMRLError(f"{type(self).__name__} acts in an environment, not on stored data")


class OnlineTaskLatent(PrototypeTaskLatent):
    """Writes the embedding of the last transition; the prototype at the first step.

    Args:
        task_latent: the prototype of the first step, ``(m,)``.
        encoder: :func:`make_task_encoder`'s module, trained.

    Raises:
        BMRLError: for an encoder that reads anything but transitions.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
        >>> online = OnlineTaskLatent(torch.zeros(2), make_task_encoder(7, 7))
        >>> env = TransformedEnv(ContinuousActionVecMockEnv(), online)
        >>> latent = env.rollout(3)["task_latent"]
        >>> latent.shape, latent[0]
        (torch.Size([3, 2]), tensor([0., 0.]))
    """

    def __init__(self, task_latent: Tensor, encoder: TensorDictModule) -> None:
        super().__init__(task_latent)
        check_reads_transitions(encoder)
        self.encoder = encoder

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        encoded = self.encoder(last_transition(tensordict, next_tensordict))
        return next_tensordict.set("task_latent", encoded.get("task_latent"))


class StageTaskLatent(PrototypeTaskLatent):
    """Writes the point of the current stage, as an oracle that knows the task index does.

    It reads ``stage (*B,)``, the number of finished stages.

    Args:
        task_latents: a point for each stage, ``(stages, m)``; the last one is kept at the end.

    Example:
        >>> transform = StageTaskLatent(torch.tensor([[0.0], [1.0]]))
        >>> transform(TensorDict({"stage": torch.tensor([0, 1, 2])}, [3])).get("task_latent")
        tensor([[0.],
                [1.],
                [1.]])
    """

    task_latents: Tensor

    def __init__(self, task_latents: Tensor) -> None:
        super().__init__(task_latents[0])
        self.register_buffer("task_latents", task_latents.detach().clone())

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the points into a batch of any shape."""
        stage = tensordict.get("stage").clamp(max=len(self.task_latents) - 1)
        return tensordict.set("task_latent", self.task_latents[stage])


class PathTaskLatent(PrototypeTaskLatent):
    """Writes the points of a path, one for each step, and then keeps the last one.

    Args:
        points: one path for all environments, ``(T, m)``, or one for each of a batch,
            ``(*B, T, m)``; a path of one point is constant.

    Raises:
        BMRLError: if there is no point; at a reset, if the batch of paths is not the environment's.

    Example:
        >>> PathTaskLatent(torch.linspace(0, 1, 5).unsqueeze(-1)).task_latent
        tensor([0.])
    """

    def __init__(self, points: Tensor) -> None:
        if points.ndim < 2 or not points.shape[-2]:
            raise BMRLError(f"points have shape {tuple(points.shape)}; valid: (*B, T, m), T > 0")
        super().__init__(points[..., 0, :])
        self.register_buffer("points", points.detach().clone())
        self._time = torch.zeros((), dtype=torch.int64)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        batch, (length, size) = tensordict.batch_size, self.points.shape[-2:]
        index = self._time.clamp(max=length - 1).reshape(*batch, 1, 1).expand(*batch, 1, size)
        latent = self.points.expand(*batch, length, size).gather(-2, index).squeeze(-2)
        return tensordict.set("task_latent", latent)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape, paths = tensordict_reset.batch_size, self.points.shape[:-2]
        if paths and paths != shape:
            raise BMRLError(
                f"paths of batch {tuple(paths)} in an environment of {tuple(shape)}; valid: one "
                "path, or one for each"
            )
        start = torch.zeros(shape, dtype=torch.int64, device=self.points.device)
        reset = None if tensordict is None else tensordict.get("_reset", None)
        # Some of several environments may be reset while others continue.
        self._time = start if reset is None else self._time.masked_fill(reset.reshape(shape), 0)
        return self._write(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._time = self._time + 1
        return self._write(next_tensordict)

    forward = only_in_environments
