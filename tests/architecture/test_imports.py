"""Which module may import which, read from the sources; and what stays unloaded until it is used."""

import ast
import functools
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("scene_ir", "detectors", "drivesem")
COMMAND_TABLE = ROOT / "drivesem" / "cli.py"
"""Loads a command's module by the command's name."""
IMPORT_BY_NAME = (ROOT / "drivesem" / "__init__.py", ROOT / "scene_ir" / "render" / "fast.py")
"""Import modules from a table, when they are used: the dotted strings in these files."""
TOP_LEVEL_NAMES = {
    *PACKAGES,
    *("configs", "docs", "tests", "tools"),
    *("pyproject.toml", "constraints.txt", "constraints.lock", "README.md", "CHANGELOG.md", "LICENSE", "NOTICE"),
    *("CONTRIBUTING.md", "CITATION.cff"),
}
HEAVY = ("torch", "cv2", "open3d", "pyrender", "warp")
LOADED_WHERE_USED = (
    "open3d",
    "pyrender",
    "onnxruntime",
    "torchvision",
    "ultralytics",
    "cma",
    "sklearn",
    "ray",
    "loky",
    "fsspec",
    "art",
    "mitsuba",
    "timm",
    "maite",
    "supervision",
)

FEW_FRAMES_NEED = (
    "drivesem.attacks.changes",
    "drivesem.failures.second_renderer.generator",
    "drivesem.failures.second_renderer.selection",
    "drivesem.synth",
    "kornia",
    "networkx",
    "scene_ir.exchange",
    "scene_ir.meshes.load",
    "scene_ir.removal",
    "scipy.stats",
    "trimesh",
)
"""Modules that an attack loads where a frame needs them, not at its start."""


@dataclass(frozen=True)
class Rule:
    """What the modules under `package` may import besides the standard library and themselves."""

    package: str
    project: tuple[str, ...]
    """Prefixes of this project's modules."""
    libraries: tuple[str, ...] | None
    """Top-level names; None for any."""
    never: tuple[str, ...] = ()
    """Prefixes that are forbidden even where `project` covers them."""
    adapters: tuple[str, ...] = ()
    """Prefixes of modules that adapt further libraries."""


