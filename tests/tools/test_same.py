"""The comparison of two versions: what its hashes ignore, the order of cases, renamed words."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from tests.tools.loading import tool

same = tool("same")


def rows(folder: Path, **files: Any) -> dict[str, str]:
    """Hashes of files with these contents, `_` in a name standing for its dot."""
    folder.mkdir()
    for name, content in files.items():
        path = folder / name.replace("_", ".")
        if isinstance(content, str):
            path.write_text(content)
        elif path.suffix == ".npz":
            np.savez(path, **content)
        else:
            save_file(content[0], path, metadata=content[1])
    return same.Hasher({folder: "WORK"}).rows("case", folder)


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("a_json", '{"b": [{"seconds": 1.5, "c": 2}]}', '{"b": [{"seconds": 7, "c": 2}]}'),
        ("a_out", '{"b": 1, "versions": {"x": "1"}}\n', '{"b": 1, "versions": {"x": "2"}}\n'),
        ("a_csv", "step,seconds,loss\n1,0.5,3\n", "step,seconds,loss\n1,0.75,3\n"),
        ("a_err", "done ━━━━ 2/2 0:00:34", "done ━━━━ 2/2 0:01:02"),
        ("a_md", "2 frames in 12.3 s", "2 frames in 9 s"),
    ],
)
def test_times_and_versions_do_not_count(tmp_path: Path, name: str, before: str, after: str) -> None:
    assert rows(tmp_path / "1", **{name: before}) == rows(tmp_path / "2", **{name: after})


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("a_json", '{"b": 1}', '{"b": 2}'),
        ("a_json", '{"b": 1, "c": 2}', '{"c": 2, "b": 1}'),
        ("a_csv", "step,loss\n1,3\n", "step,loss\n1,4\n"),
        ("a_md", "2 frames in 9 s", "3 frames in 9 s"),
        ("a_npz", {"x": np.zeros(2)}, {"x": np.zeros(2, np.float32)}),
        ("a_safetensors", ({"x": np.zeros(2)}, {"step": "1"}), ({"x": np.zeros(2)}, {"step": "2"})),
    ],
)
def test_all_else_does(tmp_path: Path, name: str, before: Any, after: Any) -> None:
    assert rows(tmp_path / "1", **{name: before}) != rows(tmp_path / "2", **{name: after})


def test_places_and_containers_do_not_count(tmp_path: Path) -> None:
    found = [
        rows(
            folder,
            a_yaml=f"out: {folder}/run\n",
            b_json=json.dumps({str(folder / "x"): str(folder / "y")}),
            c_npz={"x": np.arange(3)},
            d_safetensors=({"x": np.arange(3)}, {"seconds": str(seconds), "step": "1"}),
        )
        for seconds, folder in enumerate((tmp_path / "one", tmp_path / "another"))
    ]
    assert found[0] == found[1]
    assert set(found[0]) == {"case/a.yaml", "case/b.json", "case/c.npz", "case/d.safetensors"}


def test_every_case_can_begin() -> None:
    cases = same.suite()
    order = same.sort_cases(cases, cases)
    assert len(set(order)) == len(order) == len({*cases, *same.MADE})
    for place, name in enumerate(order):
        assert same.required_cases(name, cases) <= set(order[:place])
    assert same.sort_cases(["worth-table"], cases) == ["inputs", "worth-table"]
    assert {"attack --combo 7", "render", ""} <= set(cases["refused"])
    assert {"--help", "retrain --help"} <= set(cases["help"])


def test_compare(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, after = tmp_path / "before.txt", tmp_path / "after.txt"
    before.write_text("a/x y.txt 1\na/z 2\nb/x 3\n")
    after.write_text("a/x y.txt 1\nb/w 4\nb/x 5\n")
    assert same.main(["--compare", str(before), str(after)]) == 1
    assert capsys.readouterr().out.splitlines() == ["gone: a/z", "new: b/w", "differs: b/x", "3 lines differ"]
    assert same.main(["--compare", str(before), str(after), "--only", "b"]) == 1
    assert same.main(["--compare", str(before), str(before)]) == 0


def test_commands_of_tools_run_as_modules(tmp_path: Path) -> None:
    assert same.command_words("tools.experiments worth @/run", tmp_path, tmp_path) == [
        "tools.experiments",
        "worth",
        "./run",
    ]


def test_renamed_keys_columns_files_and_words_are_equal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {
        "before/asked-run/peer.json": '{"asked": 1, "kind": "the peer", "seconds": 3}',
        "after/asked-run/second.json": '{"kind": "the second", "samples": 1, "seconds": 4}',
        "before/asked-run/a.csv": "asked,b\n1,2\n",
        "after/asked-run/a.csv": "b,samples\n2,1\n",
        "before/asked-run/config.yaml": "peer: null\nb: 1\n",
        "after/asked-run/config.yaml": "b: 1\nsecond: null\n",
        "before/asked-run/prose.md": "Asked",
        "after/asked-run/prose.md": "Sampled",
        "before/asked-run/said.out": "1 frame",
        "after/asked-run/said.out": "2 frames",
        "before/help/attack.txt": "old",
        "after/help/attack.txt": "new",
    }
    for name, text in files.items():
        path = tmp_path / name.replace("after/asked-run", "after/samples-run")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "renamed.txt").write_text("asked samples\npeer second\n")
    words = ["--compare", str(tmp_path / "before"), str(tmp_path / "after")]
    assert same.main([*words, "--renamed", str(tmp_path / "renamed.txt")]) == 0
    (tmp_path / "after/samples-run/a.csv").write_text("b,samples\n2,3\n")
    assert same.main([*words, "--renamed", str(tmp_path / "renamed.txt")]) == 1
    assert "differs: samples-run/a.csv" in capsys.readouterr().out
