"""Exports a run's distilled policy: one small file with a card, and an ONNX file."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from tensordict import TensorDict

from torchrl_bmrl.envs.transforms import ObservationStatistics
from torchrl_bmrl.evaluation import read_results, summarise
from torchrl_bmrl.export import export_policy
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.modules import reads_context
from torchrl_bmrl.modules.task_latent import TRANSITION_KEYS
from torchrl_bmrl.pipeline.evaluate import held_out_episode, run_facts
from torchrl_bmrl.pipeline.run import Run
from torchrl_bmrl.pipeline.student import Student
from torchrl_bmrl.reports.tables import markdown_text, results_table
from torchrl_bmrl.run.folder import read_versions
from torchrl_bmrl.training.checkpoint import save_checkpoint

log = logging.getLogger(__name__)

CARD = """# The distilled policy of preset {preset}, seed {seed}

One policy for {number} tasks ({tasks}), conditioned on a task embedding m of {dim} numbers.
{parameters:,} parameters: the encoder of m{classifier}, the generator of actions and the critic
that chooses among them. The file also contains a point of m for each task, the statistics that
normalise observations, and one held-out demonstration of each task.

```bash
python recipes/evaluate.py evaluate.policy={name}
```

`{stem}.onnx` acts with ONNX Runtime alone (docs/export.md). Its inputs are `observation`
`(B, {observation})`, not normalised, `task_latent (B, {dim})`, which is m, and
`action_latent (B, N, {latent})`, a latent for each of N candidates, for example 100, drawn from
{draw}. Its output is `action (B, {action})`, in [-1, 1].

## Data

{demonstrations}.

## Training

Stage 1: a Batch-Constrained Q-learning agent for each task, {bcq_updates:,} updates of
{bcq_batch} transitions, Adam at {bcq_lr:g}. Stage 2: {updates:,} updates of {batch} transitions
of each task, Adam at {lr:g}. {versions}.

## Results

{accuracy}{table}
## Limits

- It was trained on these tasks alone, and on states like those of their demonstrations. In a chain
  of tasks it meets other states; preset `compose` is for that (docs/imitation.md).
- Its observation is a vector of exact numbers, not pictures.
- Nothing limits forces or keeps the arm away from obstacles.
"""


def export(run: Run) -> None:
    """Writes ``policy.safetensors``, ``policy.md`` and ``policy.onnx`` into the run folder.

    For an exported policy (``evaluate.policy``) only the ONNX file is written.

    Args:
        run: an open run with both stages.

    Raises:
        BMRLError: if a file is missing or damaged.

    Example:
        >>> from torchrl_bmrl.pipeline import Settings
        >>> export(Run(Settings(tasks=["reach"])))
        Traceback (most recent call last):
        ...
        torchrl_bmrl.errors.BMRLError: runs/mine is not open; valid: with Run(settings) as run: ...
    """
    run.check_open()
    student, metadata = run.policy()
    if not run.settings.evaluate.policy:
        _write_policy(run, student, metadata)
    _write_onnx(run, student, metadata)


def _write_policy(run: Run, student: Student, metadata: dict[str, Any]) -> None:
    settings, versions = run.settings, read_versions(run.folder)
    results = run.folder / "results.csv"
    table = "No episodes were played.\n\n"
    if results.exists():
        table = results_table(summarise(read_results(results))).markdown().split("\n\n", 2)[2]
    demonstrations = {
        name: held_out_episode(run, name).select(*TRANSITION_KEYS).to_dict()
        for name in metadata["tasks"]
    }
    path = run.folder / "policy.safetensors"
    save_checkpoint(
        path,
        {"module": student.state_dict(), "demonstrations": demonstrations},
        metadata | {"preset": settings.preset, "seed": settings.seed, "versions": versions},
    )
    clip, bcq, distill = metadata["latent_clip"], settings.bcq, settings.distill
    card = CARD.format(
        preset=markdown_text(settings.preset),
        seed=settings.seed,
        number=len(metadata["tasks"]),
        tasks=markdown_text(", ".join(run.titles[name].lower() for name in metadata["tasks"])),
        dim=student.prototypes.shape[-1],
        parameters=sum(
            parameter.numel()
            for name, parameter in student.named_parameters()
            if metadata["accuracy"] is not None or not name.startswith("task_classifier.")
        ),
        name=path.name,
        stem=path.stem,
        observation=len(run.statistics.loc),
        latent=student.latent_dim,
        action=metadata["student"]["action_dim"],
        draw="N(0, I)" if clip is None else f"N(0, I) and clipped to ±{clip:g}",
        demonstrations=markdown_text(run_facts(run)["Demonstrations"]),
        bcq_updates=bcq.updates,
        bcq_batch=bcq.batch_size,
        bcq_lr=bcq.lr,
        updates=distill.updates,
        batch=distill.batch_size,
        lr=distill.lr,
        versions=markdown_text(", ".join(f"{name} {x}" for name, x in versions.items())),
        accuracy=_accuracy(student, metadata["accuracy"]),
        classifier="" if metadata["accuracy"] is None else ", its classifier",
        table=table,
    )
    write_atomic(path.with_suffix(".md"), card)
    _log_size(path)


def _accuracy(student: Student, accuracy: float | None) -> str:
    """The card's paragraph on the classifier; empty without one."""
    if accuracy is None:
        return ""
    if reads_context(student.task_encoder):
        named = f"{accuracy:.2%} of the tasks from m of all held-out transitions of each"
    else:
        named = f"the task of {accuracy:.2%} of the held-out transitions from m"
    return f"A linear layer names {named}.\n\n"


def _write_onnx(run: Run, student: Student, metadata: dict[str, Any]) -> None:
    """Writes the policy as an ONNX file whose metadata contain each task's point of m."""
    path = run.folder / "policy.onnx"
    policy = student.policy(
        num_candidates=run.settings.evaluate.num_candidates, latent_clip=metadata["latent_clip"]
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
    _log_size(path)


def _log_size(path: Path) -> None:
    log.info("%s: %.1f MiB", path, path.stat().st_size / 2**20)
