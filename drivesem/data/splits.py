"""Which frames of a data set: 3D-SDN's split of Virtual KITTI, a share drawn at random, or names in a file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drivesem.data.registry import Dataset
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.types import Frame, Labels

PUBLISHED = ("3d-sdn", "3d-sdn-train")
"""Splits by name: the frames to test on, and those to train on."""
_TESTED = {1: range(356, 447), 2: range(185, 233), 6: range(69), 18: range(270, 339), 20: range(167)}
"""Frames of each world that 3D-SDN tests on, in all ten variations; all others are trained on (Yao et al. 2018,
`get_lists` of their code): 4,440 and 16,820 of 21,260 images.
"""


_RANDOM = re.compile(r"random:(0?\.\d+)(:rest)?")
_STREAM = 20261125
"""Of the random order, the same for both of its parts."""


class ChosenFrames:
    """Some frames of a data set, in its order."""

    def __init__(self, dataset: Dataset, names: Sequence[str]) -> None:
        self._dataset, self._names = dataset, tuple(names)

    @property
    def identifiers(self) -> tuple[str, ...]:
        """Of the frames that were chosen."""
        return self._names

    def labels(self, identifier: str) -> Labels | None:
        """The labels of one frame; None where the data set has none."""
        return self._dataset.labels(identifier)

    def frame(self, identifier: str) -> Frame:
        """One frame. FormatError naming the file where something is wrong with it."""
        return self._dataset.frame(identifier)


def chosen(dataset: Dataset, split: str) -> Dataset:
    """The frames of a split: one of PUBLISHED, which is Virtual KITTI's; `random:0.75`, a share drawn at random
    and always the same, or `random:0.75:rest`, all others; or a text file with a name a line, with or without an
    ending such as .png. FormatError for other data sets, for a name that it has no frame of, and where no frame is
    left.
    """
    names, share = dataset.identifiers, _RANDOM.fullmatch(split)
    if split in PUBLISHED:
        kept = {name for name in names if _is_tested(name) == (split == PUBLISHED[0])}
    elif share is not None:
        order = np.random.default_rng(_STREAM).permutation(len(names))
        count = round(float(share[1]) * len(names))
        kept = {names[i] for i in (order[count:] if share[2] else order[:count])}
    else:
        kept = _named(Path(split), names)
    if not kept:
        raise FormatError(f"--split {split}", "at least one frame of the data set", f"none of {len(names)}")
    return ChosenFrames(dataset, [name for name in names if name in kept])


def _is_tested(name: str) -> bool:
    """Whether 3D-SDN tests on a frame, `0001/clone/00003` or `Scene01/clone/Camera_0/00003`."""
    world, number = name.split("/")[0].removeprefix("Scene"), name.split("/")[-1]
    if "/" not in name or not (world.isdecimal() and number.isdecimal()) or int(world) not in _TESTED:
        worlds = ", ".join(map(str, _TESTED))
        raise FormatError("--split", f"frames of Virtual KITTI's worlds {worlds} (vkitti1, vkitti2)", repr(name))
    return int(number) in _TESTED[int(world)]


def _named(path: Path, names: Sequence[str]) -> set[str]:
    known = set(names)
    found: set[str] = set()
    for number, line in enumerate(files.read_text(path).splitlines(), start=1):
        name = line.strip()
        if name and name not in known:
            name = str(Path(name).with_suffix("")) if Path(name).name else name  # "." and "/" have none
            if name not in known:
                raise FormatError(
                    f"{path}:{number}", f"a frame such as {names[0]}" if names else "nothing", repr(line)
                )
        found |= {name} - {""}
    return found
