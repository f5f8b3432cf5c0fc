"""Every block of code in README.md and docs/: Python runs, the real parsers read commands, data is well-formed.

A Python block that cannot run here follows a comment, `<!-- not run: needs ... -->`, and must compile.
"""

import ast
import json
import os
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from PIL import Image

from detectors.registry import load_detector, save_detector
from drivesem.cli import main
from drivesem.config.commands import COMMANDS
from drivesem.config.parsing import Commands, parse
from drivesem.run.results import Failure, dump_frame, load_frame
from tools.bench.__main__ import BENCHMARKS
from tools.experiments.__main__ import EXPERIMENTS
from tools.noisy_weights import with_noise

ROOT = Path(__file__).resolve().parents[2]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
LANGUAGES = ("python", "sh", "yaml", "json", "")
PROGRAMS: dict[str, Commands] = {"drivesem": COMMANDS, "tools.bench": BENCHMARKS, "tools.experiments": EXPERIMENTS}
"""Settings of each program's commands."""
CHEAP = ("render", "edit", "report", "convert", "verify")
"""Commands that take seconds, given a run, scenes and a data set."""
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"`(?:python -m )?(drivesem|tools\.bench|tools\.experiments) ([a-z][\w-]*)([^`]*)`")
_PATH = re.compile(r"(?<=`)(?:drivesem|scene_ir|detectors|tools|configs)/[\w./-]+(?=`)")
_NAME = re.compile(r"`((?:drivesem|scene_ir|detectors)(?:\.\w+)+)(?:\([^`]*\))?`")
_LINK = re.compile(r"\]\(([^)#]*)(?:#[^)]*)?\)")
_NOT_RUN = re.compile(r"<!-- not run: \S.* -->\s*$")


@dataclass(frozen=True, slots=True)
class Block:
    """A fenced block of a page."""

    page: Path
    line: int
    """Line of the page with its first line."""
    language: str
    text: str
    runs: bool
    """Whether its Python is run, and not only compiled."""

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def iterate_blocks(page: Path) -> Iterator[Block]:
    """Yield the blocks of a page, in order."""
    content = page.read_text(encoding="utf-8")
    for match in _FENCE.finditer(content):
        before = content[: match.start()]
        yield Block(page, before.count("\n") + 2, match[1], match[2], _NOT_RUN.search(before) is None)


BLOCKS = tuple(block for page in PAGES for block in iterate_blocks(page))


def iterate_commands(block: Block) -> Iterator[tuple[str, list[str]]]:
    """Yield the commands of a shell block: the place of each, and its words."""
    joined = block.text.replace("\\\n", " ")
    for line in joined.splitlines():
        words = shlex.split(line, comments=True)
        while words:
            end = words.index("&&") if "&&" in words else len(words)
            yield f"{block}: {line.strip()}", words[:end]
            words = words[end + 1 :]


SHELL = tuple(command for block in BLOCKS if block.language == "sh" for command in iterate_commands(block))


