"""The task embedding of a demonstration, aligned with an episode: one-shot imitation."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from torchrl_bmrl.errors import BMRLError, UnknownNameError
from torchrl_bmrl.modules.task_latent import (
    TRANSITION_KEYS,
    PrototypeTaskLatent,
    check_reads_transitions,
    last_transition,
    only_in_environments,
)

ALIGNMENTS = ("time", "state", "progress")
"""How the embeddings follow an episode; see :class:`DemonstrationTaskLatent`."""


@torch.no_grad()
def _embed(demonstration: TensorDictBase, encoder: TensorDictModule) -> Tensor:
    """Embeddings of a demonstration's transitions, ``(T, m)``."""
    check_reads_transitions(encoder)
    shapes = {}
    for key in TRANSITION_KEYS:
        value = demonstration.get(key, None)
        if value is None:
            raise BMRLError(f"the demonstration has no {key!r}; valid: {list(TRANSITION_KEYS)}")
        shapes[key] = tuple(value.shape)
    try:
        return encoder(demonstration.select(*TRANSITION_KEYS)).get("task_latent")
    except RuntimeError as error:
        raise BMRLError(
            f"the demonstration's shapes are {shapes}; valid: those that the encoder was trained "
            f"on ({error})"
        ) from error


class DemonstrationTaskLatent(PrototypeTaskLatent):
    """Writes the embedding of one of a demonstration's transitions at each step.

    If the demonstration has ``stage (T,)``, a composition's number of finished tasks, the transform
    also reads the episode's ``stage (*B,)``. It then uses the demonstration's transitions of that
    stage, or of the demonstration's last stage if it lacks that one.

    Args:
        demonstration: the demonstration's transitions, batch size ``(T,)``, with the keys of
            :data:`TRANSITION_KEYS`.
        encoder: :func:`make_task_encoder`'s module, trained.
        alignment: ``"time"``: the next transition at each step, at last the stage's last one;
            ``"state"``: the transition with the nearest observation; ``"progress"``: the transition
            whose embedding is nearest to that of the episode's last transition, at most ``window``
            ahead of the current one. ``"time"`` does not wait for a slowed arm, ``"progress"``
            does.
        window: transitions that ``"progress"`` may advance in one step.

    Raises:
        BMRLError: for another alignment, a window below one, or a demonstration that is empty,
            lacks a key, has stages that go back, or sizes that the encoder does not take; and for
            an encoder that reads anything but transitions.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv
        >>> from torchrl_bmrl.modules import make_task_encoder
        >>> env = ContinuousActionVecMockEnv()
        >>> source = DemonstrationTaskLatent(env.rollout(5), make_task_encoder(7, 7))
        >>> latent = TransformedEnv(env, source).rollout(3)["task_latent"]
        >>> torch.equal(latent, source.latents[:3])
        True
    """

    def __init__(
        self,
        demonstration: TensorDictBase,
        encoder: TensorDictModule,
        *,
        alignment: str = "time",
        window: int = 20,
    ) -> None:
        if alignment not in ALIGNMENTS:
            raise UnknownNameError("alignment", alignment, ALIGNMENTS)
        if not len(demonstration):
            raise BMRLError("a demonstration of 0 transitions; valid: at least one")
        if window < 1:
            raise BMRLError(f"window is {window}; valid: at least 1")
        latents = _embed(demonstration, encoder)
        super().__init__(latents[0])
        self.alignment = alignment
        self.window = window
        self.encoder = encoder
        self.register_buffer("latents", latents)
        self.register_buffer("observations", demonstration.get("observation").clone())
        stages = demonstration.get("stage", None)
        if stages is None:
            stages = torch.zeros(len(latents), dtype=torch.int64)
        if stages.shape != latents.shape[:1] or (stages.diff() < 0).any() or stages[0] < 0:
            raise BMRLError(
                f"stage of the demonstration is {stages.tolist()}; valid: a number for each of its "
                f"{len(latents)} transitions, from 0 on, that never goes back"
            )
        # The first transition of each stage, and the end.
        number = torch.arange(int(stages.max()) + 2)
        self.register_buffer("first", torch.searchsorted(stages.contiguous(), number))
        self.staged = "stage" in demonstration.keys()  # noqa: SIM118 (a TensorDict)
        self._stage = self._position = torch.zeros((), dtype=torch.int64)

    def _candidates(self) -> tuple[Tensor, Tensor]:
        """First and last transition that each episode may use now."""
        return self.first[self._stage], self.first[self._stage + 1] - 1

    def _stage_of(self, tensordict: TensorDictBase, otherwise: Tensor) -> Tensor:
        """The episodes' stages, limited to those of the demonstration."""
        if not self.staged:
            return otherwise
        return tensordict.get("stage").clamp(max=len(self.first) - 2)

    def _write(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("task_latent", self.latents[self._position])

    def _nearest(self, distance: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """Index of the smallest ``distance (*B, T)`` between ``low`` and ``high (*B,)``."""
        number = torch.arange(len(self.latents), device=distance.device)
        outside = (number < low.unsqueeze(-1)) | (number > high.unsqueeze(-1))
        return distance.masked_fill(outside, torch.inf).argmin(-1)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape, device = tensordict_reset.batch_size, self.latents.device
        start = torch.zeros(shape, dtype=torch.int64, device=device)
        reset = None if tensordict is None else tensordict.get("_reset", None)
        # Some of several environments may be reset while others continue.
        anew = torch.ones_like(start, dtype=torch.bool) if reset is None else reset.reshape(shape)
        self._stage = torch.where(anew, self._stage_of(tensordict_reset, start), self._stage)
        low, high = self._candidates()
        if self.alignment == "state":
            low = self._nearest(self._state_distance(tensordict_reset), low, high)
        self._position = torch.where(anew, low, self._position)
        return self._write(tensordict_reset)

    def _state_distance(self, tensordict: TensorDictBase) -> Tensor:
        observation = tensordict.get("observation").unsqueeze(-2)
        return (observation - self.observations).norm(dim=-1)

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        stage = self._stage_of(next_tensordict, self._stage)
        moved = stage != self._stage
        self._stage = stage
        low, high = self._candidates()
        if self.alignment == "time":
            position = torch.minimum(self._position + 1, high)
        elif self.alignment == "state":
            position = self._nearest(self._state_distance(next_tensordict), low, high)
        else:
            last = self.encoder(last_transition(tensordict, next_tensordict)).get("task_latent")
            distance = (last.unsqueeze(-2) - self.latents).norm(dim=-1)
            ahead = torch.minimum(self._position + self.window, high)
            position = self._nearest(distance, torch.minimum(self._position, high), ahead)
        if self.alignment != "state":
            position = torch.where(moved, low, position)
        self._position = position
        return self._write(next_tensordict)

    forward = only_in_environments
