"""Fit the summary figures of KITTI's labels that the generator follows.

python tools/fit_kitti_statistics.py kitti_labels_calib.tar.xz [--out drivesem/synth/kitti_statistics.json]

Reads label_2/*.txt and calib/*.txt out of a tar archive or a folder. Only summary figures are written: no label
can be read back from them. The same input gives the same bytes.
"""

from __future__ import annotations

import argparse
import lzma
import sys
import tarfile
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drivesem.data.kitti import read_calibration, read_labels
from drivesem.synth.compare import VEHICLES, histograms
from scene_ir.errors import FormatError, SceneError
from scene_ir.files import write_json
from scene_ir.types import Labels

OUT = Path(__file__).resolve().parents[1] / "drivesem" / "synth" / "kitti_statistics.json"
SIZED = ("Car", "Van", "Truck", "Pedestrian", "Cyclist")
PEOPLE = ("Pedestrian", "Cyclist")
MOST_VEHICLES = 16
"""The last entry of `vehicles_per_frame` is this many or more."""
ALONG_RAD = 0.3
"""A vehicle within this of the camera's axis, either way, drives or stands along the road."""
CAMERA_HEIGHT_M = 1.65
"""Of the cameras above the ground (KITTI's sensor set-up page)."""


def training_folder(root: Path) -> Path:
    """The folder under `root` that holds label_2 and calib. FormatError where there is none."""
    for folder in (root, root / "training"):
        if (folder / "label_2").is_dir() and (folder / "calib").is_dir():
            return folder
    raise FormatError(str(root), "a folder with label_2 and calib", "none")


def fit(folder: Path) -> dict[str, Any]:
    """The figures of `folder`, which holds label_2 and calib. FormatError naming a bad file."""
    paths = sorted((folder / "label_2").glob("[!.]*.txt"))
    if not paths:
        raise FormatError(str(folder / "label_2"), "at least one label file", "none")
    frames = [read_labels(path) for path in paths]
    kinds = np.array([kind for labels in frames for kind in labels.kind])
    spot = np.concatenate([labels.translation.double().numpy() for labels in frames])
    size = np.concatenate([labels.size_lhw.double().numpy() for labels in frames])
    vehicle = np.isin(kinds, VEHICLES)
    if not vehicle.any():
        raise FormatError(str(folder / "label_2"), f"at least one of {', '.join(VEHICLES)}", "none")
    counts = np.array([sum(kind in VEHICLES for kind in labels.kind) for labels in frames])
    yaw = np.concatenate([labels.yaw.double().numpy() for labels in frames])[vehicle]
    off = np.abs(np.abs(yaw) - np.pi / 2)
    along = off < ALONG_RAD
    occlusion = np.concatenate([labels.occlusion.numpy() for labels in frames])[vehicle]
    truncation = np.concatenate([labels.truncation.double().numpy() for labels in frames])[vehicle]
    depth_edges, lateral_edges = np.arange(0.0, 80.1, 5.0), np.arange(-32.0, 32.1, 4.0)
    per_kind = {kind: size[kinds == kind][:, [1, 2, 0]] for kind in SIZED}
    per_kind = {kind: rows for kind, rows in per_kind.items() if len(rows)}
    return {
        "source": "Fitted to the label and calibration files of the KITTI object training set (Geiger et al. "
        f"2012; {len(frames):,} frames); summary figures only, no label is contained.",
        "vehicles_per_frame": _shares(np.bincount(np.minimum(counts, MOST_VEHICLES), minlength=MOST_VEHICLES + 1)),
        "depth_edges_m": depth_edges.tolist(),
        "depth_share": _shares(np.histogram(spot[vehicle, 2], depth_edges)[0]),
        "lateral_edges_m": lateral_edges.tolist(),
        "lateral_share": _shares(np.histogram(spot[vehicle, 0], lateral_edges)[0]),
        "yaw_along_share": round(float(along.mean()), 4),
        "yaw_same_direction_share": round(float((yaw[along] < 0).mean()) if along.any() else 0.0, 4),
        # 1.4826 times the median of absolute deviations: a normal distribution's sigma, which outliers leave
        # alone.
        "yaw_spread_rad": round(1.4826 * float(np.median(off[along])) if along.any() else 0.0, 4),
        "type_share": {kind: round(float((kinds[vehicle] == kind).mean()), 4) for kind in VEHICLES},
        "size_hwl_mean_m": {kind: np.round(rows.mean(axis=0), 3).tolist() for kind, rows in per_kind.items()},
        "size_hwl_std_m": {kind: np.round(rows.std(axis=0), 3).tolist() for kind, rows in per_kind.items()},
        "occlusion_share": np.round(np.bincount(occlusion, minlength=4) / len(occlusion), 4).tolist(),
        "truncated_share": round(float((truncation > 0).mean()), 4),
        "people_per_frame": {kind: round(float((kinds == kind).sum()) / len(frames), 4) for kind in PEOPLE},
        "cameras": _cameras(folder, paths, frames),
        "camera_height_m": CAMERA_HEIGHT_M,
        "histograms": histograms(frames).summary(),
    }


def _shares(counts: np.ndarray) -> list[float]:
    """Counts as shares that sum to one."""
    return np.round(counts / max(counts.sum(), 1), 5).tolist()


def _cameras(folder: Path, paths: Sequence[Path], frames: Sequence[Labels]) -> list[dict[str, Any]]:
    """The distinct cameras, the most frequent first. An image is as large as its camera's outermost box: KITTI
    cuts boxes at the last pixel, and neither labels nor calibration state the size.
    """
    met: Counter[tuple[float, ...]] = Counter()
    ends: dict[tuple[float, ...], np.ndarray] = {}
    for path, labels in zip(paths, frames, strict=True):
        projection = read_calibration(folder / "calib" / path.name).projection.double()
        key = tuple(np.round(projection.flatten().tolist(), 4).tolist())
        met[key] += 1
        boxes = np.concatenate([labels.boxes_xyxy.numpy(), labels.ignore_xyxy.numpy(), np.zeros((1, 4))])
        ends[key] = np.maximum(ends.get(key, np.zeros(2)), boxes[:, 2:].max(axis=0))
    return [
        {
            "focal_px": key[0],
            "centre_px": [key[2], key[6]],
            "offset_px_m": [key[3], key[7], key[11]],
            "size_wh_px": (np.floor(ends[key]).astype(int) + 1).tolist(),
        }
        for key, _ in sorted(met.items(), key=lambda item: (-item[1], item[0]))
    ]


def fit_source(source: Path) -> dict[str, Any]:
    """The figures of a tar archive or a folder. FormatError naming what is wrong with it."""
    if source.is_dir():
        return fit(training_folder(source))
    if not source.is_file():
        raise FormatError(str(source), "an archive or a folder", "nothing")
    with tempfile.TemporaryDirectory() as folder:
        try:
            with tarfile.open(source) as archive:
                archive.extractall(folder, filter="data")
        except (tarfile.TarError, lzma.LZMAError, EOFError, OSError) as error:
            raise FormatError(str(source), "a whole tar archive", type(error).__name__) from None
        return fit(training_folder(Path(folder)))


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit code: 0, or 2 for bad input."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    parsed = parser.parse_args(arguments)
    try:
        write_json(parsed.out, fit_source(parsed.source))
    except SceneError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"wrote {parsed.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
