"""A run's distilled policy as one small file, with a demonstration of each task and a card.

python recipes/export.py run_dir=runs/mine             # after recipes/evaluate.py
python recipes/export.py evaluate.policy=recipes/policies/sawyer.safetensors    # no run needed

Writes ``policy.safetensors``, ``policy.md`` and ``policy.onnx`` into the run folder. The first file
alone is enough to act: ``recipes/evaluate.py evaluate.policy=policy.safetensors``. The last one
acts without this library (docs/export.md); of a file that was shipped it is all that is written.
"""

from __future__ import annotations

import os

import needed  # noqa: F401 (first)

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig
from settings import Config, run_recipe
from tensordict import TensorDict

from torchrl_bmrl.data.demonstrations import load_transitions
from torchrl_bmrl.envs.transforms import ObservationStatistics
from torchrl_bmrl.evaluation import read_results, summarise
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS
from torchrl_bmrl.pipeline.agents import ACTION_DIM, Student, load_student
from torchrl_bmrl.pipeline.export import export_policy
from torchrl_bmrl.reports.tables import results_table
from torchrl_bmrl.run.folder import read_versions
from torchrl_bmrl.training.checkpoint import save_checkpoint

CARD = """# The distilled policy of preset {preset}, seed {seed}

One policy for {tasks} with a simulated Sawyer arm and one cube (robosuite), steered by a task
embedding m of {dim} numbers. {parameters:,} parameters: the encoder of m, its classifier, the
generator of actions and the critic that chooses among them. The file also holds a point of m for
each task, the statistics that normalise observations, and one held-out demonstration of each
task.

```bash
python recipes/evaluate.py evaluate.policy={name}
```

`{stem}.onnx` acts with ONNX Runtime alone (docs/export.md). It takes `observation` as the
environment gives it, `(B, {observation})`, `task_latent (B, {dim})`, that is m, and
`action_latent (B, N, {latent})`, a latent for each of N candidates, 100 say, drawn from {draw}.
It returns `action (B, {action})`.

## Data

Scripted experts with Gaussian noise of {noise} on every action, 200 steps an episode: {train}.
{valid} further episodes of each task were held out. No person's and no robot's data.

## Training

Stage 1: a Batch-Constrained Q-learning agent for each task, {bcq_updates:,} updates of
{bcq_batch} transitions, Adam at {bcq_lr:g}. Stage 2: {updates:,} updates of {batch} transitions
of each task, Adam at {lr:g}. {versions}.

## Figures

From starts that no demonstration had. A linear layer names the task of {accuracy:.2%} of the
held-out transitions from m.

{table}
## Limits

- It has seen these six tasks, this arm, this cube and this table, in simulation alone.
- It reads 33 exact numbers (joints, gripper, pose of the end effector, position of the goal or the
  cube), no pictures. The simulator's version matters: contacts changed with MuJoCo 3.4.
- Every task starts as its demonstrations do. In a chain of tasks it meets states that it was not
  trained on; preset `compose` is for that (docs/imitation.md).
- Lift and push know where the cube is, not whether something is in the way. Nothing limits force.
"""


def write_onnx(config: Config, student: Student, metadata: dict[str, Any]) -> None:
    """Writes the policy as an ONNX file, which also says each task's point of m."""
    path = Path(config.run_dir) / "policy.onnx"
    policy = student.policy(
        num_candidates=config.evaluate.num_candidates, latent_clip=metadata["latent_clip"]
    )
    statistics = ObservationStatistics.from_lists(metadata["statistics"])
    example = TensorDict({"observation": statistics.loc, "task_latent": student.prototypes[0]})
    tasks = dict(zip(metadata["tasks"], student.prototypes.tolist(), strict=True))
    export_policy(
        policy,
        path,
        example,
        loc=statistics.loc,
        scale=statistics.scale,
        metadata={"tasks": tasks, "versions": metadata.get("versions")},
    )
    print(f"{path}: {path.stat().st_size / 2**20:.1f} MiB")


def export(config: Config) -> None:
    """Writes the policy and its card."""
    if config.evaluate.policy:
        return write_onnx(config, *load_student(Path(config.evaluate.policy)))
    run_dir = Path(config.run_dir)
    student, metadata = load_student(run_dir / "distill" / "checkpoint.safetensors")
    rows = read_results(run_dir / "results.csv")
    versions = read_versions(run_dir)
    statistics = ObservationStatistics.from_lists(metadata["statistics"])
    demonstrations = {}
    for index, task in enumerate(metadata["tasks"]):
        data = load_transitions(run_dir / "data", task, statistics, split="valid", num_task=index)
        episode = data[data["episode"] == 0].select(*TRANSITION_KEYS)
        demonstrations[task] = episode.to_dict()
    path = run_dir / "policy.safetensors"
    save_checkpoint(
        path,
        {"module": student.state_dict(), "demonstrations": demonstrations},
        metadata | {"preset": config.preset, "seed": config.seed, "versions": versions},
    )
    clip = metadata["latent_clip"]
    card = CARD.format(
        preset=config.preset,
        seed=config.seed,
        tasks=", ".join(task.replace("_", " ") for task in metadata["tasks"]),
        dim=student.prototypes.shape[-1],
        parameters=sum(p.numel() for p in student.parameters()),
        name=path.name,
        stem=path.stem,
        observation=len(statistics.loc),
        latent=student.latent_dim,
        action=ACTION_DIM,
        draw="N(0, I)" if clip is None else f"N(0, I) and clipped to ±{clip:g}",
        noise=config.collect.noise,
        train=", ".join(
            f"{config.collect.train_episodes[task]} of {task.replace('_', ' ')}"
            for task in metadata["tasks"]
        ),
        valid=config.collect.valid_episodes,
        bcq_updates=config.bcq.epochs * config.bcq.updates_per_epoch,
        bcq_batch=config.bcq.batch_size,
        bcq_lr=config.bcq.lr,
        updates=config.distill.updates,
        batch=config.distill.batch_size,
        lr=config.distill.lr,
        versions=", ".join(f"{name} {version}" for name, version in versions.items()),
        accuracy=metadata["accuracy"],
        table=results_table(summarise(rows)).markdown().split("\n\n", 2)[2],
    )
    write_atomic(path.with_suffix(".md"), card)
    print(f"{path}: {path.stat().st_size / 2**20:.1f} MiB, and its card, {path.with_suffix('.md')}")
    write_onnx(config, student, metadata)


@hydra.main(version_base="1.3", config_path="config", config_name="recipe")
def main(config: DictConfig) -> None:
    """Command line."""
    run_recipe(config, export, trains=False)


if __name__ == "__main__":
    main()