@pytest.fixture
def workplace(small_kitti: Path, small_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the data and runs that the pages name."""
    for name in ("PATH_TO_KITTI", "data/kitti"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).symlink_to(small_kitti)
    for name in ("a", "b"):
        shutil.copytree(small_run, tmp_path / "runs" / name)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_block_has_a_language() -> None:
    assert not [str(block) for block in BLOCKS if block.language not in LANGUAGES]
    assert {block.language for block in BLOCKS} >= {"python", "sh", "yaml"}
    bare = [str(block) for block in BLOCKS if not block.language and "drivesem " in block.text.split(": ")[0]]
    assert not bare, "commands belong into sh blocks"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_paths_links_and_names_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    paths = {match[0].rstrip("/") for match in _PATH.finditer(text)}
    targets = {match[1] for match in _LINK.finditer(text) if match[1] and "://" not in match[1]}
    missing = [path for path in paths if not (ROOT / path).exists()]
    missing += [target for target in targets if not (page.parent / target).exists()]
    assert not missing
    for name in {match[1] for match in _NAME.finditer(text)}:
        assert pkgutil.resolve_name(name) is not None


@pytest.mark.parametrize(("where", "words"), SHELL, ids=[where for where, _ in SHELL])
def test_commands_parse(where: str, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    program = Path(words[0]).name
    if program == "drivesem":
        parse(words[1:])
    elif words[1] == "-m" and words[2] in PROGRAMS:
        parse(words[3:], PROGRAMS[words[2]])
    elif words[1] == "-m" and words[2].startswith("tools."):
        assert (ROOT / words[2].replace(".", "/")).with_suffix(".py").is_file()
    elif program.startswith("python") and words[1] != "-m":
        assert (ROOT / words[1]).is_file()
    else:
        assert program in ("python", "python3", "pip", "ray", "source"), where


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_in_sentences_exist(page: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for program, name, words in set(_INLINE.findall(page.read_text(encoding="utf-8"))):
        with pytest.raises(SystemExit):
            parse([name, "--help-all"], PROGRAMS[program])
        assert set(re.findall(r"--[a-z][\w-]*", words)) <= set(
            re.findall(r"--[a-z][\w-]*", capsys.readouterr().out)
        )


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language in ("yaml", "json")], ids=str)
def test_data_is_well_formed(block: Block) -> None:
    assert yaml.safe_load(block.text) if block.language == "yaml" else json.loads(block.text)


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.language == "python" and not b.runs], ids=str)
def test_python_that_does_not_run_compiles(block: Block) -> None:
    ast.parse(block.text)


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if any(b.language == "python" and b.runs for b in iterate_blocks(page))],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_python_runs(page: Path, workplace: Path) -> None:
    names: dict[str, object] = {"__name__": "__main__"}
    for block in iterate_blocks(page):
        if block.language == "python" and block.runs:
            padded = "\n" * (block.line - 1) + block.text  # so that a traceback names the page's line
            exec(compile(padded, str(page), "exec"), names)


def test_the_readmes_caption_is_that_of_its_picture() -> None:
    """`tools/example_picture.py` writes the caption into the picture."""
    with Image.open(ROOT / "docs" / "example.jpg") as picture:
        caption = picture.info["comment"].decode()
    assert caption in " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())


GATE_PAGE = ROOT / "docs" / "guide" / "gate.md"


def workflow_steps() -> list[dict[str, Any]]:
    """Steps of the workflow on the gate's page."""
    (block,) = (block for block in iterate_blocks(GATE_PAGE) if block.language == "yaml")
    return yaml.safe_load(block.text)["jobs"]["gate"]["steps"]


def test_the_workflow_installs_drivesem_from_its_own_checkout() -> None:
    steps = workflow_steps()
    (source,) = (
        step["with"]["path"] for step in steps if step.get("with", {}).get("repository", "").endswith("/drivesem")
    )
    (install,) = (step["run"] for step in steps if step.get("run", "").startswith("pip install"))
    assert shlex.split(install)[2:] == ["-c", f"{source}/constraints.txt", f"./{source}"]
    assert (ROOT / "constraints.txt").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_the_workflow_runs_as_written(noise: float, small_run: Path, tmp_path: Path) -> None:
    """All its commands but pip's, in bash, on a package of one frame: its car is lost for certain, it says."""
    run, weights = tmp_path / "run", tmp_path / "weights"
    shutil.copytree(small_run, run)
    (path,) = run.glob("frames/*/result.json")
    result = load_frame(path)
    car = result.found_before[0]
    box = result.targets_moved[car]
    lost = Failure("lost", box.label, box.xyxy, index=car, error="missed", grade="certain")
    path.write_text(dump_frame(replace(result, failures=(lost,))))
    assert main(["export", str(run), "--to", "gate", "--out", str(tmp_path / "tests" / "gate")]) == 0
    detector = load_detector("squeezedet")
    save_detector(detector, weights / "current.safetensors")
    save_detector(with_noise(detector, noise), weights / "new.safetensors")
    shim = tmp_path / "bin" / "drivesem"
    shim.parent.mkdir()
    shim.write_text(f'#!/bin/sh\nexec {sys.executable} -m drivesem "$@"\n')
    shim.chmod(0o755)
    environment = {**os.environ, "PATH": f"{shim.parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    environment["GITHUB_STEP_SUMMARY"] = str(tmp_path / "summary.md")
    codes = [
        subprocess.run(["bash", "-e", "-c", step["run"]], cwd=tmp_path, env=environment, check=False).returncode
        for step in workflow_steps()
        if "run" in step and not step["run"].startswith("pip ")
    ]
    assert codes == [int(noise > 0), 0]
    verdict = "not passed" if noise else "passed"
    assert (tmp_path / "summary.md").read_text().startswith(f"# Gate {verdict}: weights/new.safetensors after")
    assert {path.name for path in (tmp_path / "build" / "gate").iterdir()} >= {
        "gate.html",
        "gate.xml",
        "gate.json",
    }


@pytest.mark.slow
def test_cheap_commands_run(workplace: Path, small_kitti: Path) -> None:
    assert main(["derender", "--dataset", "kitti", "--root", str(small_kitti), "--fast", "--out", "scenes"]) == 0
    ran = []
    for where, words in SHELL:
        if Path(words[0]).name == "drivesem" and words[1] in CHEAP and "--help" not in words:
            paths = [word for word in words[2:] if word.startswith(("runs/", "scenes/", "data/", "PATH_TO"))]
            if all(Path(path).exists() for path in paths):
                assert main(words[1:]) == 0, where
                ran.append(words[1])
    assert set(ran) == set(CHEAP)
