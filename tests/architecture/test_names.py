"""Class names are unique, and retired words appear neither in names nor in text: `docs/glossary.md` has the terms."""

from tools.names import CODE, find_in_code, find_in_page, find_repeated_classes, iterate_files

PRODUCT = ("scene_ir", "detectors", "drivesem", "docs", "README.md", "CONTRIBUTING.md")


def test_names_and_prose_use_the_terms_of_the_glossary() -> None:
    findings = [str(finding) for path in iterate_files(PRODUCT, (".py",)) for finding in find_in_code(path)]
    findings += [str(found) for path in iterate_files(PRODUCT, (".md", ".html")) for found in find_in_page(path)]
    assert not findings, "\n".join(findings)


def test_class_names_are_unique() -> None:
    paths = [path for path in iterate_files(CODE, (".py",)) if "tests" not in path.parts]
    findings = [str(finding) for finding in find_repeated_classes(paths)]
    assert not findings, "\n".join(findings)
