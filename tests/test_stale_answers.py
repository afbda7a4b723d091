"""A file that decides a result is known by its content: another one in its place is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("gymnasium")
pytest.importorskip("h5py")
pytest.importorskip("matplotlib")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("tqdm")

from episode_files import write_file
from file_runs import PARTS, file_run, write_demonstrations
from small_runs import study_run

from torchrl_bmrl.data import demonstrations
from torchrl_bmrl.data.source_files import files_of
from torchrl_bmrl.errors import BMRLError, CheckpointError, ConfigError, DataError
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome
from torchrl_bmrl.files import digest_of, write_atomic
from torchrl_bmrl.pipeline import Run, collect, held_out, stage1, stage2
from torchrl_bmrl.pipeline.evaluate import evaluate_once
from torchrl_bmrl.run.folder import INPUTS, check_files, check_made_from, open_run
from torchrl_bmrl.studies import people
from torchrl_bmrl.studies.people import HumanSettings, learn_from_people


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sources of a run's tasks and, in ``run``, the run of both stages."""
    folder = tmp_path_factory.mktemp("sources")
    write_demonstrations(folder)
    run = run_in(folder, folder)
    with run:
        collect(run)
        stage1(run)
        stage2(run)
    return folder


def run_in(folder: Path, sources: Path, policy: Path | None = None) -> Run:
    """A run on files in a folder of sources."""
    settings = file_run(sources).settings
    chosen = replace(settings.evaluate, policy=None if policy is None else str(policy))
    return Run(replace(settings, run_dir=str(folder / "run"), evaluate=chosen))


@pytest.fixture
def trained(sources: Path, tmp_path: Path) -> Run:
    """A copy of the run, whose folder a test may change."""
    shutil.copytree(sources / "run", tmp_path / "run")
    return run_in(tmp_path, sources)


def write_other(path: Path) -> None:
    """Writes other demonstrations with the same layout."""
    write_file(path, (9, 9, 9, 9), parts=PARTS)


def opened(run: Run) -> None:
    with run:
        pass


# -- files that settings name ----------------------------------------------------------------------


def test_a_policy_that_was_overwritten_is_refused_by_name(tmp_path: Path, sources: Path) -> None:
    policy = tmp_path / "p.safetensors"
    policy.write_bytes(b"first")
    opened(run_in(tmp_path, sources, policy))
    opened(run_in(tmp_path, sources, policy))  # the same goes on
    policy.write_bytes(b"other")
    with pytest.raises(ConfigError, match=r"evaluate.policy \(.*p.safetensors\) is .* use"):
        opened(run_in(tmp_path, sources, policy))


def test_a_policy_that_is_overwritten_between_two_jobs_is_refused(
    tmp_path: Path, sources: Path
) -> None:
    policy = tmp_path / "p.safetensors"
    shutil.copy(sources / "run" / "distill" / "checkpoint.safetensors", policy)
    run = run_in(tmp_path, sources, policy)
    with run:
        assert run.policy()[1]["updates"] == 6
        shutil.copy(sources / "run" / "distill" / "checkpoint.1.safetensors", policy)
        with pytest.raises(ConfigError, match=r"evaluate.policy"):
            run.policy()


def test_a_source_that_was_overwritten_is_refused_by_its_task(tmp_path: Path) -> None:
    write_demonstrations(tmp_path)
    run = run_in(tmp_path, tmp_path)
    with run:
        collect(run)
    write_other(tmp_path / "drawer.hdf5")
    with pytest.raises(ConfigError, match=r"tasks.drawer.demonstrations \(.*drawer.hdf5\)"):
        opened(run)
    (tmp_path / "drawer.hdf5").unlink()  # the run has its own copy
    opened(run)