_LOGIC = ("scene_ir.types", "scene_ir.geometry", "scene_ir.ffd", "scene_ir.errors")
_LOGIC_LIBRARIES = ("torch", "numpy", "scipy")
_SEARCH = tuple(f"drivesem.attacks.{name}" for name in ("theta", "space", "feasible", "methods"))
_BELOW_FAILURES = ("attacks", "scenes", "data", "evaluation", "config", "store", "synth")
_BELOW_RUN = ("attacks", "failures", "scenes", "data", "evaluation", "reporting", "config", "store")
_NOT_IN_REPORTS = ("torch", "kornia", "warp", "pyrender", "open3d", "detectors", "scene_ir.raster")
RULES = (
    Rule("scene_ir", (), ("torch", "numpy", "scipy", "kornia", "cv2", "PIL", "trimesh", "warp", "yaml")),
    Rule("detectors", (), ("torch", "numpy", "kornia", "safetensors"), adapters=("detectors.adapters",)),
    *(Rule(package, (*_LOGIC, *_SEARCH), (*_LOGIC_LIBRARIES, "cma", "sklearn")) for package in _SEARCH),
    # checks, independently, what drivesem.attacks.feasible lets through
    Rule(
        "drivesem.attacks.feasibility_check",
        _LOGIC,
        (*_LOGIC_LIBRARIES, "cv2", "open3d"),
        never=("drivesem.attacks.feasible",),
    ),
    Rule(
        "drivesem.evaluation",
        ("detectors.types", "detectors.boxes"),
        ("torch", "numpy", "pycocotools", "ultrafast_pycocotools"),
        never=("scene_ir", "drivesem.attacks"),
    ),
    Rule("drivesem.failures", ("scene_ir", "detectors", *(f"drivesem.{part}" for part in _BELOW_FAILURES)), None),
    # the second renderer of photographs shares nothing with the first one but the scene
    *(
        Rule(
            f"drivesem.failures.second_renderer.{name}",
            (
                *("scene_ir.types", "scene_ir.errors", "detectors.types", "drivesem.failures.second_renderer"),
                *("drivesem.attacks.visibility", "drivesem.attacks.labels.Difficulty"),
            ),
            ("torch", "numpy", "scipy", "cv2", "pyrender", "OpenGL", "triton"),
            never=("drivesem.failures.second_renderer.generator", "drivesem.failures.second_renderer.selection"),
        )
        for name in ("base", "photograph", "baking", "geometry", "opengl", "shading")
    ),
    Rule("drivesem.run", ("scene_ir", "detectors", *(f"drivesem.{part}" for part in _BELOW_RUN)), None),
    Rule(
        "drivesem.analysis",
        ("scene_ir", "detectors", *(f"drivesem.{part}" for part in (*_BELOW_RUN, "run", "synth", "training"))),
        None,
    ),
    Rule(
        "drivesem.video",
        ("scene_ir", "detectors", *(f"drivesem.{part}" for part in (*_BELOW_RUN, "run", "synth"))),
        None,
    ),
    Rule(
        "drivesem.viewer",
        ("scene_ir", "detectors", *(f"drivesem.{part}" for part in (*_BELOW_RUN, "run"))),
        None,
    ),
    Rule("drivesem.reporting", ("scene_ir.errors", "scene_ir.files"), None, never=_NOT_IN_REPORTS),
    Rule(
        "drivesem.run.report",
        (
            "drivesem.reporting",
            "drivesem.run.results",
            "drivesem.failures.grades",
            "scene_ir.errors",
            "scene_ir.files",
        ),
        None,
        never=_NOT_IN_REPORTS,
    ),
)


@dataclass(frozen=True)
class Import:
    """The import of one module or member."""

    file: Path
    line: int
    name: str
    at_top: bool

    @property
    def importer(self) -> str:
        parts = self.file.relative_to(ROOT).with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)

    def __str__(self) -> str:
        return f"{self.file.relative_to(ROOT)}:{self.line} imports {self.name}"


def list_modules() -> list[Path]:
    """Every source file of the three packages."""
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def iterate_imports(path: Path, source: str | None = None) -> Iterator[Import]:
    """Yield every import of a file, those inside functions too; not those for the type checker alone."""
    tree = ast.parse(path.read_text(encoding="utf-8") if source is None else source, filename=str(path))
    type_checking = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    top = set(tree.body)
    for node in ast.walk(tree):
        if node in type_checking:
            continue
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(path, node.lineno, alias.name, node in top)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
            for alias in node.names:
                yield Import(path, node.lineno, f"{node.module}.{alias.name}", node in top)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("importlib.import_module", "__import__"):
            name = node.args[0]
            if path == COMMAND_TABLE and not isinstance(name, ast.Constant):
                yield Import(path, node.lineno, "drivesem.commands", False)
                continue
            if path in IMPORT_BY_NAME and not isinstance(name, ast.Constant):
                continue
            assert isinstance(name, ast.Constant), (
                f"{path}:{node.lineno}: the module of an import is not a constant"
            )
            yield Import(path, node.lineno, str(name.value), False)
        elif path in IMPORT_BY_NAME and isinstance(node, ast.Constant) and is_under(str(node.value), PACKAGES):
            yield Import(path, node.lineno, str(node.value), False)


@functools.cache
def list_imports() -> tuple[Import, ...]:
    """Every import of the three packages."""
    return tuple(imported for path in list_modules() for imported in iterate_imports(path))


def is_under(name: str, prefixes: tuple[str, ...]) -> bool:
    """Whether a dotted name is one of `prefixes` or below one."""
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes)


