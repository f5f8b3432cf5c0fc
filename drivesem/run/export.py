"""Exports counterexamples of a run as data sets with provenance, as tables, as glTF scenes, and as a gate's package.

Axes of a glTF scene are glTF's: x right, y up, looking along -z from the camera at the origin; metres.
"""

from __future__ import annotations

import io
import lzma
import shutil
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivesem.config.errors import UsageError
from drivesem.data.label_table import WriteSummary, xyxy_to_coco
from drivesem.failures.grades import Grade
from drivesem.failures.second_renderer.geometry import PictureCamera
from drivesem.failures.second_renderer.photograph import PhotographRenderer
from drivesem.reporting.drawing import write_picture
from drivesem.reporting.tables import Console, progress_bar, rows_to_csv
from drivesem.run.conversion import ConversionSettings, convert_labels, provenance
from drivesem.run.finished import METRICS, AttackRun, RunFrame
from drivesem.run.folder import CONFIG, FRAMES, REFERENCED_FILES
from drivesem.run.frame import certain_losses, has_grade
from drivesem.run.labels import RESULT
from drivesem.run.records import from_json
from drivesem.run.results import FrameResult, load_frame
from drivesem.scenes.sources import find_scene_folders
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene, save_scene, to_uint8
from scene_ir.types import SceneIR

PROVENANCE = "provenance.json"
"""File of an exported data set that describes each picture."""
DETECTIONS = "detections.json"
"""The attacked detector's detections as COCO results."""


def select_frames_by_grade(run: AttackRun, grade: str) -> list[FrameResult]:
    """Return the frames with a failure of at least this grade ("all": every frame). Raises UsageError for none."""
    results = [frame.result for frame in run.frames]
    selected = results if grade == "all" else [r for r in results if any(map(has_grade(Grade(grade)), r.failures))]
    if not selected:
        expected = "a failure of this grade (--grade all also takes frames without failures)"
        raise UsageError(f"--grade {grade}", expected, f"none of {len(run.frames)}")
    return selected


def export_dataset(
    run: AttackRun, out: Path, layout: str, grade: str, mapping: Mapping[str, str | None] | None = None
) -> WriteSummary:
    """Write the counterexamples of a run as a data set: pictures, moved labels, and `PROVENANCE`.

    Args:
        run: The run.
        out: Folder of the data set.
        layout: Label layout.
        grade: Lowest grade of a frame's failures, or "all".
        mapping: New names of classes; None drops a class.

    Raises:
        UsageError: No frame has the grade, or a class is unknown.
        FormatError: A file of the run is damaged.
    """
    results = select_frames_by_grade(run, grade)
    names = [result.identifier for result in results]
    settings = ConversionSettings(layout, "run", copy_images=True, mapping=mapping or {}, frames=names)
    written, _ = convert_labels(run.folder, out, settings)
    frames = [
        {
            "number": i,
            **provenance(run.folder, result),
            "change": result.change,
            "failed": [failure.to_row() for failure in result.failures],
        }
        for i, result in enumerate(results)
    ]
    about = {"run": run.name, "detector": run.detector, "method": run.method, "params": run.params.split(",")}
    files.write_json(out / PROVENANCE, {**about, "layout": layout, "labels": "moved", "frames": frames})
    count = written.files + 1
    if layout == "coco":
        _write_detections(out, results)
        count += 1
    return WriteSummary(count, written.lost, written.assumed)


def _write_detections(out: Path, results: Sequence[FrameResult]) -> None:
    """Write COCO results with the annotations' ids, without classes that the annotations lack."""
    annotations = files.read_json(out / "annotations" / "instances_all.json")
    categories = {row["name"]: row["id"] for row in annotations["categories"]}
    images = {row["drivesem"]["frame"]: row["id"] for row in annotations["images"]}
    rows = [
        {
            "image_id": images[result.identifier],
            "category_id": categories[box.label],
            "bbox": xyxy_to_coco(np.array(box.xyxy, np.float64)).tolist(),
            "score": box.score,
        }
        for result in results
        for box in result.detections_attacked
        if box.label in categories
    ]
    files.write_json(out / DETECTIONS, rows)


