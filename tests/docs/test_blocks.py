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


@pytest.mark.parametrize(
    ("page", "picture"), [("README.md", "docs/example.jpg"), ("docs/guide/attack.md", "docs/crossing.jpg")]
)
def test_a_caption_is_that_of_its_picture(page: str, picture: str) -> None:
    """`tools/example_picture.py` writes the caption into the picture."""
    with Image.open(ROOT / picture) as image:
        caption = image.info["comment"].decode()
    assert caption in " ".join((ROOT / page).read_text(encoding="utf-8").split())


GATE_PAGE = ROOT / "docs" / "guide" / "gate.md"


ACTION = ROOT / ".github" / "actions" / "gate" / "action.yml"
_INPUT = re.compile(r"\$\{\{ inputs\.([\w-]+) \}\}")


def action_inputs() -> dict[str, str]:
    """What the workflow on the gate's page gives to the Action, with the Action's defaults."""
    (block,) = (block for block in iterate_blocks(GATE_PAGE) if block.language == "yaml")
    (given,) = (
        step["with"]
        for step in yaml.safe_load(block.text)["jobs"]["gate"]["steps"]
        if "/drivesem/.github/actions/gate@" in step["uses"]
    )
    declared = yaml.safe_load(ACTION.read_text())["inputs"]
    assert given.keys() <= declared.keys()
    assert {name for name, facts in declared.items() if facts.get("required")} <= given.keys()
    return {name: facts.get("default") for name, facts in declared.items()} | given


def run_action(folder: Path, environment: dict[str, str]) -> int:
    """Run the Action's commands in a folder as GitHub does; the exit code of the first that fails, or 0."""
    inputs = action_inputs()
    failed = 0
    for step in yaml.safe_load(ACTION.read_text())["runs"]["steps"]:
        if "run" in step and (not failed or step.get("if") == "always()"):
            variables = {name: _INPUT.sub(lambda m: inputs[m[1]], v) for name, v in step.get("env", {}).items()}
            words = [step["shell"], "--noprofile", "--norc", "-eo", "pipefail", "-c", step["run"]]
            code = subprocess.run(words, cwd=folder, env=environment | variables, check=False).returncode
            failed = failed or code
    return failed


def uploaded_files(folder: Path) -> set[str]:
    """Names of the files that the Action uploads from a folder; all exist."""
    (upload,) = (
        step
        for step in yaml.safe_load(ACTION.read_text())["runs"]["steps"]
        if step.get("uses", "").startswith("actions/upload-artifact@")
    )
    assert upload["if"] == "always()"
    inputs = action_inputs()
    paths = [folder / line for line in _INPUT.sub(lambda m: inputs[m[1]], upload["with"]["path"]).splitlines()]
    assert all(path.is_file() for path in paths)
    return {path.name for path in paths}


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_the_action_runs_as_written(noise: float, small_run: Path, tmp_path: Path) -> None:
    """In the workflow of the gate's page, on a package of one frame whose car counts as certainly lost. pip is
    replaced by a check of what it would install.
    """
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
    programs = {
        "drivesem": f'exec {sys.executable} -m drivesem "$@"',
        "pip": '[ "$1 $2" = "install -c" ] && [ -f "$3" ] && [ -f "$4/pyproject.toml" ]',
    }
    for name, command in programs.items():
        shim = tmp_path / "bin" / name
        shim.parent.mkdir(exist_ok=True)
        shim.write_text(f"#!/bin/sh\n{command}\n")
        shim.chmod(0o755)
    environment = {**os.environ, "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    environment["GITHUB_STEP_SUMMARY"] = str(tmp_path / "summary.md")
    environment["GITHUB_ACTION_PATH"] = str(ACTION.parent)
    assert run_action(tmp_path, environment) == int(noise > 0)
    verdict = "not passed" if noise else "passed"
    assert (tmp_path / "summary.md").read_text().startswith(f"# Gate {verdict}: weights/new.safetensors after")
    assert uploaded_files(tmp_path) == {"gate.html", "gate.xml"}


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
