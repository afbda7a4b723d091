"""Whatever a file or a setting holds: it is taken correctly, or refused with a typed error.

Checksums are made right again after a change, so that what is tried is what lies behind them.
HDF5 files are tried in test_mutations.py, in processes of their own: HDF5 may loop for ever.
"""

from __future__ import annotations

import copy
import json
import math
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hypothesis")
pytest.importorskip("hydra")
pytest.importorskip("h5py")
pytest.importorskip("safetensors")
pytest.importorskip("scipy")
pytest.importorskip("gymnasium")
pytest.importorskip("tqdm")

import torch
import yaml
from hydra.errors import HydraException
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from safetensors.torch import load, save
from small_runs import configured, settings_of

from torchrl_bmrl.data.demonstrations import read_statistics
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robomimic import keep_episode, read_kept_episode
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation import ResultRow, read_results, write_results
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.pipeline import Run, learners
from torchrl_bmrl.pipeline.agents import load_bcq_loss, make_bcq_loss
from torchrl_bmrl.pipeline.stage2 import OF_THE_STUDENT, loss_options
from torchrl_bmrl.pipeline.student import Student, load_student, make_distillation_loss
from torchrl_bmrl.run.folder import deciding, open_run, read_settings, read_versions
from torchrl_bmrl.tasks import Task, get_task
from torchrl_bmrl.training import checkpoint, make_adam

TRIED = settings(
    max_examples=120,
    deadline=None,  # what hangs meets the timeout of every test; no time is asserted here
    derandomize=True,  # the same in every run
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
SMALL = {"num_cells": [8], "observation_dim": 3, "action_dim": 2}
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["../../x", "/etc/passwd", "", "nan", "a" * 10_000]),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=5,
)


def paths_of(tree: Any) -> list[tuple[Any, ...]]:
    """Of every node below the root."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree)
    found = []
    for key, value in items:
        found.append((key,))
        if isinstance(value, dict | list):
            found += [(key, *rest) for rest in paths_of(value)]
    return found


def changed(data: st.DataObject, tree: Any) -> Any:
    """A copy with some node replaced, removed, or added to."""
    tree = copy.deepcopy(tree)
    *parents, key = data.draw(st.sampled_from(paths_of(tree)))
    node = tree
    for parent in parents:
        node = node[parent]
    how = data.draw(st.sampled_from(["replaced", "removed", "added"]))
    if how == "removed":
        del node[key]
    elif how == "added" and isinstance(node, dict):
        node[data.draw(st.text(max_size=8))] = data.draw(JSON)
    else:
        node[key] = data.draw(JSON)
    return tree


def damaged(data: st.DataObject, content: bytes) -> bytes:
    """Bytes cut, doubled, overwritten or inserted somewhere."""
    start = data.draw(st.integers(0, len(content)))
    stop = data.draw(st.integers(start, min(len(content), start + 64)))
    new = data.draw(st.binary(max_size=64) | st.just(content[start:stop] * 2))
    return content[:start] + new + content[stop:]


def is_refused(function: Any, *arguments: Any) -> bool:
    """Whether a typed error says so; any other error is raised."""
    try:
        function(*arguments)
    except BMRLError as error:
        return bool(str(error))
    return False


# -- checkpoints -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A good checkpoint of each kind."""
    folder = tmp_path_factory.mktemp("kept")
    torch.manual_seed(0)
    options = {**SMALL, "num_tasks": 3, "latent_dim": 4}
    modules = {"bcq": make_bcq_loss(**SMALL), "student": Student(**options)}
    said = {
        "tasks": ["reach", "lift", "push_up"],
        "latent_clip": 0.5,
        "accuracy": 0.9,
        "statistics": {"loc": [0.0, 1.0, 2.0], "scale": [1.0, 1.0, 0.5]},
        "updates": 3,
    }
    paths = {}
    for kind, module in modules.items():
        paths[kind] = folder / f"{kind}.safetensors"
        metadata = {"kind": kind, "loss": SMALL, "student": options, **said}
        optimizers = {"all": make_adam(module.parameters(), lr=0.1)}
        checkpoint.save_training(paths[kind], module, optimizers, metadata, device="cpu", keep=1)
    return paths


def read_all(path: Path, kind: str) -> None:
    """A checkpoint's two ways back, by whoever acts with it and whoever goes on from it."""
    if kind == "bcq":
        module, _ = load_bcq_loss(path)
    else:
        module, _ = load_student(path)
    module.requires_grad_(True)
    optimizers = {"all": make_adam(module.parameters(), lr=0.1)}
    rng = torch.get_rng_state()
    try:
        checkpoint.resume_training(path, module, optimizers, kind=kind, device="cpu")
    finally:
        torch.set_rng_state(rng)


