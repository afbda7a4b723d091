"""Policies that leave the library: as programs of torch.export, and as ONNX files."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import (
    ACTION_DIM,
    CELLS,
    LATENT_DIM,
    OBSERVATION_DIM,
    TASK_LATENT_DIM,
    make_bcq_loss,
    make_critics,
    make_discrete_bcq_loss,
    make_distillation_loss,
    make_generator,
    make_plas_loss,
    undeclare,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torch.export import Dim
from torchrl.envs.transforms import ObservationNorm
from torchrl.modules import MLP

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.export import export_policy
from torchrl_bmrl.functional import sample_action_latent
from torchrl_bmrl.modules import (
    ActionFlow,
    ActionMixture,
    BCQPolicy,
    ChunkPolicy,
    DiscreteBCQPolicy,
    PLASPolicy,
    make_qvalue_network,
)
from torchrl_bmrl.objectives import BCQLoss

SIZES = {"observation": OBSERVATION_DIM, "task_latent": TASK_LATENT_DIM}
CANDIDATES = 7
LOC, SCALE = torch.linspace(-1, 1, OBSERVATION_DIM).double(), torch.tensor([0.5, 2.0, 1.0]).double()


def renamed() -> BCQPolicy:
    torch.manual_seed(0)
    keys = {"action_key": "move", "action_latent_key": ("z", "now"), "state_action_value_key": "q"}
    networks = [
        (
            MLP(OBSERVATION_DIM + LATENT_DIM, ACTION_DIM, num_cells=[8]),
            ["state", ("z", "now")],
            "move",
        ),
        (MLP(OBSERVATION_DIM + ACTION_DIM, 1, num_cells=[8]), ["state", "move"], "q"),
    ]
    parts = [TensorDictModule(net.double(), reads, [writes]) for net, reads, writes in networks]
    return BCQPolicy(*parts, latent_dim=LATENT_DIM, num_candidates=CANDIDATES, **keys)


def over(make: Any, **options: Any) -> BCQPolicy:
    """The policy of a loss with another generator than the autoencoder."""
    torch.manual_seed(0)
    generator = make(OBSERVATION_DIM, ACTION_DIM, num_cells=CELLS).double()
    loss = BCQLoss(generator, make_critics(2), bounds=(-1.0, 1.0), **options)
    return BCQPolicy.frozen(loss, num_candidates=CANDIDATES)


POLICIES: dict[str, Callable[[], Any]] = {
    "bcq": lambda: BCQPolicy.frozen(make_bcq_loss(), num_candidates=CANDIDATES),
    "live": lambda: BCQPolicy.live(make_bcq_loss(latent_clip=None), num_candidates=CANDIDATES),
    "perturbed": lambda: BCQPolicy.frozen(
        make_bcq_loss(perturbation=True, max_perturbation=0.3, edit=undeclare),
        num_candidates=CANDIDATES,
    ),
    "whole generator": lambda: BCQPolicy(
        make_generator(torch.float64),
        make_qvalue_network(OBSERVATION_DIM, ACTION_DIM, num_cells=CELLS).double(),
        num_candidates=CANDIDATES,
    ),
    "flow": lambda: over(ActionFlow),
    "mixture": lambda: over(ActionMixture),
    "ensemble": lambda: over(ActionMixture, acting_rule="min"),
    "student": lambda: BCQPolicy.frozen(make_distillation_loss(), num_candidates=CANDIDATES),
    "plas": lambda: PLASPolicy.frozen(make_plas_loss()),
    "perturbed plas": lambda: PLASPolicy.frozen(make_plas_loss(perturbation=True)),
    "discrete": lambda: DiscreteBCQPolicy.frozen(make_discrete_bcq_loss()),
    "categorical": lambda: DiscreteBCQPolicy.frozen(
        make_discrete_bcq_loss(action_space="categorical")
    ),
    "renamed": renamed,
}
each_policy = pytest.mark.parametrize("name", POLICIES)


def states(policy: TensorDictModuleBase, *batch: int, seed: int = 1) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        key: torch.randn(
            *batch, SIZES.get(key, OBSERVATION_DIM), dtype=torch.float64, generator=generator
        )
        for key in policy.in_keys
    }


def seeded(act: Callable[..., Tensor], inputs: dict[str, Tensor]) -> Tensor:
    torch.manual_seed(3)
    return act(**inputs)


# -- torch.export ----------------------------------------------------------------------------------


@each_policy
def test_an_exported_program_acts_as_the_policy_does_with_the_same_draws(name: str) -> None:
    policy = POLICIES[name]()
    policy.select_out_keys(policy.out_keys[0])
    inputs = states(policy, 4)
    program = torch.export.export(policy, args=(), kwargs=inputs).module()
    torch.testing.assert_close(seeded(program, inputs), seeded(policy, inputs))


@pytest.mark.parametrize("name", [name for name in POLICIES if name != "renamed"])
@pytest.mark.parametrize("strict", [False, True])
def test_an_exported_program_takes_any_number_of_states(name: str, strict: bool) -> None:
    policy = POLICIES[name]()
    inputs = states(policy, 4)
    shapes = {key: {0: Dim("batch")} for key in inputs}
    program = torch.export.export(
        policy, args=(), kwargs=inputs, dynamic_shapes=shapes, strict=strict
    ).module()
    for rows in (1, 9):
        inputs = states(policy, rows)
        torch.testing.assert_close(seeded(program, inputs), seeded(policy, inputs))


def test_a_state_without_a_batch_is_exported_as_it_is() -> None:
    policy = POLICIES["bcq"]()
    inputs = states(policy)
    program = torch.export.export(policy, args=(), kwargs=inputs).module()
    assert seeded(program, inputs).shape == (ACTION_DIM,)
    torch.testing.assert_close(seeded(program, inputs), seeded(policy, inputs))


def test_an_exported_live_policy_has_learnt_what_its_loss_has() -> None:
    loss = make_bcq_loss()
    policy = BCQPolicy.live(loss, num_candidates=CANDIDATES)
    inputs = states(policy, 4)
    before = seeded(policy, inputs)
    with torch.no_grad():
        for param in loss.parameters():
            param.add_(0.1)
    program = torch.export.export(policy, args=(), kwargs=inputs).module()
    assert not torch.allclose(seeded(program, inputs), before)
    torch.testing.assert_close(seeded(program, inputs), seeded(policy, inputs))


def test_a_keyword_that_a_policy_does_not_read_is_refused() -> None:
    policy = POLICIES["bcq"]()
    with pytest.raises(TypeError, match="obervation"):
        policy(**states(policy, 4), obervation=torch.zeros(4, OBSERVATION_DIM))


# -- ONNX ------------------------------------------------------------------------------------------

ALONE = """
import sys

