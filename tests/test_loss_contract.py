"""The library's losses hold the contract of torchrl_bmrl.testing; a new one is a line in ``CASES``.

What belongs to the equations of one loss is tested in that loss's own file.
"""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import (
    NO_UPDATER,
    STUDENT,
    M,
    bcq_case,
    discrete_bcq_case,
    distillation_case,
    focal_case,
    fqe_case,
    guide,
    mbml_case,
    plas_case,
    reward_models_case,
)
from tensordict import TensorDict
from torchrl.data import Bounded, Unbounded
from torchrl.objectives import SoftUpdate, ValueEstimators

from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.testing import Case, KeyedLossContract, OfflineLossContract
from torchrl_bmrl.testing.contract.compiled import check_compiled
from torchrl_bmrl.testing.measures import refused

pytestmark = pytest.mark.filterwarnings(NO_UPDATER)
REBRAC: Case = guide().TestReBRACLoss.case
OFFLINE = {
    "bcq": bcq_case(),
    "bcq_perturbed": bcq_case(perturbation=True),
    "plas": plas_case(),
    "plas_perturbed": plas_case(perturbation=True),
    "emaq_of_the_guide": guide().TestEMaQLoss.case,
    "rebrac": REBRAC,
    "rebrac_not_normalised": replace(
        REBRAC, options=REBRAC.options | {"normalise_q": False}, mixes_rows=False
    ),
    "discrete_bcq": discrete_bcq_case(),
    "discrete_bcq_categorical": discrete_bcq_case("categorical"),
    "fqe": fqe_case(),
    "focal": focal_case(),
    "focal_value_penalty": focal_case(value_penalty=True),
}
STUDENTS = {
    "distillation": distillation_case(context="current"),
    "distillation_previous": distillation_case(context="previous"),
    "distillation_random": distillation_case(context="random"),
    "distillation_metric": distillation_case(
        STUDENT | {"metric": {M}}, context="set", metric_weight=0.5
    ),
    "distillation_of_sets": distillation_case(
        STUDENT | {"distance": {M}}, sets=True, context="set", distance_weight=0.5
    ),
}
RELABELLING = {"mbml": mbml_case(), "reward_models": reward_models_case()}
CASES = OFFLINE | STUDENTS | RELABELLING
every = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
every_offline = pytest.mark.parametrize("case", OFFLINE.values(), ids=OFFLINE)
every_relabelling = pytest.mark.parametrize("case", RELABELLING.values(), ids=RELABELLING)
every_student = pytest.mark.parametrize("case", STUDENTS.values(), ids=STUDENTS)


@every_offline
class TestOfflineLosses(OfflineLossContract):
    """All of the contract."""


@every_student
class TestStudents(KeyedLossContract):
    """What holds for a loss without critics of its own, and what such a loss refuses."""

    def test_a_loss_without_targets_refuses_an_updater(self, case: Case) -> None:
        with pytest.raises(RuntimeError, match="target"):
            SoftUpdate(case.make(), tau=0.1)

    def test_renamed_and_nested_keys_give_the_same_losses(self, case: Case) -> None:
        if case is CASES["distillation_of_sets"]:
            pytest.skip("its encoder has names of its own, see tests/test_distillation_sets.py")
        super().test_renamed_and_nested_keys_give_the_same_losses(case)

    def test_value_estimators_are_refused(self, case: Case) -> None:
        with pytest.raises(NotImplementedError):
            case.make().make_value_estimator(ValueEstimators.TD0)

    def test_no_method_is_taken_for_a_term(self, case: Case) -> None:
        methods = {name for name in dir(case.make()) if name.endswith("_loss") and name[0] != "_"}
        assert methods == set()

    @pytest.mark.parametrize("shape", [(5,), (4, 5), (3, 5, 1)])
    def test_batches_that_are_not_one_row_per_teacher_are_refused(
        self, case: Case, shape: tuple[int, ...]
    ) -> None:
        data = TensorDict({"observation": torch.zeros(*shape, 3)}, batch_size=shape)
        refused(case.make(), data, str(list(shape)), "valid: [3, B], one row per teacher")

    @pytest.mark.parametrize(
        ("key", "shape"),
        [("task", (3, 5, 1)), (("next", "reward"), (3, 5)), (("next", "reward"), (3, 5, 2))],
    )
    def test_tasks_and_rewards_of_another_shape_are_refused(
        self, case: Case, key: Any, shape: tuple[int, ...]
    ) -> None:
        data = case.batch()
        data[key] = torch.zeros(shape, dtype=data[key].dtype)
        refused(case.make(), data, repr(key), str(shape), "valid")


@every_relabelling
class TestRelabellingLosses(KeyedLossContract):
    """What holds for a loss without critics of its own."""


def test_every_loss_of_the_library_has_a_case() -> None:
    from torchrl_bmrl import objectives

    losses = {getattr(objectives, name) for name in objectives.__all__ if name.endswith("Loss")}
    losses -= {objectives.StackedLoss}  # holds the others; tests/test_stacked.py goes over CASES
    losses -= {objectives.ContextInferenceLoss}  # its rows are contexts; tests/test_inference.py
    bases = {base for loss in losses for base in loss.__mro__[1:]}
    found = {type(case.make()) for case in CASES.values()} - {guide().EMaQLoss}
    assert losses - bases <= found <= losses  # MBMLLoss derives from a loss that has cases


