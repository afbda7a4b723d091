"""Tables of results: everything measured, the paper's two tables, measures of the embedding."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from torchrl_bmrl.evaluation.embedding import GoalDistanceResult, StageResult
from torchrl_bmrl.evaluation.results import Summary
from torchrl_bmrl.files import printable
from torchrl_bmrl.rows import to_cell

MISSING = "–"
"""Cell of a number that is not known."""

_POLICY_NAMES = {
    "expert": "Expert",
    "reference": "Scripted optimum",
    "bcq": "BCQ",
    "distilled": "Distilled",
    "bc": "BC",
    "bc_best": "BC, best episodes",
    "td3_bc": "TD3+BC",
    "rebrac": "ReBRAC",
    "iql": "IQL",
    "cql": "CQL",
    "bcq_one_hot": "BCQ, one-hot task",
}


@dataclass(frozen=True, kw_only=True)
class Table:
    r"""A table of text, which can be written as Markdown, CSV or HTML.

    Args:
        title: Title.
        caption: Explanation of the columns.
        header: Names of the columns.
        rows: Cells, one string per column.

    Example:
        >>> table = Table(title="T", caption="C", header=("Task", "Return"), rows=[("Lift", "1.5")])
        >>> table.csv()
        'Task,Return\nLift,1.5\n'
    """

    title: str
    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self, *, level: int = 2) -> str:
        """Returns title, caption and cells as Markdown, with numbers aligned to the right.

        Args:
            level: Level of the title's heading.
        """
        rule = ["---:" if self._is_numeric(column) else ":---" for column in range(self._width)]
        lines = [self.header, rule, *self.rows]
        cells = [
            "| " + " | ".join(markdown_text(c).replace("|", "\\|") for c in line) + " |"
            for line in lines
        ]
        # Captions may have links: they are Markdown of the caller, not text from files.
        title, caption = markdown_text(self.title), printable(self.caption).replace("<", "&lt;")
        return "\n".join([f"{'#' * level} {title}", "", caption, "", *cells, ""])

    def csv(self) -> str:
        """Returns header and rows as CSV, without title and caption."""
        text = io.StringIO()
        lines = [[to_cell(cell) for cell in line] for line in (self.header, *self.rows)]
        csv.writer(text, lineterminator="\n").writerows(lines)
        return text.getvalue()

    def html(self) -> str:
        """Returns the table as an HTML figure; all text is escaped."""
        align = [' class="number"' if self._is_numeric(i) else "" for i in range(self._width)]

        def line(tag: str, cells: Sequence[str]) -> str:
            marked = zip(align, cells, strict=True)
            return "<tr>" + "".join(f"<{tag}{a}>{escape(c)}</{tag}>" for a, c in marked) + "</tr>"

        body = "\n".join(line("td", row) for row in self.rows)
        return (
            f"<figure>\n<h3>{escape(self.title)}</h3>\n"
            f'<div class="wide"><table>\n<thead>{line("th", self.header)}</thead>\n'
            f"<tbody>\n{body}\n</tbody>\n</table></div>\n"
            f"<figcaption>{escape(self.caption)}</figcaption>\n</figure>"
        )

    @property
    def _width(self) -> int:
        return len(self.header)

    def _is_numeric(self, column: int) -> bool:
        cells = [row[column] for row in self.rows]
        return any(map(_has_digit, cells)) and not any(any(map(str.isalpha, c)) for c in cells)


def markdown_text(text: str) -> str:
    """Returns a text that Markdown shows in one line, without elements of HTML, links and pictures.

    Args:
        text: From a file, perhaps.

    Example:
        >>> markdown_text("<b>a</b> [b](c)")
        '&lt;b>a&lt;/b> [b]&#40;c)'
    """
    return printable(text).replace("<", "&lt;").replace("](", "]&#40;")


def task_name(task: str) -> str:
    """Makes a title from a task's name; of ``module:name`` the name alone is used.

    Args:
        task: Name of the task.

    Example:
        >>> task_name("push_left")
        'Push Left'
    """
    return task.rpartition(":")[2].replace("_", " ").title()


def task_titles(
    tasks: Iterable[str] = (), titles: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Returns the titles of tasks in the order in which tables and figures show them.

    Args:
        tasks: Names of tasks.
        titles: Titles by task. Their order comes first; other tasks follow with a title made from
            their name.

    Example:
        >>> task_titles(["lift", "ant_v5"], {"ant_v5": "Ant"})
        {'ant_v5': 'Ant', 'lift': 'Lift'}
    """
    names = dict.fromkeys([*(titles or {}), *tasks])
    return {task: (titles or {}).get(task) or task_name(task) for task in names}


def policy_name(policy: str) -> str:
    """Returns a policy's name as tables print it; a name that is not known stays as it is.

    Example:
        >>> policy_name("td3_bc"), policy_name("mine")
        ('TD3+BC', 'mine')
    """
    return _POLICY_NAMES.get(policy, policy)


