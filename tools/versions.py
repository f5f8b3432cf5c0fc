"""Test drivesem with the oldest and the newest dependencies that it supports.

    python -m tools.versions                                           # this Python, lowest and highest versions
    python -m tools.versions --python python3.11,python3.13 --tests    # also the quick tests
    python -m tools.versions --versions pinned,highest --bare          # where there is no compiler, EGL and libusb
    python -m tools.versions --resolve                                 # only: do the versions go together?

For each Python and each of "lowest" (each dependency of pyproject.toml at its lower bound), "pinned" (those of
constraints.txt) and "highest" (pip's choice), a wheel of the working tree is installed into a fresh virtual
environment. From an empty folder it runs `drivesem doctor` and the README's attack. The last lines
are a table. Exit code 1 where anything fails. pip's own settings count, those of the machine too.

--bare needs Linux and `unshare`: each command sees a /usr without these files, in a mount namespace of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

from scene_ir import files

ROOT = Path(__file__).resolve().parents[1]
ATTACK = "attack --combo 2 --workers 1 --json --out run"
QUICK = "--limit 1 --steps 1 --nuisances off"
SETS = ("lowest", "pinned", "highest")
PACKAGES = (
    *("torch", "numpy", "scipy", "opencv-contrib-python-headless", "kornia", "warp-lang", "open3d"),
    *("trimesh", "matplotlib", "pillow", "tyro"),
)
"""Packages with versions in the result."""
HIDDEN = (
    *("bin/*gcc*", "bin/*g++*", "bin/cc", "bin/c++", "bin/*clang*", "bin/ld*", "bin/*-linux-gnu-ld*"),
    *(f"{lib}/{name}*" for lib in ("lib", "lib/*", "lib64") for name in ("libEGL", "libOSMesa", "libusb")),
)
"""What --bare hides, below /usr."""
_MINUTES = 60
"""A step that takes longer is stopped."""
_VERSIONS = f"""
import json, platform
from importlib.metadata import version
print(json.dumps({{"Python": platform.python_version(), **{{name: version(name) for name in {PACKAGES!r}}}}}))
"""


@dataclass(frozen=True)
class StepResult:
    """One step: a line with the reason of its failure, or nothing; its output."""

    failed: str = ""
    output: str = ""


Run = Callable[[Sequence[str], Path], StepResult]
"""Runs words in a folder."""


@dataclass(frozen=True)
class VersionOutcome:
    """What came of one Python and one set of versions."""

    python: str
    versions: str
    failed: str
    """The step that failed, and why; empty where none."""
    found: Mapping[str, str] = field(default_factory=dict)
    """Versions of Python and `PACKAGES`."""
    parts: Mapping[str, str] = field(default_factory=dict)
    """Status of each part according to `drivesem doctor`."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """The attack's."""


def lowest_versions(pyproject: Path, python: str) -> list[str]:
    """Each dependency at its lower bound, `name==version`, for a Python such as 3.11. ValueError where there is
    none.
    """
    wanted = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]["dependencies"]
    pins: list[str] = []
    for requirement in map(Requirement, wanted):
        if requirement.marker is not None and not requirement.marker.evaluate({"python_version": python}):
            continue
        bounds = [one.version for one in requirement.specifier if one.operator == ">="]
        if not bounds:
            raise ValueError(f"dependency {str(requirement)!r}: expected a lower bound, name>=version")
        pins.append(f"{requirement.name}=={bounds[0]}")
    return pins


def hiding_prefix(work: Path, usr: Path = Path("/usr")) -> list[str]:
    """Words before a command that hide `HIDDEN` from it. work: a folder for the layer of /usr that lacks it."""
    upper, spare = work / "upper", work / "spare"
    spare.mkdir(parents=True)
    for path in sorted({path for pattern in HIDDEN for path in usr.glob(pattern)}):
        mark = upper / path.relative_to(usr)
        mark.parent.mkdir(parents=True, exist_ok=True)
        os.mknod(mark, 0o020000)  # a character device 0, 0: not there, to overlayfs
    upper.mkdir(exist_ok=True)
    layers = f"lowerdir={usr},upperdir={upper},workdir={spare}"
    return ["unshare", "-rm", "sh", "-c", f'mount -t overlay overlay -o {layers} {usr} && exec "$@"', "sh"]


def run_words(words: Sequence[str], folder: Path) -> StepResult:
    """See `Run`."""
    own = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    try:
        ended = subprocess.run(words, cwd=folder, env=own, capture_output=True, text=True, timeout=60 * _MINUTES)
    except (OSError, subprocess.TimeoutExpired) as error:
        return StepResult(str(error))
    lines = [line for line in (ended.stderr or ended.stdout).splitlines() if line.strip()]
    named = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]  # pytest's last line counts only
    failed = "; ".join(named) or (lines[-1] if lines else f"exit code {ended.returncode}")
    return StepResult(failed if ended.returncode else "", ended.stdout)


