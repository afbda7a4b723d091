"""Loggers write what they are given, and their failures end no run."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from wandb_files import offline, read_runs

from torchrl_bmrl.errors import UnknownNameError
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.run import loggers
from torchrl_bmrl.run.loggers import close_logger, log_metrics, make_logger


@pytest.fixture
def offline_wandb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs wandb without an account or a server; its own files go to ``home``."""
    pytest.importorskip("wandb")
    offline(monkeypatch, tmp_path / "home")


def test_no_logger_logs_nothing(tmp_path: Path) -> None:
    assert make_logger("none", tmp_path, "bcq_lift") is None
    log_metrics(None, {"loss": torch.tensor(1.0)}, 1)
    assert not any(tmp_path.iterdir())


def test_csv_logs_every_metric_at_its_step(tmp_path: Path) -> None:
    logger = make_logger("csv", tmp_path, "bcq_lift")
    for step in (10, 20):
        log_metrics(logger, {"loss_qvalue": torch.tensor(step / 4), "accuracy": 1}, step)
    folder = tmp_path / "logs" / "bcq_lift" / "scalars"
    assert {path.name for path in folder.iterdir()} == {"loss_qvalue.csv", "accuracy.csv"}
    rows = (folder / "loss_qvalue.csv").read_text().split()
    assert [tuple(map(float, row.split(","))) for row in rows] == [(10, 2.5), (20, 5.0)]


