"""One-shot imitation: one demonstration of a composition drives the distilled policy.

    python recipes/imitate.py run_dir=runs/mine      # after recipes/two_stage.py preset=compose
    python recipes/imitate.py run_dir=runs/mine imitate.composition=reach-lift

From other starts and to other goals than the demonstration's, the actions executed as they are or
perturbed: the demonstration's embeddings in several alignments, beside a policy that is told the
task at hand, behaviour cloning on that one demonstration, and its actions played again.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig
from settings import Config, run_recipe
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch.nn.functional import mse_loss
from torchrl.envs.transforms import StepCounter, Transform
from torchrl.modules import MLP

from torchrl_bmrl.data.demonstrations import read_statistics
from torchrl_bmrl.data.episodes import as_tensordict
from torchrl_bmrl.data.robomimic import keep_episode, read_kept_episode
from torchrl_bmrl.envs.transforms import (
    ObservationStatistics,
    PerturbAction,
    make_env,
    transform_data,
)
from torchrl_bmrl.errors import BMRLError
from torchrl_bmrl.evaluation import bootstrap_interval
from torchrl_bmrl.evaluation.rollout import evaluate_policy
from torchrl_bmrl.experts.collect import collect_episode
from torchrl_bmrl.files import read_rows, whole, write_rows
from torchrl_bmrl.modules import DemonstrationTaskLatent, StageTaskLatent
from torchrl_bmrl.modules.demonstration_latent import ALIGNMENTS
from torchrl_bmrl.names import composition_stages, horizon_of
from torchrl_bmrl.pipeline.agents import load_student
from torchrl_bmrl.reports.page import Section
from torchrl_bmrl.reports.studies import write_study
from torchrl_bmrl.reports.tables import Table, task_name
from torchrl_bmrl.run.folder import open_run
from torchrl_bmrl.run.progress import progress
from torchrl_bmrl.run.workers import Report, derive_seed, run_jobs

METHODS = (*(f"demonstration, by {name}" for name in ALIGNMENTS), "task index", "cloning", "replay")
PERTURBATIONS = ("none", "magnitude", "direction", "both", "both, constant")
Job = tuple[Config, str, str, int]


def make_perturbation(config: Config, name: str) -> list[Transform]:
    """What is done to the actions before they are executed."""
    settings = config.imitate
    low, high = settings.magnitude
    return {
        "none": [],
        "magnitude": [PerturbAction(magnitude=(low, high))],
        "direction": [PerturbAction(max_angle=settings.max_angle)],
        "both": [PerturbAction(magnitude=(low, high), max_angle=settings.max_angle)],
        "both, constant": [
            PerturbAction(magnitude=(low, high), max_angle=settings.max_angle, per="episode")
        ],
    }[name]


def demonstrate(config: Config, number: int) -> Path:
    """A demonstration that succeeds; kept, and found again."""
    settings = config.imitate
    path = Path(config.run_dir) / "imitation" / f"demonstration-{number}.npz"
    for attempt in range(100):
        if path.exists():
            break
        episode = collect_episode(
            settings.composition,
            derive_seed(config.seed, "imitate", "demonstration", number, attempt),
            noise=config.collect.noise,
            gains=config.collect.gains,
            stepper=config.stepper,
        )
        if episode.extras["successes"].any():
            keep_episode(path, episode)
    return path


def read_demonstration(path: Path, statistics: ObservationStatistics) -> TensorDictBase:
    """Transitions of a demonstration, normalised, with the ``stage`` before each action."""
    episode = read_kept_episode(path)
    data = transform_data(as_tensordict(episode), statistics)
    return data.set("stage", torch.as_tensor(episode.extras["stages"]).long())


def clone_behaviour(
    demonstration: TensorDictBase, *, updates: int, seed: int
) -> TensorDictModuleBase:
    """Plain regression of the demonstration's actions on its observations."""
    observation, action = demonstration["observation"], demonstration["action"]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = MLP(in_features=observation.shape[-1], out_features=action.shape[-1],
                      num_cells=[256, 256], activation_class=torch.nn.ReLU)  # fmt: skip
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    for _ in range(updates):
        optimizer.zero_grad()
        mse_loss(network(observation), action).backward()
        optimizer.step()
    return TensorDictModule(
        lambda observation: network(observation).clamp(-1, 1), ["observation"], ["action"]
    )


def make_method(
    config: Config, method: str, path: Path, statistics: ObservationStatistics
) -> tuple[TensorDictModuleBase, list[Transform]]:
    """The policy of a method, and the transforms that it needs."""
    demonstration = read_demonstration(path, statistics)
    if method == "replay":
        actions = demonstration["action"]
        play = TensorDictModule(
            lambda count: actions[count.squeeze(-1)], in_keys=["step_count"], out_keys=["action"]
        )
        return play, [StepCounter()]
    if method == "cloning":
        seed = derive_seed(config.seed, "imitate", "cloning", path.stem)
        return clone_behaviour(demonstration, updates=config.imitate.cloning_updates, seed=seed), []
    student, metadata = load_student(Path(config.run_dir) / "distill" / "checkpoint.safetensors")
    if method == "task index":
        stages = composition_stages(config.imitate.composition)
        index = [config.tasks.index(task) for task in stages]
        source: Transform = StageTaskLatent(student.prototypes[index])
    else:
        alignment = method.removeprefix("demonstration, by ")
        source = DemonstrationTaskLatent(demonstration, student.task_encoder, alignment=alignment)
    policy = student.policy(
        num_candidates=config.evaluate.num_candidates, latent_clip=metadata["latent_clip"]
    )
    return policy, [source]


