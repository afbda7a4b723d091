"""Episodes from starts that no demonstration had, and the report.

python recipes/evaluate.py run_dir=runs/mine            # after recipes/distill.py
python recipes/evaluate.py run_dir=runs/mine "evaluate.latent_sources=[prototype,online]"
python recipes/evaluate.py evaluate.policy=recipes/policies/sawyer.safetensors    # no run needed
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from statistics import fmean
from typing import Any

import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from settings import Config, run_recipe, tell
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.transforms import Transform

from torchrl_bmrl.data.demonstrations import (
    demonstration_path,
    load_transitions,
    read_demonstrations,
    read_phases,
    read_statistics,
)
from torchrl_bmrl.envs.transforms import ObservationStatistics, make_env
from torchrl_bmrl.errors import ConfigError
from torchrl_bmrl.evaluation import ResultRow, read_results, write_results
from torchrl_bmrl.evaluation.rollout import EpisodeOutcome, evaluate_policy
from torchrl_bmrl.experts.collect import collect_episode
from torchrl_bmrl.modules import BCQPolicy
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS
from torchrl_bmrl.names import horizon_of
from torchrl_bmrl.pipeline.agents import Student, load_bcq_loss, load_student
from torchrl_bmrl.reports import Embeddings, task_titles, write_report
from torchrl_bmrl.reports.films import explore_demonstrations
from torchrl_bmrl.run.folder import read_versions
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs
from torchrl_bmrl.training.checkpoint import load_checkpoint


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
        report(config.evaluate.episodes * horizon_of(task))
        tell(config, f"{path}: read back")
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
    mean = fmean(row.episode_return for row in rows)
    tell(config, f"{path}: mean return {mean:.1f}, {sum(row.success for row in rows)} successes")
    return rows


def student_path(config: Config) -> Path:
    """The distilled policy to evaluate: the run's own, or a file that was shipped."""
    if config.evaluate.policy:
        return Path(config.evaluate.policy)
    return Path(config.run_dir) / "distill" / "checkpoint.safetensors"


def held_out_episode(
    config: Config, task: str, index: int, statistics: ObservationStatistics
) -> TensorDictBase:
    """The demonstration that m may come from; a file of a policy brings its own."""
    if config.evaluate.policy:
        state, _ = load_checkpoint(student_path(config), kind="student")
        return TensorDict(state["demonstrations"][task]).auto_batch_size_(1)
    data = load_transitions(
        Path(config.run_dir) / "data", task, statistics, split="valid", num_task=index
    )
    return data[data["episode"] == 0]


def play(
    config: Config,
    task: str,
    policy: TensorDictModuleBase,
    *transforms: Transform,
    statistics: ObservationStatistics,
    seeds: list[int],
    report: Report,
) -> list[EpisodeOutcome]:
    """Episodes of a policy, all at once, in an environment with these further transforms."""
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
            report(len(seeds) * horizon_of(task))
            return played
        if policy_name == "bcq":
            loss, _ = load_bcq_loss(run_dir / "bcq" / task / "checkpoint.safetensors")
            policy = BCQPolicy.frozen(loss, num_candidates=count)
            statistics = read_statistics(run_dir / "data")
            return play(config, task, policy, statistics=statistics, seeds=seeds, report=report)
        student, metadata = load_student(student_path(config))
        policy = student.policy(num_candidates=count, latent_clip=metadata["latent_clip"])
        statistics = ObservationStatistics.from_lists(metadata["statistics"])
        index = metadata["tasks"].index(task)
        demonstration = None
        if source == "demonstration":
            demonstration = held_out_episode(config, task, index, statistics)
        transform = student.task_latent_source(source, index, demonstration)
        return play(
            config, task, policy, transform, statistics=statistics, seeds=seeds, report=report
        )

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
    embeddings = Embeddings(
        tasks=list(config.tasks),
        task_latent=student.embed(data).numpy(),
        task=data["task"].numpy(),
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


def look_at_embedding(config: Config) -> dict[str, Any]:
    """What the report shows of the embedding."""
    embeddings, accuracy = embed(config, "valid")
    return {
        "embeddings": embeddings,
        "training": embed(config, "train")[0],
        "accuracy": accuracy,
        "explorer": explore_demonstrations(Path(config.run_dir) / "data", embeddings),
    }


def evaluate(config: Config) -> None:
    """Evaluates every policy on every task, then writes ``results.csv`` and the report."""
    run_dir = Path(config.run_dir)
    alone = config.evaluate.policy is not None
    if alone:
        known = load_student(student_path(config))[1]["tasks"]
        if not set(config.tasks) <= set(known):
            raise ConfigError(f"tasks is {config.tasks}; valid for {student_path(config)}: {known}")
    policies = [] if alone else [("expert", ""), ("bcq", "")]
    policies += [("distilled", source) for source in config.evaluate.latent_sources]
    jobs = [(config, task, *policy) for policy in policies for task in config.tasks]
    rows = run_jobs(
        evaluate_job,
        jobs,
        workers=config.workers,
        total=sum(config.evaluate.episodes * horizon_of(task) for _, task, *_ in jobs),
        description="evaluating",
        unit="step",
    )
    write_results(run_dir / "results.csv", [row for part in rows for row in part])
    look = not alone and config.distill.task_encoder == "transition"
    write_report(
        run_dir,
        titles=task_titles(config.tasks),
        default_source=config.evaluate.latent_sources[0],
        facts=run_facts(config),
        seed=config.seed,
        **(look_at_embedding(config) if look else {}),
    )
    print((run_dir / "tables" / "results.md").read_text())
    print(f"report: {run_dir / 'report.html'}")


def run_facts(config: Config) -> dict[str, str]:
    """What the report says about the run."""
    versions = read_versions(Path(config.run_dir))
    said = {"Versions": ", ".join(f"{name} {version}" for name, version in versions.items())}
    if config.evaluate.policy:
        return {"Policy": config.evaluate.policy, "Seed of the starts": str(config.seed)} | said
    demonstrations = ", ".join(
        f"{task} {config.collect.train_episodes[task]}" for task in config.tasks
    )
    return {
        "Preset": config.preset + (f", {config.ablation}" if config.ablation != "none" else ""),
        "Seed": str(config.seed),
        "Demonstrations": f"{demonstrations}; {config.collect.valid_episodes} held out of each",
        "Stage 1": f"{config.bcq.epochs} epochs of {config.bcq.updates_per_epoch} updates",
        "Stage 2": f"{config.distill.updates} updates",
    } | said


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, evaluate, trains=False)


if __name__ == "__main__":
    main()
