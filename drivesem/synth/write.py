"""Generated frames as a data set on disk: in parallel, gone on with where a run stopped, the same bytes each
time."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

from drivesem.data.ground_truth import FrameLocation
from drivesem.data.registry import WRITERS, DatasetWriter
from drivesem.data.vkitti2 import Vkitti2Writer
from drivesem.synth.assets import Assets, assets_from, meshes_in, of_split
from drivesem.synth.edits import Edits, apply_edits, draw_night, read_edits
from drivesem.synth.exposure import expose
from drivesem.synth.frames import (
    GENERATOR_VERSION,
    SPLITS,
    VARIANTS,
    Plan,
    SynthFrame,
    SynthSettings,
    apply_variation,
    boxes_alone,
    plan_frame,
    render_frame,
    second_camera,
)
from drivesem.synth.layout import LayoutSettings
from drivesem.synth.variations import MIXED, parse_variations
from scene_ir import files
from scene_ir.errors import FormatError, RangeError

MANIFEST_VERSION = 2
_STATE = ".drivesem"
"""Hidden folder for what a run needs to go on: readers of the layouts never look into it."""
_DIGEST = "_digest"
"""Ends the names of a recipe's digests of folders."""
_READ = (
    *(".glb", ".gltf", ".obj", ".ply", ".yaml", ".npz"),
    *(".bin", ".mtl", ".png", ".jpg", ".jpeg", ".bmp", ".tga", ".tif", ".tiff", ".webp", ".gif"),
)
"""Files of vehicles and skies, and those that meshes name: a licence that is added changes no frame."""
_FIRST_WORLDS = (1, 2, 6, 18, 20)
"""Virtual KITTI's; further scenes take the numbers between and after."""
_STREETS_A_SCENE = 10
"""Single streets that share one of Virtual KITTI's scenes: their tracks stay below the 254 that its 8-bit instance
images can distinguish."""
_FEWEST_IN_A_DRIVE, _MOST_ATTEMPTS = 3, 10
TRACKS_A_STREET = 25
"""Track numbers set apart for each of those."""
Engine = Callable[["Callable[[Job], int]", "Sequence[Job]"], Iterator[int]]
"""Runs a function over independent jobs and yields the numbers of those done, in any order: processes, or a
cluster's."""


