"""Command line of the data formats.

python -m torchrl_bmrl.data check FILE
python -m torchrl_bmrl.data convert SOURCE OUT --to robomimic|minari|lerobot
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

import torchrl_bmrl.as_command  # noqa: F401 (first)
from torchrl_bmrl.command_line import exit_codes
from torchrl_bmrl.data.convert import TARGETS, Source, convert, open_source
from torchrl_bmrl.data.episodes import Episode
from torchrl_bmrl.data.robosuite import Relabelling
from torchrl_bmrl.data.schema import Summary, summarise
from torchrl_bmrl.extras import needs
from torchrl_bmrl.names import TASKS

with needs("data"):
    from tqdm import tqdm


def describe(path: Path, source: Source, summary: Summary) -> Iterator[str]:
    """Lines that tell a reader what a data set holds."""
    count, steps = len(summary.lengths), sum(summary.lengths)
    yield f"{path}: {source.format}, {count} episodes, {steps:,} steps"
    if count:
        shortest, longest = min(summary.lengths), max(summary.lengths)
        lengths = f"{shortest}" if shortest == longest else f"{shortest} to {longest}"
        returns = np.array(summary.returns)
        yield f"  steps an episode  {lengths}"
        yield (
            f"  return            {returns.mean():.1f} on average, "
            f"{returns.min():.1f} to {returns.max():.1f}"
        )
        known = len(summary.successes)
        success = f"{sum(summary.successes)} of {known}" if known else "not recorded"
        yield f"  success           {success}"
        yield (
            f"  ends              {count - summary.terminated} truncated, "
            f"{summary.terminated} terminated"
        )
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


def check(options: argparse.Namespace) -> int:
    """Prints a summary, the warnings and everything that is wrong; 1 if something is."""
    relabelled = []
    with open_source(options.file, task=options.task, tracking=options.tracking) as source:
        with tqdm(total=len(source.episodes), unit="episode", delay=2, leave=False) as bar:

            def look(name: str, episode: Episode | None) -> None:
                if source.format == "robosuite" and episode is not None:
                    relabelled.append(describe_relabelling(Relabelling.of(name, episode)))
                bar.update()

            summary = summarise(
                source.episodes, prefix=source.prefix, bounds=source.bounds, look=look
            )
        summary.problems = [*source.problems, *summary.problems]
        summary.warnings = [*source.oddities, *summary.warnings]
        print("\n".join(describe(options.file, source, summary)))
    if relabelled:
        print("\n".join([RELABELLED, *relabelled]))
    for warning in summary.warnings:
        print(f"warning: {warning}")
    for key, message in summary.problems:
        print(f"error: {options.file}: {key}: {message}", file=sys.stderr)
    if summary.problems:
        print(f"wrong: {len(summary.problems)}", file=sys.stderr)
    return 1 if summary.problems else 0


def convert_command(options: argparse.Namespace) -> int:
    """Converts under a progress bar."""
    with tqdm(unit="episode", delay=2, leave=False) as bar:
        convert(
            options.source,
            options.out,
            to=options.to,
            task=options.task,
            tracking=options.tracking,
            split=options.split,
            fps=options.fps,
            report=bar.update,
        )
    print(f"{options.out}: {options.to}, {bar.n} episodes")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; an expected error becomes one line and exit code 1."""
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_bmrl.data",
        description="Demonstrations of robomimic, robosuite, Minari and LeRobot.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "--task", choices=TASKS, help="the task in whose scene a robosuite demo.hdf5 was recorded"
    )
    shared.add_argument(
        "--tracking",
        type=float,
        default=1.0,
        help="share of a commanded delta that the arm covers in one step (robosuite files)",
    )
    parts = commands.add_parser(
        "check",
        parents=[shared],
        help="what a data set holds, and everything that is wrong with it",
    )
    parts.add_argument("file", type=Path, help="HDF5 file, or folder of a Minari data set")
    parts.set_defaults(run=check)
    parts = commands.add_parser("convert", parents=[shared], help="write it in another format")
    parts.add_argument("source", type=Path, help="HDF5 file, or folder of a Minari data set")
    parts.add_argument("out", type=Path, help="new file (robomimic) or folder (minari, lerobot)")
    parts.add_argument("--to", choices=TARGETS, required=True)
    parts.add_argument("--split", help="one mask's episodes of a file in robomimic's layout")
    parts.add_argument("--fps", type=float, help="steps per second, where the source tells none")
    parts.set_defaults(run=convert_command)
    options = parser.parse_args(arguments)
    with exit_codes():
        return options.run(options)


if __name__ == "__main__":
    sys.exit(main())