@pytest.mark.parametrize("kind", ["bcq", "student"])
@TRIED
@given(data=st.data())
def test_a_checkpoint_with_a_changed_header_is_refused_or_read(
    kept: dict[str, Path], tmp_path: Path, kind: str, data: st.DataObject
) -> None:
    content = kept[kind].read_bytes()
    tensors, header = load(content), json.loads(header_of(content))
    header = changed(data, header)
    if isinstance(header, dict) and "sha256" in header:
        header["sha256"] = checkpoint._checksum(header, tensors)
    path = tmp_path / "a.safetensors"
    path.write_bytes(save(tensors, {"checkpoint": json.dumps(header)}))
    is_refused(read_all, path, kind)


def header_of(content: bytes) -> str:
    size = int.from_bytes(content[:8], "little")
    return json.loads(content[8 : 8 + size])["__metadata__"]["checkpoint"]


@pytest.mark.parametrize("kind", ["bcq", "student"])
@TRIED
@given(data=st.data())
def test_a_checkpoint_with_changed_tensors_is_refused_or_read(
    kept: dict[str, Path], tmp_path: Path, kind: str, data: st.DataObject
) -> None:
    content = kept[kind].read_bytes()
    tensors, header = load(content), json.loads(header_of(content))
    name = data.draw(st.sampled_from(sorted(tensors)))
    shape = data.draw(st.lists(st.integers(0, 9), max_size=3))
    dtypes = [torch.float32, torch.float64, torch.int64, torch.bool, torch.uint8, torch.bfloat16]
    value = data.draw(st.sampled_from([0.0, 1.0, -1.0, 1e30, math.nan, math.inf]))
    tensors[name] = torch.full(shape, value).to(data.draw(st.sampled_from(dtypes)))
    header["sha256"] = checkpoint._checksum(header, tensors)
    path = tmp_path / "a.safetensors"
    path.write_bytes(save(tensors, {"checkpoint": json.dumps(header)}))
    is_refused(read_all, path, kind)


@pytest.mark.parametrize("kind", ["bcq", "student"])
@TRIED
@given(data=st.data())
def test_a_damaged_checkpoint_is_refused_unless_nothing_that_is_read_has_changed(
    kept: dict[str, Path], tmp_path: Path, kind: str, data: st.DataObject
) -> None:
    content = kept[kind].read_bytes()
    path = tmp_path / "a.safetensors"
    path.write_bytes(damaged(data, content))
    if not is_refused(read_all, path, kind):
        (now, said), (before, told) = (
            checkpoint.load_checkpoint(file, kind=kind) for file in (path, kept[kind])
        )
        assert said == told
        assert all(torch.equal(now["module"][key], x) for key, x in before["module"].items())


# -- run folders -----------------------------------------------------------------------------------

RUN = {
    "preset": "smoke",
    "seed": 0,
    "tasks": ["reach", "lift"],
    "bcq": {"lr": 1e-3, "num_cells": [8, 8], "latent_clip": None},
}


@TRIED
@given(data=st.data())
def test_changed_settings_of_a_run_are_refused_unless_they_decide_nothing(
    tmp_path: Path, data: st.DataObject
) -> None:
    settings = changed(data, RUN)
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    (tmp_path / "versions.json").write_text("{}")
    if not is_refused(open_run, tmp_path, RUN):
        said, told = (
            {key: value for key, value in deciding(run).items() if value is not None}
            for run in (settings, RUN)
        )
        assert said == told


@TRIED
@given(data=st.data())
def test_damaged_settings_of_a_run_are_refused_or_read(tmp_path: Path, data: st.DataObject) -> None:
    content = damaged(data, yaml.safe_dump(RUN).encode())
    (tmp_path / "config.yaml").write_bytes(content)
    if not is_refused(read_settings, tmp_path):
        assert isinstance(read_settings(tmp_path), dict)


STATISTICS = {"loc": [0.0, 1.0], "scale": [1.0, 2.0]}
STATISTICS = {**STATISTICS, "tasks": {"reach": STATISTICS}}


