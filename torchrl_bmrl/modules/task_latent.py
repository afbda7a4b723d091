"""The task embedding m: the encoder that makes it, and where m comes from when acting.

Training embeds a transition (s, a, r, s'); an acting policy does not have the present one yet.
Three environment transforms write ``task_latent`` for it: :class:`PrototypeTaskLatent`,
:class:`OnlineTaskLatent` and :class:`DemonstrationTaskLatent`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules.generator import Network, make_mlp

TRANSITION_KEYS = ("observation", "action", ("next", "reward"), ("next", "observation"))
"""What the task encoder reads, in this order."""


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

    Example:
        >>> make_task_encoder(3, 2).out_keys
        ['task_latent']
    """
    network = make_mlp(2 * observation_dim + action_dim + 1, task_latent_dim, num_cells)
    return Network(network, in_keys=list(TRANSITION_KEYS), out_keys=["task_latent"])


def make_task_classifier(num_tasks: int, task_latent_dim: int = 2) -> TensorDictModule:
    """Classifier :math:`P`: one linear layer from ``task_latent`` to ``task_logits``.

    Example:
        >>> make_task_classifier(6).out_keys
        ['task_logits']
    """
    return Network(
        torch.nn.Linear(task_latent_dim, num_tasks),
        in_keys=["task_latent"],
        out_keys=["task_logits"],
    )


def prototype(task_latent: Tensor, kind: str = "mean") -> Tensor:
    """One point that stands for a task.

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
    raise BMRLError(f"unknown prototype {kind!r}; valid: mean, medoid")


class PrototypeTaskLatent(Transform):
    """Writes the same ``task_latent`` at every step.

    Args:
        task_latent: the point, ``(m,)``.

    Example:
        >>> transform = PrototypeTaskLatent(torch.zeros(2))
        >>> transform(TensorDict({}, [])).get("task_latent")
        tensor([0., 0.])
    """

    task_latent: Tensor

    def __init__(self, task_latent: Tensor) -> None:
        super().__init__(in_keys=[], out_keys=["task_latent"])
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


class OnlineTaskLatent(PrototypeTaskLatent):
    """Writes the embedding of the last transition; the prototype at the first step.

    Args:
        encoder: :func:`make_task_encoder`'s module, trained.
        task_latent: the prototype of the first step, ``(m,)``.
    """

    def __init__(self, encoder: TensorDictModule, task_latent: Tensor) -> None:
        super().__init__(task_latent)
        self.encoder = encoder

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        transition = TensorDict(
            {
                "observation": tensordict.get("observation"),
                "action": tensordict.get("action"),
                "next": next_tensordict.select("observation", "reward"),
            },
            batch_size=tensordict.batch_size,
        )
        return next_tensordict.set("task_latent", self.encoder(transition).get("task_latent"))


class DemonstrationTaskLatent(PrototypeTaskLatent):
    """Writes the embeddings of one demonstration.

    Args:
        demonstration: the demonstration's transitions, batch size ``(T,)``, with the keys of
            :data:`TRANSITION_KEYS`.
        encoder: :func:`make_task_encoder`'s module, trained.
        alignment: ``"time"``: at step t the embedding of the demonstration's transition t, and its
            last one beyond the end; ``"state"``: that of the transition whose observation is
            nearest.

    Raises:
        BMRLError: for another alignment.
    """

    def __init__(
        self, demonstration: TensorDictBase, encoder: TensorDictModule, *, alignment: str = "time"
    ) -> None:
        if alignment not in ("time", "state"):
            raise BMRLError(f"unknown alignment {alignment!r}; valid: time, state")
        with torch.no_grad():
            latents = encoder(demonstration.select(*TRANSITION_KEYS)).get("task_latent")
        super().__init__(latents[0])
        self.alignment = alignment
        self.register_buffer("latents", latents)
        self.register_buffer("observations", demonstration.get("observation").clone())
        self._time = torch.zeros((), dtype=torch.int64)

    def _aligned(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.alignment == "time":
            latent = self.latents[self._time.clamp(max=len(self.latents) - 1)]
        else:
            distance = torch.cdist(
                tensordict.get("observation").reshape(-1, self.observations.shape[-1]),
                self.observations,
            )
            latent = self.latents[distance.argmin(-1)]
            latent = latent.reshape(*tensordict.batch_size, latent.shape[-1])
        return tensordict.set("task_latent", latent)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        start = torch.zeros(
            tensordict_reset.batch_size, dtype=torch.int64, device=self.latents.device
        )
        reset = None if tensordict is None else tensordict.get("_reset", None)
        # Of several environments some may restart while others go on.
        self._time = (
            start if reset is None else torch.where(reset.reshape(start.shape), start, self._time)
        )
        return self._aligned(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._time = self._time + 1
        return self._aligned(next_tensordict)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Not defined outside an environment: the alignment needs an episode."""
        raise BMRLError("DemonstrationTaskLatent acts in an environment, not on stored data")
