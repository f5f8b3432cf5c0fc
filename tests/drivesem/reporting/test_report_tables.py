"""Numbers and their nouns, and tables on terminals of any width."""

import io
import re
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivesem.reporting import tables
from drivesem.reporting.tables import Console, ReportTable, format_count, progress_bar, rows_to_csv

COLUMNS = ("arm", "where", "PSNR, dB", "perceptual distance", "FID")
ROWS = (
    ("combo-2-paper-s-protocol", "frame", "24.0 (21.7 to 27.1)", "0.0893 (0.0542 to 0.137)", "-"),
    ("photograph", "vehicles", "16.2", "0.577", "0.1"),
)
SHEET = ReportTable("Far", COLUMNS, ROWS)


def printed(sheet: ReportTable, width: int, words: tuple[str, ...] = COLUMNS[:2]) -> str:
    """What a terminal shows of it."""
    console = Console(file=io.StringIO(), width=width)
    console.print(*sheet.fit_to_console(console, words), sep="\n")
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_one_is_one_and_no_more() -> None:
    assert [format_count(count, "frame") for count in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
    assert [format_count(count, "query", "queries") for count in (1, 40)] == ["1 query", "40 queries"]


def test_a_column_that_the_first_row_lacks_is_in_the_csv() -> None:
    """Of searches, the first is not compared with itself."""
    rows = [{"name": "climb", "seconds": 1.5}, {"name": "halton", "seconds": 2, "ahead": 0.25}]
    assert rows_to_csv(rows) == "name,seconds,ahead\nclimb,1.5,\nhalton,2,0.25\n"


def test_a_table_that_fits_is_one() -> None:
    text = printed(SHEET, 110)
    assert text.count("Far") == 1
    assert "further" not in text


def test_a_table_that_does_not_fit_goes_on_below_with_its_first_columns() -> None:
    text = printed(SHEET, 80)
    for row in ROWS:
        assert all(cell in text for cell in row)
    assert max(map(len, text.splitlines())) <= 80
    assert text.count("Far") == 2
    assert text.count("Far, further columns") == 1
    assert text.count("combo-2-paper-s-protocol") == 2


def test_where_not_even_one_column_has_room_it_stays_one() -> None:
    for sheet in (
        SHEET,
        ReportTable("Far words", ("a", "b"), (("x" * 50, "y" * 50),)),
        ReportTable("Far", ("a", "b"), ()),
    ):
        text = printed(sheet, 40, (*COLUMNS[:2], "a", "b"))
        assert "further" not in text
        assert max(map(len, text.splitlines())) <= 40


_WORD = st.text("abcdefg", min_size=1, max_size=9)
_NUMBER = st.from_regex(r"\A\d{1,4}\.\d{1,3}( \[\d\.\d, \d\.\d\])?\Z")


@given(
    names=st.lists(_WORD, min_size=1, max_size=3),
    numbers=st.lists(st.tuples(st.lists(_WORD, min_size=1, max_size=4).map(" ".join), _NUMBER), max_size=8),
    sentence=st.lists(_WORD, min_size=1, max_size=12).map(" ".join),
    width=st.integers(70, 200),
)
def test_no_word_and_no_number_is_broken(
    names: list[str], numbers: list[tuple[str, str]], sentence: str, width: int
) -> None:
    columns = (
        *(f"{name}{i}" for i, name in enumerate(names)),
        *(f"{head}{i}" for i, (head, _) in enumerate(numbers, len(names))),
    )
    sheet = ReportTable("t", columns, ((*[sentence] * len(names), *(number for _, number in numbers)),))
    text = printed(sheet, width, columns[: len(names)])
    assert max(map(len, text.splitlines())) <= width
    assert all(number in text for _, number in numbers)
    assert all(word in text for word in " ".join([*columns, sentence]).split())


@pytest.mark.parametrize(("columns", "width"), [(None, 120), ("90", 90)])
def test_a_log_is_as_wide_as_columns_or_120(
    columns: str | None, width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    if columns is not None:
        monkeypatch.setenv("COLUMNS", columns)
    assert Console(file=io.StringIO()).width == width
    assert Console(file=io.StringIO(), width=70).width == 70


def test_progress_in_a_log_is_a_plain_line_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_LINE_SECONDS", 0.05)
    stream = io.StringIO()
    with progress_bar(Console(file=stream)) as progress:
        task = progress.add_task("attacking frames", total=40, completed=10)
        time.sleep(0.12)
        progress.advance(task, 2)
        time.sleep(0.12)
    lines = stream.getvalue().splitlines()
    assert lines[0] == "attacking frames: 10 of 40, 0:00:00"
    assert re.fullmatch(r"attacking frames: 12 of 40, 0:00:00, [\d.]+ a second, 0:00:0\d left", lines[-1]), lines
    assert 3 <= len(lines) <= 6


def test_progress_on_a_terminal_has_no_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "_LINE_SECONDS", 0.01)
    stream = io.StringIO()
    with progress_bar(Console(file=stream, force_terminal=True, width=80), keep=False) as progress:
        progress.add_task("frames", total=2)
        time.sleep(0.05)
    assert "frames: " not in stream.getvalue()


@pytest.mark.parametrize("options", [{"keep": False}, {"hidden": True}])
def test_a_short_job_leaves_no_line(options: dict[str, bool]) -> None:
    stream = io.StringIO()
    with progress_bar(Console(file=stream), **options) as progress:
        progress.add_task("frames", total=2)
    assert stream.getvalue().strip() == ""
