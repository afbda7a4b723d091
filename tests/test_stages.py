"""What the settings of both stages do to a small run of files, without a simulator."""

from __future__ import annotations

import math
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("matplotlib")
pytest.importorskip("tqdm")
pytest.importorskip("yaml")

import torch
import yaml
from episode_files import make_episode, write_file
from file_runs import PARTS, TASKS, UPDATES, file_run, write_demonstrations

from torchrl_bmrl.data.importing import read_original_bounds
from torchrl_bmrl.data.robomimic import write_episodes
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome
from torchrl_bmrl.modules import BCQPolicy, prototype
from torchrl_bmrl.pipeline import (
    Run,
    Settings,
    collect,
    stage1,
    stage2,
)
from torchrl_bmrl.pipeline.evaluate import expert_outcomes
from torchrl_bmrl.pipeline.held_out import COLUMNS, evaluate_held_out
from torchrl_bmrl.pipeline.learners import Agents
from torchrl_bmrl.pipeline.stage2 import advantage_scale, train_student, value_statistics
from torchrl_bmrl.pipeline.training_data import training_data
from torchrl_bmrl.rows import read_rows
from torchrl_bmrl.tasks import Task, register_task
from torchrl_bmrl.training.checkpoint import load_checkpoint


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with stage 1."""
    folder = tmp_path_factory.mktemp("trained")
    write_demonstrations(folder)
    with file_run(folder) as run:
        collect(run)
        stage1(run)
    return folder


def distilled(trained: Path, folder: Path, *, keep: int = 2, **settings: Any) -> Run:
    """A run that went on from stage 1 with other settings of stage 2."""
    run = file_run(folder, distill=settings, keep=keep)
    for part in ("data", "bcq"):
        shutil.copytree(trained / part, folder / part)
    with run:
        stage2(run)
    return run


# -- demonstrations --------------------------------------------------------------------------------


def test_files_without_an_environment_share_the_bounds_of_all_their_actions(tmp_path: Path) -> None:
    for name, bound in zip(TASKS, (2.0, 4.0), strict=True):
        episodes = [make_episode(i, parts=PARTS) for i in range(2)]
        path = tmp_path / f"{name}.hdf5"
        write_episodes(path, episodes, env_args={}, bounds=(-bound, bound))
    run = file_run(tmp_path)
    with run:
        collect(run)
    for name in TASKS:
        assert read_original_bounds(run.demonstrations(name)) == (-4.0, 4.0)


# -- stage 1 ---------------------------------------------------------------------------------------


def test_the_best_agent_is_that_of_the_epoch_with_the_highest_mean_return(trained: Path) -> None:
    run = file_run(trained)
    agents = Agents(run, {"door-9": "door"}, [run.transitions("door", "train")])
    path = run.agent_path("door-9").with_name("best.safetensors")
    for epoch, returns, best in ((1, (0.0, 4.0), 1), (2, (3.0, 0.0), 1), (3, (2.0, 2.0), 3)):
        agents.evaluations["door-9"] += [{"epoch": epoch, "return": x} for x in returns]
        agents.save_best("door-9", epoch)
        assert load_checkpoint(path, kind="bcq")[1]["updates"] == best


def test_a_run_of_an_earlier_version_goes_on_without_the_settings_that_it_did_not_have(
    trained: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    path = folder / "config.yaml"
    settings = yaml.safe_load(path.read_text()) | {"run_dir": str(folder)}
    for group, name in (("bcq", "acting_rule"), ("distill", "temperature")):
        del settings[group][name]
    path.write_text(yaml.safe_dump(settings))
    run = file_run(trained)  # the demonstrations lie there
    run.folder = folder
    with run:
        stage1(run)
    run.settings.bcq.acting_rule = "mean"
    with pytest.raises(ConfigError, match=r"acting_rule is mean here and first in the"), run:
        stage1(run)


# -- stage 2 ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("cosine", [True, False])
def test_the_learning_rate_of_stage_2_decays_as_a_cosine_or_stays(
    trained: Path, tmp_path: Path, cosine: bool
) -> None:
    run = distilled(trained, tmp_path, cosine=cosine, lr=0.01)
    state, _ = load_checkpoint(run.student_path, kind="student")
    (group,) = state["optimizers"]["student"]["param_groups"]
    share = (UPDATES - 1) / UPDATES if cosine else 0.0
    assert float(group["lr"]) == pytest.approx(0.01 * (1 + math.cos(math.pi * share)) / 2)


@pytest.mark.parametrize("kind", ["mean", "medoid"])
def test_a_tasks_point_of_m_is_of_the_kind_that_the_settings_name(
    trained: Path, tmp_path: Path, kind: str
) -> None:
    run = distilled(trained, tmp_path, prototype=kind)
    student, _ = run.student()
    for point, name in zip(student.prototypes, run.names, strict=True):
        m = student.embed(run.transitions(name, "train"))
        torch.testing.assert_close(point, prototype(m, kind))
    other = "medoid" if kind == "mean" else "mean"
    assert not torch.allclose(student.prototypes[-1], prototype(m, other))


@pytest.mark.parametrize("keep", [1, 2, 3])
def test_so_many_checkpoints_are_kept_as_the_settings_say(
    trained: Path, tmp_path: Path, keep: int
) -> None:
    run = distilled(trained, tmp_path, keep=keep)
    saved = sorted(run.student_path.parent.glob("*.safetensors"))
    kept = [load_checkpoint(path, kind="student")[1]["updates"] for path in saved]
    assert sorted(kept, reverse=True) == [6, 4, 2][:keep]
    assert len(list((trained / "bcq" / "door").glob("checkpoint*"))) == 2


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Options of the distillation's loss, once a stage 2 has begun."""
    module: Any = sys.modules[train_student.__module__]  # the function stage2 hides it
    whole, options = module.make_distillation_loss, {}

    def spy(*networks: Any, **given: Any) -> Any:
        options.update(given)
        return whole(*networks, **given)

    monkeypatch.setattr(module, "make_distillation_loss", spy)
    return options


