"""Which checkpoint is best? Fitted Q evaluation without a simulator, beside the true returns.

    python recipes/fqe.py run_dir=runs/mine                  # after recipes/collect.py
    python recipes/fqe.py run_dir=runs/mine "fqe.checkpoints=[500,1000,2000]" fqe.updates=1000

Stage 1 trains a series of agents for each task, one kept after each of so many updates. Fitted Q
evaluation estimates the return of each from the training demonstrations alone; then each plays the
evaluation's episodes. ``docs/fqe.md`` says how to read the table.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from bcq_agents import Agents
from evaluate import play
from omegaconf import DictConfig
from settings import Config, run_recipe
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.objectives import SoftUpdate
from train_bcq import choose_updates

from torchrl_bmrl.data import make_replay_buffer
from torchrl_bmrl.data.demonstrations import load_transitions, read_statistics
from torchrl_bmrl.evaluation import rank_correlation
from torchrl_bmrl.files import finite, read_rows, whole, write_rows
from torchrl_bmrl.modules import BCQPolicy, make_qvalue_network
from torchrl_bmrl.names import horizon_of
from torchrl_bmrl.objectives import FQELoss
from torchrl_bmrl.pipeline.agents import ACTION_DIM, OBSERVATION_DIM, load_bcq_loss
from torchrl_bmrl.reports.page import Section
from torchrl_bmrl.reports.studies import write_study
from torchrl_bmrl.reports.tables import Table, task_name
from torchrl_bmrl.run.folder import open_run
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs
from torchrl_bmrl.training import gradient_step, keep_freed_memory, make_adam
from torchrl_bmrl.training.checkpoint import save_checkpoint
from torchrl_bmrl.training.health import check_metrics

Job = tuple[Config, str]
Rows = list[dict[str, Any]]
COLUMNS = {"task": str, "updates": whole, "estimate": finite, "return": finite, "success": finite}


def folder(config: Config) -> Path:
    """Where the study is kept."""
    return Path(config.run_dir) / "fqe"


def checkpoint(config: Config, task: str, updates: int) -> Path:
    """The agent of a task after so many updates."""
    return folder(config) / task / f"{updates}.safetensors"


def train_job(job: Job, report: Report) -> None:
    """Trains a task's agent as stage 1 does; keeps it at each number of updates of the series."""
    config, task = job
    series = config.fqe.checkpoints
    if all(checkpoint(config, task, updates).exists() for updates in series):
        report(series[-1])
        return
    keep_freed_memory()
    data_dir = Path(config.run_dir) / "data"
    statistics = read_statistics(data_dir)
    number = config.tasks.index(task)
    data = load_transitions(data_dir, task, statistics, split="train", num_task=number)
    buffer = make_replay_buffer(data, batch_size=config.bcq.batch_size, device=config.device)
    agents = Agents(config, {task: task}, statistics)
    choose = choose_updates(config, agents.loss, agents.optimizers, agents.targets)
    for update in range(1, series[-1] + 1):
        batch = buffer.sample().select(*agents.loss.in_keys)
        metrics = choose(update)(batch)
        if update in series:
            agents.healthy(metrics, batch, update)
            agents.updates = update
            state = {"module": agents.loss.state_dict()}
            save_checkpoint(checkpoint(config, task, update), state, agents.metadata(task))
        report(1)


def ask(policy: TensorDictModuleBase, states: TensorDictBase) -> TensorDictBase:
    """The states with what a policy does there.

    It stays as it is, so that it need not propose and choose anew at every update, which would take
    three times as long.
    """
    parts = [policy(part.select(*policy.in_keys))["action"] for part in states.split(1000)]
    return states.copy().set("policy_action", torch.cat(parts))


def estimate_return(
    config: Config, task: str, policy: TensorDictModuleBase, report: Report
) -> float:
    """What fitted Q evaluation says that a policy returns, discounted, from the demonstrations."""
    settings, data_dir = config.bcq, Path(config.run_dir) / "data"
    # Alike for all policies of a task: what sets their estimates apart is the policies.
    torch.manual_seed(derive_seed(config.seed, "fqe", task))
    dims = (OBSERVATION_DIM, ACTION_DIM)
    critic = make_qvalue_network(*dims, num_cells=settings.num_cells)
    asked = TensorDictModule(nn.Identity(), in_keys=["policy_action"], out_keys=["action"])
    loss = FQELoss(asked, critic, gamma=settings.gamma).to(config.device)
    optimizer = make_adam(loss.qvalue_network_params.parameters(), settings.lr)
    targets = SoftUpdate(loss, tau=config.fqe.tau)
    number = config.tasks.index(task)
    data = load_transitions(
        data_dir, task, read_statistics(data_dir), split="train", num_task=number
    )
    starts = ask(policy, data[data["step"] == 0])
    data = data.copy().set("next", ask(policy, data["next"]))
    buffer = make_replay_buffer(data, batch_size=settings.batch_size, device=config.device)
    for update in range(1, config.fqe.updates + 1):
        value, metrics = loss.qvalue_loss(buffer.sample().select(*loss.in_keys))
        gradient_step(optimizer, value)
        targets.step()
        if update % config.log_interval == 0:
            row = {"loss_qvalue": value.item(), "pred_value": metrics["pred_value"].item()}
            check_metrics(row, f"fitted Q evaluation of {task}, update {update}")
        report(1)
    return loss.policy_value(starts.to(config.device)).item()


