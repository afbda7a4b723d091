"""Episodes from starts that no demonstration had, and the report.

python recipes/evaluate.py run_dir=runs/mine            # after recipes/distill.py
python recipes/evaluate.py run_dir=runs/mine "evaluate.latent_sources=[prototype,online]"
"""

from __future__ import annotations

import os

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from settings import Config, run_recipe
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.transforms import Transform

from torchrl_bmrl.agents import Student, load_bcq_loss, load_student
from torchrl_bmrl.data.demonstrations import (
    demonstration_path,
    load_transitions,
    read_demonstrations,
    read_phases,
    read_statistics,
)
from torchrl_bmrl.envs.transforms import make_env
from torchrl_bmrl.evaluation import ResultRow, read_results, write_results
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome, evaluate_policy
from torchrl_bmrl.experts.collect import collect_episode
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS
from torchrl_bmrl.names import HORIZON, TASKS
from torchrl_bmrl.parallel import Report, derive_seed, run_jobs
from torchrl_bmrl.reports import Embeddings, write_report
from torchrl_bmrl.reports.films import explore_demonstrations
from torchrl_bmrl.runs import read_versions


def keep_rows(
    config: Config,
    task: str,
    policy_name: str,
    outcomes: Callable[[list[int]], list[EpisodeOutcome]],
    *,
    source: str = "",
    report: Report,
) -> list[ResultRow]:
    """The evaluation's episodes of one task, policy and source of m; kept, read back if there.

    Args:
        config: of the run.
        task: whose episodes.
        policy_name: one of :data:`torchrl_bmrl.evaluation.POLICIES`.
        outcomes: plays episodes that start with these seeds.
        source: of m, for the distilled policy.
        report: called with the number of steps where the episodes are read back.
    """
    name = "-".join(filter(None, (task, policy_name, source)))
    path = Path(config.run_dir) / "evaluation" / f"{name}.csv"
    if path.exists():
        report(config.evaluate.episodes * HORIZON)
        return read_results(path)
    seeds = [derive_seed(config.seed, "evaluate", task, i) for i in range(config.evaluate.episodes)]
    rows = [
        ResultRow(
            task=task,
            policy=policy_name,
            latent_source=source,
            seed=config.seed,
            episode=i,
            episode_return=outcome.episode_return,
            success=outcome.success,
        )
        for i, outcome in enumerate(outcomes(seeds))
    ]
    write_results(path, rows)
    return rows


def play(
    config: Config,
    task: str,
    policy: TensorDictModuleBase,
    *transforms: Transform,
    seeds: list[int],
    report: Report,
) -> list[EpisodeOutcome]:
    """Episodes of a policy, all at once, in an environment with these further transforms."""
    statistics = read_statistics(Path(config.run_dir) / "data")
    options = {"num_envs": len(seeds), "stepper": config.stepper}
    with closing(make_env(task, statistics, *transforms, **options)) as env:
        return evaluate_policy(env, policy, seeds, report=report)


def evaluate_job(job: tuple[Config, str, str, str], report: Report) -> list[ResultRow]:
    """All episodes of one task, policy and source of m; kept at once, read back if there."""
    config, task, policy_name, source = job
    run_dir, count = Path(config.run_dir), config.evaluate.num_candidates

    def outcomes(seeds: list[int]) -> list[EpisodeOutcome]:
        if policy_name == "expert":
            played = expert_outcomes(config, task, seeds)
            report(len(seeds) * HORIZON)
            return played
        if policy_name == "bcq":
            loss, _ = load_bcq_loss(run_dir / "bcq" / task / "checkpoint.safetensors")
            policy = BCQPolicy.from_loss(loss, num_candidates=count)
            return play(config, task, policy, seeds=seeds, report=report)
        student, metadata = load_student(run_dir / "distill" / "checkpoint.safetensors")
        policy = student.policy(num_candidates=count, latent_clip=metadata["latent_clip"])
        index, statistics = config.tasks.index(task), read_statistics(run_dir / "data")
        held_out = load_transitions(
            run_dir / "data", task, statistics, split="valid", num_task=index
        )
        demonstration = held_out[held_out["episode"] == 0]
        transform = student.task_latent_source(source, index, demonstration)
        return play(config, task, policy, transform, seeds=seeds, report=report)

    return keep_rows(config, task, policy_name, outcomes, source=source, report=report)


