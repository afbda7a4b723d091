"""FOCAL and MBML in the study of held-out members: their training, and what they are given."""

from __future__ import annotations

import shutil
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("sklearn")
pytest.importorskip("tqdm")

import tiny_family
from small_runs import contents
from tiny_family import HORIZON, make_walk

from torchrl_bmrl.errors import BMRLError, CheckpointError, ConfigError
from torchrl_bmrl.modules import embed_context
from torchrl_bmrl.pipeline import Run, collect, stage1, stage2
from torchrl_bmrl.studies import families_methods
from torchrl_bmrl.studies.families import generalise
from torchrl_bmrl.studies.families_methods import TRIED, context, load_learner, make_method
from torchrl_bmrl.studies.families_peers import (
    PEERS,
    MBMLSettings,
    PeerJob,
    load_focal,
    peer_data,
    train_peer,
)
from torchrl_bmrl.training.checkpoint import load_checkpoint

STUDY = tiny_family.study(methods=["focal", "focal_one_shot", "mbml", "mbml_one_shot"])
CHECKPOINTS = ("families/*/checkpoint.safetensors", "families/*/*/checkpoint.safetensors")


pytestmark = pytest.mark.usefixtures("walk_family")


@pytest.fixture(scope="module")
def trained(walk_family: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with agents, a student and both peers. Tests only read it."""
    folder = tmp_path_factory.mktemp("trained")
    with Run(tiny_family.settings(folder)) as run:
        for step in (collect, stage1, stage2):
            step(run)
        for name in PEERS:
            train(run, name)
    return folder


def train(run: Run, name: str, study: Any = STUDY, report: Any = lambda updates: None) -> None:
    train_peer((run, PeerJob(name, getattr(study, name), f"families/{name}")), report)


@pytest.fixture
def untrained(trained: Path, tmp_path: Path) -> Path:
    """The same without the peers."""
    skip = shutil.ignore_patterns("families")
    return shutil.copytree(trained, tmp_path / "run", ignore=skip)


@pytest.mark.parametrize(("name", "stop"), [("focal", 2), ("mbml", 1), ("mbml", 2), ("mbml", 4)])
def test_a_peer_that_was_stopped_goes_on_to_the_same_networks(
    untrained: Path, trained: Path, name: str, stop: int
) -> None:
    done = 0

    def report(updates: int) -> None:
        nonlocal done
        done += updates
        if done > stop:
            raise KeyboardInterrupt

    with Run(tiny_family.settings(untrained)) as run:
        with pytest.raises(KeyboardInterrupt):
            train(run, name, report=report)
        train(run, name)
    expected = {k: x for k, x in contents(trained, *CHECKPOINTS).items() if name in str(k)}
    assert contents(untrained, *CHECKPOINTS) == expected


def test_a_peer_that_is_trained_is_not_trained_again(trained: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(trained, tmp_path / "run")
    before, reported = contents(folder, *CHECKPOINTS), [0]
    with Run(tiny_family.settings(folder)) as run:
        for name in PEERS:
            train(run, name, report=reported.append)
    assert contents(folder, *CHECKPOINTS) == before
    assert sum(reported) == STUDY.focal.total + STUDY.mbml.total == 4 + 2 + 4


def test_every_network_of_a_peer_is_trained(trained: Path, untrained: Path) -> None:
    short = replace(
        STUDY,
        focal=replace(STUDY.focal, updates=1),
        mbml=replace(STUDY.mbml, updates=1, reward_updates=1),
    )
    with Run(tiny_family.settings(untrained)) as run:
        for name in PEERS:
            train(run, name, short)
    kinds = {"focal": "focal", "mbml": "student", "mbml/rewards": "rewards"}
    for name, kind in kinds.items():
        first, second = (
            load_checkpoint(x / "families" / name / "checkpoint.safetensors", kind=kind)[0]
            for x in (trained, untrained)
        )
        changed = {
            key.replace("loss.", "").split(".")[0]
            for key, value in first["module"].items()
            if not torch.equal(value, second["module"][key])
        }
        expected = {
            "focal": {"task_encoder_params", "divergence_network_params", "qvalue_network_params"}
            | {"actor_network_params", "target_qvalue_network_params", "divergence_weight"},
            "mbml": {"task_encoder", "generator", "qvalue_network"},
            "mbml/rewards": {"module"},
        }[name]
        assert changed >= expected


def test_peers_learn_from_the_demonstrations_and_if_wanted_from_other_behaviour(
    trained: Path,
) -> None:
    run = Run(tiny_family.settings(trained))
    few, all_ = (peer_data(run, source) for source in ("demonstrations", "all"))
    assert [len(data) for data in few] == [2 * HORIZON] * 4
    assert [len(data) for data in all_] == [4 * HORIZON] * 4
    for data, both in zip(few, all_, strict=True):
        assert torch.equal(data["action"], both["action"][: len(data)])


def test_a_peer_s_m_of_a_trained_member_is_that_of_its_demonstrations(trained: Path) -> None:
    run = Run(tiny_family.settings(trained))
    for name in PEERS:
        learner = load_learner(run, STUDY, name)
        for i, member in enumerate(run.names):
            expected = embed_context(learner.encoder, run.transitions(member, "train"))
            torch.testing.assert_close(learner.prototypes[i], expected)


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_is_given_a_demonstration_or_its_own_first_episode(
    trained: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tiny_family.settings(shutil.copytree(trained, tmp_path / "run")))
    task, learner = make_walk(60.0), load_learner(run, STUDY, name)
    given = [context(run, STUDY, task, "demonstration", i) for i in range(STUDY.episodes)]
    policy, source = make_method(run, STUDY, task, name)
    expected = torch.stack([embed_context(learner.encoder, each) for each in given])
    torch.testing.assert_close(source.task_latent, expected)
    assert set(policy.in_keys) == {"observation", "task_latent"}
    played, original = [], families_methods.rollout_episodes

    def rollout(env: Any, policy: Any, **options: Any) -> Any:
        played.append(original(env, policy, **options))
        return played[-1]

    monkeypatch.setattr(families_methods, "rollout_episodes", rollout)
    _, source = make_method(run, STUDY, task, f"{name}_one_shot")
    (episodes,) = played
    for episode in episodes:
        tried = {tuple(m.tolist()) for m in episode["task_latent"]}
        assert tried <= {tuple(point.tolist()) for point in learner.prototypes}
        assert len(tried) == min(TRIED, len(run.names))
    with closing(run.make_env(task, source, num_envs=STUDY.episodes)) as env:
        start = env.reset()["task_latent"]
    torch.testing.assert_close(start, embed_context(learner.encoder, episodes))


def test_focal_acts_without_noise(trained: Path) -> None:
    run = Run(tiny_family.settings(trained))
    policy = load_learner(run, STUDY, "focal").policy
    data = run.transitions("walk_0", "train")
    data = data.select("observation").set("task_latent", torch.zeros(len(data), 20))
    assert torch.equal(policy(data.copy())["action"], policy(data.copy())["action"])


# -- errors ----------------------------------------------------------------------------------------


def test_a_peer_of_a_run_without_other_behaviour_learns_from_demonstrations(
    untrained: Path,
) -> None:
    settings = tiny_family.settings(untrained, {"context": "set", "inference_updates": 0})
    settings = replace(settings, collect=replace(settings.collect, context_episodes=0))
    shutil.rmtree(untrained)
    with Run(settings) as run:
        for step in (collect, stage1, stage2):
            step(run)
        small = replace(STUDY.focal, data="demonstrations", batch_size=7)
        with pytest.raises(ConfigError, match=r"families.focal.batch_size is 7; .*at least 8"):
            generalise(run, replace(STUDY, focal=small))
        assert not (untrained / "families").exists()
        assert [len(x) for x in peer_data(run, "all")] == [
            len(x) for x in peer_data(run, "demonstrations")
        ]
        methods = [name for name in STUDY.methods if name != "behaviour"]
        assert "MBML, given one demonstration" in generalise(run, replace(STUDY, methods=methods))


def test_mbml_without_agents_and_a_peer_that_is_not_trained_are_typed_errors(
    untrained: Path,
) -> None:
    with Run(tiny_family.settings(untrained)) as run:
        for name in PEERS:
            with pytest.raises(CheckpointError, match="no such checkpoint"):
                make_method(run, STUDY, make_walk(60.0), name)
        shutil.rmtree(untrained / "bcq" / "walk_40")
        with pytest.raises(BMRLError, match=r"walk_40.*no such checkpoint"):
            generalise(run, replace(STUDY, methods=["mbml"]))
        train(run, "focal")  # needs no agents


def test_a_checkpoint_of_another_kind_is_no_focal(trained: Path) -> None:
    with pytest.raises(CheckpointError, match="kind is 'student'; valid: 'focal'"):
        load_focal(trained / "families" / "mbml" / "checkpoint.safetensors")


def test_the_weights_of_the_terms_are_those_of_the_settings() -> None:
    assert MBMLSettings().triplet_weight == 0.1


def test_tasks_of_no_family_are_refused(tmp_path: Path) -> None:
    settings = replace(tiny_family.settings(tmp_path), tasks=["walk_0", "walk_40"])
    with Run(settings) as run, pytest.raises(ConfigError, match="valid: the trained members of"):
        generalise(run, STUDY)
    assert not (tmp_path / "families").exists()
