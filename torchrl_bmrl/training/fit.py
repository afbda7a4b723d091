"""The training loop of every stage and study: sample, update, check, log, save, stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase

from torchrl_bmrl.errors import StoppedError
from torchrl_bmrl.training.update import Metrics


@dataclass(frozen=True, kw_only=True)
class Every:
    """Numbers of updates between two events.

    Attributes:
        log: metrics are checked and logged.
        save: a checkpoint is saved; the last update always saves one.
        evaluate: the policy is evaluated; ``None``: never.

    Example:
        >>> Every(log=100, save=1000).evaluate is None
        True
    """

    log: int
    save: int
    evaluate: int | None = None


def fit(
    step: Callable[[int, TensorDictBase], Metrics],
    sample: Callable[[], TensorDictBase],
    *,
    total: int,
    every: Every,
    check: Callable[[int, Metrics, TensorDictBase, bool], None],
    save: Callable[[int], None],
    start: int = 0,
    evaluate: Callable[[int], Any] | None = None,
    report: Callable[[int], Any] = lambda updates: None,
) -> None:
    """Trains from update ``start + 1`` to ``total``.

    ``check`` runs before every ``save``, so that a diverged network is never saved. If the run is
    stopped, the last update is checked and saved first.

    Args:
        step: ``step(update, batch)`` changes the networks and returns metrics.
        sample: returns a batch.
        total: number of the last update.
        every: intervals.
        check: ``check(update, metrics, batch, logging)`` raises an error if the training diverged,
            and logs the metrics if ``logging``. The loop waits for the device only here.
        save: ``save(update)`` writes a checkpoint.
        start: number of updates that are already done.
        evaluate: ``evaluate(update)``, called every ``every.evaluate`` updates.
        report: ``report(1)``, called after each update; it may raise ``StoppedError``.

    Raises:
        StoppedError: if ``report`` raised it; everything is saved then.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_bmrl.training import gradient_step, make_adam
        >>> weight = torch.nn.Parameter(torch.ones(1))
        >>> optimizer, saved = make_adam([weight], lr=0.1), []
        >>> def step(update, batch):
        ...     loss = (weight * batch["x"]).square().sum()
        ...     gradient_step(optimizer, loss)
        ...     return {"loss": loss.detach()}
        >>> fit(
        ...     step,
        ...     lambda: TensorDict({"x": torch.ones(1)}, []),
        ...     total=5,
        ...     every=Every(log=1, save=2),
        ...     check=lambda update, metrics, batch, logging: None,
        ...     save=saved.append,
        ... )
        >>> saved
        [2, 4, 5]
    """
    update = saved = start
    metrics: Metrics = {}
    try:
        for update in range(start + 1, total + 1):
            batch = sample()
            metrics = step(update, batch)
            saving, logging = update % every.save == 0 or update == total, update % every.log == 0
            if logging or saving:
                check(update, metrics, batch, logging)
            if evaluate is not None and every.evaluate and update % every.evaluate == 0:
                evaluate(update)
            if saving:
                save(update)
                saved = update
            report(1)
    except StoppedError:
        if saved < update:
            check(update, metrics, batch, False)
            save(update)
        raise