def expert_outcomes(config: Config, task: str, seeds: list[int]) -> list[EpisodeOutcome]:
    """The expert's episodes: fresh ones on the evaluation's starts, or its demonstrations."""
    if config.evaluate.expert_rollouts:
        return [
            EpisodeOutcome(float(episode.rewards.sum()), bool(episode.extras["successes"].any()))
            for episode in (
                collect_episode(
                    task,
                    seed,
                    noise=config.collect.noise,
                    gains=config.collect.gains,
                    stepper=config.stepper,
                )
                for seed in seeds
            )
        ]
    path = demonstration_path(Path(config.run_dir) / "data", task)
    data = read_demonstrations(path, num_task=config.tasks.index(task))
    return [
        EpisodeOutcome(
            float(episode["next", "reward"].double().sum()), bool(episode["next", "success"].any())
        )
        for episode in (data[data["episode"] == i] for i in data["episode"].unique())
    ]


def embed(config: Config, split: str) -> tuple[Embeddings, float]:
    """Embeddings of a split of the demonstrations and the classifier's accuracy on them."""
    data_dir = Path(config.run_dir) / "data"
    statistics = read_statistics(data_dir)
    student, metadata = load_student(Path(config.run_dir) / "distill" / "checkpoint.safetensors")
    with torch.random.fork_rng([]):
        torch.manual_seed(derive_seed(config.seed, "untrained encoder"))
        untrained = Student(**metadata["student"])
    parts, distances, phases, phase_names = [], [], [], {}
    for index, task in enumerate(config.tasks):
        path = demonstration_path(data_dir, task)
        parts.append(load_transitions(data_dir, task, statistics, split=split, num_task=index))
        raw = read_demonstrations(path, split=split, num_task=index)
        distances.append((raw["robot0_eef_pos"] - raw["goal_pos"]).norm(dim=-1).numpy())
        phase, names = read_phases(path, split=split)
        phases.append(phase.numpy())
        phase_names |= {task: names} if names else {}
    data = torch.cat([part.select(*parts[0].keys(True, True)) for part in parts])
    # Class indices are positions in config.tasks; the report's are positions among all tasks.
    position = torch.tensor([TASKS.index(task) for task in config.tasks])
    embeddings = Embeddings(
        task_latent=student.embed(data).numpy(),
        task=position[data["task"]].numpy(),
        episode=data["episode"].numpy(),
        step=data["step"].numpy(),
        distance=np.concatenate(distances),
        success=data["next", "success"].squeeze(-1).numpy(),
        phase=np.concatenate(phases),
        phase_names=phase_names,
        baselines={
            "raw transition": torch.cat([data[key] for key in TRANSITION_KEYS], -1).numpy(),
            "untrained encoder": untrained.embed(data).numpy(),
        },
    )
    return embeddings, student.accuracy(data)


def evaluate(config: Config) -> None:
    """Evaluates every policy on every task, then writes ``results.csv`` and the report."""
    run_dir = Path(config.run_dir)
    policies = [("expert", ""), ("bcq", "")]
    policies += [("distilled", source) for source in config.evaluate.latent_sources]
    jobs = [(config, task, *policy) for policy in policies for task in config.tasks]
    rows = run_jobs(
        evaluate_job,
        jobs,
        workers=config.workers,
        total=len(jobs) * config.evaluate.episodes * HORIZON,
        description="evaluating",
        unit="step",
    )
    write_results(run_dir / "results.csv", [row for part in rows for row in part])
    embeddings, accuracy = embed(config, "valid")
    write_report(
        run_dir,
        default_source=config.evaluate.latent_sources[0],
        facts=run_facts(config),
        embeddings=embeddings,
        training=embed(config, "train")[0],
        accuracy=accuracy,
        explorer=explore_demonstrations(run_dir / "data", embeddings),
        seed=config.seed,
    )
    print((run_dir / "tables" / "results.md").read_text())
    print(f"report: {run_dir / 'report.html'}")


def run_facts(config: Config) -> dict[str, str]:
    """What the report says about the run."""
    versions = read_versions(Path(config.run_dir))
    demonstrations = ", ".join(
        f"{task} {config.collect.train_episodes[task]}" for task in config.tasks
    )
    return {
        "Seed": str(config.seed),
        "Demonstrations": f"{demonstrations}; {config.collect.valid_episodes} held out of each",
        "Stage 1": f"{config.bcq.epochs} epochs of {config.bcq.updates_per_epoch} updates",
        "Stage 2": f"{config.distill.updates} updates",
        "Versions": ", ".join(f"{name} {version}" for name, version in versions.items()),
    }


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, evaluate)


if __name__ == "__main__":
    main()
