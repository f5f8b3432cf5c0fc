"""Class names are unique, and retired words appear neither in names nor in text: `docs/glossary.md` has the terms."""

from __future__ import annotations

from tools.names import find_all


def test_names_and_prose_use_the_terms_of_the_glossary() -> None:
    findings = [str(finding) for finding in find_all()]
    assert not findings, "\n".join(findings)
