"""The plain update equals the library's; how many of each run per second.

pytest tests/benchmarks                         # the check and the timings
pytest tests/benchmarks --benchmark-disable     # the check, and one run of each
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from shutil import which
from typing import Any

import pytest
import torch
from bcq_speed import (
    BATCH_SIZES,
    VARIANTS,
    main,
    make_batch,
    make_library_update,
    make_pair,
    make_plain_update,
    warmed_up,
)

COMPILED = [name for name in VARIANTS if "compiled" in name]
needs_compiler = pytest.mark.skipif(
    not (which("g++") or which("clang++")), reason="torch.compile needs a C++ compiler"
)


@pytest.fixture(autouse=True)
def _no_compiled_code() -> None:
    torch.compiler.reset()


@pytest.mark.parametrize("rows", BATCH_SIZES)
def test_plain_and_library_updates_give_equal_losses(rows: int) -> None:
    plain, loss = make_pair()
    updates = make_plain_update(plain), make_library_update(loss)
    for number in range(5):  # from the second on, the optimizers' and the targets' steps count too
        batch, values = make_batch(rows, seed=number), []
        for update in updates:
            torch.manual_seed(number)
            values.append(torch.stack(update(batch)))
        torch.testing.assert_close(*values, rtol=1e-4, atol=1e-6)
    assert values[0].isfinite().all()


@needs_compiler
@pytest.mark.parametrize("method", ["generator_loss", "qvalue_loss", "forward"])
@pytest.mark.filterwarnings("ignore")
def test_losses_compile_to_one_graph(method: str) -> None:
    part = getattr(make_pair()[1], method)
    explanation = torch._dynamo.explain(part)(make_batch(100))
    assert (explanation.graph_count, explanation.graph_break_count) == (1, 0)


@pytest.mark.parametrize("rows", BATCH_SIZES)
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=needs_compiler if name in COMPILED else ()) for name in VARIANTS],
)
@pytest.mark.filterwarnings("ignore")
def test_updates_per_second(name: str, rows: int, request: pytest.FixtureRequest) -> None:
    pytest.importorskip("pytest_benchmark")
    benchmark: Callable[..., Any] = request.getfixturevalue("benchmark")
    benchmark.group = f"batch {rows}"
    batches = [make_batch(rows, seed) for seed in range(4)]
    update, source = warmed_up(VARIANTS[name](), batches), cycle(batches)
    values = benchmark(lambda: update(next(source)))
    assert torch.stack(values).isfinite().all()


@needs_compiler
@pytest.mark.filterwarnings("ignore")
def test_script_prints_one_row_per_variant(capsys: pytest.CaptureFixture[str]) -> None:
    main(["--rounds", "1", "--updates", "1", "--batch-sizes", "8"])
    _, _, *rows = capsys.readouterr().out.strip().splitlines()
    assert [row.split(" | ")[1] for row in rows] == list(VARIANTS)
