"""What `drivesem` and `drivesem COMMAND --help` say: commands by topic, options by what they are about.

Texts are the docstrings beside the settings; nothing heavy is imported.
"""

from __future__ import annotations

import ast
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from drivesem.config.blocks import CommandConfig, Options, option

TOPICS: dict[str, tuple[str, ...]] = {
    "Find failures": ("attack", "drive", "report", "runs"),
    "Are they real, and why": (
        *("verify", "confirm", "explain", "plausibility", "realism"),
        *("survey", "survey-results"),
    ),
    "How large, and who else": ("holes", "gate", "transfer", "study", "worth"),
    "Train, and hand on": ("train", "retrain", "anchors", "export", "convert"),
    "Scenes and data": ("derender", "render", "edit", "view", "synth", "eval"),
    "Classifiers of images": ("classify",),
    "Is all well": ("doctor", "presets", "check", "gradcheck", "bench"),
}
"""Every command, by what one wants to know."""
EXAMPLES = (
    ("drivesem attack --combo 2", "the shipped detector on ten generated streets; needs no data"),
    ("drivesem attack --dataset kitti --root PATH_TO_KITTI --limit 20 --out runs/a", "on photographs of yours"),
    ("drivesem attack --dataset photographs --root holiday.jpg", "on a photograph without labels"),
    ("drivesem attack --config quick", "a preset; drivesem presets lists them"),
    ("drivesem drive", "one change of each car over a whole clip: for how long is it missed?"),
    ("drivesem explain runs/a", "why it fails"),
    ("drivesem view runs/a", "move the cars yourself, in the browser, and see what the detector says"),
    ("drivesem export runs/a --to coco --out for-training", "the counterexamples as training data"),
    ("drivesem doctor", "what this machine has, and what is missing"),
)
GROUPS: dict[str, tuple[str, ...]] = {
    "what is attacked": (
        *("detector", "dataset", "root", "split", "limit", "part", "focal", "finder", "tiles", "t_star"),
    ),
    "what may change": (
        *(
            "combo",
            "params",
            "budget",
            "parametrisation",
            "changes",
            "mesh",
            "project",
            "target_objects",
            "target_classes",
        ),
    ),
    "how it is searched": (
        *("method", "steps", "queries", "passes", "early_stop", "objective", "objective_labels", "keep"),
        *("scouts", "restarts", "range", "rate", "momentum", "step_form", "norm", "like"),
    ),
    "how sure a failure is": ("grade", "draws", "nuisances", "confirm", "witness", "peer", "bootstrap"),
    "results": ("out", "resume", "json", "keep_going", "seed", "trust"),
    "how it is computed": (
        *("workers", "engine", "address", "device", "precision", "backend", "whole", "incremental", "keep_mb"),
        *("fit", "cache", "cache_gb"),
    ),
}
"""Options that many commands share, by what they are about. A command's others stand first."""
_OWN = "options"
_WIDEST, _INDENT = 100, 6


def overview(commands: Mapping[str, type[CommandConfig]], prog: str) -> str:
    """Commands by topic, each with a line, and examples."""
    lines = ["Find out where a driving detector breaks: semantic counterexamples by gradient.", ""]
    lines += [f"usage: {prog} COMMAND [options]; {prog} COMMAND --help lists them", ""]
    width = _width()
    ours = prog == "drivesem"
    for topic, names in (TOPICS if ours else {"Commands": tuple(commands)}).items():
        lines.append(topic)
        for name in names:
            lines += _wrapped(_brief(commands[name]), width, f"  {name:<15} ", " " * 18)
        lines.append("")
    lines.append("Examples")
    for words, meaning in EXAMPLES if ours else ():
        lines += [f"  {words}", *_wrapped(meaning, width, " " * _INDENT)]
    lines += ["", "docs/commands.md tells exit codes, shell completion, and what a run holds"]
    return "\n".join(lines) + "\n"


def _width() -> int:
    return min(shutil.get_terminal_size().columns, _WIDEST)


def _wrapped(text: str, width: int, first: str = "", rest: str | None = None) -> list[str]:
    indent = first if rest is None else rest
    return textwrap.wrap(text, width, initial_indent=first, subsequent_indent=indent)


def _brief(kind: type[CommandConfig]) -> str:
    """The first sentence of a command's docstring, without its full stop."""
    return " ".join((kind.__doc__ or "").split()).split(". ")[0].rstrip(".")