def build_tables(run: AttackRun, results: Sequence[FrameResult]) -> dict[str, list[dict[str, Any]]]:
    """Return flat rows by table: frames, failures, and theta (a row per coordinate). Each row names its frame."""
    names = {result.identifier for result in results}
    theta = [{"frame": result.identifier, **asdict(one)} for result in results for one in result.theta]
    return {
        "frames": [row for row in run.rows() if row["frame"] in names],
        "failures": [row for row in run.failure_rows() if row["frame"] in names],
        "theta": theta,
    }


def write_tables(tables: Mapping[str, Sequence[Mapping[str, Any]]], out: Path) -> list[str]:
    """Write each table that has rows as CSV, and as Parquet if pyarrow is installed. Returns the file names."""
    written: list[str] = []
    for name, rows in tables.items():
        if not rows:
            continue
        files.write_text(out / f"{name}.csv", rows_to_csv(rows))
        written.append(f"{name}.csv")
        if find_spec("pyarrow") is not None:
            files.write_bytes(out / f"{name}.parquet", _rows_to_parquet(rows))
            written.append(f"{name}.parquet")
    return written


def _rows_to_parquet(rows: Sequence[Mapping[str, Any]]) -> bytes:
    import pyarrow  # pyright: ignore[reportMissingImports]
    import pyarrow.parquet  # pyright: ignore[reportMissingImports]

    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist([dict(row) for row in rows]), sink)
    return sink.getvalue().to_pybytes()


PACKAGE = "package.json"
"""File of a gate's package with its failures and the SHA-256 of every other file."""
_PACKAGE_SCHEMA = 1
_SCENE, _ARCHIVE, _PHOTOGRAPH, _AFTER = "scene", "frame.tar.xz", "photograph.jpg", "counterexample.jpg"
"""Folder of a frame's scene; files of a frame of a package. The archive holds the scene without its photograph."""
_MAX_UNPACKED_BYTES = 1 << 28
"""Size limit of an unpacked frame: 1280x720 has 8 MB."""


@dataclass(frozen=True, slots=True)
class GateSource:
    """A run, or what a package holds of one."""

    run: AttackRun
    """The run; of a package, with its failing frames only."""
    frames: int
    """Number of frames of the whole run."""
    frames_attacked: int
    """Number of those that had something to attack."""

    @classmethod
    def from_run(cls, run: AttackRun) -> GateSource:
        """Count the frames of a run."""
        return cls(run, len(run.frames), sum(frame.result.attacked for frame in run.frames))


def export_gate_package(run: AttackRun, out: Path) -> dict[str, Any]:
    """Write what `drivesem gate` needs of a run: its frames with certain failures of objects, as lossy scenes.

    Returns its failures, frames, bytes, and SHA-256 of `PACKAGE`. Raises UsageError if there is no such failure.
    """
    failing = [frame for frame in run.frames if certain_losses(frame.result)]
    if not failing:
        expected = "a run with a certain failure of an object, which a gate compares detectors at"
        raise UsageError("--to gate", expected, f"none in {len(run.frames)} frames of {run.folder}")
    with files.atomic_folder(out) as folder:
        for name in (CONFIG, REFERENCED_FILES, METRICS):
            if (run.folder / name).is_file():
                shutil.copy(run.folder / name, folder)
        with progress_bar(Console(stderr=True), keep=False) as bar:
            task = bar.add_task("packing frames", total=len(failing))
            for frame in failing:
                _pack_frame(frame, folder / FRAMES / frame.result.identifier)
                bar.advance(task)
        paths = sorted(path for path in folder.rglob("*") if path.is_file())
        failures = [
            {"frame": frame.result.identifier, **failure.to_row()}
            for frame in failing
            for failure in certain_losses(frame.result)
        ]
        source = GateSource.from_run(run)
        package = {
            "schema": _PACKAGE_SCHEMA,
            "run": run.name,
            "frames": source.frames,
            "frames_attacked": source.frames_attacked,
            "failures": failures,
            "files": {path.relative_to(folder).as_posix(): files.sha256_digest(path) for path in paths},
        }
        files.write_json(folder / PACKAGE, package)
        size = sum(path.stat().st_size for path in (*paths, folder / PACKAGE))
    digest = files.sha256_digest(out / PACKAGE)
    return {"out": str(out), "failures": len(failures), "frames": len(failing), "bytes": size, "sha256": digest}


