#!/usr/bin/env bash
# torchrl 0.14.1: losses that a Trainer with num_epochs=2 logs, and its count of optimisation steps.
#
# Guess: the logged loss is the mean over all steps on a batch, and a step is counted when it is made.
# Seen:  the mean begins anew with each epoch, so that the losses of all but the last epoch are thrown
#        away. With optim_steps_per_batch=None, the end of each epoch counts as one more step; intervals in
#        optimisation steps follow this count. (optim_steps in trainers/trainers.py)
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1

RL_WARNINGS=False RL_LOGGING_LEVEL=WARNING "$folder/venv/bin/python" -W ignore - <<'PY'
from importlib.metadata import version

import tempfile
from pathlib import Path

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives import BCLoss
from torchrl.trainers import OptimizationStepper, Trainer


class Two(OptimizationStepper):
    """Reports 100 in the first epoch, and 0 in the second."""

    made = 0

    def step(self, trainer, batch):
        self.made += 1
        return TensorDict({"loss": torch.tensor(100.0 if self.made == 1 else 0.0)})


class Collector:
    def __init__(self, batch):
        self.batch = batch

    def __iter__(self):
        yield self.batch

    def shutdown(self, *args, **kwargs):
        pass

    def state_dict(self):
        return {}

    def set_seed(self, *args, **kwargs):
        pass


batch = TensorDict({"observation": torch.ones(4, 3), "action": torch.ones(4, 2)}, [4])
seen = {}
for steps in (1, None):
    loss = BCLoss(TensorDictModule(nn.Linear(3, 2), ["observation"], ["action"]))
    trainer = Trainer(
        collector=Collector(batch),
        total_frames=4,
        frame_skip=1,
        optim_steps_per_batch=steps,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters()),
        optimization_stepper=Two(),
        num_epochs=2,
        progress_bar=False,
        log_interval=1,
    )
    left = [1, 0, 1, 0]  # of each epoch: one batch, then its end

    def once(batch):
        if steps is None and not left.pop(0):
            raise StopIteration
        return batch

    trainer.register_op("process_optim_batch", once)
    logged = {}
    trainer._log = lambda **values: logged.update(values)
    trainer.optim_steps(batch)
    seen[steps] = trainer._optim_count, float(logged["loss"])
    print(f"torchrl {version('torchrl')}, optim_steps_per_batch={steps}: losses 100 and 0 logged as {seen[steps][1]},")
    print(f"  {trainer.optimization_stepper.made} steps made, {seen[steps][0]} counted")
assert seen[1] == (2, 0.0), seen
assert seen[None][0] == 4, seen
PY