def command_help(name: str, commands: Mapping[str, type[CommandConfig]], prog: str) -> str:
    """Usage, what the command does, and its options in groups."""
    kind = commands[name]
    hints = get_type_hints(kind, include_extras=True)
    told = {field.name: _Told.of(field, hints[field.name], _texts(kind)) for field in fields(kind)}
    positional = [one.names for one in told.values() if one.positional]
    positional += ["RUN"] if "run" in told else []
    usage = " ".join([f"usage: {prog}", name, *positional, "[options]"])
    width = _width()
    lines = [usage, "", *_wrapped(" ".join((kind.__doc__ or "").split()), width), ""]
    for title, group in grouped(kind):
        lines.append(f"{title}:")
        for one in (told[field] for field in group):
            lines += [f"  {one.names}", *_wrapped(one.text, width, " " * _INDENT)]
        lines.append("")
    config = "--config PRESET reads options from a preset or a YAML file (drivesem presets); what is typed wins."
    return "\n".join([*lines, *_wrapped(config, width)]) + "\n"


def grouped(kind: type[CommandConfig]) -> list[tuple[str, tuple[str, ...]]]:
    """The fields of a command by the title of their group, each once, in the order of the groups."""
    own = [field.name for field in fields(kind) if str(field.type) != "CommandName"]
    shared = {field for group in GROUPS.values() for field in group}
    groups = [(_OWN, tuple(field for field in own if field not in shared))]
    groups += [(title, tuple(field for field in group if field in own)) for title, group in GROUPS.items()]
    return [(title, group) for title, group in groups if group]


@dataclass(frozen=True)
class _Told:
    """One option. names: as it is written; text: what it does, and its default."""

    name: str
    names: str
    text: str
    positional: bool

    @classmethod
    def of(cls, field: Field[Any], hint: Any, texts: dict[str, str]) -> _Told:
        markers = [marker for marker in getattr(hint, "__metadata__", ()) if hasattr(marker, "aliases")]
        metavar = next((marker.metavar for marker in markers if marker.metavar), None)
        aliases = [name for marker in markers for name in marker.aliases or ()]
        positional = any("Positional" in repr(marker) for marker in getattr(hint, "__metadata__", ()))
        text, default = texts.get(field.name, ""), field.default
        required = default is MISSING and not positional
        if not positional and default not in (MISSING, None, False, (), ""):
            text += f" (default: {_default(default)})"
        names = metavar or _value(hint)
        if not positional:
            flag = option(field.name)
            pair = f"{flag}, {option(f'no-{field.name}')}" if default is True else flag
            names = " ".join(filter(None, [", ".join([pair, *aliases]), "" if _is_flag(hint) else names]))
        return cls(field.name, names, f"{text} (required)" if required else text, positional)


def _default(value: object) -> str:
    return "on" if value is True else str(value)


def _plain(hint: Any) -> Any:
    """A type without its markers and without None."""
    while hasattr(hint, "__metadata__"):
        hint = get_args(hint)[0]
    parts = [part for part in get_args(hint) if part is not type(None)]
    if get_origin(hint) not in (Literal, tuple) and len(parts) == 1:
        return _plain(parts[0])
    return hint


def _is_flag(hint: Any) -> bool:
    return _plain(hint) is bool


def _value(hint: Any) -> str:
    """What stands for a value: its choices, or its kind."""
    kind = _plain(hint)
    if get_origin(kind) is Literal:
        return "{" + ",".join(map(str, get_args(kind))) + "}"
    return {int: "N", float: "NUMBER"}.get(kind, "TEXT")


def _texts(kind: type[CommandConfig]) -> dict[str, str]:
    """The docstrings of a command's fields: of a field that is declared twice, its own."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if issubclass(base, Options):
            texts |= _written(base.__module__).get(base.__name__, {})
    return texts


@cache
def _written(module: str) -> dict[str, dict[str, str]]:
    """Field docstrings by class of a module, from its source."""
    path = Path(str(sys.modules[module].__file__))
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name: dict(_documented(node)) for node in tree.body if isinstance(node, ast.ClassDef)}


def _documented(node: ast.ClassDef) -> Iterator[tuple[str, str]]:
    for field, text in zip(node.body, node.body[1:], strict=False):
        if not (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)):
            continue
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
            yield field.target.id, " ".join(str(text.value.value).split())