def _pack_frame(frame: RunFrame, folder: Path) -> None:
    folder.mkdir(parents=True)
    write_picture(folder / _AFTER, files.read_image(frame.pictures["attacked"]))
    with tempfile.TemporaryDirectory(prefix="drivesem-pack-") as temporary:
        packed = Path(temporary)
        write_lossy_frame(frame.folder, packed)
        shutil.move(packed / _SCENE / _PHOTOGRAPH, folder / _PHOTOGRAPH)
        buffer = io.BytesIO()
        with tarfile.open(fileobj=buffer, mode="w:xz") as archive:
            for path in sorted(path for path in packed.rglob("*") if path.is_file()):
                entry = tarfile.TarInfo(path.relative_to(packed).as_posix())  # without owner and date
                entry.size = path.stat().st_size
                with path.open("rb") as stream:
                    archive.addfile(entry, stream)
        files.write_bytes(folder / _ARCHIVE, buffer.getvalue())


def write_lossy_frame(frame: Path, folder: Path) -> Path:
    """Write a frame of a run, its result and lossy scene, to `folder`. Returns the folder that holds them: `frame`
    itself if its scene is lossy.
    """
    if (frame / _SCENE / _PHOTOGRAPH).is_file():
        return frame
    save_scene(load_scene(frame / _SCENE), folder / _SCENE, lossy=True)
    shutil.copy(frame / RESULT, folder)
    return folder


@contextmanager
def open_gate_package(source: Path, limit: int | None = None) -> Iterator[GateSource]:
    """Unpack a gate's package to a temporary folder, as a run with the frames that it holds, or the first `limit`.

    Raises FormatError naming the first file that is damaged, missing or too many.
    """
    record = files.read_json(source / PACKAGE)
    if not isinstance(record, dict) or record.get("schema") != _PACKAGE_SCHEMA:
        raise FormatError(str(source / PACKAGE), f"a package of schema {_PACKAGE_SCHEMA}", "another")
    digests = from_json(dict[str, str], record.get("files"), f"{source / PACKAGE}: files")
    run_name = from_json(str, record.get("run"), f"{source / PACKAGE}: run")
    counts = [from_json(int, record.get(n), f"{source / PACKAGE}: {n}") for n in ("frames", "frames_attacked")]
    files.check_links(source)
    for name, digest in digests.items():
        path = files.resolve_inside(source, name)
        if (found := files.sha256_digest(path)) != digest:
            raise FormatError(str(path), f"the SHA-256 of {PACKAGE}, {digest[:16]}", found[:16])
    names = sorted({Path(name).parts[1] for name in digests if Path(name).parts[0] == FRAMES})
    with tempfile.TemporaryDirectory(prefix="drivesem-gate-") as temporary:
        folder = Path(temporary)
        for name in digests:
            if Path(name).parts[0] != FRAMES:
                files.write_bytes(folder / name, files.read_bytes(source / name))
        frames = [_unpack_frame(source / FRAMES / name, folder / FRAMES / name) for name in names[:limit]]
        config, metrics = files.read_yaml(folder / CONFIG), files.read_json(folder / METRICS)
        try:
            settings = (config["detector"], config["method"], ",".join(metrics["params"]))
        except (KeyError, TypeError) as error:
            raise FormatError(str(source / CONFIG), "settings of a run", error) from error
        detector, method, params = (from_json(str, value, str(source / CONFIG)) for value in settings)
        yield GateSource(AttackRun(run_name, folder, detector, method, params, tuple(frames)), *counts)


