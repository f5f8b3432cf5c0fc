"""From a frame of a run to what the scene generator planned for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from drivesem.config.errors import UsageError
from drivesem.synth.demo import demo_plan
from drivesem.synth.frames import GENERATOR_VERSION, Plan
from drivesem.synth.write import Order, jobs_of, plan_of
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.types import SceneIR

MANIFEST = "manifest.json"
_GENERATED = "a run on generated frames: the embedded scenes, or drivesem synth --layout kitti"
_NOT_KEPT = ("edits", "meshes", "assets")
"""What a recipe names without holding it."""


@dataclass(frozen=True, slots=True)
class Planned:
    """plan: of the frame before the attack. tracks: of each of the scene's objects; None where the plan has no
    counterpart.
    """

    plan: Plan
    tracks: tuple[int | None, ...]


class Plans(Protocol):
    """Plans by frame. Cheap to construct, so that every worker has its own."""

    def planned(self, identifier: str, scene: SceneIR) -> Planned:
        """What the generator planned for a frame. scene: the run's. FormatError where that cannot be known."""
        ...


class DemoPlans:
    """Of the embedded scenes: their provenance names seed, street and attempt."""

    def planned(self, identifier: str, scene: SceneIR) -> Planned:
        """Objects are the plan's actors, in order."""
        try:
            origin = [int(scene.provenance[name]) for name in ("seed", "index", "attempt")]
        except (KeyError, ValueError) as error:
            raise FormatError(f"scene of {identifier}: provenance", "seed, index, attempt", error) from error
        plan = demo_plan(*origin)
        if plan is None:
            raise FormatError(f"scene of {identifier}: provenance", "an embedded scene's", origin)
        known = [actor.track for actor in plan.actors]
        return Planned(plan, tuple(known[i] if i < len(known) else None for i in range(len(scene.objects))))


class FolderPlans:
    """Of a folder in KITTI's layout that `drivesem synth` wrote: its manifest names recipe and tracks.

    Raises UsageError for a folder of photographs, FormatError for a manifest that says too little.
    """

    def __init__(self, root: Path) -> None:
        # Readers take the folder of a data set, or the part of it that holds the pictures.
        self._path = next((f / MANIFEST for f in (root, root.parent) if (f / MANIFEST).is_file()), root / MANIFEST)
        if not self._path.is_file():
            raise UsageError("--run", _GENERATED, f"one on {root}, which has no {MANIFEST}")
        manifest = files.read_json(self._path)
        if not isinstance(manifest, dict) or "generator" not in manifest:
            raise UsageError("--run", _GENERATED, f"one on {root}, whose {MANIFEST} is another program's")
        if manifest["generator"] != GENERATOR_VERSION:
            version = f"version {GENERATOR_VERSION}, which alone gives the same pictures"
            raise FormatError(f"{self._path}: generator", version, manifest["generator"])
        if manifest.get("layout") != "kitti":
            raise UsageError("--run", _GENERATED, f"layout {manifest.get('layout')}")
        for name in _NOT_KEPT:
            if manifest.get(name) is not None:
                raise FormatError(f"{self._path}: {name}", "none: such files are not kept", manifest[name])
        try:
            self._frames: list[dict[str, Any]] = list(manifest["frames"])
            self._jobs = jobs_of(_order(self._path.parent, manifest))
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(str(self._path), "a manifest as drivesem synth writes it", error) from error

    def planned(self, identifier: str, scene: SceneIR) -> Planned:
        """Objects are rows of the label file, which holds the manifest's labelled objects in order."""
        if not identifier.isdecimal() or int(identifier) >= len(self._frames):
            raise FormatError(f"{self._path}: frames", f"frame {identifier}", f"{len(self._frames)} others")
        number = int(identifier)
        try:
            labelled = [one["track"] for one in self._frames[number]["objects"] if one["labelled"]]
        except (KeyError, TypeError) as error:
            raise FormatError(f"{self._path}: frame {number}", "objects with tracks", error) from error
        rows = [scene.provenance.get(f"objects[{i}].label", "") for i in range(len(scene.objects))]
        tracks = (labelled[int(r)] if r.isdecimal() and int(r) < len(labelled) else None for r in rows)
        plan = plan_of(self._jobs[number])
        known = {actor.track for actor in plan.actors}
        return Planned(plan, tuple(track if track in known else None for track in tracks))


def _order(root: Path, manifest: Mapping[str, Any]) -> Order:
    variations = tuple(manifest["variations"])
    return Order(
        out=root,
        frames=len(manifest["frames"]) // len(variations),
        seed=manifest["seed"],
        layout=manifest["layout"],
        split=manifest["split"],
        variations=variations,
        sequence=manifest["sequence"],
        people=manifest["people"],
        cameras=manifest["cameras"],
        validation=manifest["validation"],
    )
