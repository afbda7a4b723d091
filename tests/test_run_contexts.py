"""Contexts of another behaviour in a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("tqdm")

import tiny_family
from episode_files import make_episode
from tiny_family import HORIZON

from torchrl_bmrl.data import robomimic
from torchrl_bmrl.data.robomimic import open_episodes
from torchrl_bmrl.errors import BMRLError, DataError
from torchrl_bmrl.pipeline import Run, Settings, collect
from torchrl_bmrl.pipeline.evaluate import expert_outcomes

OFF = {"context": "set", "inference_updates": 0, "reward_updates": 0}
"""Settings of a stage 2 that reads no episode of another behaviour."""

pytestmark = pytest.mark.usefixtures("walk_family")


@pytest.fixture(scope="module")
def collected(walk_family: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collected")
    with Run(tiny_family.settings(folder)) as run:
        collect(run)
    return folder


def masks(path: Path) -> dict[str, int]:
    found = {}
    for name in ("train", "valid", "context"):
        try:
            with open_episodes(path, split=name, observation_keys=[]) as episodes:
                found[name] = len(episodes)
        except BMRLError:
            continue
    return found


def test_context_episodes_are_of_other_members_experts_and_apart(collected: Path) -> None:
    path = collected / "data" / "walk_40.hdf5"
    assert masks(path) == {"train": 2, "valid": 1, "context": 2}
    for split in ("train", "valid", "context"):
        with open_episodes(path, split=split, observation_keys=[]) as episodes:
            for _, episode in episodes.items():
                like = str(episode.attributes.get("like", ""))
                assert bool(like) == (split == "context")
                assert "walk_40" not in like
    run = Run(tiny_family.settings(collected))
    first, second = (run.transitions("walk_40", split) for split in ("train", "context"))
    assert len(first) == len(second) == 2 * HORIZON
    # The data are normalised by the demonstrations alone.
    every = torch.cat([run.transitions(name, "train")["observation"] for name in run.names])
    torch.testing.assert_close(every.mean(0), torch.zeros(2), atol=1e-5, rtol=0)


def test_the_number_of_context_episodes_does_not_change_the_demonstrations(
    collected: Path, tmp_path: Path
) -> None:
    settings = tiny_family.settings(tmp_path, OFF)
    with Run(replace(settings, collect=replace(settings.collect, context_episodes=0))) as run:
        collect(run)
        for name in run.names:
            mine, theirs = (
                Run(tiny_family.settings(x)).transitions(name, "train")
                for x in (tmp_path, collected)
            )
            assert torch.equal(mine["action"], theirs["action"])
            assert torch.equal(mine["observation"], theirs["observation"])


def from_file(folder: Path, path: Path, **distill: Any) -> Settings:
    """Settings of a run on one user's file, whose episodes of another behaviour are in a mask."""
    tasks = {name: {"demonstrations": str(path)} for name in ("mine", "yours")}
    return replace(tiny_family.settings(folder, {**OFF, **distill}), tasks=tasks)


def write_own(path: Path, masks: dict[str, list[int]]) -> Path:
    """Four episodes, whose returns are 5, 10, 15 and 20."""
    episodes = []
    for number in range(4):
        episode = make_episode(seed=number, parts={"x": ((3,), "f4")})
        episodes.append(replace(episode, rewards=np.full(len(episode), number + 1.0)))
    robomimic.write_episodes(path, episodes, env_args={}, masks=masks)
    return path


def test_a_file_without_episodes_of_another_behaviour_is_refused_before_it_is_imported(
    tmp_path: Path,
) -> None:
    path = write_own(tmp_path / "own.hdf5", {})
    with Run(from_file(tmp_path / "run", path, context="given")) as run:
        with pytest.raises(DataError, match=r"own\.hdf5.*mask/context"):
            collect(run)
        assert not list(run.data_dir.glob("*.hdf5"))


def test_the_expert_of_a_file_is_its_demonstrations_alone(tmp_path: Path) -> None:
    path = write_own(tmp_path / "own.hdf5", {"context": [3]})
    with Run(from_file(tmp_path / "run", path)) as run:
        collect(run)
        outcomes = expert_outcomes(run, "mine", [])
    assert sorted(outcome.episode_return for outcome in outcomes) == [5.0, 10.0, 15.0]