ABSENT = {"torch", "tensordict", "torchrl", "torchrl_bmrl"}

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ABSENT:
            raise ModuleNotFoundError(name)

sys.meta_path.insert(0, Blocked())
for name in ABSENT:
    try:
        __import__(name)
    except ModuleNotFoundError:
        continue
    raise SystemExit(f"{name} can be imported")
import json
from pathlib import Path
import numpy as np
import onnxruntime

for path in map(Path, sys.argv[1:]):
    session = onnxruntime.InferenceSession(path)
    inputs = dict(np.load(path.with_suffix(".npz")))
    assert [value.name for value in session.get_inputs()] == list(inputs)
    np.save(path.with_suffix(".npy"), session.run(["action"], inputs)[0])
assert not ABSENT & set(sys.modules)
"""


def written(policy: Any, path: Path, **options: Any) -> Path:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    export_policy(policy, path, TensorDict(states(policy)), **options)
    return path


def act(path: Path, **inputs: Tensor) -> Tensor:
    import onnxruntime

    session = onnxruntime.InferenceSession(path)
    return torch.as_tensor(session.run(None, {k: v.numpy() for k, v in inputs.items()})[0])


def drawn(policy: Any, rows: int, number: int = CANDIDATES) -> dict[str, Tensor]:
    """The latents that the policy itself draws after ``seeded``."""
    if not isinstance(policy, BCQPolicy):
        return {}
    torch.manual_seed(3)
    shape, clip = (rows, number, policy.latent_dim), policy.latent_clip
    latent = sample_action_latent(shape, latent_clip=clip, dtype=torch.float64)
    key = policy.keys.action_latent
    return {key if isinstance(key, str) else "_".join(key): latent}


@pytest.mark.slow
def test_a_file_acts_as_its_policy_where_neither_this_library_nor_torch_can_be_imported(
    tmp_path: Path,
) -> None:
    expected = {}
    for name, make in POLICIES.items():
        if name in ("mixture", "ensemble"):
            continue  # ONNX Runtime has no Softplus of float64; the next test has float32
        policy = make()
        path = written(policy, tmp_path / f"{name.replace(' ', '_')}.onnx")
        inputs = states(policy, 5)
        expected[path] = seeded(policy, inputs)
        latents = drawn(policy, 5)
        np.savez(path.with_suffix(".npz"), **{k: v.numpy() for k, v in (inputs | latents).items()})
    command = [sys.executable, "-I", "-c", ALONE, *map(str, expected)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    for path, action in expected.items():
        found = torch.as_tensor(np.load(path.with_suffix(".npy")))
        torch.testing.assert_close(
            found, action, msg=lambda text, path=path: f"{path.stem}: {text}"
        )


@pytest.mark.parametrize("name", ["flow", "mixture", "ensemble"])
def test_a_file_over_each_generator_acts_as_its_policy_in_float32(
    name: str, tmp_path: Path
) -> None:
    policy = POLICIES[name]().float()
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    path = tmp_path / "policy.onnx"
    export_policy(policy, path, TensorDict(states(policy)).float())
    inputs = {key: value.float() for key, value in states(policy, 5).items()}
    expected = seeded(policy, inputs)
    torch.manual_seed(3)
    latent = torch.randn(5, CANDIDATES, policy.latent_dim)
    torch.testing.assert_close(act(path, **inputs, action_latent=latent), expected)


def test_states_and_candidates_may_be_as_many_as_one_likes(tmp_path: Path) -> None:
    policy = POLICIES["student"]()
    path = written(policy, tmp_path / "policy.onnx")
    for rows, number in ((1, 100), (3, 1), (9, 2)):
        policy.num_candidates = number
        inputs = states(policy, rows)
        found = act(path, **inputs, **drawn(policy, rows, number))
        torch.testing.assert_close(found, seeded(policy, inputs))


@pytest.mark.parametrize("name", ["bcq", "plas", "discrete"])
def test_a_file_normalises_the_observation_as_the_environment_did(
    name: str, tmp_path: Path
) -> None:
    policy = POLICIES[name]()
    path = written(policy, tmp_path / "policy.onnx", loc=LOC, scale=SCALE)
    raw = states(policy, 5)
    norm = ObservationNorm(LOC, SCALE, in_keys=["observation"], standard_normal=True)
    data = norm(TensorDict(raw, [5]))
    torch.manual_seed(3)
    expected = policy(data)["action"]
    torch.testing.assert_close(act(path, **raw, **drawn(policy, 5)), expected)
    assert not torch.equal(expected, seeded(policy, raw))


def test_a_file_says_how_its_latents_are_drawn_and_what_it_is_told(tmp_path: Path) -> None:
    path = written(POLICIES["bcq"](), tmp_path / "a.onnx", metadata={"tasks": {"lift": [0.5, 1]}})
    import onnxruntime

    said = onnxruntime.InferenceSession(path).get_modelmeta().custom_metadata_map["policy"]
    assert json.loads(said) == {
        "kind": "BCQPolicy",
        "num_candidates": CANDIDATES,
        "latent_dim": LATENT_DIM,
        "latent_clip": 0.5,
        "tasks": {"lift": [0.5, 1]},
    }


def test_a_file_is_the_same_each_time_and_names_no_file_of_this_machine(tmp_path: Path) -> None:
    policy = POLICIES["perturbed"]()
    policy.train()
    first, second = (written(policy, tmp_path / name).read_bytes() for name in ("a.onnx", "b.onnx"))
    assert first == second
    assert policy.training
    for text in (".py", str(tmp_path), sys.prefix):
        assert text.encode() not in first


def test_a_live_policy_is_written_as_it_is_now(tmp_path: Path) -> None:
    loss = make_bcq_loss()
    policy = BCQPolicy.live(loss, num_candidates=CANDIDATES)
    loss.float().double()  # its parameters lie elsewhere now
    with torch.no_grad():
        for param in loss.parameters():
            param.add_(0.1)
    path = written(policy, tmp_path / "policy.onnx")
    inputs = states(policy, 5)
    torch.testing.assert_close(act(path, **inputs, **drawn(policy, 5)), seeded(policy, inputs))


class NoLatent(TensorDictModuleBase):
    """A generator that draws actions of its own."""

    metrics, options, latent_dim, in_keys, out_keys = (), (), None, ["observation"], ["action"]

    def row_loss(self) -> None: ...

    def propose(self) -> None: ...


def refused() -> dict[str, tuple[Callable[[], Any], dict[str, Any], str]]:
    critic = make_qvalue_network(OBSERVATION_DIM, ACTION_DIM).double()
    bcq = POLICIES["bcq"]
    return {
        "half": (bcq, {"loc": LOC}, "scale is None; valid: both, or neither"),
        "key": (
            bcq,
            {"loc": LOC, "scale": SCALE, "observation_key": "pixels"},
            r"observation_key is 'pixels'; valid: keys of the policy, \['observation'\]",
        ),
        "zero": (
            bcq,
            {"loc": LOC, "scale": torch.zeros_like(SCALE)},
            "scale is .*; valid: finite numbers above 0",
        ),
        "infinite": (
            bcq,
            {"loc": LOC, "scale": SCALE / 0.0},
            "scale is .*inf.*; valid: finite numbers above 0",
        ),
        "latent": (lambda: BCQPolicy(NoLatent(), critic), {}, "NoLatent has no 'decode'"),
        "chunks": (
            lambda: ChunkPolicy(bcq(), 2),
            {},
            "ChunkPolicy remembers .*; valid: its policy",
        ),
    }


@pytest.mark.parametrize("case", ["half", "key", "zero", "infinite", "latent", "chunks"])
def test_what_cannot_be_written_is_refused(case: str, tmp_path: Path) -> None:
    make, options, message = refused()[case]
    with pytest.raises(BMRLError, match=message):
        written(make(), tmp_path / "policy.onnx", **options)
    assert list(tmp_path.iterdir()) == []


def test_an_example_that_lacks_an_entry_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    example = TensorDict({"observation": torch.zeros(3)})
    with pytest.raises(BMRLError, match="example has no 'task_latent'; valid"):
        export_policy(POLICIES["student"](), tmp_path / "policy.onnx", example)


def test_without_the_packages_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    example = TensorDict({"observation": torch.zeros(3)})
    with pytest.raises(BMRLError, match=r'no onnx; valid: pip install "torchrl_bmrl\[export\]"'):
        export_policy(POLICIES["bcq"](), tmp_path / "policy.onnx", example)
