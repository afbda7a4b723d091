"""Command line of the data formats.

python -m torchrl_bmrl.data check FILE
python -m torchrl_bmrl.data convert SOURCE [SOURCE ...] OUT --to robomimic|minari|lerobot
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_args

import numpy as np

import torchrl_bmrl.run.as_command  # noqa: F401 (first)
from torchrl_bmrl.data.convert import TARGETS, convert
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.options import LastStep, ReadOptions, Reward
from torchrl_bmrl.data.robosuite import Relabelling
from torchrl_bmrl.data.sources import Source, open_source
from torchrl_bmrl.data.summary import Summary, summarise
from torchrl_bmrl.files import printable
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.run.progress import progress


def describe(source: Source, summary: Summary) -> Iterator[str]:
    """Yields the lines that describe a data set."""
    count, account = len(summary.lengths), summary.account
    yield f"{source.path}: {source.format}, {count} episodes, {sum(summary.lengths):,} steps"
    if wrong := len(source.episodes) - count:
        yield f"  not counted       {wrong} episodes with faults"
    if count:
        yield f"  in the file       {account.whole}"
        yield f"  read              {account.read}"
        left = [str(tally) for tally in (account.cut, account.failed) if tally.steps]
        yield f"  left out          {' and '.join(left) or 'nothing'}"
        shortest, longest = min(summary.lengths), max(summary.lengths)
        lengths = f"{shortest}" if shortest == longest else f"{shortest} to {longest}"
        returns = np.array(summary.returns)
        yield f"  steps an episode  {lengths}"
        yield (
            f"  return            {returns.mean():.6g} on average, "
            f"{returns.min():.6g} to {returns.max():.6g}"
        )
        known, failed = len(summary.successes), summary.failed
        named = f"; not in {', '.join(failed)}" if failed else ""
        success = f"{sum(summary.successes)} of {known}{named}" if known else "not recorded"
        yield f"  success           {success}"
        yield (
            f"  ends              {count - summary.terminated} truncated, "
            f"{summary.terminated} terminated"
        )
    if "action_bounds" in source.metadata:
        yield f"  action bounds     {source.bounds[0]} to {source.bounds[1]}: the loss's, too"
    for mask, names in source.metadata.get("masks", {}).items():
        yield f"  mask {mask:<12} {len(names)} episodes"
    yield ""
    width = max([5, *map(len, summary.ranges)])
    yield f"  {'array':<{width}}  {'dtype':<8} {'row':>10} {'lowest':>10} {'highest':>10}"
    for key, extent in summary.ranges.items():
        shape = "x".join(map(str, np.shape(extent.low))) or "1"
        low, high = np.min(extent.low), np.max(extent.high)
        yield f"  {key:<{width}}  {extent.dtype:<8} {shape:>10} {low:>10.4g} {high:>10.4g}"


RELABELLED = """
  relabelled     steps  rows  duration   lifted  held at end  action error  model error"""


def describe_relabelling(row: Relabelling) -> str:
    """One line of the table under :data:`RELABELLED`."""
    return (
        f"  {row.name:<13} {row.steps:>6} {row.recorded_rows:>5} {row.duration:>7.2f} s "
        f"{100 * row.lift_height:>5.1f} cm {'yes' if row.grasped_at_end else 'no':>12} "
        f"{1000 * row.action_error:>10.2f} mm {1000 * row.model_error:>9.2f} mm"
    )


def reading(options: argparse.Namespace) -> dict[str, Any]:
    """The options for reading a source."""
    names = [field.name for field in fields(ReadOptions)]
    return {name: getattr(options, name) for name in [*names, "task", "tracking"]}


def check(options: argparse.Namespace) -> int:
    """Prints a summary, warnings and faults; returns 1 if there are faults."""
    relabelled = []
    with open_source(options.file, **reading(options)) as source:
        with progress(len(source.episodes), "reading", "episode", delay=2, leave=False) as bar:

            def look(name: str, episode: Episode | None) -> None:
                if source.format == "robosuite" and episode is not None:
                    relabelled.append(describe_relabelling(Relabelling.of(name, episode)))
                bar.update()

            summary = summarise(
                source.episodes,
                prefix=source.prefix,
                bounds=source.bounds,
                account=source.account,
                options=source.options,
                look=look,
            )
        summary.problems = [*source.problems, *summary.problems]
        summary.warnings = [*source.oddities, *summary.warnings]
        print("\n".join(map(printable, describe(source, summary))))
    if relabelled:
        print("\n".join([RELABELLED, *map(printable, relabelled)]))
    for warning in summary.warnings:
        print(printable(f"warning: {warning}"))
    for key, message in summary.problems:
        print(printable(f"error: {options.file}: {key}: {message}"), file=sys.stderr)
    if summary.problems:
        print(f"wrong: {len(summary.problems)}", file=sys.stderr)
    return 1 if summary.problems else 0


def convert_command(options: argparse.Namespace) -> int:
    """Converts with a progress bar."""
    with progress(None, "converting", "episode", delay=2, leave=False) as bar:
        done = convert(
            options.source,
            options.out,
            to=options.to,
            fps=options.fps,
            report=bar.update,
            **reading(options),
        )
    print(f"{options.out}: {options.to}, {done.account.read}")
    for note in done.notes:
        print(printable(f"warning: {note}"))
    return 0


def reading_options() -> argparse.ArgumentParser:
    """Parser of the options that all commands share."""
    parser = argparse.ArgumentParser(add_help=False)
    group = parser.add_argument_group("how the source is read")
    group.add_argument("--split", help="one mask's episodes (robomimic's layout)")
    group.add_argument(
        "--observation-keys", nargs="+", metavar="KEY", help="parts of the observation; else all"
    )
    group.add_argument(
        "--last-step",
        choices=get_args(LastStep),
        help="treatment of a last step without an observation after it: leave it out (drop), or "
        "keep it, repeat its observation, and bootstrap (truncate) or not (terminate)",
    )
    group.add_argument(
        "--dones-terminate", action="store_true", help="dones at the last step is a termination"
    )
    group.add_argument(
        "--reward",
        choices=get_args(Reward),
        help="1 for a solved task, or at each last step, instead of the file's rewards",
    )
    group.add_argument(
        "--successful", action="store_true", help="leave out the episodes that did not succeed"
    )
    group.add_argument(
        "--bounds",
        nargs="+",
        type=_number_or_data,
        action=_Bounds,
        metavar=("LOW", "HIGH"),
        help="of actions, or `data` for their range; by default those of the source, or -1 1",
    )
    group.add_argument(
        "--horizon", type=int, help="steps of the longest episode (D4RL's files without timeouts)"
    )
    group.add_argument(
        "--task", help="the task in whose scene a robosuite demo.hdf5 was recorded, such as lift"
    )
    group.add_argument(
        "--tracking",
        type=float,
        default=1.0,
        help="share of a commanded delta that the arm covers in one step (robosuite files)",
    )
    return parser


def _number_or_data(text: str) -> float | str:
    return text if text == "data" else float(text)


class _Bounds(argparse.Action):
    """Two numbers, or ``data``."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option: Any = None) -> None:
        pair = len(values) == 2 and "data" not in values
        if not pair and values != ["data"]:
            parser.error(f"argument {option}: valid: LOW HIGH, or data")
        namespace.bounds = tuple(values) if pair else "data"


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line; an expected error prints one line and returns exit code 1."""
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_bmrl.data",
        description="Demonstrations of robomimic, robosuite, Isaac Lab, Minari, D4RL and LeRobot.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    shared = [reading_options()]
    source = "HDF5 file, or folder of a Minari or LeRobot data set"
    parts = commands.add_parser(
        "check", parents=shared, help="summarise a data set, and list its faults"
    )
    parts.add_argument("file", type=Path, help=source)
    parts.set_defaults(run=check)
    parts = commands.add_parser("convert", parents=shared, help="write it in another format")
    parts.add_argument("source", type=Path, nargs="+", help=f"{source}; several become one")
    parts.add_argument("out", type=Path, help="new file (robomimic) or folder (minari, lerobot)")
    parts.add_argument("--to", choices=TARGETS, required=True)
    parts.add_argument("--fps", type=float, help="steps per second, if not the source's")
    parts.set_defaults(run=convert_command)
    options = parser.parse_args(arguments)
    with exit_codes(saves=False):
        return options.run(options)


if __name__ == "__main__":
    sys.exit(main())
