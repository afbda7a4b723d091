"""Files are written whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from torchrl_bmrl.files import atomic_path, write_atomic


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("data", ["σ = 0.3\r\nend\n", b"\x00\xff\n"])
def test_content_is_written_byte_by_byte(tmp_path: Path, data: str | bytes) -> None:
    write_atomic(tmp_path / "new" / "file", data)
    expected = data if isinstance(data, bytes) else data.encode("utf-8")
    assert (tmp_path / "new" / "file").read_bytes() == expected


def test_a_second_write_replaces_the_first(tmp_path: Path) -> None:
    write_atomic(tmp_path / "file", "a longer first text")
    write_atomic(tmp_path / "file", "second")
    assert (tmp_path / "file").read_text() == "second"
    assert names(tmp_path) == ["file"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_failure_keeps_the_old_file_and_leaves_no_temporary(
    tmp_path: Path, error: type[BaseException]
) -> None:
    path = tmp_path / "data.hdf5"
    write_atomic(path, "old")

    def write_half() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("half of the n")
            raise error

    with pytest.raises(error):
        write_half()
    assert path.read_text() == "old"
    assert names(tmp_path) == ["data.hdf5"]


def test_nothing_shows_under_the_final_name_before_the_end(tmp_path: Path) -> None:
    path = tmp_path / "data.hdf5"
    with atomic_path(path) as temporary:
        temporary.write_text("half")
        assert not path.exists()
        assert temporary.parent == path.parent
        assert list(tmp_path.glob("*.hdf5")) == []
    assert path.read_text() == "half"


def test_a_block_that_writes_nothing_fails_and_keeps_the_old_file(tmp_path: Path) -> None:
    write_atomic(tmp_path / "file", "old")
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "file"):
        pass
    assert (tmp_path / "file").read_text() == "old"


@pytest.mark.parametrize("links", [True, False], ids=["links", "no links"])
def test_the_first_of_two_writers_stays_where_the_second_does_not_replace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise PermissionError("a file system without links")

    if not links:
        monkeypatch.setattr("os.link", refuse)
    write_atomic(tmp_path / "file", "first", replace=False)
    assert (tmp_path / "file").read_text() == "first"
    write_atomic(tmp_path / "file", "second", replace=False)
    # Without links it falls back on replacing.
    assert (tmp_path / "file").read_text() == ("first" if links else "second")
    assert names(tmp_path) == ["file"]


def test_two_writers_of_one_path_do_not_share_a_temporary(tmp_path: Path) -> None:
    with atomic_path(tmp_path / "file") as first, atomic_path(tmp_path / "file") as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "file").read_text() == "first"  # the outer block ends last
