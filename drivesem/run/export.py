"""Exports counterexamples of a run as data sets with provenance, as tables, and as glTF scenes.

Axes of a glTF scene are glTF's: x right, y up, looking along -z from the camera at the origin; metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
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
from drivesem.report.tables import rows_to_csv
from drivesem.run.conversion import ConversionSettings, convert_labels, provenance
from drivesem.run.finished import AttackRun
from drivesem.run.frame import has_grade
from drivesem.run.results import FrameResult
from drivesem.scenes.sources import find_scene_folders
from scene_ir import files
from scene_ir.io import load_scene, to_uint8
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
