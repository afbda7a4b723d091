"""An exported policy acts as in its run, and its ONNX file acts without this library."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from small_runs import RECIPES, Run, make_run, tasks
from tensordict import TensorDict

from torchrl_bmrl.evaluation import read_results


@pytest.fixture(scope="module")
def exported(run: Run, finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished run, with its exported policy."""
    from torchrl_bmrl.pipeline import export

    folder = shutil.copytree(finished, tmp_path_factory.mktemp("exported") / "run")
    return run(folder, export)


@pytest.mark.robosuite
@pytest.mark.slow
def test_the_policy_of_the_repository_plays_all_tasks_and_knows_its_own_demonstrations(
    run: Run, tmp_path: Path
) -> None:
    from torchrl_bmrl.pipeline import evaluate
    from torchrl_bmrl.pipeline.evaluate import held_out_episode
    from torchrl_bmrl.pipeline.settings import SIX_TASKS
    from torchrl_bmrl.pipeline.student import load_student

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
        # It acts as the expert did in the same states, up to the expert's noise of 0.2.
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
    from torchrl_bmrl.pipeline.student import load_student

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
    """Compares the file's actions on the policy's own demonstrations, and their values, with it."""
    onnxruntime = pytest.importorskip("onnxruntime")
    from torchrl_bmrl.functional import sample_action_latent
    from torchrl_bmrl.pipeline.student import load_student
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