def try_versions(
    python: str, versions: str, wheel: str, work: Path, args: argparse.Namespace, run: Run
) -> VersionOutcome:
    """One Python and one set of versions. wheel: to install, or the tree."""
    environment, empty = work / "environment", work / "empty"
    empty.mkdir(parents=True)
    before = hiding_prefix(work) if args.bare else []
    own = [*before, str(environment / "bin" / "python")]
    install = [*own, "-m", "pip", "install", "-q"]
    if versions == "lowest":
        python_version = run(
            [python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"], work
        ).output.strip()
        files.write_text(
            work / "lowest.txt",
            "\n".join(lowest_versions(ROOT / "pyproject.toml", python_version or "3.11")) + "\n",
        )
        install += ["-c", str(work / "lowest.txt")]
    if versions == "pinned":
        install += ["-c", str(ROOT / "constraints.txt")]
    install += ["--dry-run"] if args.resolve else []
    steps = {
        "venv": [*before, python, "-m", "venv", str(environment)],
        "install": [*install, f"{wheel}[test]" if args.tests else wheel],
    }
    if not args.resolve:
        steps["versions"] = [*own, "-c", _VERSIONS]
        steps["doctor"] = [*own, "-m", "drivesem.cli", "doctor", "--json"]
        steps["attack"] = [*own, "-m", "drivesem.cli", *ATTACK.split(), *(QUICK.split() if args.quick else [])]
    if args.tests and not args.resolve:
        steps["tests"] = [*own, "-m", "pytest", "-q", "-m", "quick", "-p", "no:cacheprovider", str(ROOT / "tests")]
    outputs: dict[str, Any] = {}
    failed = ""
    for name, words in steps.items():
        ended = run(words, ROOT if name == "tests" else empty)
        if ended.failed:
            failed = f"{name}: {ended.failed}"
            break
        if name in ("versions", "doctor", "attack") and ended.output:
            outputs[name] = json.loads(ended.output)
    shutil.rmtree(environment, ignore_errors=True)  # gigabytes
    parts = {part["name"]: part["status"] for part in outputs.get("doctor", {}).get("parts", ())}
    if args.bare and not failed and parts.get("EGL") == "works":
        failed = "doctor: EGL is hidden, and works"
    metrics = {key: outputs["attack"][key] for key in ("frames", "grades") if key in outputs.get("attack", {})}
    named = f"{versions}, bare" if args.bare else versions
    return VersionOutcome(python, named, failed, outputs.get("versions", {}), parts, metrics)


def table(outcomes: Sequence[VersionOutcome]) -> str:
    """The outcomes in Markdown."""
    heads = ("Python", "versions", *PACKAGES, "outcome")
    rows = [
        (
            o.found.get("Python", Path(o.python).name),
            o.versions,
            *(o.found.get(name, "") for name in PACKAGES),
            o.failed or "works",
        )
        for o in outcomes
    ]
    return "".join(f"| {' | '.join(row)} |\n" for row in (heads, ("---",) * len(heads), *rows))


def main(argv: Sequence[str] | None = None, run: Run = run_words) -> int:
    """Entry point; exit code 0, or 1 where anything fails."""
    parser = argparse.ArgumentParser(prog="python -m tools.versions", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--python", default=sys.executable, help="interpreters, with commas")
    parser.add_argument("--versions", default="lowest,highest", help=f"some of {', '.join(SETS)}, with commas")
    parser.add_argument("--tests", action="store_true", help="also run the quick tests of the tree")
    parser.add_argument(
        "--quick", action="store_true", help="one frame and one step instead of the README's attack"
    )
    parser.add_argument("--bare", action="store_true", help="hide compilers, EGL, OSMesa and libusb")
    parser.add_argument("--resolve", action="store_true", help="only let pip resolve the versions")
    parser.add_argument("--out", help="JSON file for the outcomes")
    args = parser.parse_args(argv)
    if not set(args.versions.split(",")) <= set(SETS):
        parser.error(f"--versions: expected some of {', '.join(SETS)}, found {args.versions}")
    outcomes: list[VersionOutcome] = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        made = run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(work), str(ROOT)], work)
        if made.failed:
            sys.stderr.write(f"the wheel cannot be made: {made.failed}\n")
            return 1
        wheel = next((str(path) for path in work.glob("*.whl")), str(ROOT))
        for python in args.python.split(","):
            for versions in args.versions.split(","):
                place = work / f"{Path(python).name}-{versions}-{len(outcomes)}"
                outcome = try_versions(python, versions, wheel, place, args, run)
                outcomes.append(outcome)
                lacking = ", ".join(name for name, status in outcome.parts.items() if status != "works")
                sys.stdout.write(f"{python}, {versions}: {outcome.failed or 'works'}\n")
                sys.stdout.write(f"    {dict(outcome.metrics)}; without {lacking}\n" if lacking else "")
    sys.stdout.write(f"\n{table(outcomes)}")
    if args.out:
        files.write_json(Path(args.out), [asdict(outcome) for outcome in outcomes])
    return 1 if any(outcome.failed for outcome in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
