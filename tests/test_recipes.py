"""Whole runs: from nothing to the report, runs that go on, runs that repeat."""

from __future__ import annotations

import csv
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

import yaml
from small_runs import (
    RECIPES,
    SMALL,
    Interruption,
    Run,
    contents,
    make_run,
    recipe,
    tasks,
    times,
)
from tensordict import TensorDict

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation import RESULT_FIELDS, read_results
from torchrl_bmrl.run import progress


def show_results(folder: Path) -> dict[str, bytes]:
    return contents(folder, "results.csv", "tables/*", "bcq/*/evaluations.csv")


@pytest.mark.robosuite
@pytest.mark.slow
def test_two_stages_from_an_empty_folder_to_the_report_and_again(tmp_path: Path) -> None:
    pytest.importorskip("robosuite", exc_type=ImportError)
    pytest.importorskip("matplotlib")
    overrides = [each for each in SMALL if not each.startswith("tasks=")]
    overrides += ["tasks=[reach,lift]"]  # of their own length, in which demonstrations succeed
    overrides += ["bcq.epochs=1", "evaluate.latent_sources=[online]", "run_dir=run", "workers=1"]
    done = recipe("two_stage", *overrides, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "report: run/report.html" in done.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["run"]
    folder = tmp_path / "run"

    with (folder / "results.csv").open() as file:
        assert tuple(csv.DictReader(file).fieldnames or ()) == RESULT_FIELDS
    rows = read_results(folder / "results.csv")
    counts = {
        (task, policy, source): sum(
            (row.task, row.policy, row.latent_source) == (task, policy, source) for row in rows
        )
        for task in ("reach", "lift")
        for policy, source in (("expert", ""), ("bcq", ""), ("distilled", "online"))
    }
    # The expert's rows are its two demonstrations.
    assert list(counts.values()) == [2, 1, 1] * 2
    assert sum(counts.values()) == len(rows)
    assert all(0 < row.episode_return < 600 for row in rows)

    for name in ("results", "table1", "table2", "stages", "goal_distance"):
        assert "lift" in (folder / "tables" / f"{name}.csv").read_text().lower()
        assert "\n| Lift |" in (folder / "tables" / f"{name}.md").read_text()
    page = (folder / "report.html").read_text()
    assert page.rstrip().endswith("</html>")
    assert page.count("data:image/png;base64") >= 2
    assert "Explore the embedding" in page
    assert yaml.safe_load((folder / "config.yaml").read_text())["bcq"]["num_cells"] == [16, 16]
    versions = json.loads((folder / "versions.json").read_text())
    assert {"torch", "torchrl", "robosuite", "mujoco", "python", "torchrl_bmrl"} <= set(versions)
    assert set(json.loads((folder / "seconds.json").read_text())) == {
        "collect",
        "stage 1",
        "stage 2",
        "evaluate",
    }
    written = times(folder)
    for path in (
        "data/reach.hdf5",
        "data/lift.hdf5",
        "bcq/reach/checkpoint.safetensors",
        "bcq/lift/checkpoint.safetensors",
        "distill/checkpoint.safetensors",
        "evaluation/lift-distilled-online.csv",
    ):
        assert path in written
    assert list((folder / "logs").rglob("*.csv"))
    assert not [path for path in folder.rglob("*") if path.name.endswith(".tmp")]

    before = show_results(folder)
    done = recipe("two_stage", *overrides, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert times(folder) == written
    assert show_results(folder) == before


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_one_hot_student_learns_from_the_same_agents_and_acts(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    from torchrl_bmrl.pipeline import two_stage
    from torchrl_bmrl.pipeline.agents import load_student

    folder = run(
        tmp_path / "run",
        two_stage,
        "ablation=one_hot",
        "evaluate.latent_sources=[prototype]",
        f"base={finished}",
    )
    assert contents(folder, "data/*.hdf5") == contents(finished, "data/*.hdf5")
    pattern = "bcq/*/checkpoint.safetensors"
    assert contents(folder, pattern) == contents(finished, pattern)
    student, metadata = load_student(folder / "distill" / "checkpoint.safetensors")
    assert student.prototypes.tolist() == [[1.0, 0.0], [0.0, 1.0]]
    assert metadata["accuracy"] == 1.0
    rows = read_results(folder / "results.csv")
    assert {row.latent_source for row in rows if row.policy == "distilled"} == {"prototype"}
    assert "The figures of the embedding are left out" in (folder / "report.html").read_text()


@pytest.fixture(scope="module")
def exported(run: Run, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished run with its exported policy; the former stays as it is for others."""
    from torchrl_bmrl.pipeline import export

    folder = shutil.copytree(finished, tmp_path_factory.mktemp("exported") / "run")
    return run(folder, export)


@pytest.mark.robosuite
@pytest.mark.slow
def test_the_policy_of_the_repository_plays_all_tasks_and_knows_its_own_demonstrations(
    run: Run, tmp_path: Path
) -> None:
    from torchrl_bmrl.pipeline import evaluate
    from torchrl_bmrl.pipeline.agents import load_student
    from torchrl_bmrl.pipeline.evaluate import held_out_episode
    from torchrl_bmrl.pipeline.settings import SIX_TASKS

    policy = RECIPES / "policies" / "sawyer.safetensors"
    assert policy.stat().st_size < 5e6
    card = policy.with_suffix(".md").read_text()
    assert f"evaluate.policy=recipes/policies/{policy.name}" in card
    made = make_run(tmp_path, f"evaluate.policy={policy}", tasks(*SIX_TASKS))
    student, metadata = load_student(policy)
    for number, task in enumerate(SIX_TASKS):
        episode = held_out_episode(made, task)
        points = student.task_encoder(episode)
        logits = student.task_classifier(points)["task_logits"]
        assert (logits.argmax(-1) == number).float().mean() > 0.95
        # Where its expert acted, it acts alike, but for the expert's noise of 0.2.
        acting = student.policy(num_candidates=100, latent_clip=metadata["latent_clip"])
        episode["task_latent"] = student.prototypes[number].expand(len(episode), -1)
        apart = acting(episode.copy())["action"] - episode["action"]
        assert apart.abs().mean() < 0.2
    run(tmp_path, evaluate, f"evaluate.policy={policy}", tasks(*SIX_TASKS))
    rows = read_results(tmp_path / "results.csv")
    sources = {"prototype", "online", "demonstration"}
    assert {(row.task, row.latent_source) for row in rows} == {
        (task, source) for task in SIX_TASKS for source in sources
    }


@pytest.mark.robosuite
@pytest.mark.slow
def test_an_exported_policy_acts_alone_as_it_does_in_its_run(
    run: Run, exported: Path, tmp_path: Path
) -> None:
    from torchrl_bmrl.data.demonstrations import read_statistics
    from torchrl_bmrl.envs.transforms import ObservationStatistics
    from torchrl_bmrl.pipeline import evaluate
    from torchrl_bmrl.pipeline.agents import load_student

    policy = shutil.copy(exported / "policy.safetensors", tmp_path)
    kept = ObservationStatistics.from_lists(load_student(Path(policy))[1]["statistics"])
    of_data = read_statistics(exported / "data")
    assert torch.equal(kept.loc, of_data.loc)
    assert torch.equal(kept.scale, of_data.scale)
    alone = run(tmp_path / "alone", evaluate, f"evaluate.policy={policy}")
    distilled = [row for row in read_results(exported / "results.csv") if row.latent_source]
    assert read_results(alone / "results.csv") == distilled
    assert not (alone / "data").exists()
    assert str(policy) in (alone / "report.html").read_text()
    card = (exported / "policy.md").read_text()
    assert "reach 1, lift 1; 1 held out of each" in card
    assert "| Lift | Distilled | online |" in card


@pytest.mark.robosuite
@pytest.mark.slow
def test_an_exported_policy_has_a_file_that_acts_without_this_library(exported: Path) -> None:
    check_onnx(exported / "policy.onnx", exported / "policy.safetensors")
    card = " ".join((exported / "policy.md").read_text().split())
    assert "`action_latent (B, N, 14)`" in card
    assert "drawn from N(0, I) and clipped to ±0.5." in card


@pytest.mark.slow
def test_the_policy_of_the_repository_is_exported_without_a_run(run: Run, tmp_path: Path) -> None:
    from torchrl_bmrl.pipeline import export

    policy = RECIPES / "policies" / "sawyer.safetensors"
    run(tmp_path, export, f"evaluate.policy={policy}")
    check_onnx(tmp_path / "policy.onnx", policy)
    assert not (tmp_path / "policy.safetensors").exists()


def check_onnx(path: Path, policy: Path) -> None:
    """It acts as the policy does on its own demonstrations, up to actions of equal value."""
    onnxruntime = pytest.importorskip("onnxruntime")
    from torchrl_bmrl.functional import sample_action_latent
    from torchrl_bmrl.pipeline.agents import load_student
    from torchrl_bmrl.training.checkpoint import load_checkpoint

    student, metadata = load_student(policy)
    acting = student.policy(num_candidates=100, latent_clip=metadata["latent_clip"])
    loc, scale = (torch.tensor(metadata["statistics"][name]) for name in ("loc", "scale"))
    session = onnxruntime.InferenceSession(path)
    said = json.loads(session.get_modelmeta().custom_metadata_map["policy"])
    state, _ = load_checkpoint(policy, kind="student")
    for number, task in enumerate(metadata["tasks"]):
        assert said["tasks"][task] == student.prototypes[number].tolist()
        data = TensorDict(state["demonstrations"][task]).auto_batch_size_(1)
        data = data.select("observation")
        data["task_latent"] = student.prototypes[number].expand(len(data), -1)
        torch.manual_seed(0)
        expected = acting(data.copy())
        torch.manual_seed(0)
        clip = metadata["latent_clip"]
        latent = sample_action_latent((len(data), 100, said["latent_dim"]), latent_clip=clip)
        inputs = {
            "observation": loc + scale * data["observation"],
            "task_latent": data["task_latent"],
            "action_latent": latent,
        }
        action = session.run(None, {key: value.numpy() for key, value in inputs.items()})[0]
        found = data.copy().set("action", torch.from_numpy(action))
        alike = (found["action"] - expected["action"]).abs().amax(-1) < 1e-4
        assert alike.float().mean() > 0.9
        best, value = (student.qvalue_network(of)["state_action_value"] for of in (expected, found))
        torch.testing.assert_close(value, best, rtol=1e-3, atol=1e-3)


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_policy_is_refused_for_a_task_that_it_was_not_trained_on(
    run: Run, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import evaluate

    with pytest.raises(SystemExit, match="1"):
        run(
            tmp_path,
            evaluate,
            f"evaluate.policy={exported / 'policy.safetensors'}",
            tasks("reach", "push_up"),
        )
    said = capsys.readouterr().err
    assert "tasks is ['reach', 'push_up']; valid for" in said
    assert said.endswith("policy.safetensors: ['reach', 'lift']\n")
    assert not (tmp_path / "results.csv").exists()


@pytest.mark.robosuite
@pytest.mark.slow
def test_one_seed_gives_the_same_bytes_in_one_go_and_recipe_by_recipe(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    from torchrl_bmrl.pipeline import collect, evaluate, stage1, stage2

    for stage in (collect, stage1, stage2, evaluate):
        run(tmp_path, stage)
    expected = show_results(finished)
    assert len(expected) == 1 + 6 + 2
    assert show_results(tmp_path) == expected
    costly = ("data/*", "**/*.safetensors")
    assert contents(tmp_path, *costly) == contents(finished, *costly)


@pytest.mark.robosuite
@pytest.mark.slow
def test_two_workers_give_the_same_bytes_as_one(finished: Path, tmp_path: Path) -> None:
    done = recipe("two_stage", *SMALL, "run_dir=run", "workers=2", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert show_results(tmp_path / "run") == show_results(finished)
    checkpoints = contents(finished, "**/*.safetensors")
    assert len(checkpoints) == 2 * 3 + 2
    assert contents(tmp_path / "run", "**/*.safetensors") == checkpoints


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_run_goes_on_with_other_workers_but_not_with_other_settings(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    folder = shutil.copytree(finished, tmp_path / "run")
    before, written = show_results(folder), times(folder)
    with pytest.raises(SystemExit) as caught:
        run(folder, two_stage, "bcq.lr=0.1")
    assert caught.value.code == 1
    assert "bcq.lr is 0.1 here and 0.001 in the folder's run" in capsys.readouterr().err
    run(folder, two_stage, "workers=2", "logger=none")
    assert times(folder) == written
    assert show_results(folder) == before


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize(
    ("update", "kept", "error"),
    # Checkpoints are due after updates 4, 8 and 12, evaluations after 6 and 12.
    [(3, None, KeyboardInterrupt), (7, 4, KeyboardInterrupt), (12, 12, BMRLError)],
)
def test_stage_1_resumed_equals_never_stopped(
    run: Run, finished: Path, tmp_path: Path, update: int, kept: int | None, error: Any
) -> None:
    from torchrl_bmrl.pipeline.stage1 import train_job
    from torchrl_bmrl.training.checkpoint import load_checkpoint

    shutil.copytree(finished / "data", tmp_path / "data")
    made = make_run(tmp_path)
    checkpoint = tmp_path / "bcq" / "lift" / "checkpoint.safetensors"
    with pytest.raises(error):
        train_job((made, {"lift": "lift"}), Interruption(update, error))
    if kept is None:
        assert not checkpoint.exists()
    else:
        assert load_checkpoint(checkpoint, kind="bcq")[1]["updates"] == kept
    counted: list[int] = []
    train_job((made, {"lift": "lift"}), counted.append)
    # What the checkpoint holds is reported at once and not trained again.
    assert counted == ([kept] if kept else []) + [1] * (12 - (kept or 0))
    expected = contents(finished, *LIFT)
    assert len(expected) == 4 + 7
    assert contents(tmp_path, *LIFT) == expected


LIFT = ("bcq/lift/*", "logs/bcq_lift/scalars/*")
"""What stage 1 makes of it: checkpoints (newest, before, best), evaluations; metrics."""


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize("moment", ["write_rows", "save_best", "save"])
def test_stage_1_killed_between_two_files_goes_on_to_the_same_ones(
    run: Run, finished: Path, tmp_path: Path, moment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    from torchrl_bmrl.pipeline import learners
    from torchrl_bmrl.pipeline.stage1 import train_job

    shutil.copytree(finished / "data", tmp_path / "data")
    made = make_run(tmp_path)
    # The package's function stage1 hides the module of the same name.
    owner: Any = learners.Agents if "save" in moment else sys.modules[train_job.__module__]
    whole, calls = getattr(owner, moment), []

    def killed(*arguments: Any) -> None:
        calls.append(arguments)
        if len(calls) == 2:  # at update 12, or 8 of the checkpoints
            raise KeyboardInterrupt
        whole(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(owner, moment, killed)
        with pytest.raises(KeyboardInterrupt):
            train_job((made, {"lift": "lift"}), lambda count: None)
    train_job((made, {"lift": "lift"}), lambda count: None)
    assert contents(tmp_path, *LIFT) == contents(finished, *LIFT)


STACKED = ("bcq.stacked=true", "bcq.seeds=2")
AGENTS = {"reach": "reach", "lift": "lift", "reach-1": "reach", "lift-1": "lift"}


@pytest.fixture(scope="module")
def stacked(run: Run, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Stage 1 of two tasks and two seeds in one program, never stopped."""
    from torchrl_bmrl.pipeline import stage1

    folder = tmp_path_factory.mktemp("stacked")
    shutil.copytree(finished / "data", folder / "data")
    return run(folder, stage1, *STACKED)


@pytest.mark.robosuite
@pytest.mark.slow
def test_every_member_of_a_stack_has_a_checkpoint_and_curves_of_its_own(stacked: Path) -> None:
    from torchrl_bmrl.pipeline.agents import load_bcq_loss

    weights = set()
    for name, task in AGENTS.items():
        loss, metadata = load_bcq_loss(stacked / "bcq" / name / "checkpoint.safetensors")
        assert (metadata["task"], metadata["updates"]) == (task, 12)
        weights.add(float(next(loss.generator_params.parameters()).sum()))
        with (stacked / "bcq" / name / "evaluations.csv").open() as file:
            assert [row["update"] for row in csv.DictReader(file)] == ["6", "12"]
        curve = stacked / "logs" / f"bcq_{name}" / "scalars" / "loss_qvalue.csv"
        assert [line.split(",")[0] for line in curve.read_text().splitlines()] == ["4", "8", "12"]
    assert len(weights) == len(AGENTS)


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize(("update", "kept"), [(3, None), (7, 4), (12, 12)])
def test_a_stack_resumed_equals_one_never_stopped(
    run: Run, stacked: Path, finished: Path, tmp_path: Path, update: int, kept: int | None
) -> None:
    from torchrl_bmrl.pipeline.agents import load_bcq_loss
    from torchrl_bmrl.pipeline.stage1 import train_job

    shutil.copytree(finished / "data", tmp_path / "data")
    made = make_run(tmp_path, *STACKED)
    with pytest.raises(KeyboardInterrupt):
        train_job((made, AGENTS), Interruption(update * len(AGENTS), KeyboardInterrupt))
    member = tmp_path / "bcq" / "lift" / "checkpoint.safetensors"
    assert member.exists() == (kept is not None)
    if kept is not None:
        assert load_bcq_loss(member)[1]["updates"] == kept
    counted: list[int] = []
    train_job((made, AGENTS), counted.append)
    assert sum(counted) == 12 * len(AGENTS)
    expected = contents(stacked, "bcq/**/*")
    assert len(expected) == 2 + 3 * len(AGENTS)
    assert contents(tmp_path, "bcq/**/*") == expected


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_members_checkpoint_that_a_kill_left_out_is_written_when_the_run_goes_on(
    run: Run, stacked: Path, tmp_path: Path
) -> None:
    from torchrl_bmrl.pipeline import stage1

    folder = shutil.copytree(stacked, tmp_path / "run")
    (folder / "bcq" / "lift" / "checkpoint.safetensors").unlink()
    before = times(folder)
    run(folder, stage1, *STACKED)
    assert contents(folder, "bcq/**/*") == contents(stacked, "bcq/**/*")
    assert before.items() <= times(folder).items()  # and nothing else


def diverging(monkeypatch: pytest.MonkeyPatch, factor: Any) -> list[Any]:
    """Multiplies the critics' sixth loss by a factor; returns all losses."""
    from torchrl_bmrl.pipeline import learners

    step, calls = learners.gradient_step, []

    def breaking(optimizer: Any, loss: Any, max_norm: Any) -> None:
        calls.append(loss)  # the generator's and the critics' in turn
        step(optimizer, loss * factor if len(calls) == 2 * 6 else loss, max_norm)

    monkeypatch.setattr(learners, "gradient_step", breaking)
    return calls


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_member_that_diverges_is_named_and_frozen_and_the_others_go_on(
    run: Run,
    stacked: Path,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from torchrl_bmrl.pipeline import stage1
    from torchrl_bmrl.pipeline.agents import load_bcq_loss

    shutil.copytree(finished / "data", tmp_path / "data")
    calls = diverging(monkeypatch, torch.tensor([1.0, float("nan"), 1.0, 1.0]))
    for _ in range(2):  # said again when the command is repeated
        with pytest.raises(SystemExit) as caught:
            run(tmp_path, stage1, *STACKED)
        assert caught.value.code == 1
        says = "bcq lift, update 8: loss_qvalue is nan"
        message = capsys.readouterr().err
        assert f"error: {says}" in message
    assert len(calls) == 2 * 12
    updates = {
        name: load_bcq_loss(tmp_path / "bcq" / name / "checkpoint.safetensors")[1]["updates"]
        for name in AGENTS
    }
    assert updates == {"reach": 12, "lift": 4, "reach-1": 12, "lift-1": 12}
    others = [f"bcq/{name}/*" for name in AGENTS if name != "lift"]
    assert contents(tmp_path, *others) == contents(stacked, *others)


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_single_agent_that_diverges_ends_the_run_with_its_last_checkpoint(
    run: Run,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from torchrl_bmrl.pipeline import stage1
    from torchrl_bmrl.pipeline.agents import load_bcq_loss

    shutil.copytree(finished / "data", tmp_path / "data")
    diverging(monkeypatch, float("nan"))
    with pytest.raises(SystemExit):
        run(tmp_path, stage1, tasks("lift"))
    assert "error: bcq lift, update 8: loss_qvalue is nan" in capsys.readouterr().err
    path = tmp_path / "bcq" / "lift" / "checkpoint.safetensors"
    assert load_bcq_loss(path)[1]["updates"] == 4


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++"))), reason="no compiler")
def test_compiled_stages_train_what_eager_ones_do(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import stage1, stage2
    from torchrl_bmrl.training.checkpoint import load_checkpoint

    for kept in ("data", "bcq/reach", "logs/bcq_reach"):
        shutil.copytree(finished / kept, tmp_path / kept)
    for stage in (stage1, stage2):
        run(tmp_path, stage, "compile=true")
    assert "not accelerated" not in capsys.readouterr().err
    for path, kind in (
        ("bcq/lift/checkpoint.safetensors", "bcq"),
        ("distill/checkpoint.safetensors", "student"),
    ):
        compiled, eager = (
            load_checkpoint(folder / path, kind=kind)[0]["module"]
            for folder in (tmp_path, finished)
        )
        for name, value in eager.items():
            torch.testing.assert_close(compiled[name], value, rtol=0, atol=1e-4)


@pytest.mark.robosuite
@pytest.mark.slow
def test_without_a_gpu_captured_stages_say_so_and_train_the_same(
    run: Run, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from torchrl_bmrl.pipeline import stage1
    from torchrl_bmrl.pipeline.agents import load_bcq_loss

    shutil.copytree(finished / "data", tmp_path / "data")
    run(tmp_path, stage1, "cudagraphs=true", tasks("lift"))
    assert "device=cpu has no CUDA graphs" in capsys.readouterr().err
    for name in ("best", "checkpoint.1", "checkpoint"):  # they say how they were trained
        captured, eager = (
            load_bcq_loss(folder / "bcq" / "lift" / f"{name}.safetensors")[0].state_dict()
            for folder in (tmp_path, finished)
        )
        torch.testing.assert_close(captured, eager, rtol=0, atol=0)
    expected = contents(finished, "bcq/lift/*.csv")
    assert contents(tmp_path, "bcq/lift/*.csv") == expected


def trained(
    finished: Path, folder: Path, *overrides: str
) -> tuple[dict[str, Any], float, set[str]]:
    """What stage 1 trains of lift: its state, the critics' way from their start, what it logs."""
    from torchrl_bmrl.pipeline.agents import make_bcq_loss
    from torchrl_bmrl.pipeline.stage1 import train_job
    from torchrl_bmrl.training.checkpoint import load_checkpoint

    shutil.copytree(finished / "data", folder / "data")
    made = make_run(folder, *overrides)
    train_job((made, {"lift": "lift"}), lambda count: None)
    path = folder / "bcq" / "lift" / "checkpoint.safetensors"
    state, metadata = load_checkpoint(path, kind="bcq")
    torch.manual_seed(made.seed("bcq", "lift"))
    start = make_bcq_loss(**metadata["loss"]).state_dict()
    way = max(
        float((state["module"][key] - start[key]).abs().max())
        for key in start
        if key.startswith("qvalue_network_params") and key in state["module"]
    )
    return state, way, {path.stem for path in (folder / "logs").rglob("bcq_lift/**/*.csv")}


@pytest.mark.robosuite
@pytest.mark.slow
def test_critics_wait_while_the_generator_warms_up(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    for warmup, waits in ((12, True), (11, False)):
        folder = tmp_path / str(warmup)
        _, way, logged = trained(finished, folder, f"bcq.generator_warmup={warmup}")
        assert (way == 0) == waits
        assert "loss_generator" in logged
        assert ("loss_qvalue" in logged) != waits


@pytest.mark.robosuite
@pytest.mark.slow
def test_the_critics_gradient_is_clipped_and_no_other(
    run: Run, finished: Path, tmp_path: Path
) -> None:
    # Adam divides by the gradient's size but for its epsilon of 1e-8: only a tiny norm shows.
    state, way, _ = trained(finished, tmp_path / "clipped", "bcq.critic_grad_clip=1e-12")
    whole, whole_way, _ = trained(finished, tmp_path / "whole")
    assert way < 1e-4 < whole_way
    generator = [key for key in state["module"] if key.startswith("generator_params")]
    assert all(torch.equal(state["module"][key], whole["module"][key]) for key in generator)


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize(("update", "kept"), [(3, None), (6, 4), (12, 12)])
def test_stage_2_resumed_equals_never_stopped(
    run: Run, finished: Path, tmp_path: Path, update: int, kept: int | None
) -> None:
    from torchrl_bmrl.pipeline.stage2 import train_student
    from torchrl_bmrl.training.checkpoint import load_checkpoint

    for name in ("data", "bcq"):
        shutil.copytree(finished / name, tmp_path / name)
    made = make_run(tmp_path)
    checkpoint = tmp_path / "distill" / "checkpoint.safetensors"
    with pytest.raises(KeyboardInterrupt):
        train_student((made, None), Interruption(update, KeyboardInterrupt))
    if kept is None:
        assert not checkpoint.exists()
    else:
        assert load_checkpoint(checkpoint, kind="student")[1]["updates"] == kept
    counted: list[int] = []
    train_student((made, None), counted.append)
    assert counted == ([kept] if kept else []) + [1] * (12 - (kept or 0))
    # The teachers are as they were, too.
    stages = ("bcq/*/*", "distill/*", "logs/distill/scalars/*")
    assert contents(tmp_path, *stages) == contents(finished, *stages)


@pytest.mark.robosuite
@pytest.mark.slow
@pytest.mark.parametrize("damage", ["truncated", "not finite"])
def test_damaged_demonstrations_stop_training_before_anything_is_written(
    run: Run,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: str,
) -> None:
    import h5py

    from torchrl_bmrl.pipeline import stage1

    shutil.copytree(finished / "data", tmp_path / "data")
    path = tmp_path / "data" / "lift.hdf5"
    if damage == "truncated":
        path.write_bytes(path.read_bytes()[:-1000])
    else:
        with h5py.File(path, "r+") as file:
            file["data/demo_0/rewards"][2] = float("nan")
    with pytest.raises(SystemExit) as caught:
        run(tmp_path, stage1, tasks("lift"))
    assert caught.value.code == 1
    message = capsys.readouterr().err.splitlines()[-1]
    says = "not a complete HDF5 file" if damage == "truncated" else "not finite in row 2"
    assert message.startswith(f"error: {path}: ")
    assert says in message
    assert not (tmp_path / "bcq").exists()


@pytest.mark.robosuite
@pytest.mark.slow
def test_a_run_says_nothing_more_than_its_tables_unless_it_is_verbose(
    run: Run,
    finished: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from torchrl_bmrl.pipeline import two_stage

    # A slow machine has lines of progress beside them.
    monkeypatch.setattr(progress, "SOON", 600.0)
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    capsys.readouterr()
    run(folder, two_stage)
    quiet = capsys.readouterr()
    assert quiet.err == ""
    assert quiet.out.splitlines()[-1].startswith("collect 0.")
    run(folder, two_stage, "verbose=true")
    told = capsys.readouterr()
    assert told.out.splitlines()[:-1] == quiet.out.splitlines()[:-1]
    for line in (
        f"{folder}: two_stage, smoke",
        "bcq lift: resumed from update 12",
        "distillation: resumed from update 12",
        f"{folder / 'evaluation' / 'lift-bcq.csv'}: loaded",
        "stage 2: done",
    ):
        assert line in told.err.splitlines()