def test_a_source_that_is_replaced_before_it_is_imported_leaves_no_demonstrations(
    tmp_path: Path,
) -> None:
    write_demonstrations(tmp_path)
    run = run_in(tmp_path, tmp_path)
    with run:
        write_other(tmp_path / "door.hdf5")
        with pytest.raises(ConfigError, match=r"tasks.door.demonstrations"):
            collect(run)
    assert list(run.data_dir.glob("*")) == []


def test_human_demonstrations_that_were_overwritten_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def convert(settings: HumanSettings, path: Path, bounds: Any) -> None:
        write_atomic(path, "made")
        raise BMRLError("enough")

    def learn() -> None:
        with study_run(tmp_path / "run") as run:
            learn_from_people(run, HumanSettings(path=str(path)))

    monkeypatch.setattr(people, "_convert", convert)
    path = tmp_path / "human.hdf5"
    path.write_text("first")
    for _ in range(2):
        with pytest.raises(BMRLError, match="enough"):
            learn()
    path.write_text("other")
    with pytest.raises(ConfigError, match=r"the content of human.path \(.*human.hdf5\) is"):
        learn()


def test_a_folder_of_an_earlier_version_takes_the_files_as_they_are(tmp_path: Path) -> None:
    policy = tmp_path / "p"
    policy.write_text("first")
    open_run(tmp_path / "run", {"seed": 0})
    assert not (tmp_path / "run" / INPUTS).exists()
    open_run(tmp_path / "run", {"seed": 0}, files={"evaluate.policy": [policy]})
    policy.write_text("other")
    with pytest.raises(ConfigError, match=r"evaluate\.policy"):
        check_files(tmp_path / "run", {"evaluate.policy": [policy]})


def test_a_base_passes_on_what_its_demonstrations_were_imported_from(tmp_path: Path) -> None:
    source, files = tmp_path / "a.hdf5", {"tasks.a.demonstrations": [tmp_path / "a.hdf5"]}
    source.write_text("first")
    open_run(tmp_path / "base", {"seed": 0}, files=files)
    source.write_text("other")
    settings = {"seed": 0, "base": str(tmp_path / "base")}
    with pytest.raises(ConfigError, match=r"tasks\.a\.demonstrations"):
        open_run(tmp_path / "run", settings, files=files)


def test_digests_that_are_damaged_are_named(tmp_path: Path) -> None:
    open_run(tmp_path, {"seed": 0})
    (tmp_path / INPUTS).write_text("[]")
    with pytest.raises(DataError, match=r"inputs.json: a list; valid: digests by setting"):
        open_run(tmp_path, {"seed": 0})


def test_the_files_of_a_data_set_are_those_that_are_read(tmp_path: Path) -> None:
    for name in ("demo.hdf5", "models/a.xml", "set/meta/info.json", "set/data/0.parquet"):
        write_atomic(tmp_path / name, "")
    write_atomic(tmp_path / "set" / "videos" / "0.mp4", "")
    assert files_of(tmp_path / "demo.hdf5") == [
        tmp_path / "demo.hdf5",
        tmp_path / "models" / "a.xml",
    ]
    assert [path.name for path in files_of(tmp_path / "set")] == ["0.parquet", "info.json"]
    assert files_of(tmp_path) == [tmp_path / "demo.hdf5"]  # a folder of HDF5 files
    assert files_of(tmp_path / "nowhere") == []


# -- results and the policies that they are of ---------------------------------------------------


def test_a_result_of_another_policy_is_refused_until_it_is_removed(trained: Run) -> None:
    played: list[int] = []

    def play(seeds: list[int]) -> list[EpisodeOutcome]:
        played.append(len(seeds))
        return [EpisodeOutcome(1.0, None) for _ in seeds]

    def evaluated() -> None:
        path = trained.agent_path("door")
        evaluate_once(trained, "door", "bcq", play, of=[path], report=lambda steps: None)

    evaluated()
    evaluated()
    assert played == [1]
    shutil.copy(trained.agent_path("drawer"), trained.agent_path("door"))
    with pytest.raises(ConfigError, match=r"door-bcq.csv: made from another .*remove this result"):
        evaluated()
    (trained.folder / "evaluation" / "door-bcq.csv").unlink()
    evaluated()
    evaluated()
    assert played == [1, 1]


