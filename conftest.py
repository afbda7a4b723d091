"""What every test run shares: one thread, and clear skips where something is not installed."""

import os
import signal

# Before torch is imported: many small networks run fastest on one thread each.
for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"
# Read by pytest-timeout where it is installed [s].
os.environ.setdefault("PYTEST_TIMEOUT", "900")

from collections.abc import Iterator  # noqa: E402
from functools import cache  # noqa: E402
from importlib.util import find_spec  # noqa: E402
from typing import Any  # noqa: E402

import pytest  # noqa: E402
import torch  # noqa: E402

torch.set_num_threads(1)

# Modules whose import, or whose docstrings' examples, need an extra.
_NEEDS = {
    "gymnasium": [
        "tests/minari_files.py",
        "tests/tool_files.py",
        "tests/scene_state.py",
        "tests/stock_robosuite.py",
        "torchrl_bmrl/data/convert.py",
        "torchrl_bmrl/data/demonstrations.py",
        "torchrl_bmrl/envs/*",
        "torchrl_bmrl/reports/films.py",
    ],
    "h5py": [
        *(
            f"torchrl_bmrl/data/{name}.py"
            for name in (
                "__main__",
                "convert",
                "datasets",
                "demonstrations",
                "hdf5",
                "minari",
                "recordings",
                "robomimic",
                "robosuite",
            )
        ),
        *(
            f"tests/{name}.py"
            for name in (
                "d4rl_files",
                "d4rl_mutations",
                "episode_files",
                "file_runs",
                "file_edits",
                "lerobot_files",
                "minari_files",
                "minari_mutations",
                "mutations",
                "reader_edits",
                "recordings",
                "tiny_family",
                "tool_files",
            )
        ),
        "torchrl_bmrl/experts/*",
        "torchrl_bmrl/reports/films.py",
    ],
    "hydra": ["tests/small_runs.py", "torchrl_bmrl/configs.py"],
    "matplotlib": [
        "tests/explorers.py",
        "tests/families.py",
        "tests/published_data.py",
        "tests/report_data.py",
        "tests/weak_data.py",
        "torchrl_bmrl/reports/*",
    ],
    "metaworld": ["torchrl_bmrl/envs/metaworld.py", "torchrl_bmrl/experts/metaworld.py"],
    "minari": ["tests/minari_files.py", "torchrl_bmrl/data/convert.py"],
    "mujoco": ["torchrl_bmrl/reports/films.py"],
    "onnxscript": ["torchrl_bmrl/export.py"],
    "pyarrow": ["tests/lerobot_files.py"],
    "robosuite": [
        "tests/recordings.py",
        "tests/scene_state.py",
        "tests/stock_robosuite.py",
        "torchrl_bmrl/envs/*",
        "torchrl_bmrl/evaluation/rollout.py",
        "torchrl_bmrl/experts/*",
    ],
    "safetensors": [
        "torchrl_bmrl/pipeline/agents.py",
        "torchrl_bmrl/pipeline/student.py",
        "torchrl_bmrl/training/checkpoint.py",
    ],
    "scipy": [
        "tests/explorers.py",
        "tests/families.py",
        "tests/report_data.py",
        "torchrl_bmrl/evaluation/*",
        "torchrl_bmrl/reports/*",
    ],
    "sklearn": ["torchrl_bmrl/evaluation/embedding.py", "torchrl_bmrl/reports/figures.py"],
    "tqdm": [
        "tests/tiny_family.py",
        "tests/tool_files.py",
        "torchrl_bmrl/data/__main__.py",
        "torchrl_bmrl/run/workers.py",
        "torchrl_bmrl/run/progress.py",
    ],
    "yaml": ["torchrl_bmrl/run/folder.py"],
}
# Its import makes a process ignore signals, as the server of workers does.
collect_ignore = ["torchrl_bmrl/run/forked_server.py"]
collect_ignore_glob = sorted(
    {glob for package, globs in _NEEDS.items() if find_spec(package) is None for glob in globs}
)


def _stored_by_the_configurations() -> dict[str, Any]:
    """What the losses' configurations store in Hydra, which is left as it was.

    With them come TorchRL's groups ``env`` and ``logger``; a recipe in the same process would take
    its settings of these names for them.
    """
    if find_spec("hydra") is None:
        return {}
    from hydra.core.config_store import ConfigStore

    repo = ConfigStore.instance().repo
    before = set(repo)
    import torchrl_bmrl.configs  # noqa: F401

    return {group: repo.pop(group) for group in set(repo) - before}


_STORED = _stored_by_the_configurations()


@pytest.fixture
def stored_configurations() -> Iterator[None]:
    """Hydra with the losses' configurations, as after their import."""
    from hydra.core.config_store import ConfigStore

    repo = ConfigStore.instance().repo
    repo.update(_STORED)
    yield
    for group in _STORED:
        del repo[group]


@pytest.fixture
def signals_not_ignored() -> Iterator[None]:
    """No stop signal is ignored, as SIGHUP is under nohup and SIGINT in the background of a shell.

    Ignored signals stay ignored in a run, so a test that sends one would wait for ever.
    """
    defaults = {signal.SIGINT: signal.default_int_handler}
    defaults |= {number: signal.SIG_DFL for number in (signal.SIGHUP, signal.SIGTERM)}
    before = {number: signal.signal(number, handler) for number, handler in defaults.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@cache
def _robosuite_problem() -> str | None:
    """Why robosuite cannot be imported, or ``None``; it is imported only once a test asks."""
    try:
        import robosuite  # noqa: F401
    except Exception as error:  # a broken graphics or physics library raises what it likes
        return f"robosuite cannot be imported ({type(error).__name__}: {error})"
    return None


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skips what this machine cannot run."""
    if item.get_closest_marker("gpu") and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    if item.get_closest_marker("robosuite") and (problem := _robosuite_problem()):
        pytest.skip(problem)
