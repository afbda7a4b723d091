"""What is collected opens in the tools that it is meant for: robomimic and robosuite."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("robosuite", exc_type=ImportError)
pytest.importorskip("h5py")

import h5py
from observations import OBSERVATION_SHAPES

from torchrl_bmrl.envs.skills import Lift
from torchrl_bmrl.experts.collect import collect_demonstrations
from torchrl_bmrl.experts.controllers import LiftExpert
from torchrl_bmrl.experts.tabletop import make_task

pytestmark = pytest.mark.robosuite

ROBOMIMIC = "robomimic==0.3.0"
READ = """
import sys
import h5py
import numpy as np
import robomimic.utils.obs_utils as ObsUtils
from robomimic.utils.dataset import SequenceDataset

path, keys = sys.argv[1], sys.argv[2:]
ObsUtils.initialize_obs_utils_with_obs_specs([{"obs": {"low_dim": keys}}])
data = SequenceDataset(
    path,
    obs_keys=keys,
    dataset_keys=("actions", "rewards", "dones"),
    seq_length=3,
    load_next_obs=True,
    filter_by_attribute="train",
)
assert len(data) == 8, len(data)
with h5py.File(path, "r", libver="latest", swmr=True) as file:  # as robomimic holds it
    demo = file["data/demo_0"]
    for start in range(4):
        item = data[start]
        for key in ("actions", "rewards"):
            rows = demo[key][start : start + 3]
            np.testing.assert_array_equal(item[key][: len(rows)], rows)
        for group in ("obs", "next_obs"):
            for key in keys:
                rows = demo[f"{group}/{key}"][start : start + 3]
                np.testing.assert_array_equal(item[group][key][: len(rows)], rows)
print("read")
"""


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("played")
    task = make_task(Lift(), LiftExpert, horizon=4)
    return collect_demonstrations(
        folder, [task], {"lift": 2}, valid_episodes=1, noise=0.2, seed=5, workers=1
    )["lift"]


@pytest.mark.slow
def test_robomimics_own_sequence_dataset_reads_what_is_collected(
    path: Path, tmp_path: Path
) -> None:
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target"]
    done = subprocess.run(
        [*install, str(tmp_path / "robomimic"), ROBOMIMIC],
        capture_output=True,
        text=True,
        timeout=300,
    )
    if done.returncode:
        pytest.skip(f"{ROBOMIMIC} does not install here: {done.stderr.strip()[-200:]}")
    read = subprocess.run(
        [sys.executable, "-c", READ, str(path), *OBSERVATION_SHAPES],
        env={**os.environ, "PYTHONPATH": str(tmp_path / "robomimic")},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert read.returncode == 0, read.stderr
    assert read.stdout.endswith("read\n")


def test_robosuite_plays_states_back_to_the_observations_that_were_recorded(path: Path) -> None:
    import robosuite

    with h5py.File(path) as file:
        meta = json.loads(file["data"].attrs["env_args"])
        demo = file["data/demo_1"]
        env = robosuite.make(meta["env_name"], **meta["env_kwargs"])
        env.reset()
        env.reset_from_xml_string(env.edit_model_xml(demo.attrs["model_file"]))
        for t, state in enumerate(demo["states"][:]):
            env.sim.set_state_from_flattened(state)
            env.sim.forward()
            for name, part in env.named_observation().items():
                np.testing.assert_array_equal(part, demo[f"obs/{name}"][t])
        env.close()