def is_forbidden(rule: Rule, imported: Import) -> bool:
    """Whether an import of a module under `rule.package` is against it."""
    if is_under(imported.name, rule.never):
        return True
    top = imported.name.partition(".")[0]
    if top in sys.stdlib_module_names or is_under(imported.name, (rule.package,)):
        return False
    if top in PACKAGES:
        return not is_under(imported.name, rule.project)
    if is_under(imported.importer, rule.adapters):
        return False
    return rule.libraries is not None and top not in rule.libraries


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.package)
def test_packages_import_only_what_they_may(rule: Rule) -> None:
    broken = [
        str(imported)
        for imported in list_imports()
        if is_under(imported.importer, (rule.package,)) and is_forbidden(rule, imported)
    ]
    assert not broken, "\n".join(broken)


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("scene_ir/io.py", "from drivesem.data import kitti"),
        ("scene_ir/types.py", "def f():\n    import detectors.types"),
        ("scene_ir/types.py", "import open3d"),
        ("detectors/boxes.py", "from scene_ir.types import Labels"),
        ("detectors/boxes.py", "import onnxruntime"),
        ("detectors/training.py", "from rich.progress import Progress"),
        ("drivesem/attacks/methods/base.py", "from drivesem.attacks import objective"),
        ("drivesem/attacks/methods/base.py", "from detectors import types"),
        ("drivesem/attacks/feasible/vehicles.py", "from scene_ir.render import compositor"),
        ("drivesem/attacks/feasibility_check.py", "from drivesem.attacks.feasible.projection import FeasibleSet"),
        ("drivesem/evaluation/coco.py", "from scene_ir.types import Labels"),
        (
            "drivesem/evaluation/coco.py",
            "import importlib\nimportlib.import_module('drivesem.attacks.labels')",
        ),
        ("drivesem/run/attack.py", "def f():\n    from drivesem.analysis import verify"),
        ("drivesem/analysis/verify.py", "from drivesem.commands import verify"),
        ("drivesem/run/report/page.py", "import torch"),
        ("drivesem/run/report/page.py", "from scene_ir.render import compositor"),
    ],
)
def test_the_rules_catch_what_they_forbid(file: str, source: str) -> None:
    imported = list(iterate_imports(ROOT / file, source))
    assert any(is_forbidden(rule, f) for rule in RULES for f in imported if is_under(f.importer, (rule.package,)))


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("scene_ir/io.py", "import json\nimport torch\nfrom scene_ir.types import Mesh"),
        ("detectors/adapters/onnx.py", "import onnxruntime"),
        (
            "drivesem/attacks/methods/gradient_ascent.py",
            "from drivesem.attacks.methods import base\nfrom scene_ir import ffd",
        ),
        ("drivesem/run/frame.py", "from scene_ir.render import compositor\nfrom detectors import registry"),
        ("drivesem/run/report/page.py", "import jinja2\nfrom drivesem.run.results import RunSummary"),
    ],
)
def test_the_rules_let_through_what_they_allow(file: str, source: str) -> None:
    imported = list(iterate_imports(ROOT / file, source))
    assert imported
    assert not [
        f for rule in RULES for f in imported if is_under(f.importer, (rule.package,)) and is_forbidden(rule, f)
    ]


def test_only_the_command_table_imports_commands_and_only_commands_import_benchmarks() -> None:
    front = ("drivesem.cli", "drivesem.commands", "drivesem.bench")
    broken = [
        str(imported)
        for imported in list_imports()
        if is_under(imported.name, ("drivesem.commands", "drivesem.bench"))
        and not is_under(imported.importer, front)
    ]
    assert not broken, "\n".join(broken)


def test_analyses_do_not_import_each_other() -> None:
    analyses = ("drivesem.analysis",)
    broken = [
        str(imported)
        for imported in list_imports()
        if is_under(imported.importer, analyses)
        and is_under(imported.name, analyses)
        and imported.importer.split(".")[2:3] != imported.name.split(".")[2:3]
    ]
    assert not broken, "\n".join(broken)


