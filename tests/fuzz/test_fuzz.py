"""Damaged files of every format, a few of each: nothing but the project's own errors. `python -m tools.fuzz` gives
as many as wanted, in a child with limits.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scene_ir import files
from scene_ir.errors import FormatError
from tools.fuzz.formats import FORMATS
from tools.fuzz.trial import FuzzSubject, find_fault

SEED, COUNT = 0, 20


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files(name: str, tmp_path: Path) -> None:
    form = FORMATS[name]
    subject = FuzzSubject(form, tmp_path)
    assert find_fault(form, subject.root) == ("", True)
    for number in range(max(round(COUNT * form.share), 5)):
        with subject.damaged(SEED, number) as root:
            fault, _ = find_fault(form, root)
        assert not fault, f"python -m tools.fuzz --formats '{name}' --seed {SEED} --show {number}: {fault}"
    assert find_fault(form, subject.root) == ("", True)  # whole again


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(codec=None)),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(st.characters(codec=None)), inner),
    max_leaves=20,
)


@given(JSON)
@settings(deadline=None, max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_json_is_read_can_be_written_and_read_again(tmp_path: Path, value: object) -> None:
    """Any value but for what no file may hold; NaN, which JSON has not, is read and never written."""
    path = tmp_path / "a.json"
    path.write_text(json.dumps(value))
    with suppress(FormatError):
        read = files.read_json(path)
        with suppress(ValueError):  # NaN and infinities
            files.write_json(path, read)
            assert files.read_json(path) == read
