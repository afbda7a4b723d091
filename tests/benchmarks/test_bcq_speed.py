"""Checks that the plain update equals the library's, and times both.

pytest tests/benchmarks                         # checks and timings
pytest tests/benchmarks --benchmark-disable     # checks, and one run of each update
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from shutil import which
from typing import Any

import acting_speed
import distillation_speed
import generator_speed
import pytest
import torch
from bcq_speed import (
    BATCH_SIZES,
    main,
    make_alone,
    make_batch,
    make_library_update,
    make_pair,
    make_products,
    make_stack,
    plain_arguments,
    variants,
    warmed_up,
)
from torch.utils.flop_counter import FlopCounterMode

needs_compiler = pytest.mark.skipif(
    not (which("g++") or which("clang++")), reason="torch.compile needs a C++ compiler"
)


@pytest.fixture(autouse=True)
def _no_compiled_code() -> None:
    torch.compiler.reset()


@pytest.mark.parametrize("rows", BATCH_SIZES)
def test_plain_and_library_updates_give_equal_losses(rows: int) -> None:
    plain, loss = make_pair()
    update = make_library_update(loss)
    for number in range(5):  # from the second on, the optimizers' and the targets' steps count too
        batch = make_batch(rows, seed=number)
        torch.manual_seed(number)
        expected = torch.stack(plain.update(*plain_arguments(batch)))
        torch.manual_seed(number)
        torch.testing.assert_close(torch.stack(update(batch)), expected, rtol=1e-4, atol=1e-6)
    assert expected.isfinite().all()


def test_the_limit_is_the_products_of_an_update_of_the_library() -> None:
    batch, counts = make_batch(100), []
    for update in (make_products(100), make_alone()):
        with FlopCounterMode(display=False) as counter:
            update(batch)
        counts.append(counter.get_total_flops())
    # More is the gradient into the observation, which the generator reads beside its latent.
    assert counts[0] <= counts[1] < 1.005 * counts[0]


@needs_compiler
@pytest.mark.parametrize("method", ["generator_loss", "qvalue_loss", "forward"])
@pytest.mark.filterwarnings("ignore")
def test_losses_compile_to_one_graph(method: str) -> None:
    part = getattr(make_pair()[1], method)
    explanation = torch._dynamo.explain(part)(make_batch(100))
    assert (explanation.graph_count, explanation.graph_break_count) == (1, 0)


UPDATES: dict[str, Callable[[], Any]] = {
    "alone": make_alone,
    "alone, compiled": lambda: make_alone(accelerated="compiled"),
    "stack of 6": lambda: make_stack(6),
}


@needs_compiler
@pytest.mark.parametrize("rows", BATCH_SIZES)
@pytest.mark.parametrize("name", UPDATES)
@pytest.mark.filterwarnings("ignore")
def test_updates_per_second(name: str, rows: int, request: pytest.FixtureRequest) -> None:
    pytest.importorskip("pytest_benchmark")
    benchmark: Callable[..., Any] = request.getfixturevalue("benchmark")
    benchmark.group = f"batch {rows}"
    batches = [make_batch(rows, seed) for seed in range(4)]
    update, source = warmed_up(UPDATES[name](), batches), cycle(batches)
    values = benchmark(lambda: update(next(source)))
    assert torch.stack(values).isfinite().all()


@needs_compiler
@pytest.mark.filterwarnings("ignore")
def test_script_prints_one_row_per_variant(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--rounds", "1", "--updates", "1", "--batch-sizes", "8", "--members", "2"])
    _, _, _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert [row.split(" | ")[1] for row in rows] == list(variants(8, "cpu", [2]))


@pytest.mark.parametrize("states", [1, 5])
def test_plain_and_library_policies_choose_equal_actions(states: int) -> None:
    actions = []
    for act in acting_speed.acting(states).values():
        torch.manual_seed(0)
        actions.append(act())
    torch.testing.assert_close(*actions, rtol=0, atol=1e-5)


@needs_compiler
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("script", [acting_speed, distillation_speed])
def test_other_scripts_print_their_tables(script: Any, capsys: pytest.CaptureFixture[str]) -> None:
    script.main(["--rounds", "1"])
    _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert len(rows) == {acting_speed: 8, distillation_speed: 4}[script]


@pytest.mark.parametrize("generator", generator_speed.GENERATORS)
def test_updates_per_second_with_each_generator(
    generator: str, request: pytest.FixtureRequest
) -> None:
    pytest.importorskip("pytest_benchmark")
    benchmark: Callable[..., Any] = request.getfixturevalue("benchmark")
    benchmark.group = "generators, batch 128"
    values = benchmark(generator_speed.updates(128, 2, 4)[generator])
    assert torch.stack(values).isfinite().all()


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)], ids=["cpu", "gpu"]
)
def test_every_policy_acts_within_the_bounds(device: str) -> None:
    ways = generator_speed.acting(3, 4, device)
    assert [*generator_speed.GENERATORS, generator_speed.STUDENT] == [
        name for name in ways if "critics" not in name
    ]
    for act in ways.values():
        action = act()
        assert (action.shape, action.device.type) == ((3, 7), device)
        assert action.abs().max() <= 1


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)], ids=["cpu", "gpu"]
)
def test_a_measurement_has_a_ratio_to_the_first_for_every_way(device: str) -> None:
    ways = generator_speed.updates(8, 2, 2, device)
    measured = generator_speed.measure(ways, rounds=1, calls=1, device=device)
    assert list(measured) == list(generator_speed.GENERATORS)
    assert measured[generator_speed.FIRST][1] == 1.0
    assert all(milliseconds > 0 for milliseconds, _ in measured.values())
