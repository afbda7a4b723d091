"""The report of a run folder: tables, figures and one page, computed from files of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrl_bmrl.errors import DataError
from torchrl_bmrl.evaluation.results import Summary, read_results, summarise
from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.reports import paper
from torchrl_bmrl.reports.drawn import DrawnEmbeddings, draw_embeddings
from torchrl_bmrl.reports.embedding import Embeddings
from torchrl_bmrl.reports.explorer import Explorer
from torchrl_bmrl.reports.page import Section, write_page
from torchrl_bmrl.reports.stage1 import (
    diagnostics_table,
    draw_stage1,
    read_stage1_curves,
    read_stage1_diagnostics,
)
from torchrl_bmrl.reports.studies import read_studies
from torchrl_bmrl.reports.tables import (
    Table,
    results_table,
    task_titles,
)


def write_report(
    run_dir: Path,
    *,
    facts: Mapping[str, str],
    titles: Mapping[str, str] | None = None,
    default_source: str = "prototype",
    tables: Mapping[str, Table] | None = None,
    embeddings: Embeddings | None = None,
    training: Embeddings | None = None,
    accuracy: float | None = None,
    explorer: Explorer | None = None,
    drawn: DrawnEmbeddings | None = None,
    seed: int = 0,
) -> Path:
    """Writes tables, figures and ``report.html`` of a run folder.

    It writes ``tables/*.{md,csv}``, ``figures/*.png`` and ``report.html``, each atomically and
    after everything has been computed. Tables of returns need a ``results.csv``, tables of the
    embedding need ``training``. The page names each figure that lacks its data, and shows the
    studies in the folder.

    Args:
        run_dir: Run folder, with ``results.csv`` if episodes were evaluated, and
            ``bcq/<task>/evaluations.csv`` (columns epoch, update, episode, return, success) for the
            training curves, and ``bcq/<task>/diagnostics.csv`` for the table of diagnostics.
        facts: Names and values for the box at the top of the page.
        titles: Titles by task, in the order of the run's tasks; other tasks follow, with titles
            made from their names.
        default_source: Source of m that comes first in the tables.
        tables: Further tables by file name, shown in the summary.
        embeddings: Held-out transitions, which are drawn and measured.
        training: Training transitions, to which stages and success points are fitted.
        accuracy: Held-out accuracy of the task classifier, in [0, 1].
        explorer: Held-out transitions to explore.
        drawn: Of :func:`draw_embeddings` for the same transitions, if it was called before.
        seed: Seed of t-SNE, of the stages and of the bootstrap.

    Returns:
        Path of the page.

    Raises:
        DataError: if there is nothing to report, or a file of results, training curves or a study
            is not valid.

    Example:
        >>> import tempfile
        >>> from torchrl_bmrl.evaluation import ResultRow, write_results
        >>> folder = Path(tempfile.mkdtemp())
        >>> row = ResultRow(
        ...     task="lift", policy="bcq", seed=0, episode=0, episode_return=80.0, success=True
        ... )
        >>> write_results(folder / "results.csv", [row])
        >>> write_report(folder, facts={"seed": "0"}).name
        'report.html'
    """
    run_dir = Path(run_dir)
    results = run_dir / "results.csv"
    rows = read_results(results) if results.is_file() else []
    titles = task_titles(
        [*(row.task for row in rows), *(embeddings.tasks if embeddings else ())], titles
    )
    summaries = summarise(rows, titles)
    curves = read_stage1_curves(run_dir, titles)
    diagnosed = read_stage1_diagnostics(run_dir, titles)
    studies = read_studies(run_dir)
    if not (rows or curves or diagnosed or studies or tables or embeddings):
        raise DataError(results, None, "contains no episode, and there is nothing else to report")
    returns = {}
    if rows:
        epochs = {task: curve[-1][0] for task, curve in curves.items()}
        returns = {
            "results": results_table(summaries, titles=titles),
            "table1": paper.table_1(summaries, titles=titles, epochs=epochs),
            "table2": paper.table_2(summaries, titles=titles, default_source=default_source),
        }
    stage1, note1 = draw_stage1(curves, summaries, titles)
    if drawn is None:
        drawn = draw_embeddings(embeddings, training, titles, seed=seed)
    agents = {"diagnostics": diagnostics_table(diagnosed)} if diagnosed else {}

    for name, table in {**returns, **agents, **(tables or {}), **drawn.tables}.items():
        write_atomic(run_dir / "tables" / f"{name}.md", table.markdown())
        write_atomic(run_dir / "tables" / f"{name}.csv", table.csv())
    for name, picture in {**stage1, **drawn.shown, **drawn.measured}.items():
        write_atomic(run_dir / "figures" / f"{name}.png", picture.png)
    sections = [
        Section(
            heading="Summary",
            paragraphs=headline(
                summaries, titles=titles, default_source=default_source, accuracy=accuracy
            ),
            tables=list((tables or {}).values()),
        )
    ]
    if returns or curves or agents:
        sections.append(
            Section(
                heading="Stage 1: one BCQ policy per task",
                paragraphs=note1,
                tables=[*([returns["table1"]] if returns else []), *agents.values()],
                pictures=list(stage1.values()),
            )
        )
    if returns:
        heading = "Stage 2: one distilled policy for all tasks"
        sections.append(Section(heading=heading, tables=[returns["table2"]]))
    sections.append(
        Section(
            heading="The task embedding",
            paragraphs=drawn.shown_notes,
            pictures=list(drawn.shown.values()),
        )
    )
    if explorer:
        heading = "Explore the embedding"
        sections.append(
            Section(heading=heading, paragraphs=explorer.paragraphs(), explorer=explorer)
        )
    if embeddings:
        sections.append(
            Section(
                heading="Stages and distances in the embedding",
                paragraphs=drawn.measured_notes,
                tables=list(drawn.tables.values()),
                pictures=list(drawn.measured.values()),
            )
        )
    sections += studies
    if returns:
        sections.append(Section(heading="Everything measured", tables=[returns["results"]]))
    page = run_dir / "report.html"
    title = "Compositional skill learning with batch meta RL"
    write_page(page, title=title, facts=facts, sections=sections)
    return page


def headline(
    summaries: Sequence[Summary],
    *,
    titles: Mapping[str, str] | None = None,
    default_source: str,
    accuracy: float | None,
) -> list[str]:
    """Summarises the results in a few sentences.

    Args:
        summaries: Results of :func:`torchrl_bmrl.evaluation.summarise`.
        titles: Titles by task, as in :func:`~torchrl_bmrl.reports.tables.task_titles`.
        default_source: Source of m of the distilled policy.
        accuracy: Held-out accuracy of the task classifier, in [0, 1].

    Returns:
        One paragraph, or none.

    Example:
        >>> headline([], default_source="prototype", accuracy=0.998)[0][:31]
        'A single linear layer tells a h'
    """
    titles = task_titles((s.task for s in summaries), titles)
    sentences = []
    bcq = {s.task: s for s in summaries if s.policy == "bcq"}
    if solved := _successes(list(bcq.values()), titles):
        sentences.append(f"The BCQ policies, one per task, {solved}.")
    distilled = [
        s for s in summaries if s.policy == "distilled" and s.latent_source == default_source
    ]
    if solved := _successes(distilled, titles):
        sentences.append(
            f"The distilled policy, one for all tasks, its task embedding m from the "
            f"source “{default_source}”, {solved}."
        )
    shares = [
        (s.mean_return / bcq[s.task].mean_return, s.task)
        for s in distilled
        if s.task in bcq and bcq[s.task].mean_return > 0.0
    ]
    if shares:
        low, high = min(shares), max(shares)
        subject = "Its return" if solved else "The distilled policy's return"
        sentences.append(
            f"{subject} is between {low[0]:.1%} ({titles[low[1]]}) and {high[0]:.1%} "
            f"({titles[high[1]]}) of that of the BCQ policies."
        )
    if accuracy is not None:
        comparison = f" (paper: {paper.ACCURACY:.0%})" if paper.covers(titles) else ""
        sentences.append(
            f"A single linear layer tells a held-out transition's task from its embedding in "
            f"{accuracy:.1%} of the cases{comparison}."
        )
    return [" ".join(sentences)] if sentences else []


def _successes(summaries: Sequence[Summary], titles: Mapping[str, str]) -> str:
    """States how often policies succeeded, and where least often; empty if nothing is known."""
    rates = [(s.success_rate, s) for s in summaries if s.success_rate is not None]
    if not rates:
        return ""
    episodes = sum(s.episodes for _, s in rates)
    successes = round(sum(rate * s.episodes for rate, s in rates))
    if successes == episodes:
        return f"solved all of {episodes} episodes"
    worst, summary = min(rates, key=lambda item: item[0])
    return (
        f"solved {successes} of {episodes} episodes (least often on {titles[summary.task]}: "
        f"{worst:.0%})"
    )
