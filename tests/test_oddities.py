"""What `check` warns of: each oddity is found where it is, and nothing where there is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

pytest.importorskip("h5py")

from episode_files import PARTS, TASK_PARTS, make_episode

from torchrl_bmrl.data.episodes import Episode, LeftOut
from torchrl_bmrl.data.oddities import FROZEN_STEPS, Oddities
from torchrl_bmrl.data.summary import summarise

STEPS = 60


def demonstration(
    seed: int = 0, steps: int = STEPS, *, start: np.ndarray | None = None, **changes: Any
) -> Episode:
    """Smooth motion under commands that change, a camera, and a reward of 1 at the end."""
    rng = np.random.default_rng(seed)
    actions = np.cumsum(0.2 * rng.normal(size=(steps, 2)), axis=0).clip(-1, 1)
    first = rng.uniform(-5, 5, size=(1, 2)) if start is None else start
    path = np.concatenate([first, first + np.cumsum(0.05 * actions, axis=0)])
    image = rng.integers(0, 255, (steps + 1, 4, 4, 3)).astype(np.uint8)
    whole = {"position": path, "image": image, "goal": np.tile(rng.normal(size=2), (steps + 1, 1))}
    return replace(
        Episode(
            observations={name: part[:-1].copy() for name, part in whole.items()},
            next_observations={name: part[1:].copy() for name, part in whole.items()},
            actions=actions,
            rewards=1.0 * (np.arange(steps) == steps - 1),
            terminated=np.zeros(steps, bool),
            extras={"successes": np.arange(steps) == steps - 1},
            attributes={"success": True},
        ),
        **changes,
    )


def warnings_of(episodes: Sequence[Episode]) -> list[str]:
    oddities = Oddities()
    for number, episode in enumerate(episodes):
        oddities.add(f"demo_{number}", episode)
    return oddities.warnings()


def stop(episode: Episode, first: int, last: int, *, keys: Sequence[str] = ()) -> Episode:
    """The recording of some parts, or of all, stays as it was at step ``first``."""
    for name in keys or episode.observations:
        part, after = episode.observations[name], episode.next_observations[name]
        part[first : last + 1] = part[first]
        after[: len(part) - 1] = part[1:]
        if last == len(part) - 1:
            after[-1] = part[first]
    return episode


# -- none where there is none ----------------------------------------------------------------------


def pieces(episode: Episode, length: int) -> list[Episode]:
    """An episode cut up."""

    def cut(arrays: Any, rows: slice) -> Any:
        return {name: array[rows] for name, array in arrays.items()}

    parts = [slice(i, i + length) for i in range(0, len(episode), length)]
    return [
        replace(
            episode,
            observations=cut(episode.observations, rows),
            next_observations=cut(episode.next_observations, rows),
            actions=episode.actions[rows],
            rewards=episode.rewards[rows],
            terminated=episode.terminated[rows],
            extras=cut(episode.extras, rows),
            attributes={},
        )
        for rows in parts
    ]


UNSUSPECTED: dict[str, Callable[[], Sequence[Episode]]] = {
    "none": lambda: [],
    "demonstrations": lambda: [demonstration(i) for i in range(5)],
    "random numbers": lambda: [make_episode(i, 5 + i) for i in range(5)],
    "the tasks' random numbers": lambda: [make_episode(i, 40, parts=TASK_PARTS) for i in range(3)],
    "one step": lambda: [make_episode(i, 1) for i in range(5)],
    "a scalar part": lambda: [make_episode(i, parts={"x": ((), "f8")}) for i in range(3)],
    "flags": lambda: [make_episode(i, 20, parts={"x": ((2,), "?"), **PARTS}) for i in range(3)],
    "short stops": lambda: [stop(demonstration(i), 20, 18 + FROZEN_STEPS) for i in range(3)],
    "rest under one command": lambda: [
        stop(demonstration(i, actions=np.repeat(np.eye(3, 2), 20, axis=0)), 22, 38)
        for i in range(3)
    ],
    "short ends": lambda: [
        stop(
            demonstration(i, actions=np.minimum(np.arange(STEPS), 51)[:, None] / STEPS),
            STEPS - FROZEN_STEPS + 1,
            STEPS - 1,
        )
        for i in range(3)
    ],
    "a short rest after a constant command": lambda: [
        stop(demonstration(i, actions=np.ones((STEPS, 2))), STEPS - 6, STEPS - 1) for i in range(3)
    ],
    "a constant command in motion": lambda: [
        demonstration(i, actions=np.ones((STEPS, 2))) for i in range(3)
    ],
    "a gripper that is used in few": lambda: [
        replace(
            episode,
            observations={
                **episode.observations,
                "held": 1.0 * (np.arange(STEPS) > 30 + i) * (i < 2),
            },
            next_observations={**episode.next_observations, "held": np.zeros(STEPS)},
        )
        for i, episode in enumerate(demonstration(i) for i in range(5))
    ],
    "short and at rest": lambda: [
        stop(demonstration(0, 6, attributes={}), 0, 5, keys=["position", "image"]) for _ in range(3)
    ],
    "pieces of one recording": lambda: pieces(demonstration(steps=180), 60),
    "a return to the start": lambda: [
        demonstration(i, observations={"x": loop}, next_observations={"x": np.roll(loop, -1)})
        for i in range(3)
        for loop in [np.sin(np.linspace(0, 2 * np.pi, STEPS, endpoint=False))]
    ],
    "nothing known of success": lambda: [demonstration(i, attributes={}) for i in range(3)],
    "rewards of 1 while alive": lambda: [
        demonstration(i, rewards=np.ones(STEPS), extras={}, attributes={"success": False})
        for i in range(3)
    ],
    "dense rewards": lambda: [
        demonstration(i, rewards=np.full(STEPS, 0.1), extras={}, attributes={"success": False})
        for i in range(3)
    ],
    "no rewards": lambda: [demonstration(i, rewards=np.zeros(STEPS)) for i in range(3)],
    "a success that was left out": lambda: [
        demonstration(
            i,
            rewards=np.zeros(STEPS) if i else demonstration().rewards,
            extras={"successes": np.zeros(STEPS, bool)},
            left_out=LeftOut(steps=1, reward=1.0, success=True),
        )
        for i in range(3)
    ],
}


@pytest.mark.parametrize("name", UNSUSPECTED)
def test_what_is_as_it_should_be_is_not_warned_of(name: str) -> None:
    assert warnings_of(UNSUSPECTED[name]()) == []


@pytest.mark.robosuite
@pytest.mark.parametrize("noise", [0.0, 0.2])
@pytest.mark.parametrize("task", ["reach", "lift", "push_up"])
def test_scripted_demonstrations_are_not_warned_of(task: str, noise: float) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    from torchrl_bmrl.tasks import get_task

    expert = get_task(task)
    episodes = [expert.record(i, noise=noise, **expert.options) for i in range(3)]
    assert warnings_of(episodes) == []


# -- found where it is -----------------------------------------------------------------------------


def test_a_frozen_recording_is_found() -> None:
    episodes = [demonstration(i) for i in range(4)]
    stop(episodes[2], 30, 30 + FROZEN_STEPS - 1)
    (warning,) = warnings_of(episodes)
    assert warning.startswith("1 of 4 episodes have one observation for 10 steps or more while")
    assert "such as demo_2 (steps 30 to 39)" in warning


def test_a_recording_that_is_frozen_as_a_whole_is_named_once() -> None:
    episodes = [demonstration(i) for i in range(4)]
    stop(episodes[3], 0, STEPS - 1)
    (warning,) = warnings_of(episodes)
    assert "such as demo_3 (steps 0 to 59)" in warning


def test_a_part_that_is_frozen_in_some_episodes_is_found() -> None:
    episodes = [demonstration(i) for i in range(4)]
    stop(episodes[1], 0, STEPS - 1, keys=["image"])
    (warning,) = warnings_of(episodes)
    assert warning.startswith("obs/image: never changes in 1 of 4 episodes, such as demo_1, and")


def test_idle_ends_are_found_with_their_length() -> None:
    episodes = [demonstration(i) for i in range(4)]
    for episode in episodes[1:3]:
        episode.actions[-20:] = 0
        stop(episode, STEPS - 20, STEPS - 1)
    # At rest, but for the last digits.
    episodes[2].observations["position"][-20:] += 1e-12 * np.random.normal(size=(20, 2))
    (warning,) = warnings_of(episodes)
    assert warning.startswith("2 of 4 episodes end idle, such as demo_1 (its last 19 steps)")


def shift(episodes: Sequence[Episode]) -> Sequence[Episode]:
    """The next observations are the next row's of the whole file."""
    for episode, following in pairwise(episodes):
        for name, part in following.observations.items():
            episode.next_observations[name][-1] = part[0]
    return episodes


