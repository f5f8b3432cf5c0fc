"""Numbers and their nouns."""

from drivesem.report.tables import number_of


def test_one_is_one_and_no_more() -> None:
    assert [number_of(count, "frame") for count in (0, 1, 2)] == ["0 frames", "1 frame", "2 frames"]
    assert [number_of(count, "query", "queries") for count in (1, 40)] == ["1 query", "40 queries"]
