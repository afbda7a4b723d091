"""Lift from scripted and human demonstrations together: does the human share help or hurt?

    python recipes/learn_from_people.py human.path=demo.hdf5
    python recipes/learn_from_people.py human.path=demo.hdf5 "human.shares=[0,0.5]" \
        collect.train_episodes.lift=10

Agents of every share of human transitions in each batch train on the same scripted demonstrations
and are evaluated from the same starts; share 0 is what the others are compared with.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import hydra
import numpy as np
from collect import collect
from omegaconf import DictConfig
from settings import Config, run_recipe
from train_bcq import train_agents

from torchrl_bmrl.data import make_mixed_replay_buffer
from torchrl_bmrl.data.convert import convert, find_format
from torchrl_bmrl.data.demonstrations import load_transitions, read_demonstrations, read_statistics
from torchrl_bmrl.envs.transforms import make_env, transform_data
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation import bootstrap_interval
from torchrl_bmrl.evaluation.rollout import evaluate_policy
from torchrl_bmrl.files import finite, read_rows, whole, write_atomic, write_rows
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.names import horizon_of
from torchrl_bmrl.pipeline.agents import load_bcq_loss
from torchrl_bmrl.run.progress import progress
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs

TASK = "lift"
Job = tuple[Config, float, int]


def agent_name(share: float, seed: int) -> str:
    """Folder of an agent under ``bcq/``."""
    return f"{TASK}-human{share:g}-{seed}"


def train_job(job: Job, report: Report) -> None:
    """Trains the agent of one share and training seed."""
    config, share, seed = job
    data_dir = Path(config.run_dir) / "data"
    statistics = read_statistics(data_dir)
    scripted = load_transitions(data_dir, TASK, statistics, split="train", num_task=0)
    human = transform_data(read_demonstrations(data_dir / "human.hdf5", num_task=0), statistics)
    buffer = make_mixed_replay_buffer(
        [scripted, human.select(*scripted.keys(True, True))],
        weights=[1 - share, share],
        batch_size=config.bcq.batch_size,
        device=config.device,
    )
    train_agents(config, {agent_name(share, seed): TASK}, buffer, statistics, report)


def evaluate_job(job: Job, report: Report) -> list[dict]:
    """Episodes of one agent; kept at once, read back if there."""
    config, share, seed = job
    folder = Path(config.run_dir) / "bcq" / agent_name(share, seed)
    path = folder / "results.csv"
    if not path.exists():
        count = config.evaluate.episodes
        starts = [derive_seed(config.seed, "evaluate", TASK, i) for i in range(count)]
        loss, _ = load_bcq_loss(folder / "checkpoint.safetensors")
        policy = BCQPolicy.frozen(loss, num_candidates=config.evaluate.num_candidates)
        statistics = read_statistics(Path(config.run_dir) / "data")
        env = make_env(TASK, statistics, num_envs=count, stepper=config.stepper)
        with closing(env):
            outcomes = evaluate_policy(env, policy, starts, report=report)
        rows = [
            {
                "share": share,
                "training_seed": seed,
                "episode": i,
                "return": outcome.episode_return,
                "success": int(outcome.success),
            }
            for i, outcome in enumerate(outcomes)
        ]
        write_rows(path, rows)
    else:
        report(config.evaluate.episodes * horizon_of(TASK))
    columns = {"training_seed": whole, "episode": whole, "success": whole}
    return read_rows(path, {"share": finite, **columns, "return": finite})


def comparison(rows: list[dict], shares: list[float]) -> str:
    """Table of all shares, with the difference from share 0 on the same starts."""

    def column(share: float, field: str) -> np.ndarray:
        return np.array([float(row[field]) for row in rows if row["share"] == share])

    lines = [
        "| Human share | Return | Success | Return against share 0 (95% interval) | Human data |",
        "|---:|---:|---:|---:|---|",
    ]
    for share in shares:
        returns, successes = column(share, "return"), column(share, "success")
        difference = returns - column(0.0, "return")
        low, high = bootstrap_interval(difference, strata=column(share, "training_seed"))
        verdict = "helped" if low > 0 else "hurt" if high < 0 else "no difference to be seen"
        if len(difference) < 10:
            verdict = "too few episodes to tell"
        against = f"{difference.mean():+.1f} ({low:+.1f} to {high:+.1f})"
        lines.append(
            f"| {share:.0%} | {returns.mean():.1f} | {successes.sum():.0f} of {len(successes)} | "
            + (f"{against} | {verdict} |" if share else "| |")
        )
    lines += ["", "Intervals are over episodes of these agents, not over further trainings."]
    return "\n".join(lines) + "\n"


def learn_from_people(config: Config) -> None:
    """Collects, converts, trains and compares; each part skips what it finds done."""
    if not config.human.path:
        raise ConfigError(
            "human.path is empty; valid: a robosuite demo.hdf5, or robomimic's layout"
        )
    config = replace(config, tasks=[TASK])
    human = Path(config.run_dir) / "data" / "human.hdf5"
    if not human.exists():
        raw = find_format(Path(config.human.path)) == "robosuite"
        options = {"task": TASK, "tracking": config.human.tracking} if raw else {}
        with progress(None, "converting", "episode") as bar:
            done = convert(config.human.path, human, to="robomimic", report=bar.update, **options)
        for note in done.notes:
            print(f"warning: {config.human.path}: {note}")
    collect(config)
    agents = [
        (config, share, seed)
        for share in config.human.shares
        for seed in range(config.human.training_seeds)
    ]
    updates = config.bcq.epochs * config.bcq.updates_per_epoch
    run_jobs(
        train_job,
        agents,
        workers=config.workers,
        total=updates * len(agents),
        description="training BCQ",
        unit="update",
    )
    results = run_jobs(
        evaluate_job,
        agents,
        workers=config.workers,
        total=config.evaluate.episodes * horizon_of(TASK) * len(agents),
        description="evaluating",
        unit="step",
    )
    rows = [row for part in results for row in part]
    write_rows(Path(config.run_dir) / "human.csv", rows)
    table = comparison(rows, config.human.shares)
    write_atomic(Path(config.run_dir) / "tables" / "human.md", table)
    print(table)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, learn_from_people)


if __name__ == "__main__":
    main()
