"""The report of a run folder: tables, figures and one page, all from files of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation.results import Summary, read_results, summarise
from torchrl_bmrl.files import finite, read_rows, whole, write_atomic
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports import paper
from torchrl_bmrl.reports.embedding import (
    EMBEDDING,
    Embeddings,
    measure_goal_distance,
    measure_stages,
    name_stages,
    success_point,
)
from torchrl_bmrl.reports.explorer import Explorer
from torchrl_bmrl.reports.figures import (
    Curve,
    embedding_scatter,
    embedding_stages,
    embedding_tsne,
    reach_trajectories,
    stage1_curves,
)
from torchrl_bmrl.reports.page import Picture, Section, write_page
from torchrl_bmrl.reports.studies import read_studies
from torchrl_bmrl.reports.tables import (
    Table,
    goal_distance_table,
    results_table,
    stages_table,
    table_1,
    table_2,
    task_name,
)

_CURVE_COLUMNS = {"epoch": whole, "update": whole, "return": finite}


def read_stage1_curves(run_dir: Path) -> dict[str, Curve]:
    """Reads ``bcq/<task>/evaluations.csv`` of a run folder, for those tasks that have one.

    Args:
        run_dir: The run folder.

    Returns:
        Evaluations by task: epoch, update and returns, in the order of the epochs.

    Raises:
        DataError: if a file lacks a column, or a value is not a finite number.

    Example:
        >>> read_stage1_curves(Path("no-such-run"))
        {}
    """
    files = {task: run_dir / "bcq" / task / "evaluations.csv" for task in TASKS}
    curves = {task: _read_curve(path) for task, path in files.items() if path.is_file()}
    return {task: curve for task, curve in curves.items() if curve}


def write_report(
    run_dir: Path,
    *,
    default_source: str,
    facts: Mapping[str, str],
    embeddings: Embeddings | None = None,
    training: Embeddings | None = None,
    accuracy: float | None = None,
    explorer: Explorer | None = None,
    seed: int = 0,
) -> Path:
    """Writes tables, figures and ``report.html`` of a run folder from its ``results.csv``.

    Written are ``tables/{results,table1,table2}.{md,csv}``, with ``training`` also
    ``tables/{stages,goal_distance}.{md,csv}``, ``figures/*.png`` and ``report.html``, each
    atomically and after everything has been computed. A figure without data is left out, and the
    page says so. Studies that the folder holds are shown.

    Args:
        run_dir: The run folder, with ``results.csv`` and, for the training curves,
            ``bcq/<task>/evaluations.csv`` (columns epoch, update, episode, return, success).
        default_source: Source of m that comes first in the tables.
        facts: Names and values for the box at the top of the page.
        embeddings: Transitions to draw and to measure, from held-out data.
        training: Transitions of the training data, which stages and success points come from.
        accuracy: Held-out classification accuracy of the embedding, in [0, 1].
        explorer: Transitions to explore, from held-out data.
        seed: Seed of t-SNE.

    Returns:
        Path of the page.

    Raises:
        DataError: if ``results.csv``, a file of training curves or a study is missing or not valid.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.evaluation import ResultRow, write_results
        >>> folder = Path(tempfile.mkdtemp())
        >>> row = ResultRow(
        ...     task="lift", policy="bcq", seed=0, episode=0, episode_return=80.0, success=True
        ... )
        >>> write_results(folder / "results.csv", [row])
        >>> write_report(folder, default_source="prototype", facts={"seed": "0"}).name
        'report.html'
    """
    run_dir = Path(run_dir)
    summaries = summarise(read_results(run_dir / "results.csv"))
    if not summaries:
        raise DataError(run_dir / "results.csv", None, "holds no episode to report on")
    curves = read_stage1_curves(run_dir)
    tables = {
        "results": results_table(summaries),
        "table1": table_1(summaries, epochs={task: curve[-1][0] for task, curve in curves.items()}),
        "table2": table_2(summaries, default_source=default_source),
    }
    stage1, note1 = _draw_stage1(curves, summaries)
    stage2, note2 = _draw_embeddings(embeddings, training, seed=seed)
    known, drawn, note3 = _measure_embeddings(embeddings, training, seed=seed)

    for name, table in {**tables, **known}.items():
        write_atomic(run_dir / "tables" / f"{name}.md", table.markdown())
        write_atomic(run_dir / "tables" / f"{name}.csv", table.csv())
    for name, picture in {**stage1, **stage2, **drawn}.items():
        write_atomic(run_dir / "figures" / f"{name}.png", picture.png)
    page = run_dir / "report.html"
    write_page(
        page,
        title="Compositional skill learning with batch meta RL",
        facts=facts,
        sections=[
            Section(
                heading="Summary",
                paragraphs=headline(summaries, default_source=default_source, accuracy=accuracy),
            ),
            Section(
                heading="Stage 1: one BCQ policy per task",
                paragraphs=note1,
                tables=[tables["table1"]],
                pictures=list(stage1.values()),
            ),
            Section(
                heading="Stage 2: one distilled policy for all tasks", tables=[tables["table2"]]
            ),
            Section(heading="The task embedding", paragraphs=note2, pictures=list(stage2.values())),
            *_explore(explorer),
            Section(
                heading="What the embedding knows",
                paragraphs=note3,
                tables=list(known.values()),
                pictures=list(drawn.values()),
            ),
            *read_studies(run_dir),
            Section(heading="Everything measured", tables=[tables["results"]]),
        ],
    )
    return page


def _explore(explorer: Explorer | None) -> list[Section]:
    if explorer is None:
        return []
    heading = "Explore the embedding"
    return [Section(heading=heading, paragraphs=explorer.paragraphs(), explorer=explorer)]


def headline(
    summaries: Sequence[Summary], *, default_source: str, accuracy: float | None
) -> list[str]:
    """The few sentences that a hurried reader needs.

    Args:
        summaries: What :func:`torchrl_bmrl.evaluation.summarise` returns.
        default_source: Source of m of the distilled policy.
        accuracy: Held-out classification accuracy of the embedding, in [0, 1].

    Returns:
        One paragraph, or none.

    Example:
        >>> headline([], default_source="prototype", accuracy=0.998)[0][:31]
        'A single linear layer tells a h'
    """
    sentences = []
    bcq = {s.task: s for s in summaries if s.policy == "bcq"}
    if bcq:
        sentences.append(f"The BCQ policies, one per task, {_successes(list(bcq.values()))}.")
    distilled = [
        s for s in summaries if s.policy == "distilled" and s.latent_source == default_source
    ]
    if distilled:
        sentences.append(
            f"The distilled policy, one for all tasks, its task embedding m from the "
            f"source “{default_source}”, "
            f"{_successes(distilled)}."
        )
    shares = [
        (s.mean_return / bcq[s.task].mean_return, s.task)
        for s in distilled
        if s.task in bcq and bcq[s.task].mean_return > 0.0
    ]
    if shares:
        low, high = min(shares), max(shares)
        sentences.append(
            f"Its return is between {low[0]:.1%} ({task_name(low[1])}) and {high[0]:.1%} "
            f"({task_name(high[1])}) of that of the BCQ policies."
        )
    if accuracy is not None:
        sentences.append(
            f"A single linear layer tells a held-out transition's task from its embedding in "
            f"{accuracy:.1%} of the cases (paper: {paper.ACCURACY:.0%})."
        )
    return [" ".join(sentences)] if sentences else []


def _successes(summaries: Sequence[Summary]) -> str:
    """How often the policies of some tasks succeeded, and where least."""
    episodes = sum(s.episodes for s in summaries)
    successes = round(sum(s.success_rate * s.episodes for s in summaries))
    if successes == episodes:
        return f"solved all of {episodes} episodes"
    worst = min(summaries, key=lambda s: s.success_rate)
    return (
        f"solved {successes} of {episodes} episodes (least often on {task_name(worst.task)}: "
        f"{worst.success_rate:.0%})"
    )


def _draw_stage1(
    curves: Mapping[str, Curve], summaries: Sequence[Summary]
) -> tuple[dict[str, Picture], list[str]]:
    """The picture of stage 1, and a sentence on what is missing from it."""
    missing = [task_name(task) for task in TASKS if task not in curves]
    note = [f"No training curve was found for {', '.join(missing)}."] if missing else []
    if not curves:
        return {}, ["The figure of training curves is left out: no evaluations were found."]
    experts = {s.task: s.mean_return for s in summaries if s.policy == "expert"}
    return {
        "stage1_curves": Picture(
            png=stage1_curves(curves, expert_means=experts),
            alt="Return against training epoch, one panel per task",
            caption=(
                "Return of the BCQ policy, rolled out after each training epoch: mean over the "
                "episodes, and a band of one standard deviation to either side. Dashed: mean "
                "return of the scripted expert whose demonstrations it learns from. Compare the "
                "paper's figure 3 (push tasks)."
            ),
        )
    }, note


def _draw_embeddings(
    embeddings: Embeddings | None, training: Embeddings | None, *, seed: int
) -> tuple[dict[str, Picture], list[str]]:
    """The pictures of the embedding, and a sentence on what is missing."""
    if embeddings is None:
        return {}, ["The figures of the embedding are left out: no embeddings were given."]
    embeddings = embeddings.in_time()
    latent, task = embeddings.task_latent, embeddings.task
    pictures = {
        "embedding": Picture(
            png=embedding_scatter(latent, task),
            alt="Scatter plot of task embeddings, one colour per task",
            caption=(
                "Each point is the embedding m of one transition (state, action, reward, next "
                "state). Tasks that form separate clusters can be told apart from a single "
                "transition. Compare the paper's figure 4a."
            ),
        ),
        "embedding_tsne": Picture(
            png=embedding_tsne(latent, task, seed=seed),
            alt="t-SNE map of task embeddings, one colour per task",
            caption=(
                "The same embeddings after t-SNE, which keeps neighbours together and distorts "
                "distances: several clusters of one colour suggest stages of that task, such as "
                "descending, grasping and lifting. Compare the paper's figure 4b."
            ),
        ),
    }
    reach = embeddings.on_the_way("reach")
    if not len(reach.task):
        return pictures, ["The reach trajectories are left out: no reach transition was given."]
    center = None if training is None else success_point(training, "reach")
    pictures["reach_trajectories"] = Picture(
        png=reach_trajectories(
            reach.task_latent,
            reach.episode,
            reach.distance,
            success_point=None if center is None else center[EMBEDDING],
        ),
        alt="Lines through the embedding, one per reach episode, coloured by distance to the goal",
        caption=(
            "Reach episodes as lines through the embedding, from circle to star, up to their first "
            "success. If the embedding holds the progress of the task, the lines end in one place "
            "and points of one colour lie on a circle around it. The circles, where drawn, are "
            "centred on the success point of the training demonstrations; each has the colour of a "
            "distance to the goal, and the radius that transitions there have in the middle. "
            "Compare the paper's figure 5."
        ),
    )
    return pictures, []


def _measure_embeddings(
    embeddings: Embeddings | None, training: Embeddings | None, *, seed: int
) -> tuple[dict[str, Table], dict[str, Picture], list[str]]:
    """Tables and the picture of what the embedding knows, and sentences on what is missing."""
    if embeddings is None or training is None:
        return {}, {}, ["Stages and distances are left out: no training transitions were given."]
    notes = []
    tables = {}
    if stages := measure_stages(training, embeddings, seed=seed):
        tables["stages"] = stages_table(stages)
    else:
        notes.append("The stages are left out: no phases of the expert were recorded.")
    if distances := measure_goal_distance(training, embeddings, seed=seed):
        tables["goal_distance"] = goal_distance_table(distances)
    else:
        notes.append("The distances are left out: no training demonstration succeeds.")
    way = embeddings.in_stages("lift")
    if "lift" not in [result.task for result in stages] or len(way.task) < 4:
        return tables, {}, notes
    picture = Picture(
        png=embedding_stages(
            way.task_latent,
            way.phase,
            name_stages(training, embeddings, "lift", seed=seed)[EMBEDDING],
            embeddings.phase_names["lift"],
            seed=seed,
        ),
        alt="Two t-SNE maps of lift's embeddings: by recorded phase, and by group found",
        caption=(
            "t-SNE of the embeddings of lift, held-out episodes that succeed, until half a second "
            "after their first success: by the phase that the expert recorded, and by the group "
            "found without it. Compare the paper's figure 4b."
        ),
    )
    return tables, {"embedding_stages": picture}, notes


def _read_curve(path: Path) -> Curve:
    epochs: dict[tuple[int, int], list[float]] = {}
    for row in read_rows(path, _CURVE_COLUMNS):
        epochs.setdefault((row["epoch"], row["update"]), []).append(row["return"])
    return [(epoch, update, np.array(epochs[epoch, update])) for epoch, update in sorted(epochs)]