def test_the_product_does_not_import_tools() -> None:
    broken = [str(imported) for imported in list_imports() if is_under(imported.name, ("tools", "tests"))]
    assert not broken, "\n".join(broken)


def test_no_import_circle() -> None:
    """Imports inside functions count too: what needs them to be there is a circle as well."""
    names = {Import(path, 0, "", at_top=True).importer for path in list_modules()}
    needs: dict[str, set[str]] = {name: set() for name in names}
    for imported in list_imports():
        name = imported.name
        while name and name not in names:
            name = name.rpartition(".")[0]
        if name and name != imported.importer:
            needs[imported.importer].add(name)
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as circle:
        pytest.fail(" imports ".join(reversed(circle.args[1])))


def test_libraries_that_may_be_missing_are_imported_where_used() -> None:
    early = [str(f) for f in list_imports() if f.at_top and is_under(f.name, LOADED_WHERE_USED)]
    early = [line for line in early if not line.startswith("detectors/adapters")]
    assert not early, "\n".join(early)


def test_files_are_named_for_what_they_hold() -> None:
    assert not [
        str(path) for path in list_modules() if path.stem in ("utils", "util", "helpers", "misc", "common")
    ]


def test_top_level_names() -> None:
    try:
        listed = subprocess.run(
            ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("needs git and a checkout: top-level names are read from the tracked files")
    names = {name.partition("/")[0] for name in listed if not name.startswith(".")}
    assert names <= TOP_LEVEL_NAMES
    assert {path.name for path in ROOT.iterdir()} >= set(PACKAGES)


@pytest.mark.parametrize(
    "module",
    ["drivesem", "drivesem.cli", "drivesem.config.parsing", "scene_ir.files"],
)
def test_importing_loads_nothing_heavy(module: str) -> None:
    code = f"import sys, {module}; print(*sorted(set({HEAVY!r}) & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.split() == []


def test_an_attack_starts_without_what_few_frames_need(tmp_path: Path) -> None:
    """Command, options, attack, grader and source of scenes, as they are before the first frame of KITTI."""
    for name in ("label_2/000000.txt", "image_2/000000.png", "calib/000000.txt"):
        (tmp_path / "training" / name).parent.mkdir(parents=True)
        (tmp_path / "training" / name).touch()
    code = (
        "import sys, drivesem.commands.attack\n"
        "from drivesem.config.parsing import parse\n"
        "from drivesem.run.attack import build_attack, build_grader\n"
        "from drivesem.scenes.sources import compile_source_kernels, open_source\n"
        f"words = ['attack', '--dataset', 'kitti', '--root', {str(tmp_path)!r}, '--combo', '2', '--t-star', '0.5']\n"
        "config = parse(words)\n"
        "open_source(config), build_attack(config), build_grader(config, None), compile_source_kernels(config)\n"
        f"print(*(name for name in {FEW_FRAMES_NEED!r} if name in sys.modules))\n"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.split() == []


@pytest.mark.parametrize("protocol", ["coco", "kitti", "voc"])
def test_files_of_labels_are_evaluated_without_torch(protocol: str, tmp_path: Path) -> None:
    line = "Car 0.00 0 -10 10 10 60 60 -1 -1 -1 -1000 -1000 -1000 -10"
    for folder, text in (("truth", line), ("found", f"{line} 0.9")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "000000.txt").write_text(text)
    words = ["eval", "--gt", str(tmp_path / "truth"), "--pred", str(tmp_path / "found"), "--protocol", protocol]
    code = (
        "import sys\n"
        "from drivesem.cli import main\n"
        f"code = main({words!r})\n"
        f"print(code, *sorted(set({HEAVY!r}) & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0"]


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys, atexit\n"
        f"atexit.register(lambda: print('loaded:', *sorted(set({HEAVY!r}) & set(sys.modules))))\n"
        "sys.argv = ['drivesem', '--help']\n"
        "from drivesem.cli import main\n"
        "main()\n"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stderr
    assert found.stdout.rstrip().endswith("loaded:")