def evaluate_job(job: tuple[Config, str, int], report: Report) -> Rows:
    """Estimate and true return of one agent; kept at once, read back if there."""
    config, task, updates = job
    path = checkpoint(config, task, updates).with_suffix(".csv")
    count = config.evaluate.episodes
    if path.exists():
        report(config.fqe.updates + count * horizon_of(task))
        return read_rows(path, COLUMNS)
    keep_freed_memory()
    loss, _ = load_bcq_loss(checkpoint(config, task, updates))
    policy = BCQPolicy.frozen(loss, num_candidates=config.fqe.num_candidates)
    estimate = estimate_return(config, task, policy, report)
    statistics = read_statistics(Path(config.run_dir) / "data")
    seeds = [derive_seed(config.seed, "evaluate", task, i) for i in range(count)]
    outcomes = play(config, task, policy, statistics=statistics, seeds=seeds, report=report)
    row = {
        "task": task,
        "updates": updates,
        "estimate": round(estimate, 6),
        "return": round(float(np.mean([outcome.episode_return for outcome in outcomes])), 4),
        "success": round(float(np.mean([outcome.success for outcome in outcomes])), 4),
    }
    write_rows(path, [row])
    return [row]


def make_table(rows: Rows, tasks: Sequence[str]) -> Table:
    """One line per task, and one for all."""

    def line(name: str, names: Sequence[str]) -> tuple[str, ...]:
        mine = [row for row in rows if row["task"] in names]
        labels = [row["task"] for row in mine]
        estimates, returns = ([row[key] for row in mine] for key in ("estimate", "return"))
        found = rank_correlation(estimates, returns, groups=labels)
        series = [[row for row in mine if row["task"] == task] for task in names]
        chosen = [max(part, key=lambda row: row["estimate"]) for part in series]
        best = [max(row["return"] for row in part) for part in series]
        last = [part[-1]["return"] for part in series]
        means = (np.mean(x) for x in (returns, best, last, [row["return"] for row in chosen]))
        picked = str(chosen[0]["updates"]) if len(names) == 1 else ""
        return name, str(found), *(f"{mean:.1f}" for mean in means), picked

    series = ", ".join(f"{n:,}" for n in sorted({row["updates"] for row in rows}))
    return Table(
        title="Fitted Q evaluation beside the true returns",
        caption=(
            f"Of each task the agents of stage 1 after {series} updates. Rank correlation: "
            "Spearman's, between the estimates from the demonstrations and the mean returns on the "
            "evaluation's starts, with a 95% bootstrap interval over the agents; for all tasks the "
            "mean of the tasks'. Then the mean return of all agents, of the best and the last one, "
            "and of the one with the highest estimate, which had so many updates."
        ),
        header=("Task", "Rank correlation", "Mean", "Best", "Last", "Chosen", "Chosen after"),
        rows=[
            *(line(task_name(task), [task]) for task in tasks),
            *([line("All", tasks)] if len(tasks) > 1 else []),
        ],
    )


def fqe(config: Config) -> None:
    """Trains and evaluates what is not done yet, then writes ``fqe.csv`` and the table."""
    run_dir, series = Path(config.run_dir), config.fqe.checkpoints
    read_statistics(run_dir / "data")  # before anything is written
    open_run(folder(config), asdict(config.fqe))
    run_jobs(
        train_job,
        [(config, task) for task in config.tasks],
        workers=config.workers,
        total=series[-1] * len(config.tasks),
        description="training the series",
        unit="update",
    )
    jobs = [(config, task, updates) for task in config.tasks for updates in series]
    steps = [config.evaluate.episodes * horizon_of(task) for _, task, _ in jobs]
    parts = run_jobs(
        evaluate_job,
        jobs,
        workers=config.workers,
        total=sum(steps) + config.fqe.updates * len(jobs),
        description="evaluating without and with the simulator",
        unit="step",
    )
    rows = [row for part in parts for row in part]
    write_rows(run_dir / "fqe.csv", rows)
    table = make_table(rows, config.tasks)
    write_study(run_dir, "fqe", Section(heading="Fitted Q evaluation", tables=[table]), {})
    print(table.markdown())


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, fqe)


if __name__ == "__main__":
    main()