@pytest.mark.parametrize("normalise", [True, False])
def test_values_are_normalised_by_each_teachers_own_or_not_at_all(
    trained: Path, tmp_path: Path, normalise: bool, given: dict[str, Any]
) -> None:
    run = distilled(trained, tmp_path, normalise_qvalue=normalise)
    data = [run.transitions(name, "train") for name in run.names]
    values = value_statistics([BCQPolicy.frozen(run.teacher(name)) for name in run.names], data)
    for name, expected in zip(("qvalue_loc", "qvalue_scale"), values, strict=True):
        if normalise:
            torch.testing.assert_close(given[name], expected)
        else:
            assert given[name] is None
    assert values[0].shape == (len(TASKS),)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_advantages_have_a_scale_where_they_are_distilled(
    trained: Path, tmp_path: Path, weight: float, given: dict[str, Any]
) -> None:
    distilled(trained, tmp_path, advantage_weight=weight)
    scale = given["advantage_scale"]
    assert (scale is not None) == (weight > 0)
    assert scale is None or ((scale > 0) & (scale != 1)).all()


@pytest.mark.parametrize("normalise", [True, False])
def test_advantages_are_measured_in_each_teachers_own_spread_of_proposals(
    trained: Path, normalise: bool
) -> None:
    run = file_run(trained)
    teachers = [BCQPolicy.frozen(run.teacher(name), num_candidates=400) for name in run.names]
    data = [run.transitions(name, "train") for name in run.names]
    scale = torch.tensor([2.0, 4.0]) if normalise else None
    found = advantage_scale(teachers, data, scale)
    for i, (teacher, states) in enumerate(zip(teachers, data, strict=True)):
        proposed = teacher.propose(states.select("observation"))
        value = teacher.qvalue_network(proposed)["state_action_value"].squeeze(-1)
        expected = value.var(-1).mean().sqrt() / (1.0 if scale is None else scale[i])
        torch.testing.assert_close(found[i], expected, rtol=0.1, atol=0)
    for teacher in teachers:
        teacher.qvalue_network.module[-1].weight.zero_()  # one value for all
    ones = torch.ones(len(teachers))
    torch.testing.assert_close(
        advantage_scale(teachers, data, scale), ones if scale is None else ones / scale
    )


# -- evaluation ------------------------------------------------------------------------------------