@pytest.mark.parametrize("task", [None, get_task("reach")])
@TRIED
@given(data=st.data())
def test_changed_statistics_are_refused_or_fit_to_normalise(
    tmp_path: Path, task: Task | None, data: st.DataObject
) -> None:
    text = json.dumps(changed(data, STATISTICS)).encode()
    if data.draw(st.booleans()):
        text = damaged(data, text)
    (tmp_path / "statistics.json").write_bytes(text)
    if not is_refused(read_statistics, tmp_path, task):
        statistics = read_statistics(tmp_path, task)
        assert statistics.loc.shape == statistics.scale.shape
        assert statistics.loc.isfinite().all()
        assert (statistics.scale > 0).all()


@TRIED
@given(content=st.binary(max_size=200) | JSON.map(lambda tree: json.dumps(tree).encode()))
def test_any_versions_are_refused_or_texts(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "versions.json").write_bytes(content)
    if not is_refused(read_versions, tmp_path):
        assert all(isinstance(version, str) for version in read_versions(tmp_path).values())


# -- results and episodes --------------------------------------------------------------------------


@TRIED
@given(data=st.data())
def test_damaged_results_are_refused_or_valid(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "results.csv"
    options: dict[str, Any] = {"task": "lift", "policy": "bcq", "latent_source": "", "seed": 0}
    rows = [
        ResultRow(**options, episode=i, episode_return=i / 3, success=bool(i % 2)) for i in range(3)
    ]
    write_results(path, rows)
    path.write_bytes(damaged(data, path.read_bytes()))
    if not is_refused(read_results, path):
        for row in read_results(path):
            assert math.isfinite(row.episode_return)
            assert row.task in ("reach", "lift", "push_right", "push_left", "push_up", "push_down")


@TRIED
@given(data=st.data())
def test_a_damaged_episode_is_refused_or_read(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "a.npz"
    parts = {"object": torch.zeros(3, 2).numpy()}
    numbers = torch.arange(3.0).numpy()
    episode = Episode(
        observations=parts,
        next_observations=parts,
        actions=torch.zeros(3, 2).numpy(),
        rewards=numbers,
        terminated=numbers > 3,
        extras={"successes": numbers > 1},
        attributes={"seed": 3},
    )
    keep_episode(path, episode)
    path.write_bytes(damaged(data, path.read_bytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not is_refused(read_kept_episode, path):
            assert len(read_kept_episode(path).actions) == 3


# -- settings --------------------------------------------------------------------------------------


def leaves(tree: Any, prefix: str = "") -> list[str]:
    if not OmegaConf.is_dict(tree):
        return [prefix]
    return [
        leaf for key in tree for leaf in leaves(tree._get_node(key), f"{prefix}.{key}".lstrip("."))
    ]


VALUES = st.one_of(
    st.integers(-3, 3).map(str),
    st.integers().map(str),
    st.floats().map(str),
    st.sampled_from(
        ["null", "true", "nan", "inf", "[]", "[0]", "[-1]", "[1,1]", "[nan]", "{}", "{a:1}", "x"]
    ),
    st.sampled_from(
        ["''", "'${nothing}'", "'${seed}'", "'${oc.env:HOME}'", "???", "[[1]]", "../x"]
    ),
)


@cache
def setting_names() -> list[str]:
    """All settings but those that say where things are, or are others together."""
    return sorted(
        set(leaves(configured("preset=smoke"))) - {"run_dir", "base", "preset", "ablation"}
    )


@pytest.mark.usefixtures("recipes")
@settings(TRIED, max_examples=150)
@given(data=st.data())
def test_any_setting_is_refused_by_name_or_makes_losses(
    tmp_path: Path, data: st.DataObject
) -> None:
    key, value = data.draw(st.sampled_from(setting_names())), data.draw(VALUES)
    small = ["bcq.num_cells=[4]", "distill.num_cells=[4]", "preset=smoke", f"run_dir={tmp_path}"]
    try:
        config = settings_of(*small, f"{key}={value}")
        config.check()
        run = Run(config)
    except (BMRLError, HydraException, OmegaConfBaseException):
        return
    widths = (*config.bcq.num_cells, *config.distill.num_cells, config.distill.task_latent_dim)
    if max(*widths, config.bcq.num_qvalue_nets) > 1000:
        return  # memory, not validity
    sizes = {"observation_dim": 3, "action_dim": 2}
    agents = [make_bcq_loss(**learners.loss_options(config.bcq), **sizes) for _ in run.tasks]
    student = Student(
        num_tasks=len(run.tasks),
        **{name: getattr(config.distill, name) for name in OF_THE_STUDENT},
        latent_dim=agents[0].generator.latent_dim,
        **sizes,
    )
    make_distillation_loss(
        student,
        [BCQPolicy.frozen(agent) for agent in agents],
        **loss_options(config.distill),
    )
