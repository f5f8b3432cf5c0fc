"""What was found on disk in a data set, and what became of it.

A reader names the files that it reads; every other file below the data set's folder is skipped, with a reason. Rows
of labels are counted by class as written.
"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from drivesem.config.errors import refuse
from drivesem.data.classes import class_role
from scene_ir.errors import SceneError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
"""Suffixes of images that all layouts read, in any letter case."""
_OTHER_IMAGES = (".gif", ".heic", ".heif", ".avif", ".jp2", ".svg", ".ppm", ".pgm", ".dng", ".jxl")
_MAX_REASONS = 10
"""Number of classes or reasons that a line names; the largest first."""


@dataclass(frozen=True, slots=True)
class DataAccount:
    """Files and rows of a data set, and what became of them. Files on disk = files read + files skipped."""

    layout: str
    """Layout."""
    frames: int
    """Frames."""
    files: int
    """Files that are read: images, labels, calibrations, lists."""
    skipped: Mapping[str, int]
    """Files that are not read, by reason."""
    classes: Mapping[str, int]
    """Rows of objects by class, as written."""
    regions: int = 0
    """Rows that are crowds or regions to ignore."""
    unlabelled: int = 0
    """Images without labels: they have no objects."""
    without_image: int = 0
    """Labels without an image: they cannot be used as frames."""
    splits: Mapping[str, int] = field(default_factory=dict)
    """Frames by split, of data sets that have splits."""
    unused_keys: tuple[str, ...] = ()
    """Keys of the data set's own description that are not used."""
    repairs: Mapping[str, int] = field(default_factory=dict)
    """Values that were not read as they are written, by what was done."""
    selection: str = ""
    """What was selected of the data set, with `--split` and `--where`."""
    mapping: Mapping[str, str | None] = field(default_factory=dict)
    """New class names, from `--map`."""

    def by_role(self) -> dict[str, dict[str, int]]:
        """Return rows by class, as written, for each role of a class; see `classes.class_role`."""
        roles: dict[str, dict[str, int]] = {"used": {}, "mapped": {}, "ignored": {}, "background": {}}
        for name, count in self.classes.items():
            role, target = class_role(name, self.mapping)
            roles[role][f"{name} as {target}" if role == "mapped" else name] = count
        return roles

    def to_json(self, roles: bool = True) -> dict[str, Any]:
        """Return the account as JSON; without `roles` rows are given by class alone, as in `summarise`."""
        rows = self.by_role() if roles else {"classes": dict(self.classes)}
        return {
            "layout": self.layout,
            "frames": self.frames,
            "files": self.files,
            "skipped": dict(self.skipped),
            "rows": {**rows, "regions": self.regions},
            "unlabelled": self.unlabelled,
            "without_image": self.without_image,
            "splits": dict(self.splits),
            "unused_keys": list(self.unused_keys),
            "repairs": dict(self.repairs),
            "selection": self.selection,
        }

    def summarise(self, roles: bool = True) -> str:
        """Return the account as one line.

        Args:
            roles: Name what becomes of each class; False where labels are only copied or compared by name.
        """
        text = f"{self.layout}: {_count(self.frames, 'image', 's')}, {_count(sum(self.classes.values()), 'box', 'es')}"
        text += f" in {_count(len(self.classes), 'class', 'es')}" if self.classes else ""
        by_role = self.by_role() if roles else {}
        parts = [f"{role}: {_list_largest(by_role[role])}" for role in ("mapped", "ignored") if by_role.get(role)]
        if by_role.get("background"):
            parts.append(f"background: {_list_largest(by_role['background'])}")
        counts = {
            "crowds and regions to ignore": self.regions,
            "images without labels": self.unlabelled,
            "labels without image": self.without_image,
        }
        parts += [f"{name}: {count:,}" for name, count in counts.items() if count]
        parts += [f"splits: {_list_largest(self.splits)}"] if len(self.splits) > 1 else []
        parts += [f"not used: {', '.join(self.unused_keys[:_MAX_REASONS])}"] if self.unused_keys else []
        parts += [f"repaired: {_list_largest(self.repairs)}"] if self.repairs else []
        parts += [f"skipped files: {_list_largest(self.skipped)}"] if self.skipped else []
        parts += [self.selection] if self.selection else []
        return "; ".join([text, *parts])