@dataclass(frozen=True, slots=True)
class Order:
    """What to make. out: folder; frames: how many streets' frames, each in every one of `variations` (Virtual
    KITTI's names, or "mixed": weather of its own). layout: of `drivesem.data.registry.WRITERS`. split: pool of
    shapes, "train" or "heldout". sequence: frames of one drive. people: pedestrians and cyclists too.
    varied_people: as of `layout.place_people`. cameras: 2 for Virtual KITTI 2's stereo. validation: share of the
    frames that belong to part "val", made of held-out shapes. night: share of the streets drawn by night. edits: a
    YAML file of `drivesem.synth.edits`. meshes, assets: folders of vehicles, of the optional pack.
    """

    out: Path
    frames: int
    seed: int = 0
    layout: str = "kitti"
    split: str = "train"
    variations: tuple[str, ...] = (MIXED,)
    sequence: int = 1
    people: bool = True
    varied_people: bool = False
    cameras: int = 1
    validation: float = 0.0
    night: float = 0.0
    edits: Path | None = None
    meshes: Path | None = None
    assets: Path | None = None
    resume: bool = True

    def __post_init__(self) -> None:
        for name, value in (("frames", self.frames), ("sequence", self.sequence)):
            if value < 1:
                raise RangeError(f"synth {name}", "at least 1", value)
        if self.split not in SPLITS:
            raise RangeError("synth split", " or ".join(SPLITS), self.split)
        if self.layout not in WRITERS:
            raise RangeError("synth layout", f"one of {', '.join(WRITERS)}", self.layout)
        if not 0 <= self.validation < 1:
            raise RangeError("synth validation", "a share in [0, 1)", self.validation)
        if not 0 <= self.night <= 1:
            raise RangeError("synth night", "a share in [0, 1]", self.night)
        if self.cameras not in (1, 2) or (self.cameras == 2 and self.layout != "vkitti2"):
            raise RangeError("synth cameras", "1, or 2 in layout vkitti2", self.cameras)
        if self.people and self.layout.startswith("vkitti"):
            raise RangeError("synth people", f"none in layout {self.layout}, which has no class for them", "some")
        if self.varied_people and not self.people:
            raise RangeError("synth varied_people", "none without people", "some")
        parse_variations(",".join(self.variations))
        _read_edits(self.edits)
        vehicles = _pack(self.meshes, self.assets).vehicles
        for split in (self.split, *(("heldout",) if self.validation else ())):
            if vehicles and not of_split(vehicles, split):
                place = self.assets if self.meshes is None else self.meshes
                found = ", ".join(vehicle.name for vehicle in vehicles)
                raise FormatError(str(place), f"a vehicle of split {split} (by its file name)", found)

    def recipe(self) -> dict[str, object]:
        """What decides on every byte of a frame; runs with another recipe do not go on in the same folder."""
        recipe = {k: v for k, v in asdict(self).items() if k not in ("out", "frames", "resume")}
        recipe["variations"] = list(self.variations)
        for name in ("night", "varied_people"):
            if not recipe[name]:
                # as in recipes from before there was such an option
                del recipe[name]
        if self.edits is not None:
            recipe["edits"] = hashlib.sha256(files.read_bytes(self.edits)).hexdigest()
        for name in ("meshes", "assets"):
            folder: Path | None = getattr(self, name)
            recipe[name] = None if folder is None else folder.name
            if folder is not None:
                recipe[name + _DIGEST] = self._digest(folder)
        return {"generator": GENERATOR_VERSION, "version": MANIFEST_VERSION, **recipe}

    def _digest(self, folder: Path) -> str:
        """Of the files below a folder that vehicles and skies are read from, and their names; not of what this
        order makes there.
        """
        known, made = hashlib.sha256(), self.out.resolve()
        inside = made.is_relative_to(folder.resolve())
        for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in _READ and path.is_file()):
            if not (inside and path.resolve().is_relative_to(made)):
                known.update(f"{path.relative_to(folder).as_posix()}\0{files.sha256_digest(path)}\0".encode())
        return known.hexdigest()

    def places(self) -> list[FrameLocation]:
        """The frames of the data set, in order: frame by frame, each in all its variations."""
        found = []
        for index in range(self.frames):
            street, time = divmod(index, self.sequence)
            per_scene = 1 if self.sequence > 1 else _STREETS_A_SCENE
            scene, inside = divmod(street, per_scene)
            for variation in self.variations:
                place = FrameLocation(
                    number=len(found),
                    scene=_scene_name(scene),
                    variation="clone" if variation == MIXED else variation,
                    frame=inside * self.sequence + time,
                    part=self._part(street),
                )
                found.append(place)
        return found

    def _part(self, street: int) -> str:
        """Which part a street's frames belong to: every so-and-so-many-th is for validation, evenly spread."""
        share = self.validation
        return "val" if int((street + 1) * share + 1e-9) > int(street * share + 1e-9) else "train"


@dataclass(frozen=True, slots=True)
class Job:
    """One frame to make."""

    order: Order
    place: FrameLocation
    index: int
    variation: str


def _scene_name(scene: int) -> str:
    others = (n for n in range(1, scene + len(_FIRST_WORLDS) + 1) if n not in _FIRST_WORLDS)
    return f"{[*_FIRST_WORLDS, *others][scene]:02d}"


def _entry_path(out: Path, number: int) -> Path:
    return out / _STATE / f"{number // 1000:03d}" / f"{number:06d}.json"


@lru_cache(maxsize=2)
def _read_edits(path: Path | None) -> Edits:
    return {} if path is None else read_edits(path)


def _pack(meshes: Path | None, assets: Path | None) -> Assets:
    """Vehicles and skies from the user's folders; a folder of meshes wins over the pack's vehicles."""
    pack = Assets((), ()) if assets is None else assets_from(assets)
    return pack if meshes is None else Assets(meshes_in(meshes), pack.skies)


def _busy_attempt(seed: int, start: int, split: str, settings: SynthSettings) -> int:
    """The first attempt at a drive that begins with some vehicles in view: one without would be empty for all its
    frames. Single frames are empty as often as KITTI's.
    """
    if settings.sequence == 1:
        return 0
    for attempt in range(_MOST_ATTEMPTS):
        seen = boxes_alone(plan_frame(seed, start, split, settings, attempt))
        if sum(truth.labelled for truth in seen) >= _FEWEST_IN_A_DRIVE:
            return attempt
    return 0


