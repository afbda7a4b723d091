"""Studies of held-out members of several runs, put together: training seeds, and families."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

from torchrl_bmrl.errors import BMRLError, ConfigError, DataError
from torchrl_bmrl.evaluation.results import name
from torchrl_bmrl.families import SPLITS, registered_families
from torchrl_bmrl.pipeline.settings import Settings
from torchrl_bmrl.reports import Table
from torchrl_bmrl.rows import finite, one_of, or_nothing, read_rows, whole
from torchrl_bmrl.run.folder import deciding, read_settings
from torchrl_bmrl.run.settings import check_settings
from torchrl_bmrl.studies.families import METHODS, FamilySettings
from torchrl_bmrl.studies.families_line import COLUMNS as LINE_COLUMNS
from torchrl_bmrl.studies.families_line import LINES, line_table
from torchrl_bmrl.studies.families_report import make_tables
from torchrl_bmrl.tasks import FAMILIES

_COLUMNS: dict[str, Any] = {
    "family": name,
    "method": one_of(*METHODS),
    "split": one_of(*SPLITS[1:]),
    "member": name,
    "episode": whole,
    "return": finite,
    "success": one_of("", "0", "1"),
    "data_return": or_nothing,
}


@dataclass(frozen=True, kw_only=True)
class FinishedStudy:
    """What a run's study of held-out members has written.

    Attributes:
        run_dir: folder of the run.
        family: name of the run's family.
        seed: training seed of the run.
        settings: all others that decide the results, of the run and of the study, by dotted names.
        rows: of ``families/results.csv``, with a column ``run``.
        lines: of ``families/lines.csv``, the same; none if there is no such file.
    """

    run_dir: Path
    family: str
    seed: int
    settings: Mapping[str, Any]
    rows: Sequence[Mapping[str, Any]]
    lines: Sequence[Mapping[str, Any]]

    @property
    def methods(self) -> list[str]:
        """Names of the methods that were compared."""
        return list(self.settings["families.methods"])


def read_study(run_dir: str | Path) -> FinishedStudy:
    """Reads a finished study of held-out members.

    Args:
        run_dir: folder of the run.

    Raises:
        DataError: naming the file that is missing or damaged, or lacks an episode.
    """
    run_dir = Path(run_dir)
    folder = run_dir / FamilySettings.folder
    settings = deciding(asdict(Settings())) | deciding(read_settings(run_dir))
    seed = settings.pop("seed")
    of_study = asdict(FamilySettings()) | read_settings(folder)
    known = {key: x for key, x in of_study.items() if key in asdict(FamilySettings())}
    try:
        check_settings(FamilySettings(**known), "families.")
        if not isinstance(known["episodes"], int):
            raise ConfigError(f"families.episodes is {known['episodes']}; valid: a whole number")
    except BMRLError as error:
        raise DataError(folder / "config.yaml", None, str(error)) from error
    study = {f"families.{key}": x for key, x in deciding(of_study).items()}
    path = folder / "results.csv"
    rows = read_rows(path, _COLUMNS)
    families = {row["family"] for row in rows}
    if len(families) != 1:
        raise DataError(path, "family", f"has {len(families)} names; valid: one")
    members = {(row["split"], row["member"]) for row in rows}
    found = [(row["method"], row["split"], row["member"], row["episode"]) for row in rows]
    numbers = range(study["families.episodes"])
    wanted = [(x, *y, i) for x, y, i in product(study["families.methods"], members, numbers)]
    for method, _, member, episode in sorted(set(wanted) ^ set(found)):
        raise DataError(
            path,
            "episode",
            f"episode {episode} of {member} with method {method} is missing, or not of the settings"
            f" in {folder.name}/config.yaml; recipes/families.py writes both",
        )
    if len(found) > len(wanted):
        raise DataError(path, "episode", "an episode is there twice; valid: once")
    path = folder / "lines.csv"
    lines = read_rows(path, LINE_COLUMNS) if path.exists() else []
    for code in LINES if lines else ():
        if not any(row["code"] == code and 0.25 <= row["share"] <= 0.75 for row in lines):
            message = f"no row of {code} in the middle of a line; recipes/families.py writes them"
            raise DataError(path, "code", message)
    return FinishedStudy(
        run_dir=run_dir,
        family=families.pop(),
        seed=seed,
        settings=settings | study,
        rows=[{"run": str(run_dir), **row} for row in rows],
        lines=[{"run": str(run_dir), **row} for row in lines],
    )


def combine(run_dirs: Sequence[str | Path]) -> dict[str, Table]:
    """Tables over finished studies: of each family over its training seeds, and over the families.

    Args:
        run_dirs: folders of the runs. Those of one family differ in their seed alone.

    Returns:
        the tables by the names of their files.

    Raises:
        BMRLError: naming a file that is missing or damaged; and for two runs of one family that
            have the same seed, or differ in another setting.
    """
    if not run_dirs:
        raise ConfigError("no runs are given; valid: folders of finished runs")
    studies: dict[str, list[FinishedStudy]] = {}
    for run_dir in run_dirs:
        study = read_study(run_dir)
        others = studies.setdefault(study.family, [])
        for other in others:
            check_comparable(other, study)
        others.append(study)
    tables: dict[str, Table] = {}
    for family, runs in studies.items():
        title = FAMILIES[family].title if family in registered_families() else family
        titles = {name: METHODS[name] for name in runs[0].methods}
        rows = [row for run in runs for row in run.rows]
        seeds = f" Training seeds: {', '.join(str(run.seed) for run in runs)}."
        found = make_tables(title, titles, rows)
        if all(run.lines for run in runs):
            found["_lines"] = line_table(title, [row for run in runs for row in run.lines])
        tables |= {f"{family}{end}": _noted(table, seeds) for end, table in found.items()}
    if len(studies) > 1:
        every = [run for runs in studies.values() for run in runs]
        common = [name for name in METHODS if all(name in run.methods for run in every)]
        rows = [row for run in every for row in run.rows]
        note = f" Means over the families {', '.join(studies)}, which count the same."
        found = make_tables(f"{len(studies)} families", {x: METHODS[x] for x in common}, rows)
        tables |= {f"all{end}": _noted(table, note) for end, table in found.items()}
    return tables


def check_comparable(first: FinishedStudy, second: FinishedStudy) -> None:
    """Checks that two runs of one family differ in their seed alone.

    Args:
        first: a run's study.
        second: that of another run.

    Raises:
        ConfigError: naming what they have in common, or what differs.
    """
    one, two = first.run_dir, second.run_dir
    if first.seed == second.seed:
        raise ConfigError(f"{two}: seed is {second.seed} as in {one}; valid: another seed")
    for key in sorted({*first.settings, *second.settings}):
        mine, theirs = (study.settings.get(key) for study in (second, first))
        if mine != theirs:
            raise ConfigError(
                f"{two}: {key} is {mine} here and {theirs} in {one}; valid: runs of one family "
                "that differ in their seed alone"
            )
    members = [{row["member"] for row in study.rows} for study in (first, second)]
    for member in sorted(members[0] ^ members[1]):
        raise ConfigError(f"{member} is in one of {one} and {two}; valid: runs with equal members")


def _noted(table: Table, note: str) -> Table:
    return Table(
        title=table.title, caption=table.caption + note, header=table.header, rows=table.rows
    )
