"""Run folders contain the settings and versions of their run, and are compared with others."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

pytest.importorskip("yaml")

import yaml

from torchrl_bmrl import __version__
from torchrl_bmrl.errors import ConfigError, DataError
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.run import folder as runs
from torchrl_bmrl.run.folder import (
    open_run,
    read_settings,
    read_versions,
    read_yaml,
)

SETTINGS = {
    "run_dir": "runs/a",
    "workers": 1,
    "logger": "none",
    "seed": 0,
    "tasks": ["reach", "lift"],
    "bcq": {"lr": 1e-5, "num_cells": [8, 8], "latent_clip": None, "schedule": {"kind": "cosine"}},
}


def changed(key: str, value: Any) -> dict[str, Any]:
    """The settings with one entry set, or removed for ``...``."""
    settings = json.loads(json.dumps(SETTINGS))
    *groups, name = key.split(".")
    group = settings
    for part in groups:
        group = group[part]
    if value is ...:
        del group[name]
    else:
        group[name] = value
    return settings


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# -- the folder --------------------------------------------------------------------------------


def test_a_new_folder_says_what_it_was_told_and_on_what_it_runs(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "run"
    open_run(folder, SETTINGS)
    assert set(contents(folder)) == {"config.yaml", "versions.json"}
    assert read_settings(folder) == SETTINGS
    versions = read_versions(folder)
    assert versions["torchrl_bmrl"] == __version__
    assert versions["torch"] == torch.__version__
    assert {"python", "torchrl", "tensordict"} <= versions.keys()


@pytest.mark.parametrize("build", ["+cpu", "+cu130", ""])
def test_a_run_names_the_build_of_torch_that_package_metadata_may_lack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, build: str
) -> None:
    monkeypatch.setattr(torch, "__version__", f"2.13.0{build}")
    monkeypatch.setattr(runs.importlib.metadata, "version", lambda package: "2.13.0")
    open_run(tmp_path, SETTINGS)
    assert read_versions(tmp_path)["torch"] == f"2.13.0{build}"


@pytest.mark.parametrize(
    "key", ["run_dir", "workers", "logger", "only", "base", "preset", "ablation"]
)
def test_a_run_goes_on_with_the_same_settings_and_what_is_free_to_change(
    tmp_path: Path, key: str
) -> None:
    open_run(tmp_path, SETTINGS)
    before = contents(tmp_path)
    open_run(tmp_path, dict(reversed(SETTINGS.items())))
    open_run(tmp_path, changed(key, "other"))
    assert contents(tmp_path) == before


@pytest.mark.skipif(shutil.which("git") is None, reason="no git")
def test_a_run_names_the_commit_of_its_sources_and_no_other_repositorys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def git(*words: str) -> None:
        who = ["-c", "user.name=a", "-c", "user.email=a@b"]
        subprocess.run(["git", *who, "-C", str(tmp_path), *words], check=True, capture_output=True)

    def commit(number: int) -> str | None:
        open_run(tmp_path / "runs" / str(number), SETTINGS)
        return read_versions(tmp_path / "runs" / str(number)).get("commit")

    sources = tmp_path / "runs.py"
    monkeypatch.setattr("torchrl_bmrl.run.folder.__file__", str(sources))
    sources.write_text("first")
    assert commit(0) is None
    git("init")
    git("commit", "--allow-empty", "-m", "somebody else's")
    assert commit(1) is None
    git("add", "runs.py")
    git("commit", "-m", "ours")
    known = commit(2)
    assert known is not None
    assert re.fullmatch("[0-9a-f]{7,}", known)
    sources.write_text("changed")
    assert commit(3) == f"{known}+"


BASE_FILES = {
    "data/reach.hdf5": "collect",
    "data/statistics.json": "collect",
    "bcq/reach/checkpoint.safetensors": "bcq",
    "bcq/reach/evaluations.csv": "bcq",
    "distill/checkpoint.safetensors": "distill",
    "evaluation/reach-expert.csv": "collect, evaluate",
    "evaluation/reach-bcq.csv": "bcq, evaluate",
}
"""Files of a run, and the settings that decide them."""


@pytest.mark.parametrize(
    ("other", "taken"),
    [
        ({}, set(BASE_FILES)),
        ({"workers": 7, "logger": "csv"}, set(BASE_FILES)),
        ({"distill": {"updates": 2}}, set(BASE_FILES) - {"distill/checkpoint.safetensors"}),
        ({"evaluate": {"episodes": 2}}, {name for name in BASE_FILES if "evaluation/" not in name}),
        (
            {"bcq": {"lr": 1.0}},
            {"data/reach.hdf5", "data/statistics.json", "evaluation/reach-expert.csv"},
        ),
        (
            {"evaluate": {"episodes": 1, "num_candidates": 7}},
            {name for name in BASE_FILES if not name.startswith("evaluation/")}
            - {"bcq/reach/evaluations.csv"},
        ),
        ({"collect": {"noise": 0.0}}, set()),
        ({"robot": "Panda"}, set()),
        ({"seed": 1}, set()),
        ({"tasks": ["reach"]}, set()),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, dict) else "",
)
def test_a_run_takes_from_its_base_what_it_would_only_make_again(
    tmp_path: Path, other: dict[str, Any], taken: set[str]
) -> None:
    base, run = tmp_path / "base", tmp_path / "run"
    sections = {"collect": {"noise": 0.2}, "distill": {"updates": 1}, "evaluate": {"episodes": 1}}
    settings = SETTINGS | sections
    open_run(base, settings)
    for name in (*BASE_FILES, "data/.episodes/reach/0.npz", "evaluation/reach-distilled-x.csv"):
        (base / name).parent.mkdir(parents=True, exist_ok=True)
        (base / name).write_text(name)
    open_run(run, settings | other | {"run_dir": str(run), "base": str(base)})
    files = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    assert files == taken | {"config.yaml", "versions.json"}
    # The base stays as it is when the run goes on, which replaces files.
    write_atomic(run / "data" / "reach.hdf5", "other")
    assert (base / "data" / "reach.hdf5").read_text() == "data/reach.hdf5"


def test_a_folder_of_an_earlier_version_has_the_defaults_of_settings_that_it_lacks(
    tmp_path: Path,
) -> None:
    """In the folder itself and in one that is a base."""
    base, run = tmp_path / "base", tmp_path / "run"
    open_run(base, SETTINGS | {"collect": {"noise": 0.2}})
    (base / "data").mkdir()
    (base / "data" / "reach.hdf5").write_text("episodes")
    defaults = {"collect": {"noise": 0.1, "speed": 1.0, "absent": 3}, "new": "usual"}
    now = SETTINGS | {"collect": {"noise": 0.2, "speed": 1.0}, "new": "usual"}
    open_run(base, now, defaults)
    open_run(run, now | {"run_dir": str(run), "base": str(base)}, defaults)
    assert (run / "data" / "reach.hdf5").exists()
    for other in ({"new": "other"}, {"collect": {"noise": 0.2, "speed": 0.5}}):
        with pytest.raises(ConfigError, match=r"(new|collect.speed) is .* in the folder's run"):
            open_run(base, now | other, defaults)
    with pytest.raises(ConfigError, match=r"collect.speed is 1.0 here and None in"):
        open_run(base, now)


@pytest.mark.parametrize(
    ("section", "name", "first"), [("bcq", "cosine", False), ("distill", "advantage_weight", 0.0)]
)
def test_a_folder_without_a_setting_has_the_value_with_which_it_was_made(
    tmp_path: Path, section: str, name: str, first: Any
) -> None:
    """Although the default is another one today."""
    settings = pytest.importorskip("torchrl_bmrl.pipeline.settings", exc_type=ImportError)
    defaults = asdict(settings.Settings())
    assert defaults[section][name] != first
    before = {key: value for key, value in defaults[section].items() if key != name}
    open_run(tmp_path, SETTINGS | {section: before})
    now = SETTINGS | {section: defaults[section]}
    with pytest.raises(ConfigError, match=rf"{name} is .* here and {first} in the folder"):
        open_run(tmp_path, now, defaults)
    open_run(tmp_path, SETTINGS | {section: defaults[section] | {name: first}}, defaults)


def test_a_run_that_was_killed_while_it_took_files_holds_no_others_when_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base, run = tmp_path / "base", tmp_path / "run"
    open_run(base, SETTINGS)
    (base / "data").mkdir()
    (base / "data" / "reach.hdf5").write_text("of seed 0")
    monkeypatch.setattr(runs, "link_or_copy", Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        open_run(run, SETTINGS | {"base": str(base)})
    monkeypatch.undo()
    with pytest.raises(ConfigError, match="seed is 1 here and 0 in"):
        open_run(run, SETTINGS | {"seed": 1})
    open_run(run, SETTINGS | {"base": str(base)})
    assert not (run / "data").exists()  # to be made, not half taken


def test_a_base_on_another_disk_is_copied(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError("cross-device link")

    base, run = tmp_path / "base", tmp_path / "run"
    open_run(base, SETTINGS)
    (base / "data").mkdir()
    (base / "data" / "reach.hdf5").write_text("episodes")
    monkeypatch.setattr(os, "link", refuse)
    open_run(run, SETTINGS | {"base": str(base)})
    assert (run / "data" / "reach.hdf5").read_text() == "episodes"


def test_a_base_that_is_no_run_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such file; valid: the folder of a run"):
        open_run(tmp_path / "run", SETTINGS | {"base": str(tmp_path / "nothing")})
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("seed", 1, "seed is 1 here and 0 in the folder's run"),
        ("tasks", ["reach"], "tasks is "),
        ("bcq.lr", 1e-4, "bcq.lr is 0.0001 here and 1e-05 in"),
        ("bcq.latent_clip", 0.5, "bcq.latent_clip is 0.5 here and None in"),
        ("bcq.schedule.kind", "flat", "bcq.schedule.kind is flat here and cosine in"),
        ("bcq.tau", 0.5, "bcq.tau is 0.5 here and None in"),
        ("seed", ..., "seed is None here and 0 in"),
        ("bcq.workers", 3, "bcq.workers is 3 here"),
    ],
)
def test_other_settings_are_refused_by_the_key_that_differs(
    tmp_path: Path, key: str, value: Any, message: str
) -> None:
    open_run(tmp_path, SETTINGS)
    before = contents(tmp_path)
    with pytest.raises(ConfigError) as info:
        open_run(tmp_path, changed(key, value))
    assert message in str(info.value)
    assert str(tmp_path) in str(info.value)
    assert contents(tmp_path) == before


def test_of_two_runs_that_create_a_folder_at_once_one_does_and_the_other_is_checked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = runs.write_atomic

    def while_another_is_faster(path: Path, text: str, **options: Any) -> None:
        if path.name == "config.yaml":
            write(path, yaml.safe_dump(SETTINGS))
        write(path, text, **options)

    monkeypatch.setattr(runs, "write_atomic", while_another_is_faster)
    open_run(tmp_path / "same", changed("workers", 2))
    with pytest.raises(ConfigError, match="seed is 1 here and 0 in"):
        open_run(tmp_path / "other", changed("seed", 1))
    assert read_settings(tmp_path / "other") == SETTINGS


@pytest.mark.parametrize(
    ("name", "read", "text"),
    [
        *(("config.yaml", read_settings, text) for text in (None, "a: [1", "- 1\n- 2\n", "")),
        *(("versions.json", read_versions, text) for text in (None, "{", "", "[1, 2]")),
    ],
)
def test_a_folder_without_readable_settings_or_versions_is_refused_by_name(
    tmp_path: Path, name: str, read: Callable[[Path], Any], text: str | None
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(DataError) as info:
        read(tmp_path)
    assert info.value.path == tmp_path / name


def test_settings_that_refer_to_each_other_are_refused_before_they_grow(tmp_path: Path) -> None:
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{i}: &a{i} {{x: *a{i - 1}, y: *a{i - 1}}}" for i in range(1, 60)]
    (tmp_path / "config.yaml").write_text("\n".join(lines))
    with pytest.raises(DataError, match=r"config\.yaml: not YAML \(contains a reference; valid"):
        read_settings(tmp_path)


@pytest.mark.parametrize("text", ["[" * 100_000, "a: " + "{a: " * 5_000, "\udc80"])
def test_settings_and_versions_of_any_content_are_refused_by_name(
    tmp_path: Path, text: str
) -> None:
    for name, read in (("config.yaml", read_settings), ("versions.json", read_versions)):
        (tmp_path / name).write_bytes(text.encode("utf-8", "surrogateescape"))
        with pytest.raises(DataError, match=name):
            read(tmp_path)


@pytest.mark.parametrize("name", ["", "missing.yaml"])
def test_a_folder_or_nothing_in_place_of_a_yaml_file_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(DataError, match="no such file"):
        read_yaml(tmp_path / name)