def test_tensorboard_writes_events_in_the_run_folder(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    logger = make_logger("tensorboard", tmp_path, "bcq_lift")
    log_metrics(logger, {"loss_qvalue": 0.5}, 10)
    logger.experiment.close()
    files = list((tmp_path / "logs" / "bcq_lift").glob("events*"))
    assert len(files) == 1
    assert b"loss_qvalue" in files[0].read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("offline_wandb")
def test_every_wandb_logger_of_a_process_has_a_run_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = ["bcq_reach", "bcq_lift", "distill"]
    made = {name: make_logger("wandb", tmp_path / "run", name) for name in names}
    for step in (10, 20):
        for number, name in enumerate(names):
            log_metrics(made[name], {"loss": torch.tensor(number + 0.5)}, number + step)
    for logger in made.values():
        settings = logger.experiment.settings
        assert (settings.mode, logger.experiment.project) == ("offline", "torchrl_bmrl")
        close_logger(logger)
    runs = read_runs(tmp_path / "run")
    assert [(run["name"], run["ended"]) for run in runs] == [(name, True) for name in names]
    for number, run in enumerate(runs):
        expected = [{"loss": number + 0.5, "step": number + step} for step in (10, 20)]
        assert run["rows"] == expected
    assert len({run["id"] for run in runs}) == 3
    assert {path.name for path in tmp_path.iterdir()} == {"home", "run"}


@pytest.mark.slow
@pytest.mark.usefixtures("offline_wandb")
def test_a_run_that_goes_on_continues_its_own_wandb_run_whatever_a_batch_script_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WANDB_RUN_ID", "one-for-all")
    for step in (0, 20):
        for folder in ("a", "b"):
            logger = make_logger("wandb", tmp_path / folder, "bcq_lift", step)
            log_metrics(logger, {"loss": step / 4}, step + 10)
            close_logger(logger)
        time.sleep(1.1)  # wandb's folders have the second of their start in their names
    a, b = (read_runs(tmp_path / folder) for folder in ("a", "b"))
    for both in (a, b):
        assert [run["rows"] for run in both] == [
            [{"loss": 0.0, "step": 10}],
            [{"loss": 5.0, "step": 30}],
        ]
        assert both[0]["id"] == both[1]["id"]
    assert a[0]["id"] != b[0]["id"]


@pytest.mark.parametrize("text", ["../../elsewhere", "", "\0", "A" * 16, "a" * 17])
def test_an_id_that_is_none_of_ours_gets_no_further(tmp_path: Path, text: str) -> None:
    path = tmp_path / "logs" / "bcq_lift" / "wandb_id"
    write_atomic(path, text)
    known = loggers._wandb_id(path)
    assert re.fullmatch("[0-9a-f]{16}", known)
    assert loggers._wandb_id(path) == known


def test_an_unknown_logger_is_refused_with_the_valid_ones(tmp_path: Path) -> None:
    with pytest.raises(
        UnknownNameError, match=r"'mlflow'; valid .*: csv, wandb, tensorboard, none"
    ):
        make_logger("mlflow", tmp_path, "bcq_lift")


# -- loggers that fail -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["tensorboard", "wandb"])
def test_a_logger_that_cannot_be_made_is_said_and_csv_files_take_its_place(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    import torchrl.record.loggers as theirs

    make = theirs.get_logger

    def unreachable(name: str, *arguments: Any, **options: Any) -> Any:
        if name == kind:
            raise ConnectionError("no route to host\nand much more")
        return make(name, *arguments, **options)

    monkeypatch.setattr(theirs, "get_logger", unreachable)
    monkeypatch.setattr(loggers, "_wandb_options", lambda run_dir, name: {})
    logger = make_logger(kind, tmp_path, "bcq_lift")
    log_metrics(logger, {"loss": 0.5}, 10)
    (said,) = caplog.messages
    assert f"bcq_lift: {kind} is not available (no route to host); metrics go to CSV files" in said
    assert str(tmp_path) in said
    assert (tmp_path / "logs" / "bcq_lift" / "scalars" / "loss.csv").read_text() == "10,0.5\n"


def test_a_server_that_is_out_of_reach_is_waited_for_once_in_a_run_and_for_seconds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("wandb")
    import torchrl.record.loggers as theirs

    make, asked = theirs.get_logger, []

    def unreachable(name: str, *arguments: Any, **options: Any) -> Any:
        if name == "wandb":
            asked.append(options["wandb_kwargs"]["settings"])
            raise ConnectionError("context deadline exceeded")
        return make(name, *arguments, **options)

    monkeypatch.setattr(theirs, "get_logger", unreachable)
    monkeypatch.setenv("WANDB_MODE", "offline")  # no account is looked for
    monkeypatch.delenv("WANDB_INIT_TIMEOUT", raising=False)
    for name in ("bcq_reach", "bcq_lift"):
        log_metrics(make_logger("wandb", tmp_path / "a", name), {"loss": 0.5}, 10)
        assert (tmp_path / "a" / "logs" / name / "scalars" / "loss.csv").exists()
    assert len(caplog.messages) == len(asked) == 1
    assert asked[0]["init_timeout"] <= 20
    monkeypatch.setenv("WANDB_INIT_TIMEOUT", "300")
    make_logger("wandb", tmp_path / "b", "bcq_reach")
    assert asked[1] == {}  # wandb reads its own variable


def test_a_logger_that_fails_later_is_said_once_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    logger = make_logger("csv", tmp_path, "bcq_lift")
    log_metrics(logger, {"loss": 0.5}, 10)
    with monkeypatch.context() as patch:
        fails = Mock(side_effect=OSError("no space left on device"))
        patch.setattr(logger, "log_scalar", fails)
        for step in (20, 30):
            log_metrics(logger, {"loss": 0.5, "accuracy": 1}, step)
    assert fails.call_count == 1
    (said,) = caplog.messages
    assert said == "metrics from step 20 on are not logged (no space left on device)"
    other = make_logger("csv", tmp_path, "bcq_reach")
    log_metrics(other, {"loss": 0.5}, 10)
    assert (tmp_path / "logs" / "bcq_reach" / "scalars" / "loss.csv").exists()


def test_a_logger_that_cannot_end_is_said_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    close_logger(None)
    logger = make_logger("csv", tmp_path, "bcq_lift")
    monkeypatch.setattr(logger, "close", Mock(side_effect=ConnectionError("no route to host")))
    close_logger(logger)
    (said,) = caplog.messages
    assert said == "the last metrics may be missing (no route to host)"


@pytest.mark.parametrize("torn", ["", "4", "40,0.", "\0\0\0\n", "40,0.25"])
def test_rows_after_the_step_that_a_run_goes_on_from_are_dropped_and_torn_ones(
    tmp_path: Path, torn: str
) -> None:
    logger = make_logger("csv", tmp_path, "bcq_lift")
    for step in (10, 20, 30):
        log_metrics(logger, {"loss": step / 4}, step)
    del logger
    path = tmp_path / "logs" / "bcq_lift" / "scalars" / "loss.csv"
    whole = path.read_text()
    path.write_text(whole + torn)
    logger = make_logger("csv", tmp_path, "bcq_lift", step=20)
    for step in (30, 40):
        log_metrics(logger, {"loss": step / 4}, step)
    assert path.read_text() == whole + "40,10.0\n"


@pytest.mark.parametrize("there", [True, False])
def test_rows_are_appended_to_no_file_that_a_run_has_a_link_to(tmp_path: Path, there: bool) -> None:
    path, other = tmp_path / "run/logs/bcq_lift/scalars/loss.csv", tmp_path / "other.csv"
    path.parent.mkdir(parents=True)
    path.symlink_to(other)
    if there:
        other.write_text("10,2.5\n")
    logger = make_logger("csv", tmp_path / "run", "bcq_lift", step=10)
    log_metrics(logger, {"loss": 5.0}, 20)
    assert path.read_text() == "10,2.5\n" * there + "20,5.0\n"
    assert (other.read_text() if other.exists() else "") == "10,2.5\n" * there
