"""The loop that trains: its order, its checkpoints, its stops, its way back."""

from __future__ import annotations

from collections.abc import Callable
from signal import SIGTERM
from typing import Any

import pytest
import torch
from tensordict import TensorDict

from torchrl_bmrl.errors import BMRLError, StoppedError
from torchrl_bmrl.training.fit import Every, fit

Events = list[tuple[Any, ...]]


def recorded(
    *, every: Every, report: Callable[[int], Any] = lambda updates: None, **options: Any
) -> Events:
    """What the loop does, in order; nothing but ``report`` fails."""
    events: Events = []
    options = {"total": 6, "start": 0, "events": events} | options
    run(options.pop("events"), every=every, report=report, **options)
    return events


def run(
    events: Events,
    *,
    every: Every,
    total: int = 6,
    start: int = 0,
    report: Callable[[int], Any] = lambda updates: None,
    check: Callable[[int], Any] = lambda update: None,
    evaluates: bool = False,
) -> None:
    batches = iter(range(100))

    def sample() -> TensorDict:
        return TensorDict({"number": torch.tensor(next(batches))}, [])

    def step(update: int, batch: TensorDict) -> dict[str, Any]:
        events.append(("step", update, batch["number"].item()))
        return {"update": torch.tensor(update)}

    def checked(update: int, metrics: Any, batch: TensorDict, logging: bool) -> None:
        assert metrics["update"].item() == update  # of this update, with its batch
        events.append(("check", update, logging, batch["number"].item()))
        check(update)

    def evaluate(update: int) -> None:
        events.append(("evaluate", update))

    fit(
        step,
        sample,
        start=start,
        total=total,
        every=every,
        check=checked,
        save=lambda update: events.append(("save", update)),
        evaluate=evaluate if evaluates else None,
        report=report,
    )


def kinds(events: Events, *names: str) -> list[tuple[str, int]]:
    return [(event[0], event[1]) for event in events if event[0] in names]


def test_updates_come_in_their_order_each_with_a_batch_of_its_own() -> None:
    events = recorded(every=Every(log=100, save=100))
    assert [event[1:] for event in events if event[0] == "step"] == [(i + 1, i) for i in range(6)]


@pytest.mark.parametrize(
    ("save", "saved"), [(1, [1, 2, 3, 4, 5, 6]), (2, [2, 4, 6]), (4, [4, 6]), (7, [6])]
)
def test_it_saves_at_intervals_and_after_the_last_update_once(save: int, saved: list[int]) -> None:
    events = recorded(every=Every(log=100, save=save))
    assert [update for _, update in kinds(events, "save")] == saved


@pytest.mark.parametrize(("log", "save"), [(1, 1), (2, 3), (3, 2), (100, 5), (4, 100)])
def test_every_save_comes_after_a_check_of_the_same_update(log: int, save: int) -> None:
    events = kinds(recorded(every=Every(log=log, save=save)), "check", "save")
    for position, (kind, update) in enumerate(events):
        if kind == "save":
            assert events[position - 1] == ("check", update)
    assert events[-1] == ("save", 6)


def test_metrics_are_logged_at_their_interval_alone() -> None:
    events = recorded(every=Every(log=2, save=3))
    logging = [(event[1], event[2]) for event in events if event[0] == "check"]
    assert logging == [(2, True), (3, False), (4, True), (6, True)]


def test_an_evaluation_lies_between_the_check_and_the_save_of_its_update() -> None:
    events = recorded(every=Every(log=2, save=2, evaluate=2), evaluates=True)
    assert [kind for kind, update in kinds(events, "step", "check", "evaluate", "save")][:5] == [
        "step",
        "step",
        "check",
        "evaluate",
        "save",
    ]
    assert kinds(events, "evaluate") == [("evaluate", update) for update in (2, 4, 6)]
    assert not kinds(recorded(every=Every(log=2, save=2), evaluates=True), "evaluate")


def test_a_training_that_went_wrong_is_not_saved_any_more() -> None:
    events: Events = []

    def check(update: int) -> None:
        if update == 4:
            raise BMRLError("diverged")

    with pytest.raises(BMRLError, match="diverged"):
        run(events, every=Every(log=100, save=2), check=check)
    assert kinds(events, "save") == [("save", 2)]
    assert events[-1][:2] == ("check", 4)


def stop_at(update: int) -> Callable[[int], None]:
    done = []

    def report(count: int) -> None:
        done.append(count)
        if sum(done) == update:
            raise StoppedError(SIGTERM)

    return report


@pytest.mark.parametrize("update", [1, 3, 5])
def test_a_stop_checks_and_saves_the_last_update_and_is_raised(update: int) -> None:
    events: Events = []
    with pytest.raises(StoppedError):
        run(events, every=Every(log=100, save=4), report=stop_at(update))
    assert kinds(events, "check", "save")[-2:] == [("check", update), ("save", update)]
    assert events[-2][2] is False  # the interval of the log is not its own
    assert len(kinds(events, "step")) == update


@pytest.mark.parametrize("update", [4, 6])
def test_a_stop_after_a_save_saves_nothing_twice(update: int) -> None:
    events: Events = []
    with pytest.raises(StoppedError):
        run(events, every=Every(log=100, save=4), report=stop_at(update))
    assert kinds(events, "save").count(("save", update)) == 1


def test_a_stop_never_saves_a_training_that_went_wrong() -> None:
    events: Events = []

    def check(update: int) -> None:
        raise BMRLError("diverged")

    with pytest.raises(BMRLError, match="diverged"):
        run(events, every=Every(log=100, save=4), report=stop_at(3), check=check)
    assert not kinds(events, "save")


@pytest.mark.parametrize("start", [0, 2, 5])
def test_a_training_resumes_with_the_update_after_the_last_one(start: int) -> None:
    events = recorded(every=Every(log=2, save=4), start=start)
    assert kinds(events, "step") == [("step", update) for update in range(start + 1, 7)]
    whole = kinds(recorded(every=Every(log=2, save=4)), "check", "save")
    assert kinds(events, "check", "save") == [event for event in whole if event[1] > start]


def test_nothing_is_left_to_do_after_the_last_update() -> None:
    assert recorded(every=Every(log=1, save=1, evaluate=1), start=6, evaluates=True) == []


def test_progress_is_reported_once_for_each_update() -> None:
    counts: list[int] = []
    recorded(every=Every(log=2, save=4), start=2, report=counts.append)
    assert counts == [1, 1, 1, 1]
