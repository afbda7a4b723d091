"""A demonstration gives the task embedding by time, by state or by progress."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from helpers import ACTION_DIM, OBSERVATION_DIM, TASK_LATENT_DIM, transitions
from latent_sources import Walk, demonstration, driven, embedded, make_encoder
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.modules import DemonstrationTaskLatent

encoder = pytest.fixture(make_encoder)


def staged() -> TensorDict:
    """Seven transitions of a demonstration: three of stage 0, two of stage 1, two after the end."""
    data = transitions(7, dtype=torch.float32)
    return data.set("stage", torch.tensor([0, 0, 0, 1, 1, 2, 2]))


# -- by time and by state --------------------------------------------------------------------------


def test_demonstration_by_time_goes_step_by_step_and_holds_its_last(
    encoder: TensorDictModule,
) -> None:
    env = TransformedEnv(Walk(), DemonstrationTaskLatent(demonstration(), encoder))
    latents = embedded(encoder, demonstration())
    for steps in (10, 2, 10):  # an episode that is broken off restarts as well
        latent = env.rollout(steps)["task_latent"]
        expected = latents[torch.arange(min(steps, 6)).clamp(max=3)]
        assert torch.equal(latent, expected)


@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_demonstration_by_state_takes_the_nearest_observation(
    batch_size: tuple[int, ...], encoder: TensorDictModule
) -> None:
    env = TransformedEnv(
        Walk(batch_size), DemonstrationTaskLatent(demonstration(), encoder, alignment="state")
    )
    latents = embedded(encoder, demonstration())
    assert torch.equal(env.reset()["task_latent"], latents[0].expand(*batch_size, TASK_LATENT_DIM))
    for x, nearest in ((18.0, 2), (-7.0, 0), (999.0, 3)):
        data = env.reset()
        data["observation"] = torch.tensor([x, 0.0, 0.0]).expand(*batch_size, OBSERVATION_DIM)
        data["action"] = torch.zeros(*batch_size, ACTION_DIM)
        latent = env.step(data)["next", "task_latent"]
        assert torch.equal(latent, latents[nearest].expand(*batch_size, TASK_LATENT_DIM))


# -- in stages -------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch_size", [(), (2,)])
def test_a_staged_demonstration_by_time_waits_for_the_stage_and_starts_anew_with_it(
    batch_size: tuple[int, ...], encoder: TensorDictModule
) -> None:
    transform = DemonstrationTaskLatent(staged(), encoder)
    expected = embedded(encoder, staged())[[0, 1, 2, 2, 2, 3, 5, 6, 6]]
    latents = driven(transform, [0, 0, 0, 0, 0, 1, 2, 2, 2], batch_size)
    assert torch.equal(latents, expected.expand_as(latents))


@pytest.mark.parametrize("alignment", ["state", "progress"])
def test_a_staged_demonstration_drives_a_stage_with_its_own_transitions_alone(
    alignment: str, encoder: TensorDictModule
) -> None:
    transform = DemonstrationTaskLatent(staged(), encoder, alignment=alignment)
    latents = embedded(encoder, staged())
    stages = [0, 0, 0, 1, 1, 1, 2, 2]
    for latent, stage in zip(driven(transform, stages), stages, strict=True):
        mine = latents[staged()["stage"] == stage]
        assert (latent == mine).all(-1).any()


def test_a_stage_that_the_demonstration_lacks_is_driven_by_its_last(
    encoder: TensorDictModule,
) -> None:
    transform = DemonstrationTaskLatent(staged()[:5], encoder)
    latents = driven(transform, [1, 1, 2, 2])
    assert torch.equal(latents[1:], embedded(encoder, staged())[[4, 4, 4]])


# -- by progress -----------------------------------------------------------------------------------


def test_progress_never_goes_back_nor_further_than_its_window(encoder: TensorDictModule) -> None:
    data = transitions(40, dtype=torch.float32)
    latents = embedded(encoder, data)
    for window in (1, 4):
        transform = DemonstrationTaskLatent(data, encoder, alignment="progress", window=window)
        transform._reset(None, data[0].exclude("next"))
        position = 0
        for t in (1, 39, 0, 30, 20, 5, 39):  # an episode that jumps to and fro
            latent = transform._step(data[t], data[t]["next"].clone())["task_latent"]
            reachable = latents[position : position + window + 1]
            position += int((reachable - latents[t]).norm(dim=-1).argmin())
            assert torch.equal(latent, latents[position])
        assert position > window


def test_progress_follows_an_episode_that_repeats_the_demonstration(
    encoder: TensorDictModule,
) -> None:
    data = transitions(8, dtype=torch.float32)
    transform = DemonstrationTaskLatent(data, encoder, alignment="progress")
    latents = embedded(encoder, data)
    transform._reset(None, data[0].exclude("next"))
    for t in range(8):
        for _ in range(2):  # at half the speed
            following = data[t]["next"].clone()
            latent = transform._step(data[t], following)["task_latent"]
            assert torch.equal(latent, latents[t])


def test_progress_stays_where_it_is_when_an_episode_falls_back(
    encoder: TensorDictModule,
) -> None:
    data = transitions(8, dtype=torch.float32)
    latents = embedded(encoder, data)
    transform = DemonstrationTaskLatent(data, encoder, alignment="progress")
    transform._reset(None, data[0].exclude("next"))
    positions = []
    for t in (5, 1):
        latent = transform._step(data[t], data[t]["next"].clone())["task_latent"]
        positions.append(int((latents == latent).all(-1).nonzero()[0]))
    nearest = (latents[5:] - latents[1]).norm(dim=-1).argmin()
    assert positions == [5, 5 + int(nearest)]


# -- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rows", "options", "says"),
    [(0, {}, "0 transitions; valid: at least one"), (4, {"window": 0}, "window is 0; valid")],
)
def test_a_demonstration_that_cannot_drive_is_refused(
    rows: int, options: dict[str, Any], says: str, encoder: TensorDictModule
) -> None:
    with pytest.raises(BMRLError, match=says):
        DemonstrationTaskLatent(demonstration()[:rows], encoder, **options)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d.exclude(("next", "reward")), r"has no \('next', 'reward'\); valid: \["),
        (lambda d: d.set("observation", torch.zeros(7, 9)), r"'observation': \(7, 9\)"),
        (lambda d: d.set("action", torch.zeros(7, 1)), r"'action': \(7, 1\)"),
        (lambda d: d.set("stage", torch.tensor([0, 1, 0, 1, 1, 1, 1])), "never goes back"),
        (lambda d: d.set("stage", d["stage"] - 1), "from 0 on"),
    ],
    ids=["no reward", "other observation", "other action", "stages go back", "negative stage"],
)
def test_a_demonstration_of_another_layout_is_refused(
    change: Callable[[TensorDict], TensorDict], says: str, encoder: TensorDictModule
) -> None:
    with pytest.raises(BMRLError, match=says):
        DemonstrationTaskLatent(change(staged()), encoder)


def test_an_unknown_alignment_is_refused_with_the_valid_ones(encoder: TensorDictModule) -> None:
    with pytest.raises(BMRLError, match="'phase'; valid alignments: time, state, progress"):
        DemonstrationTaskLatent(demonstration(), encoder, alignment="phase")


def test_a_demonstration_is_no_transform_of_stored_data(encoder: TensorDictModule) -> None:
    with pytest.raises(BMRLError, match="environment"):
        DemonstrationTaskLatent(demonstration(), encoder)(demonstration())