def _writer(order: Order) -> DatasetWriter:
    return Vkitti2Writer(order.out, 2) if order.cameras == 2 else WRITERS[order.layout](order.out)


def _rendered(plan: Plan) -> SynthFrame:
    frame = render_frame(plan)
    assert frame is not None
    return frame


def plan_job(job: Job) -> Plan:
    """What the frame will show, before it is rendered."""
    order = job.order
    split = "heldout" if job.place.part == "val" else order.split
    pack = _pack(order.meshes, order.assets)
    settings = SynthSettings(
        layout=LayoutSettings(
            variants=VARIANTS[split],
            people=order.people,
            fleet=of_split(pack.vehicles, split),
            varied_people=order.varied_people,
        ),
        skies=tuple(sky for sky in pack.skies if sky.split == split),
        sunny=job.variation != MIXED,
        camera=order.layout if order.layout in ("vkitti1", "vkitti2") else None,
        sequence=order.sequence,
        bent=True,
    )
    attempt = _busy_attempt(order.seed, job.index - job.index % order.sequence, split, settings)
    plan = apply_variation(plan_frame(order.seed, job.index, split, settings, attempt), job.variation)
    return apply_edits(draw_night(plan, order.night), _read_edits(order.edits), job.index)


def make_frame(job: Job) -> int:
    """Make one frame, with all its files, and leave its entry; the frame's number. Done before: nothing to do."""
    order, place = job.order, job.place
    writer = _writer(order)
    entry_path = _entry_path(order.out, place.number)
    if order.resume and entry_path.exists() and writer.exists(place):
        return place.number
    plan = plan_job(job)
    first_track = 0
    if order.layout.startswith("vkitti") and order.sequence == 1:
        first_track = TRACKS_A_STREET * (job.index % _STREETS_A_SCENE)
    exposure = expose(_rendered(plan), first_track)
    written = []
    if isinstance(writer, Vkitti2Writer) and order.cameras == 2:
        # The left camera last: where its photograph is, the frame is whole.
        written.append(writer.write(place, expose(_rendered(second_camera(plan)), first_track), camera=1))
    written.append(writer.write(place, exposure))
    objects = [
        {"track": o.track, "kind": o.kind, "model": o.model, "labelled": o.labelled} for o in exposure.objects
    ]
    manifest_row = {**asdict(place), **exposure.manifest, "objects": objects}
    entry = {"written": written, "manifest": manifest_row}
    files.write_text(entry_path, json.dumps(entry, allow_nan=False))
    return place.number


def list_jobs(order: Order) -> list[Job]:
    """All frames of the data set, in order."""
    variations = order.variations
    return [
        Job(order, place, place.number // len(variations), variations[place.number % len(variations)])
        for place in order.places()
    ]


def synthesise(order: Order, engine: Engine | None = None) -> Iterator[int]:
    """Make the data set of `order`. Yields the number of each finished frame.

    At the end come the files that frames share, and `manifest.json`: recipe, and each frame's seed, shapes and
    objects. A frame's bytes depend on its seed, index and settings alone, not on order, engine or number of
    frames. Raises FormatError where the folder holds frames of another recipe, before the first one is made.
    """
    stamp = order.out / _STATE / "recipe.json"
    recipe = order.recipe()
    if order.resume and stamp.exists():
        found = files.read_json(stamp)
        # Recipes of earlier versions have no digests.
        differing = {k for k in {*found, *recipe} if found.get(k) != recipe.get(k)}
        differing -= {k for k in recipe if k.endswith(_DIGEST) and k not in found}
        if differing:
            key = min(differing)
            raise FormatError(f"{stamp}: {key}", repr(recipe.get(key)), repr(found.get(key)))
    if not order.resume or not stamp.exists():
        files.write_json(stamp, recipe)
    return _made(order, recipe, engine or map)


def _made(order: Order, recipe: Mapping[str, object], engine: Engine) -> Iterator[int]:
    jobs = list_jobs(order)
    yield from engine(make_frame, jobs)
    _finish(order, recipe, jobs)


def _finish(order: Order, recipe: Mapping[str, object], jobs: Sequence[Job]) -> None:
    entries = [files.read_json(_entry_path(order.out, job.place.number)) for job in jobs]
    written = [rows for entry in entries for rows in entry["written"]]
    _writer(order).finish(written)
    frames = [entry["manifest"] for entry in entries]
    files.write_json(order.out / "manifest.json", {**recipe, "frames": frames})