@pytest.mark.parametrize("make", [demonstration, make_episode])
def test_a_next_observation_from_the_next_episode_is_found(make: Callable[..., Episode]) -> None:
    (warning,) = warnings_of(shift([make(i, 40) for i in range(4)]))
    assert warning.startswith(
        "in 3 of 4 episodes the last next observation is the first observation of the next episode "
        "in the file: demo_0, demo_1, demo_2. It was probably not recorded"
    )


def test_many_names_are_cut_short() -> None:
    (warning,) = warnings_of(shift([demonstration(i) for i in range(20)]))
    assert "in 19 of 20" in warning
    assert "demo_7, ...." in warning
    assert "demo_8" not in warning


def test_one_of_several_boundaries_is_found() -> None:
    episodes = [demonstration(i) for i in range(4)]
    shift(episodes[1:3])
    (warning,) = warnings_of(episodes)
    assert "in 1 of 4" in warning
    assert ": demo_1. " in warning


@pytest.mark.parametrize("kind", [bool, int, np.bool_, np.int64])
def test_a_success_that_contradicts_the_successes_is_found(kind: Callable[[Any], Any]) -> None:
    episodes = [demonstration(i, rewards=np.zeros(STEPS)) for i in range(3)]
    episodes[1] = replace(episodes[1], attributes={"success": kind(0)})
    found = summarise({f"demo_{i}": episode for i, episode in enumerate(episodes)}).warnings
    (warning,) = (text for text in found if "attribute success contradicts" in text)
    assert warning == (
        "attribute success contradicts successes in 1 episodes, such as demo_1; successes are used"
    )


@pytest.mark.parametrize("success", [False, True])
def test_a_success_that_contradicts_sparse_rewards_is_found(success: bool) -> None:
    episodes = [demonstration(i, extras={}) for i in range(3)]
    rewards = np.zeros(STEPS) if success else episodes[2].rewards
    episodes[2] = replace(episodes[2], rewards=rewards, attributes={"success": success})
    (warning,) = warnings_of(episodes)
    assert "in 1 of 3 episodes the attribute success contradicts the rewards" in warning
    said = "success is 1, no reward" if success else "success is 0, a reward"
    assert f"such as demo_2 ({said})" in warning


def test_several_oddities_are_all_named() -> None:
    episodes = list(shift([demonstration(i) for i in range(4)]))
    stop(episodes[0], 10, 40)
    episodes[1] = replace(episodes[1], attributes={"success": 0})
    told = warnings_of(episodes)
    assert len(told) == 3
    for oddity in (
        "one observation for",
        "first observation of the next",
        "contradicts the rewards",
    ):
        assert any(oddity in text for text in told), oddity