def test_keys_have_the_same_order_in_another_process() -> None:
    code = "from test_loss_contract import keys_of_all; print(keys_of_all())"
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parent,
        env=os.environ | {"PYTHONHASHSEED": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ast.literal_eval(result.stdout.splitlines()[-1]) == keys_of_all()


def keys_of_all() -> dict[str, list[Any]]:
    losses = {name: case.make() for name, case in CASES.items()}
    return {name: [*loss.in_keys, *loss.out_keys] for name, loss in losses.items()}


@pytest.mark.gpu
def test_losses_on_the_gpu_are_those_on_the_cpu() -> None:
    # The loss that draws nothing, so that both see the same numbers.
    case = CASES["discrete_bcq"]
    expected = case.make()(case.batch())
    losses = case.make().to("cuda")(case.batch().to("cuda")).cpu()
    torch.testing.assert_close(losses.to_dict(), expected.to_dict(), rtol=0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no compiler")
def test_inductor_gives_the_same_values() -> None:
    with torch._inductor.config.patch(fallback_random=True):
        check_compiled(CASES["plas"])


SPEC = Bounded(low=torch.tensor([-1.0, -2.0]), high=torch.tensor([0.5, 3.0]), shape=(2,))
VAE = ("bcq", "plas")
BOUNDED = (*VAE, "rebrac", "focal")
BAD_OPTIONS = [
    (CASES, {"reduction": "avg"}, "'avg'; valid .*: mean, sum, none"),
    (OFFLINE, {"loss_function": "huber"}, "'huber'; valid .*: l2, l1, smooth_l1"),
    (VAE, {"lmbda": 1.5}, "lmbda is 1.5; valid: between 0 and 1"),
    (VAE, {"lmbda": -0.1}, "lmbda is -0.1; valid: between 0 and 1"),
    (VAE, {"kl_reduction": "max"}, "'max'; valid .*: mean, sum"),
    (BOUNDED, {"bounds": None}, "either action_spec or bounds; got neither"),
    (BOUNDED, {"action_spec": SPEC}, "either action_spec or bounds; got both"),
    (BOUNDED, {"bounds": (1.0, -1.0)}, "lower bound .*1.* above the upper bound .*-1"),
    (BOUNDED, {"bounds": None, "action_spec": Unbounded((2,))}, "Unbounded.*; valid: Bounded"),
    (["bcq"], {"num_candidates": 0}, "num_candidates is 0; valid: at least 1"),
    (["bcq"], {"value_bounds": (1.0, 0.0)}, r"value_bounds are \(1.0, 0.0\); valid: \(low, high"),
    (["rebrac"], {"actor_penalty": -0.1}, "actor_penalty is -0.1; valid: at least 0"),
    (["rebrac"], {"critic_penalty": -0.1}, "critic_penalty is -0.1; valid: at least 0"),
    (["focal"], {"context_size": 0}, "context_size is 0; valid: at least 1"),
    (["focal"], {"divergence_weight": 401.0}, "divergence_weight is 401.0; valid: between 0 and"),
    (["focal"], {"entropy_weight": -1.0}, "entropy_weight is -1.0; valid: at least 0"),
    (["discrete_bcq"], {"threshold": 1.5}, "threshold is 1.5; valid: between 0 and 1"),
    (["discrete_bcq"], {"action_space": "box"}, "'box'; valid .*: one-hot, categorical"),
    (["mbml"], {"max_deviation": -0.1}, "max_deviation is -0.1; valid: at least 0"),
    (["mbml"], {"triplet_margin": -1.0}, "triplet_margin is -1.0; valid: at least 0"),
    (STUDENTS, {"context": "next"}, "'next'; valid .*: current, previous, random, set"),
    (STUDENTS, {"context_fraction": 1.5}, "context_fraction is 1.5; valid: between 0 and 1"),
    (STUDENTS, {"context_size": 0}, "context_size is 0; valid: at least 1"),
    (STUDENTS, {"encoder_terms": ("norm",)}, "'norm'; valid .*: classification, .*metric"),
]


@pytest.mark.parametrize(
    ("case", "options", "message"),
    [
        pytest.param(CASES[name], options, message, id=f"{name}-{'-'.join(options)}")
        for names, options, message in BAD_OPTIONS
        for name in names
    ],
)
def test_bad_options_are_refused_with_the_valid_ones(
    case: Case, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(BMRLError, match=message):
        case.make(**options)


@pytest.mark.parametrize("name", VAE)
@pytest.mark.parametrize("part", ["encoder", "decoder", "latent_dim"])
def test_a_generator_that_lacks_a_part_is_refused_by_name(name: str, part: str) -> None:
    loss = CASES[name].make()
    generator = deepcopy(loss.generator)
    delattr(generator, part)
    networks = [generator, *([loss.actor_network] if name == "plas" else []), loss.qvalue_network]
    with pytest.raises(BMRLError, match=f"no {part!r}; valid: .*{re.escape('ActionVAE')}"):
        type(loss)(*networks, bounds=(-1.0, 1.0))
