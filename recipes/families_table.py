"""Puts the results of several runs of recipes/families.py together in one set of tables.

    python recipes/families_table.py runs/push-0 runs/push-1 runs/push-2     # three training seeds
    python recipes/families_table.py runs/push-* runs/lift-* --out tables    # and two families

Prints the tables as Markdown. With --out they are also written, as Markdown and CSV
(docs/families.md).
"""

from __future__ import annotations

import torchrl_bmrl.run.as_command  # noqa: F401 (first: it turns errors at import into one line)

# isort: split
import argparse
import os
from pathlib import Path

os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

from torchrl_bmrl.files import write_atomic
from torchrl_bmrl.run.command_line import exit_codes
from torchrl_bmrl.studies.families_runs import combine


def read_options(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs")
    parser.add_argument("--out", type=Path, help="folder for the tables")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    options = read_options(arguments)
    with exit_codes(saves=False):
        for name, table in combine(options.runs).items():
            if options.out:
                write_atomic(options.out / f"{name}.md", table.markdown())
                write_atomic(options.out / f"{name}.csv", table.csv())
            print(table.markdown())


if __name__ == "__main__":
    main()
