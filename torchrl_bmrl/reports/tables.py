"""The results and the paper's two tables, computed from summaries alone."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

from torchrl_bmrl.evaluation.embedding import GoalDistanceResult, StageResult
from torchrl_bmrl.evaluation.results import Summary
from torchrl_bmrl.evaluation.statistics import Estimate
from torchrl_bmrl.names import TASKS
from torchrl_bmrl.reports import paper

MISSING = "–"
"""Cell of a number that was not measured."""

_POLICY_NAMES = {
    "expert": "Expert",
    "bcq": "BCQ",
    "distilled": "Distilled",
    "bc": "BC",
    "td3_bc": "TD3+BC",
    "iql": "IQL",
    "cql": "CQL",
    "bcq_one_hot": "BCQ, one-hot task",
}


@dataclass(frozen=True, kw_only=True)
class Table:
    r"""A table of text, ready to be written in three ways.

    Args:
        title: What the table shows, in a few words.
        caption: What a reader must know to read it.
        header: Names of the columns.
        rows: Cells, one string for each column.

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
        """The table as Markdown: title, caption, and a table with numbers to the right.

        Args:
            level: of the title among the headings.
        """
        rule = ["---:" if self._is_numeric(column) else ":---" for column in range(self._width)]
        lines = [self.header, rule, *self.rows]
        cells = ["| " + " | ".join(c.replace("|", "\\|") for c in line) + " |" for line in lines]
        return "\n".join([f"{'#' * level} {self.title}", "", self.caption, "", *cells, ""])

    def csv(self) -> str:
        """Header and rows as CSV, without title and caption."""
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([self.header, *self.rows])
        return text.getvalue()

    def html(self) -> str:
        """The table as an HTML figure; every text is escaped."""
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


def task_name(task: str) -> str:
    """A task's name as the paper prints it.

    Args:
        task: one of :data:`torchrl_bmrl.names.TASKS`.

    Example:
        >>> task_name("push_left")
        'Push Left'
    """
    return task.replace("_", " ").title()


def policy_name(policy: str) -> str:
    """A policy's name as tables print it.

    Example:
        >>> policy_name("td3_bc")
        'TD3+BC'
    """
    return _POLICY_NAMES[policy]


def results_table(summaries: Sequence[Summary]) -> Table:
    """Everything that was evaluated: one line per task, policy and source of m.

    Args:
        summaries: What :func:`torchrl_bmrl.evaluation.summarise` returns.

    Example:
        >>> results_table([]).header[:4]
        ('Task', 'Policy', 'Source of m', 'Mean return')
    """
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
                task_name(s.task),
                policy_name(s.policy),
                s.latent_source,
                f"{s.mean_return:.1f}",
                f"[{s.return_interval[0]:.1f}, {s.return_interval[1]:.1f}]",
                f"{s.std_return:.1f}",
                f"{s.success_rate:.0%}",
                f"[{s.success_interval[0]:.0%}, {s.success_interval[1]:.0%}]",
                str(s.episodes),
                str(s.seeds),
            )
            for s in summaries
        ],
    )


def table_1(
    summaries: Sequence[Summary],
    *,
    epochs: Mapping[str, int] | None = None,
    differences: Mapping[str, Estimate] | None = None,
) -> Table:
    """The paper's Table 1, expert against BCQ, beside the measured returns.

    Args:
        summaries: What :func:`torchrl_bmrl.evaluation.summarise` returns.
        epochs: Stage-1 epochs trained here, by task.
        differences: Relative difference of BCQ to the expert by task, whose interval is printed.

    Example:
        >>> table_1([]).rows[0][:5]
        ('Reach', '119.07', '151.16', '127%', '100')
    """
    found = _by_key(summaries)
    rows = []
    for task in TASKS:
        printed = paper.TABLE_1[task]
        expert, bcq = found.get((task, "expert", "")), found.get((task, "bcq", ""))
        rows.append(
            (
                task_name(task),
                f"{printed.expert_return:.2f}",
                f"{printed.bcq_return:.2f}",
                f"{printed.bcq_return / printed.expert_return:.0%}",
                str(printed.epochs),
                _mean_return(expert),
                _mean_return(bcq),
                _share(bcq, expert, (differences or {}).get(task)),
                str((epochs or {}).get(task, MISSING)),
                _success(bcq),
            )
        )
    return Table(
        title="Table 1: stage 1, one BCQ policy per task",
        caption=(
            "Mean return over 200 steps of the scripted expert and of the BCQ policy trained on "
            "its demonstrations; paper beside this run. Simulator and experts differ, and the "
            "number of demonstrations may, so compare the shares rather than the returns. An "
            "epoch is a stretch of training between two evaluations; its length differs as well."
        ),
        header=(
            "Task",
            "Paper: expert",
            "Paper: BCQ",
            "Paper: BCQ/expert",
            "Paper: epochs",
            "Here: expert",
            "Here: BCQ",
            "Here: BCQ/expert",
            "Here: epochs",
            "Here: BCQ success",
        ),
        rows=rows,
    )