def _unpack_frame(source: Path, folder: Path) -> RunFrame:
    path, size = source / _ARCHIVE, 0
    try:
        with tarfile.open(fileobj=io.BytesIO(files.read_bytes(path)), mode="r:xz") as archive:
            for entry in archive:
                size += entry.size
                stream = archive.extractfile(entry) if entry.isfile() else None  # no links
                if stream is None or size > _MAX_UNPACKED_BYTES:
                    raise FormatError(str(path), f"files of at most {_MAX_UNPACKED_BYTES:,} bytes", entry.name)
                files.write_bytes(files.resolve_inside(folder, entry.name), stream.read())
    except (tarfile.TarError, lzma.LZMAError, EOFError) as error:
        raise FormatError(str(path), "an archive of a frame", error) from error
    files.write_bytes(folder / _SCENE / _PHOTOGRAPH, files.read_bytes(source / _PHOTOGRAPH))
    return RunFrame(folder, load_frame(folder / RESULT), {})


STEP_PX = 4
"""Of the relief's grid."""
FARTHEST_M = 120.0
"""The sky is as far."""
_TORN = 1.25
"""Neighbours with distances that differ by more than this factor are not joined."""
_TO_GLTF = np.array([1.0, -1.0, -1.0], np.float32)
"""From camera axes: x right, y down, z forward."""


def export_scenes(source: Path, out: Path) -> list[str]:
    """Write a GLB file for each scene below a folder, as it stands; their names. Raises SceneError where there is
    no scene, or no second renderer to bake textures with.
    """
    written: list[str] = []
    for name, folder in find_scene_folders(source).items():
        files.write_bytes(out / f"{name}.glb", scene_to_glb(name, load_scene(folder)))
        written.append(f"{name}.glb")
    return written


def scene_to_glb(name: str, scene: SceneIR) -> bytes:
    """A scene as a GLB file: meshes "vehicle-0" and so on, and "surroundings"."""
    import trimesh

    whole = trimesh.Scene()
    for i, (corners, skin) in enumerate(PhotographRenderer(name, scene).textured_vehicles(scene)):
        faces = np.arange(corners.shape[0] * 3).reshape(-1, 3)
        points = corners.reshape(-1, 3) * _TO_GLTF
        whole.add_geometry(_textured(points, faces, skin.uv, skin.texture), geom_name=f"vehicle-{i}")
    points, faces, uv = _relief(scene)
    behind = to_uint8(scene.origin.background)
    whole.add_geometry(_textured(points * _TO_GLTF, faces, uv, behind), geom_name="surroundings")
    exported: Any = whole.export(file_type="glb")
    return bytes(exported)


def _textured(points: NDArray[Any], faces: NDArray[Any], uv: NDArray[Any], picture: NDArray[np.uint8]) -> Any:
    import trimesh
    from PIL import Image
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    material = PBRMaterial(
        baseColorTexture=Image.fromarray(np.ascontiguousarray(picture)),
        metallicFactor=0.0,
        roughnessFactor=1.0,
        doubleSided=True,
    )
    visual = TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(points, faces, visual=visual, process=False)


def _relief(scene: SceneIR) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The background as a surface: points (N, 3) m in the camera's own axes, faces (M, 3), uv (N, 2) upwards."""
    lens = PictureCamera.from_camera(scene.camera)
    depth = np.minimum(scene.origin.depth.cpu().numpy().astype(np.float32), FARTHEST_M)
    rows = np.unique(np.append(np.arange(0, lens.height, STEP_PX), lens.height - 1))
    columns = np.unique(np.append(np.arange(0, lens.width, STEP_PX), lens.width - 1))
    smooth = cv2.medianBlur(depth, 5)[np.ix_(rows, columns)]
    x, y = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(lens.intrinsics.astype(np.float64)).T
    points = (rays * smooth[..., None]).reshape(-1, 3).astype(np.float32)
    uv = np.stack([(x + 0.5) / lens.width, 1 - (y + 0.5) / lens.height], -1).reshape(-1, 2)
    at = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel())
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    far = smooth.ravel()[faces]
    return points, faces[far.max(1) <= _TORN * far.min(1)], uv