def test_held_out_numbers_are_those_of_the_demonstrations_and_computed_once(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = distilled(trained, tmp_path)
    policies: list[Any] = []

    def estimate(policy: Any, data: Any, **options: Any) -> float:
        policies.append((policy, data))
        return float(len(policies))

    monkeypatch.setattr("torchrl_bmrl.pipeline.held_out.estimate_return", estimate)
    for _ in range(2):
        with run:
            evaluate_held_out(run)
    assert len(policies) == 4  # two of each task, the first time
    rows = read_rows(run.folder / "held_out.csv", COLUMNS)
    student, _ = run.student()
    for index, (name, row) in enumerate(zip(run.names, rows, strict=True)):
        assert row["accuracy"] == student.accuracy(run.transitions(name, "valid"))
        data = run.transitions(name, "train")
        discounted = data["next", "reward"].squeeze(-1) * 0.99 ** data["step"]
        episodes = len(data["episode"].unique())
        assert row["demonstrated"] == pytest.approx(discounted.sum().item() / episodes)
        assert (row["bcq"], row["distilled"]) == (2 * index + 1, 2 * index + 2)
        _, seen = policies[2 * index + 1]
        for part in (seen, seen["next"]):
            assert (part["task_latent"] == student.prototypes[index]).all()


def test_held_out_values_are_compared_in_the_units_that_the_critics_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_demonstrations(tmp_path)
    run = file_run(tmp_path, bcq={"standard_reward": True, "n_steps": 3})
    monkeypatch.setattr("torchrl_bmrl.pipeline.held_out.estimate_return", lambda *x, **y: 0.0)
    with run:
        collect(run)
        stage1(run)
        stage2(run)
        evaluate_held_out(run)
    rows = read_rows(run.folder / "held_out.csv", COLUMNS)
    for name, row in zip(run.names, rows, strict=True):
        parts = [run.transitions(name, split) for split in ("train", "valid")]
        loss, data = run.teacher(name), training_data(parts, run.settings.bcq)[1]
        torch.manual_seed(run.seed("held out", name))
        values = [f(data.copy())[0].item() for f in (loss.generator_loss, loss.qvalue_loss)]
        assert [row["loss_generator"], row["loss_qvalue"]] == pytest.approx(values, rel=1e-5)
        assert loss.qvalue_loss(parts[1])[0].item() != pytest.approx(values[1], rel=0.1)


def test_held_out_numbers_of_a_run_on_a_device_that_is_not_here_are_refused_by_name(
    trained: Path, tmp_path: Path
) -> None:
    run = distilled(trained, tmp_path)
    with run:
        run.settings.device = "cuda:99"
        with pytest.raises(ConfigError, match=r"device is 'cuda:99'; valid: one that torch"):
            evaluate_held_out(run)


def record(seed: int, *, noise: float, **options: Any) -> Any:
    """An episode whose return is its seed, and that succeeds without noise."""
    episode = make_episode(seed, 1, parts=PARTS)
    extras = {**episode.extras, "successes": np.array([noise == 0.0])}
    return replace(episode, rewards=np.array([float(seed)]), extras=extras)


@pytest.mark.parametrize("rollouts", [True, False])
def test_the_experts_rows_are_new_episodes_or_its_demonstrations(
    tmp_path: Path, rollouts: bool
) -> None:
    register_task(Task(name="counting", record=record, success="success"))
    settings = Settings(run_dir=str(tmp_path), tasks=["counting"])
    settings.evaluate.expert_rollouts = rollouts
    settings.collect.noise = 0.0
    run = Run(settings)
    episodes = write_file(run.demonstrations("counting"), parts=PARTS)
    expected = [
        EpisodeOutcome(float(each.rewards.sum()), bool(each.extras["successes"].any()))
        for each in episodes
    ]
    outcomes = expert_outcomes(run, "counting", [7, 8])
    if rollouts:
        assert outcomes == [EpisodeOutcome(7.0, True), EpisodeOutcome(8.0, True)]
    else:
        assert [each.episode_return for each in outcomes] == pytest.approx(
            [each.episode_return for each in expected]
        )
        assert [each.success for each in outcomes] == [each.success for each in expected]
