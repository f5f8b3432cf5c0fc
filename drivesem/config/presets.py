"""Presets by name: the YAML files of `configs`, which a wheel brings along."""

from __future__ import annotations

from functools import cache
from importlib import metadata
from pathlib import Path

_INSTALLED = "share/drivesem/configs/"
"""Where pyproject.toml has a wheel put them."""


@cache
def presets() -> dict[str, Path]:
    """The presets by name: of the clone that this code is from, else of what is installed."""
    clone = Path(__file__).resolve().parents[2]
    if (clone / "pyproject.toml").is_file() and (clone / "configs").is_dir():
        found = sorted((clone / "configs").glob("*.yaml"))
    else:
        found = _installed()
    return {path.stem: path for path in found}


def _installed() -> list[Path]:
    try:
        files = metadata.files("drivesem") or []
    except metadata.PackageNotFoundError:
        return []
    named = (file for file in files if _INSTALLED in file.as_posix() and file.suffix == ".yaml")
    return sorted(Path(str(file.locate())).resolve() for file in named)


def preset_path(name: str) -> str:
    """The file that `--config` means: a file as it stands, else a preset by its name, also as configs/NAME.yaml.
    What is neither is given back as it is.
    """
    path = Path(name)
    if path.exists():
        return name
    plain = path.stem if path.suffix in (".yaml", ".yml") else path.name
    if path.parent.name in ("", "configs") and plain in presets():
        return str(presets()[plain])
    return name


def remark(path: Path) -> str:
    """What a preset is for: the comment at its beginning."""
    lines = path.read_text(encoding="utf-8").splitlines()
    told: list[str] = []
    for line in lines:
        if not line.startswith("#"):
            break
        told.append(line.removeprefix("#").strip())
    return " ".join(told)
