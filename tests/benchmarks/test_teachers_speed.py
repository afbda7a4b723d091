"""The script that measures how cost grows with the number of tasks."""

from __future__ import annotations

import sys

import pytest
import teachers_speed
from teachers_speed import MAKERS, STACKED, memory

needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="memory is read from /proc")


def test_variants_take_turns_and_each_is_measured_in_every_round() -> None:
    called: list[str] = []
    calls = {name: lambda name=name: called.append(name) for name in ("a", "b")}
    seconds = teachers_speed.measure(calls, rounds=2, device="cpu")
    assert called == [*"aabb", *"abab"]  # two to warm up
    assert {name: len(each) for name, each in seconds.items()} == {"a": 2, "b": 2}


@pytest.mark.parametrize("name", MAKERS)
def test_every_variant_makes_updates(name: str) -> None:
    call = MAKERS[name](2, "cpu")
    call()
    call()


@pytest.mark.slow
@needs_linux
def test_memory_is_that_of_a_fresh_process_and_grows_with_the_agents() -> None:
    mine = bytes(range(256)) * 2_000_000  # 512 MB of this process, and not of the others
    held = [memory(STACKED, agents, "cpu") for agents in (1, 24)]
    assert held[0] + 20 < held[1] < 200 < len(mine) / 1e6


@pytest.mark.slow
@needs_linux
def test_the_script_prints_a_row_for_every_number_of_tasks(
    capsys: pytest.CaptureFixture[str],
) -> None:
    teachers_speed.main(["--rounds", "1", "--tasks", "1", "2"])
    first, second = capsys.readouterr().out.strip().split("\n\n")
    assert [line.split(" | ")[0] for line in first.splitlines()[2:]] == ["| 1", "| 2"]
    assert [line.split(" | ")[0] for line in second.splitlines()[2:]] == ["| 2"]