def imitate_job(job: Job, report: Report) -> list[dict]:
    """The episodes that one demonstration drives; kept at once, read back if there."""
    config, method, perturbation, number = job
    settings = config.imitate
    count = settings.episodes // settings.demonstrations
    folder = Path(config.run_dir) / "imitation"
    path = folder / f"{method}-{perturbation}-{number}.csv".replace(" ", "_").replace(",", "")
    if path.exists():
        report(count * horizon_of(settings.composition))
    else:
        statistics = read_statistics(Path(config.run_dir) / "data")
        policy, sources = make_method(
            config, method, folder / f"demonstration-{number}.npz", statistics
        )
        transforms = [*sources, *make_perturbation(config, perturbation)]
        options = {"num_envs": count, "stepper": config.stepper}
        seeds = [derive_seed(config.seed, "imitate", number, i) for i in range(count)]
        with closing(make_env(settings.composition, statistics, *transforms, **options)) as env:
            outcomes = evaluate_policy(
                env, policy, seeds, max_steps=horizon_of(settings.composition), report=report
            )
        rows = [
            {
                "method": method,
                "perturbation": perturbation,
                "demonstration": number,
                "episode": i,
                "stages": outcome.stages,
                "success": int(outcome.success),
            }
            for i, outcome in enumerate(outcomes)
        ]
        write_rows(path, rows)
    return read_rows(path, COLUMNS)


COLUMNS = {
    "method": str,
    "perturbation": str,
    "demonstration": whole,
    "episode": whole,
    "stages": whole,
    "success": whole,
}


def imitation_table(config: Config, rows: list[dict]) -> Table:
    """Success of each stage and of the whole, by method and perturbation."""
    settings, lines = config.imitate, []
    stages = composition_stages(settings.composition)
    for method in METHODS:
        for perturbation in PERTURBATIONS:
            mine = [r for r in rows if (r["method"], r["perturbation"]) == (method, perturbation)]
            done = [row["stages"] for row in mine]
            all_done = [float(row["success"]) for row in mine]
            low, high = bootstrap_interval(all_done, strata=[row["demonstration"] for row in mine])
            reached = [sum(d > i for d in done) / len(done) for i in range(len(stages))]
            lines.append(
                (
                    method,
                    perturbation,
                    *(f"{share:.0%}" for share in reached),
                    f"{sum(all_done) / len(all_done):.0%}",
                    f"[{low:.0%}, {high:.0%}]",
                    str(len(mine)),
                )
            )
    low, high = settings.magnitude
    return Table(
        title=f"One-shot imitation of {settings.composition}",
        caption=(
            f"Share of episodes that complete each task of the chain, and all of them, from other "
            f"starts and to other goals than the demonstration's ({settings.demonstrations} "
            f"demonstrations, each alone, with the same number of episodes). Perturbation: the "
            f"motion is multiplied by {low:g} to {high:g} (magnitude), its direction tilted by up "
            f"to {settings.max_angle:g}° (direction), drawn anew at every step or, constant, once "
            f"an episode. Task index: the policy is told which task is at hand (a prototype each). "
            f"Cloning: regression on that one demonstration. Replay: its actions, open loop. "
            f"Brackets: 95% bootstrap interval over episodes."
        ),
        header=(
            "Method",
            "Perturbation",
            *(f"{i + 1}. {task_name(task)}" for i, task in enumerate(stages)),
            "Whole",
            "95% interval",
            "Episodes",
        ),
        rows=lines,
    )


def imitate(config: Config) -> None:
    """Demonstrates, imitates, and writes ``imitation/results.csv`` and the table."""
    settings, run_dir = config.imitate, Path(config.run_dir)
    stages = composition_stages(settings.composition)
    missing = [task for task in stages if task not in config.tasks]
    if missing:
        raise BMRLError(
            f"imitate.composition is {settings.composition}, but the policy knows no {missing[0]}; "
            f"valid: tasks of the run ({', '.join(config.tasks)})"
        )
    load_student(run_dir / "distill" / "checkpoint.safetensors")  # before anything is written
    open_run(run_dir / "imitation", asdict(settings))
    with progress(settings.demonstrations, "demonstrating", "demonstration") as bar:
        for number in range(settings.demonstrations):
            demonstrate(config, number)
            bar.update(1)
    jobs = [
        (config, method, perturbation, number)
        for method in METHODS
        for perturbation in PERTURBATIONS
        for number in range(settings.demonstrations)
    ]
    episodes = settings.episodes // settings.demonstrations
    results = run_jobs(
        imitate_job,
        jobs,
        workers=config.workers,
        total=len(jobs) * episodes * horizon_of(settings.composition),
        description="imitating",
        unit="step",
    )
    rows = [row for part in results for row in part]
    write_rows(run_dir / "imitation" / "results.csv", rows)
    table = imitation_table(config, rows)
    write_study(run_dir, "imitation", Section(heading="One-shot imitation", tables=[table]), {})
    print(table.markdown())


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, imitate, trains=False)


if __name__ == "__main__":
    main()
