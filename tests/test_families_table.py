"""Tables of held-out members over several training seeds and families."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("hydra")
pytest.importorskip("h5py")
pytest.importorskip("scipy")
pytest.importorskip("yaml")

import yaml
from small_runs import RECIPES

from torchrl_bmrl.errors import BMRLError, ConfigError, DataError
from torchrl_bmrl.evaluation.clusters import clustered_ratio
from torchrl_bmrl.rows import write_rows
from torchrl_bmrl.studies.families import METHODS
from torchrl_bmrl.studies.families_report import make_tables
from torchrl_bmrl.studies.families_runs import combine, read_study

MEMBERS = {"inside": ("a", "b", "c"), "outside": ("d", "e")}
EPISODES = 2
SOME = ("told", "demonstration", "one_shot", "teacher")
Edit = Callable[[Path], object]


def values(seed: int, *, scale: float = 1.0) -> list[dict[str, Any]]:
    """Rows of a study: demonstrations return 100, and policies a share of it that varies."""
    rng = np.random.default_rng(seed)
    share = dict(zip(SOME, (1.0, 0.9, 0.8, 0.7), strict=True))
    return [
        {
            "method": method,
            "split": split,
            "member": member,
            "episode": i,
            "return": scale * (100 * share[method] + rng.normal()),
            "success": int(rng.random() < share[method]),
            "family": "walks",
            "data_return": scale * 100.0,
        }
        for method in SOME
        for split, members in MEMBERS.items()
        for member in members
        for i in range(EPISODES)
    ]


def write_run(
    folder: Path,
    seed: int,
    *,
    rows: list[dict[str, Any]] | None = None,
    study: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Path:
    """A run folder with a finished study."""
    (folder / "families").mkdir(parents=True)
    (folder / "config.yaml").write_text(yaml.safe_dump({"seed": seed, "run_dir": "x"} | settings))
    of_study = {"episodes": EPISODES, "demonstrations": 1, "methods": list(SOME)} | (study or {})
    (folder / "families" / "config.yaml").write_text(yaml.safe_dump(of_study))
    write_rows(folder / "families" / "results.csv", rows or values(seed))
    return folder


def write_lines(folder: Path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    write_rows(
        folder / "families" / "lines.csv",
        [
            {
                "code": code,
                "start": "a",
                "end": "d",
                "share": share,
                "measured": share + 0.1 * rng.normal(),
                "episode": i,
            }
            for code in ("m", "one_hot")
            for share in np.linspace(0, 1, 9).tolist()
            for i in range(EPISODES)
        ],
    )


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    return [write_run(tmp_path / f"run{seed}", seed) for seed in range(3)]


def cells(table: Any, split: str, method: str) -> dict[str, str]:
    (row,) = (each for each in table.rows if each[:2] == [split, METHODS[method]])
    return dict(zip(table.header, row, strict=True))


def test_runs_of_one_family_are_put_together(runs: list[Path]) -> None:
    found = combine(runs)
    assert list(found) == ["walks", "walks_shares", "walks_differences"]
    episodes = [
        row["return"]
        for run in runs
        for row in read_study(run).rows
        if (row["split"], row["method"]) == ("inside", "teacher")
    ]
    row = cells(found["walks"], "inside", "teacher")
    assert row["Episodes"] == "18"
    assert row["Return"] == f"{np.mean(episodes):.1f}"
    assert row["Success"].endswith("%]")
    for table in found.values():
        assert "Training seeds: 0, 1, 2." in table.caption
        assert "the variation over training seeds and members" in table.caption
        assert [row[:2] for row in table.rows] == [
            [split, METHODS[method]] for split in MEMBERS for method in SOME
        ]


def test_one_run_tells_nothing_of_other_training_seeds(runs: list[Path]) -> None:
    for table in combine(runs[:1]).values():
        assert "the variation over members" in table.caption


def test_shares_and_differences_are_paired_by_run_member_and_episode(runs: list[Path]) -> None:
    found = combine(list(reversed(runs)))  # rows of the runs are matched, in whatever order
    studies = [read_study(run) for run in runs]

    def column(method: str, name: str = "return") -> dict[Any, float]:
        return {
            (row["run"], row["member"], row["episode"]): row[name]
            for study in studies
            for row in study.rows
            if (row["split"], row["method"]) == ("inside", method)
        }

    told, mine, other = (column(name) for name in ("told", "demonstration", "teacher"))
    keys = sorted(told)
    labels = {"runs": [key[0] for key in keys], "members": [key[1] for key in keys]}
    share = clustered_ratio([mine[x] for x in keys], [told[x] for x in keys], **labels)
    row = cells(found["walks_shares"], "inside", "demonstration")
    assert row["Return / told"] == str(share)
    assert row["Return / data"] == str(
        clustered_ratio([mine[x] for x in keys], [100.0] * len(keys), **labels)
    )
    less = clustered_ratio([mine[x] - other[x] for x in keys], [told[x] for x in keys], **labels)
    row = cells(found["walks_differences"], "inside", "teacher")
    assert row["Demonstration minus this"] == str(less)
    assert row["One-shot minus this"].startswith("0.1")


def test_a_policy_is_not_compared_with_itself(runs: list[Path]) -> None:
    table = combine(runs)["walks_differences"]
    assert cells(table, "inside", "demonstration")["Demonstration minus this"] == "–"
    assert cells(table, "inside", "one_shot")["One-shot minus this"] == "–"


def test_without_a_policy_that_is_told_differences_are_shares_of_the_demonstration() -> None:
    rows = [row for row in values(0, scale=3.0) if row["method"] != "told"]
    names = {name: METHODS[name] for name in SOME}
    found = make_tables("walks", names, rows)
    assert cells(found["_shares"], "inside", "teacher")["Return / told"] == "–"
    assert cells(found["_shares"], "inside", "teacher")["Return / data"].startswith("0.7")
    difference = cells(found["_differences"], "inside", "teacher")["Demonstration minus this"]
    assert 0.18 < float(difference.split()[0]) < 0.22
    for row in rows:  # as for tasks without an expert
        row["data_return"] = ""
    found = make_tables("walks", names, rows)
    assert set(cells(found["_differences"], "inside", "teacher").values()) >= {"–"}
    assert cells(found["_shares"], "inside", "teacher")["Return / data"] == "–"


@pytest.mark.parametrize("told", [-1.0, 0.0])
def test_a_table_has_no_share_of_what_is_not_above_zero(told: float) -> None:
    def row(method: str, value: float) -> dict[str, Any]:
        first = {"method": method, "split": "inside", "member": "a", "episode": 0}
        return first | {"return": value, "success": "", "data_return": 0.5}

    names = {"told": "told", "teacher": "agent"}
    found = make_tables("x", names, [row("told", told), row("teacher", 1.0)])
    assert found["_shares"].rows[1] == ["inside", "agent", "–", "2.00 [2.00, 2.00]"]
    assert found[""].rows[1] == ["inside", "agent", "1.0", "–", "1"]


def test_several_families_get_tables_of_their_own_and_means_that_count_them_alike(
    runs: list[Path], tmp_path: Path
) -> None:
    other = [row | {"family": "jumps"} for row in values(7, scale=1000.0)]
    methods = ["told", "demonstration", "one_shot"]
    other = [row for row in other if row["method"] in methods]
    jumps = write_run(tmp_path / "j", 0, rows=other, study={"methods": methods}, tasks=["jumps"])
    found = combine([*runs, jumps])
    names = ("walks", "jumps", "all")
    ends = ("", "_shares", "_differences")
    assert list(found) == [f"{name}{end}" for name in names for end in ends]
    each = [
        float(cells(found[f"{name}_shares"], "inside", "demonstration")["Return / told"].split()[0])
        for name in names
    ]
    assert each[2] == pytest.approx(np.mean(each[:2]), abs=0.011)
    table = found["all"]
    assert {row[1] for row in table.rows} == {METHODS[name] for name in methods}  # common to both
    assert cells(table, "inside", "told")["Return"] == "–"  # returns of families differ in scale
    assert "walks, jumps" in table.caption


def test_lines_between_members_are_put_together_if_every_run_has_them(runs: list[Path]) -> None:
    for seed, run in enumerate(runs[:-1]):
        write_lines(run, seed)
    assert "walks_lines" not in combine(runs)
    write_lines(runs[-1], 2)
    table = combine(runs)["walks_lines"]
    assert [row[-2:] for row in table.rows] == [["3", "54"]] * 2  # a line of each run


def test_a_row_fits_into_a_narrow_terminal() -> None:
    rows = [
        row | {"method": method, "return": 0.9 * row["return"]}
        for method in METHODS
        for row in values(0)
        if row["method"] == "teacher"
    ]
    for table in make_tables("walks", METHODS, rows).values():
        lines = [line for line in table.markdown().splitlines() if line.startswith("|")]
        assert len(lines) == 2 + 2 * len(METHODS)
        assert max(map(len, lines)) <= 100


def edit_rows(change: Callable[[list[dict[str, str]]], object]) -> Edit:
    def edit(folder: Path) -> None:
        path = folder / "families" / "results.csv"
        with path.open() as file:
            rows = list(csv.DictReader(file))
        change(rows)
        write_rows(path, rows)

    return edit


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        (lambda f: (f / "config.yaml").unlink(), r"run1/config.yaml: no such file"),
        (lambda f: (f / "families/config.yaml").unlink(), r"families/config.yaml: no such file"),
        (lambda f: (f / "families/results.csv").unlink(), r"results.csv: no such file"),
        (
            lambda f: (f / "families/results.csv").write_bytes(b"\xff\x00"),
            r"results.csv: not a CSV",
        ),
        (edit_rows(lambda rows: rows.pop()), r"results.csv.*episode 1 of e with method teacher"),
        (edit_rows(lambda rows: rows.append(rows[0])), r"results.csv.*twice; valid: once"),
        (edit_rows(lambda rows: rows[3].update(episode="7")), r"results.csv.*episode 1 of b.*told"),
        (edit_rows(lambda rows: rows[3].update(family="x")), r"results.csv.*2 names; valid: one"),
        (
            edit_rows(lambda rows: rows[2].update({"return": "nan"})),
            r"results.csv.*line 4 is 'nan'",
        ),
        (edit_rows(lambda rows: rows[2].update(split="train")), r"results.csv.*inside, outside"),
        (
            edit_rows(lambda rows: [row.pop("data_return") for row in rows]),
            r"results.csv.*data_return.*column is missing",
        ),
    ],
)
def test_a_missing_or_damaged_file_is_named(runs: list[Path], edit: Edit, says: str) -> None:
    edit(runs[1])
    with pytest.raises(DataError, match=says):
        combine(runs)


@pytest.mark.parametrize(
    ("seed", "settings", "study", "says"),
    [
        (0, {}, {}, r"again: seed is 0 as in .*run0; valid: another seed"),
        (5, {"bcq": {"lr": 0.5}}, {}, r"again: bcq.lr is 0.5 here and 0.003 in .*run0"),
        (5, {}, {"cloning_updates": 3}, "families.cloning_updates is 3 here and 2000 in"),
        (5, {"workers": 3, "stepper": "robosuite"}, {}, None),  # these change no result
    ],
)
def test_runs_of_one_family_differ_in_their_seed_alone(
    runs: list[Path],
    tmp_path: Path,
    seed: int,
    settings: dict[str, Any],
    study: dict[str, Any],
    says: str | None,
) -> None:
    again = write_run(tmp_path / "again", seed, study=study, **settings)
    if says is None:
        assert "walks" in combine([*runs, again])
        return
    with pytest.raises(ConfigError, match=says):
        combine([*runs, again])


def test_runs_of_one_family_have_equal_members(runs: list[Path], tmp_path: Path) -> None:
    fewer = [row for row in values(5) if row["member"] != "b"]
    with pytest.raises(ConfigError, match=r"b is in one of .*run0 and .*fewer"):
        combine([*runs, write_run(tmp_path / "fewer", 5, rows=fewer)])
    with pytest.raises(BMRLError, match="no runs are given"):
        combine([])


def test_the_command_prints_and_writes_what_the_function_returns(
    runs: list[Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(RECIPES))
    monkeypatch.delitem(sys.modules, "families_table", raising=False)
    import families_table

    words = [*map(str, runs), "--out", str(tmp_path / "tables")]
    families_table.main(words)
    said = capsys.readouterr().out
    for name, table in combine(runs).items():
        assert table.markdown() in said
        assert (tmp_path / "tables" / f"{name}.md").read_text() == table.markdown()
        assert (tmp_path / "tables" / f"{name}.csv").read_text() == table.csv()
    (runs[2] / "families" / "results.csv").unlink()
    with pytest.raises(SystemExit, match="1"):
        families_table.main(words)
    assert "run2/families/results.csv: no such file" in capsys.readouterr().err