def write_account(account: DataAccount | None, roles: bool = True) -> dict[str, Any]:
    """Write an account as one line to stderr, and return it as JSON.

    Args:
        account: The account; None writes nothing and returns an empty object.
        roles: Name what becomes of each class; see `DataAccount.summarise`.

    Raises:
        UsageError: `--map` names a class that the data set does not have.
    """
    if account is None:
        return {}
    for name in account.mapping:
        known = ", ".join(sorted(account.classes)[:_MAX_REASONS]) or "none"
        refuse(name not in account.classes, f"--map {name}", f"a class of the data set ({known})", "no such class")
    sys.stderr.write(f"{account.summarise(roles)}\n")
    return account.to_json(roles)


class AccountedData(Protocol):
    """Data that can be accounted for: a data set, or a source of scenes."""

    def account(self) -> DataAccount | None:
        """Account for all files and label rows; None where there is no data set."""
        ...


def write_account_of(data: AccountedData, keep_going: bool) -> dict[str, Any]:
    """Account for data as `write_account` does. With `keep_going`, a damaged file is named instead of raised.

    Raises:
        SceneError: A file is damaged, and `keep_going` is not set.
        UsageError: See `write_account`.
    """
    try:
        account = data.account()
    except SceneError as error:
        if not keep_going:
            raise
        sys.stderr.write(f"files and boxes were not counted: {error}\n")
        return {"not_counted": str(error)}
    return write_account(account)


def _count(number: int, noun: str, plural: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else plural}"


def _list_largest(counts: Mapping[str, int]) -> str:
    ordered = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    text = ", ".join(f"{name} {count:,}" for name, count in ordered[:_MAX_REASONS])
    rest = ordered[_MAX_REASONS:]
    return text + (f", {len(rest)} more with {sum(count for _, count in rest):,}" if rest else "")


def sum_accounts(accounts: Sequence[DataAccount]) -> DataAccount:
    """Add the accounts of several data sets of one layout."""
    numbers = ("frames", "files", "regions", "unlabelled", "without_image")
    counts = ("skipped", "classes", "splits", "repairs")
    return replace(
        accounts[0],
        unused_keys=tuple(dict.fromkeys(key for one in accounts for key in one.unused_keys)),
        **{name: sum(getattr(one, name) for one in accounts) for name in numbers},
        **{name: dict(sum((Counter(getattr(one, name)) for one in accounts), Counter())) for name in counts},
    )


def account_for_files(
    root: Path, read: Iterable[Path | str], reasons: Mapping[str, str] | None = None
) -> tuple[int, dict[str, int]]:
    """Count the files below a folder that are read, and those that are skipped, by reason.

    Args:
        root: Folder of the data set.
        read: Files that are read; those outside of the folder, or missing ones, do not count.
        reasons: Reasons by file, for skipped files that a reader knows more about than their suffix.

    Returns:
        Number of files read, and of files skipped by reason.
    """
    wanted, known = {os.fspath(path) for path in read}, reasons or {}
    skipped: Counter[str] = Counter()
    count = 0
    for folder, folders, names in os.walk(root):
        folders.sort()
        for name in names:
            path = f"{folder}{os.sep}{name}"
            if path in wanted:
                count += 1
            else:
                skipped[known.get(path) or _reason(name)] += 1
    return count, dict(skipped)


def _reason(name: str) -> str:
    suffix = os.path.splitext(name)[1].lower()
    if name.startswith("."):
        return "hidden"
    if suffix in _OTHER_IMAGES:
        return f"{suffix} not readable"
    if suffix in IMAGE_SUFFIXES:
        return "image that no label or folder of the layout names"
    return f"{suffix} not part of the layout" if suffix else "no suffix"