def percent(share: float | None) -> str:
    """Returns a share as tables print it.

    Example:
        >>> percent(0.5), percent(None)
        ('50%', '–')
    """
    return MISSING if share is None else f"{share:.0%}"


def results_table(
    summaries: Sequence[Summary], *, titles: Mapping[str, str] | None = None
) -> Table:
    """One line per task, policy and source of m.

    Args:
        summaries: Results of :func:`torchrl_bmrl.evaluation.summarise`.
        titles: Titles by task, as in :func:`task_titles`.

    Example:
        >>> results_table([]).header[:4]
        ('Task', 'Policy', 'Source of m', 'Mean return')
    """
    named = task_titles((s.task for s in summaries), titles)
    return Table(
        title="Results",
        caption=(
            "Return: undiscounted sum of an episode's rewards. Success: the task's goal was met at "
            "some step of the episode. Brackets hold 95% bootstrap intervals of the mean, "
            "resampled over episodes within each seed; they have no width where all episodes "
            "agree. Std: standard deviation over episodes. Source of m: where the distilled policy "
            "takes its task embedding from: prototype is one fixed point per task, online the "
            "embedding of the last transition, demonstration those of one given trajectory."
        ),
        header=(
            "Task",
            "Policy",
            "Source of m",
            "Mean return",
            "Return 95% interval",
            "Std",
            "Success",
            "Success 95% interval",
            "Episodes",
            "Seeds",
        ),
        rows=[
            (
                named[s.task],
                policy_name(s.policy),
                s.latent_source,
                f"{s.mean_return:.1f}",
                f"[{s.return_interval[0]:.1f}, {s.return_interval[1]:.1f}]",
                f"{s.std_return:.1f}",
                percent(s.success_rate),
                "[{:.0%}, {:.0%}]".format(*s.success_interval) if s.success_interval else MISSING,
                str(s.episodes),
                str(s.seeds),
            )
            for s in summaries
        ],
    )


def stages_table(
    results: Sequence[StageResult], *, titles: Mapping[str, str] | None = None
) -> Table:
    """Agreement of groups found without labels with the experts' recorded phases.

    Args:
        results: Results of :func:`torchrl_bmrl.reports.measure_stages`.
        titles: Titles by task, as in :func:`task_titles`.

    Example:
        >>> stages_table([]).header[:2]
        ('Task', 'Phases')
    """
    names = _representations([r.agreement for r in results])
    named = task_titles((r.task for r in results), titles)
    return Table(
        title="Stages found without labels",
        caption=(
            "Adjusted mutual information of the groups that a mixture of Gaussians finds in a "
            "task's transitions and the phases that the expert recorded: 1 if both divide them "
            "alike, 0 by chance. There are as many groups as phases. They are fitted to the "
            "training demonstrations and measured on the held-out ones, on each successful "
            "episode until half a second after its first success. Brackets contain 95% bootstrap "
            "intervals over episodes. For comparison: the same number for the encoder's input "
            "(the normalised transition) and for an encoder that was never trained."
        ),
        header=("Task", "Phases", *map(str.capitalize, names), "Episodes", "Transitions"),
        rows=[
            (
                named[r.task],
                ", ".join(r.phases),
                *(str(r.agreement[name]) for name in names),
                str(r.episodes),
                str(r.transitions),
            )
            for r in results
        ],
    )


def goal_distance_table(
    results: Sequence[GoalDistanceResult], *, titles: Mapping[str, str] | None = None
) -> Table:
    """Correlation of distances to the success point in the embedding with distances to the goal.

    Args:
        results: Results of :func:`torchrl_bmrl.reports.measure_goal_distance`.
        titles: Titles by task, as in :func:`task_titles`.

    Example:
        >>> goal_distance_table([]).header[0]
        'Task'
    """
    names = _representations([r.correlation for r in results])
    named = task_titles((r.task for r in results), titles)
    return Table(
        title="Distance to the goal in the embedding",
        caption=(
            "Spearman's correlation of a transition's distance to its task's success point (the "
            "mean over first successes in the training demonstrations) with its distance to the "
            "goal, in each held-out episode up to its first success: mean over episodes, 95% "
            "bootstrap interval over episodes, and the lowest episode. For comparison: the same "
            "number for the encoder's input and for an encoder that was never trained. Spread: "
            "the episodes' spread in the embedding at their first success, divided by their "
            "spread at the start; below 1 they converge."
        ),
        header=(
            "Task",
            *map(str.capitalize, names),
            "Lowest episode",
            "Spread, success over start",
            "Episodes",
            "Transitions",
        ),
        rows=[
            (
                named[r.task],
                *(str(r.correlation[name]) for name in names),
                f"{r.lowest:.2f}",
                MISSING if r.spread is None else str(r.spread),
                str(r.episodes),
                str(r.transitions),
            )
            for r in results
        ],
    )


def _representations(results: Sequence[Mapping[str, object]]) -> list[str]:
    """Returns the names of all representations, in the order of their first appearance."""
    return list(dict.fromkeys(name for result in results for name in result))


def _has_digit(text: str) -> bool:
    return any(map(str.isdigit, text))