def table_2(
    summaries: Sequence[Summary],
    *,
    default_source: str,
    differences: Mapping[str, Estimate] | None = None,
) -> Table:
    """The paper's Table 2, the distilled policy against BCQ, beside the measured returns.

    Args:
        summaries: What :func:`torchrl_bmrl.evaluation.summarise` returns.
        default_source: Source of m whose columns come first; every other one found follows.
        differences: Relative difference to BCQ by task, with the default source, whose interval is
            printed.

    Example:
        >>> table_2([], default_source="prototype").rows[0]
        ('Reach', '105.13', '70%*', '–', '–', '–')
    """
    found = _by_key(summaries)
    present = {s.latent_source for s in summaries if s.policy == "distilled"}
    sources = [default_source, *sorted(present - {default_source})]
    rows = []
    for task in TASKS:
        bcq = found.get((task, "bcq", ""))
        cells = [
            task_name(task),
            f"{paper.TABLE_2[task].distilled_return:.2f}",
            paper.TABLE_2[task].printed_percent,
        ]
        for source in sources:
            distilled = found.get((task, "distilled", source))
            interval = (differences or {}).get(task) if source == default_source else None
            share = _share(distilled, bcq, interval)
            cells += [_mean_return(distilled), share, _success(distilled)]
        rows.append(tuple(cells))
    measured = [
        f"{source}: {column}" for source in sources for column in ("return", "% of BCQ", "success")
    ]
    return Table(
        title="Table 2: stage 2, one distilled policy for all tasks",
        caption=(
            "Mean return over 200 steps of the distilled policy, and its share of the return of "
            "the BCQ policy that it was distilled from; paper beside this run. Here the columns "
            "are named after the source of the task embedding m that drives the policy; "
            f"{default_source} is the default. The paper's percentages are as printed, under the "
            "heading “% Change” (its returns give 117% for lift and 97% for push up); * marks, in "
            "the paper, a lower return with the task still solved."
        ),
        header=("Task", "Paper: return", "Paper: % of BCQ", *measured),
        rows=rows,
    )


def stages_table(results: Sequence[StageResult]) -> Table:
    """Groups found without labels against the experts' recorded phases.

    Args:
        results: What :func:`torchrl_bmrl.reports.measure_stages` returns.

    Example:
        >>> stages_table([]).header[:2]
        ('Task', 'Phases')
    """
    names = _representations([r.agreement for r in results])
    return Table(
        title="Stages found without labels",
        caption=(
            "Adjusted mutual information of the groups that a mixture of Gaussians finds in a "
            "task's transitions and the phases that the expert recorded: 1 where either tells the "
            "other, 0 by chance. Groups, as many as phases, are fitted to the training "
            "demonstrations and named on the held-out ones, of each successful episode until half "
            "a second after its first success. "
            "Brackets hold 95% bootstrap intervals over episodes. Beside the embedding, the same "
            "of what the encoder reads (the normalised transition) and of an encoder that was "
            "never trained."
        ),
        header=("Task", "Phases", *map(str.capitalize, names), "Episodes", "Transitions"),
        rows=[
            (
                task_name(r.task),
                ", ".join(r.phases),
                *(str(r.agreement[name]) for name in names),
                str(r.episodes),
                str(r.transitions),
            )
            for r in results
        ],
    )


def goal_distance_table(results: Sequence[GoalDistanceResult]) -> Table:
    """Distances to the success point in the embedding against distances to the goal.

    Args:
        results: What :func:`torchrl_bmrl.reports.measure_goal_distance` returns.

    Example:
        >>> goal_distance_table([]).header[0]
        'Task'
    """
    names = _representations([r.correlation for r in results])
    return Table(
        title="Distance to the goal in the embedding",
        caption=(
            "Spearman's correlation of a transition's distance to its task's success point (the "
            "mean over first successes in the training demonstrations) and the end effector's "
            "distance to the goal, in each held-out episode up to its first success: mean over "
            "episodes, 95% bootstrap interval over episodes, and the lowest episode. Beside the "
            "embedding, the same of what the encoder reads and of an encoder that was never "
            "trained. Spread: how far apart the episodes lie in the embedding at their first "
            "success, over how far apart they lie at their start; below 1 they come together."
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
                task_name(r.task),
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
    """Names of what was measured, in the order in which they were."""
    return list(dict.fromkeys(name for result in results for name in result))


def _by_key(summaries: Sequence[Summary]) -> dict[tuple[str, str, str], Summary]:
    return {(s.task, s.policy, s.latent_source): s for s in summaries}


def _mean_return(summary: Summary | None) -> str:
    return MISSING if summary is None else f"{summary.mean_return:.1f}"


def _success(summary: Summary | None) -> str:
    return MISSING if summary is None else f"{summary.success_rate:.0%}"


def _share(
    summary: Summary | None, reference: Summary | None, difference: Estimate | None = None
) -> str:
    if summary is None or reference is None or reference.mean_return <= 0.0:
        return MISSING
    share = f"{summary.mean_return / reference.mean_return:.1%}"
    if difference is None:
        return share
    return f"{share} [{100 * (1 + difference.low):.1f}, {100 * (1 + difference.high):.1f}]"


def _has_digit(text: str) -> bool:
    return any(map(str.isdigit, text))
