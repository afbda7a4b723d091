"""A training with checkpoints, a log and learning rates that decay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.optim import Adam

from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.run.loggers import close_logger, log_metrics, make_logger
from torchrl_bmrl.run.workers import Report
from torchrl_bmrl.training.checkpoint import resume_training, save_training
from torchrl_bmrl.training.fit import Every, fit
from torchrl_bmrl.training.health import check_metrics, largest_metric
from torchrl_bmrl.training.update import Metrics, Update, accelerate, decay, gradient_step


@dataclass
class Training:
    """A training that saves checkpoints, and resumes from the last one.

    Attributes:
        run: the run.
        folder: of the checkpoint, below the run's folder.
        kind: of the checkpoint.
        module: the networks to save.
        optimizers: of the networks, by name.
        rates: learning rates of the first update; they decay to zero.
        prepare: is given the networks before they are saved, and returns further metadata.
        rewards: that the losses are made of, of all data; their limit grows with them.
    """

    run: Run
    folder: str
    kind: str
    module: nn.Module
    optimizers: Mapping[str, Adam]
    rates: Mapping[str, float]
    prepare: Callable[[Any], dict[str, Any]] = lambda saved: {}
    rewards: Sequence[Tensor] = ()

    def train(
        self, update: Update, sample: Callable[[], TensorDictBase], total: int, report: Report
    ) -> None:
        """Trains, or goes on from the checkpoint.

        Args:
            update: changes the networks and returns metrics.
            sample: returns a batch.
            total: number of the last update.
            report: called with the number of new updates.

        Raises:
            BMRLError: if the training diverges.
        """
        settings = self.run.settings
        path = self.run.folder / self.folder / "checkpoint.safetensors"
        saved = resume_training(
            path, self.module, self.optimizers, kind=self.kind, device=settings.device
        )
        done = saved["updates"] if saved else 0
        report(done)
        if done == total:
            return
        largest = largest_metric(*self.rewards)
        accelerated = accelerate(
            update,
            compiled=settings.compile,
            captured=settings.cudagraphs,
            device=settings.device,
        )

        def step(number: int, batch: TensorDictBase) -> Metrics:
            for name, optimizer in self.optimizers.items():
                decay(optimizer, self.rates[name], number, total)
            return accelerated(batch)

        def check(number: int, metrics: Metrics, batch: TensorDictBase, logging: bool) -> None:
            check_metrics(metrics, f"{self.folder}, update {number}", largest=largest)
            log_metrics(logger if logging else None, metrics, number)

        def save(number: int) -> None:
            on_cpu = settings.device == "cpu"
            module = self.module if on_cpu else deepcopy(self.module).to("cpu")
            metadata = {
                "kind": self.kind,
                "tasks": list(self.run.names),
                "updates": number,
                "settings": settings.deciding(),
                "statistics": self.run.statistics.to_lists(),
                **self.prepare(module),
            }
            save_training(
                path,
                module,
                self.optimizers,
                metadata,
                device=settings.device,
                keep=settings.keep_checkpoints,
            )

        with ExitStack() as stack:
            name = self.folder.replace("/", "_")
            logger = make_logger(settings.logger, self.run.folder, name, done)
            stack.callback(close_logger, logger)
            fit(
                step,
                sample,
                start=done,
                total=total,
                every=Every(log=settings.log_interval, save=settings.checkpoint_interval),
                check=check,
                save=save,
                report=report,
            )


def make_update(loss: Any, optimizer: Adam) -> Update:
    """An update on the sum of a loss's terms.

    Args:
        loss: returns terms whose names start with ``loss_``, and metrics.
        optimizer: of its networks.
    """

    def update(batch: TensorDictBase) -> Metrics:
        losses = loss(batch)
        total = sum(term for name, term in losses.items() if name.startswith("loss_"))
        gradient_step(optimizer, total)
        return {name: value.detach() for name, value in losses.items()}

    return update