def test_numbers_of_a_student_that_was_trained_further_are_refused(
    trained: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = dict.fromkeys(held_out.COLUMNS, 0.5) | {"task": "door"}
    monkeypatch.setattr(held_out, "_held_out", lambda run, name, report: row)
    half = trained.student_path.with_name("checkpoint.1.safetensors").read_bytes()
    whole = trained.student_path.read_bytes()
    trained.student_path.write_bytes(half)
    held_out.held_out_job((trained, "door"), lambda updates: None)
    trained.student_path.write_bytes(whole)
    with pytest.raises(ConfigError, match=r"door-held_out.csv: made from another"):
        held_out.held_out_job((trained, "door"), lambda updates: None)


def test_a_result_of_an_earlier_version_is_taken_as_it_is(tmp_path: Path) -> None:
    result, policy = tmp_path / "lift-bcq.csv", tmp_path / "policy"
    result.write_text("its episodes")
    check_made_from(result, [policy])  # a policy that is gone
    policy.write_text("first")
    check_made_from(result, [policy])
    policy.write_text("second")
    with pytest.raises(ConfigError, match=r"made from another"):
        check_made_from(result, [policy])


# -- demonstrations and their statistics -----------------------------------------------------------


def test_demonstrations_that_were_replaced_are_refused_and_statistics_stay(trained: Run) -> None:
    path = trained.data_dir / "statistics.json"
    before = path.read_bytes()
    opened(trained)
    write_other(trained.demonstrations("drawer"))
    with pytest.raises(DataError, match=r"drawer.hdf5: its content is .* valid: the file as it"):
        opened(trained)
    with pytest.raises(DataError, match=r"drawer.hdf5: its content is"):
        trained.transitions("drawer", "train")
    assert path.read_bytes() == before


def test_a_file_that_is_replaced_after_its_digest_gives_no_statistics(
    trained: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    (trained.data_dir / "statistics.json").unlink()

    def digest(path: Path) -> str:
        before = digest_of(path)
        write_other(path)
        return before

    monkeypatch.setattr(demonstrations, "digest_of", digest)
    with pytest.raises(DataError, match=r"hdf5: its content is"):
        demonstrations.write_statistics(trained.data_dir, trained.tasks)
    assert not (trained.data_dir / "statistics.json").exists()


def test_statistics_are_computed_once_and_without_digests_anew(trained: Run) -> None:
    path = trained.data_dir / "statistics.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content))  # the same numbers in other bytes
    kept = path.read_bytes()
    with trained:
        collect(trained)
        assert path.read_bytes() == kept
        for task in content["tasks"].values():
            del task["sha256"]  # as earlier versions wrote them
        path.write_text(json.dumps(content))
        collect(trained)
    assert "sha256" in json.loads(path.read_text())["tasks"]["door"]


def test_an_agent_plays_with_no_other_statistics_than_its_own(trained: Run) -> None:
    path = trained.data_dir / "statistics.json"
    content = json.loads(path.read_text())
    trained.teacher("door")
    trained.student()
    nudged = content | {"loc": [x * (1 + 1e-6) for x in content["loc"]]}
    path.write_text(json.dumps(nudged))  # as another machine rounds
    vars(trained).pop("statistics")
    trained.teacher("door")
    path.write_text(json.dumps(content | {"loc": [x + 1 for x in content["loc"]]}))
    vars(trained).pop("statistics")
    with pytest.raises(CheckpointError, match=r"door.checkpoint.safetensors: trained on obs"):
        trained.teacher("door")
    with pytest.raises(CheckpointError, match=r"distill.checkpoint.safetensors: trained on obs"):
        trained.student()
    trained.policy()  # evaluated with its own
