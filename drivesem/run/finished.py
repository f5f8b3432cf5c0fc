"""Loads finished runs of `drivesem attack`, rebuilds their frames' objectives, and builds manifest.json."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from detectors import boxes
from detectors.base import Predictor, detector_device
from detectors.registry import ONNX, ONNX_RUNTIME
from drivesem.attacks.budgets import budget_for_coordinates, parse_budget
from drivesem.attacks.feasible.constraints import FeasibilityLimits
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.labels import Difficulty
from drivesem.attacks.objective import Objective, RenderEvaluation
from drivesem.attacks.space import Parameter, ParameterSpace
from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.evaluation.failures import MATCH_IOU, FrameFailures
from drivesem.failures.grades import Grade
from drivesem.failures.grading import Grader, GradingInput
from drivesem.failures.kinds import OBJECT_KINDS, Fault
from drivesem.failures.neighbourhood import Neighbourhood
from drivesem.failures.nuisances import Nuisances
from drivesem.run.feature_map import FailureMap
from drivesem.run.folder import CONFIG, FRAMES, result_settings
from drivesem.run.frame import build_map, certain_losses, count_grades, objective_grading_input
from drivesem.run.labels import MANIFEST, RESULT, list_manifest_frames
from drivesem.run.lock import is_locked_elsewhere
from drivesem.run.records import from_json
from drivesem.run.results import SCHEMA, Failure, FrameResult, load_frame
from scene_ir import files
from scene_ir.errors import FormatError
from scene_ir.io import load_scene
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import convert_scene

METRICS = "metrics.json"
PICTURES = {"benign": "benign.png", "rerendered": "rerender.png", "attacked": "counterexample.png"}
"""Lossless pictures of a frame: the photograph, its re-render without a change, and the counterexample."""


@dataclass(frozen=True, slots=True)
class RunFrame:
    """One frame of a finished run."""

    folder: Path
    """Folder of the frame."""
    result: FrameResult
    """Contents of its result.json."""
    pictures: dict[str, Path]
    """Paths by the names of `PICTURES`."""


@dataclass(frozen=True, slots=True)
class AttackRun:
    """A finished run of `drivesem attack`."""

    name: str
    """Name of the folder, or its path if several runs have that name."""
    folder: Path
    """Folder of the run."""
    detector: str
    """The attacked detector, as named in the settings."""
    method: str
    """Search method."""
    params: str
    """Attacked parameters, separated by commas."""
    frames: tuple[RunFrame, ...]
    """Frames in the order of their names."""

    def rows(self) -> list[dict[str, Any]]:
        """Return a flat dict per frame, for `pandas.DataFrame`."""
        return [_frame_row(frame) for frame in self.frames]

    def failure_rows(self) -> list[dict[str, Any]]:
        """Return a flat dict per failure: frame, kind, grade, draws, second opinions, and box."""
        return [
            {"frame": frame.result.identifier, **failure.to_row()}
            for frame in self.frames
            for failure in frame.result.failures
        ]

    def _repr_html_(self) -> str:
        """Return an HTML table of the frames, for notebooks."""
        rows = self.rows()
        lines = [list(rows[0]), *(["" if v is None else str(v) for v in row.values()] for row in rows)]
        head, *body = ("".join(f"<td>{escape(cell)}</td>" for cell in line) for line in lines)
        table = "".join(f"<tr>{line}</tr>" for line in (head, *body))
        caption = escape(f"{self.name}: {self.method} on {self.detector}, {self.params}")
        return f"<table><caption>{caption}</caption><tbody>{table}</tbody></table>"


def _frame_row(frame: RunFrame) -> dict[str, Any]:
    result = frame.result
    kinds = [failure.kind for failure in result.failures]
    return {
        "frame": result.identifier,
        "objects": result.objects,
        "judged": len(result.judged),
        "found_before": len(result.found_before),
        "attacked": result.attacked,
        "success_moved": result.success_moved if result.attacked else None,
        "success_paper": result.success_paper if result.attacked else None,
        "lost": kinds.count("lost"),
        "phantoms": kinds.count("phantom"),
        **_count_frame_grades(result),
        "passes": result.passes,
        "feasible": result.feasible,
        "queries": result.queries,
        "loss_first": result.loss_trace[0] if result.loss_trace else None,
        "loss_best": max(result.loss_trace, default=None),
        "identity_psnr_db": result.identity_psnr_db,
        "seconds": result.seconds,
        "picture": str(frame.pictures["attacked"]),
    }


def _count_frame_grades(result: FrameResult) -> dict[str, int | None]:
    """Count failures by lowest grade from certain on, and by kind; None if the failures are not graded."""
    summary = count_grades([result])
    counts = {grade: count for grade, count in summary["grades"].items() if grade != Grade.THRESHOLD}
    counts |= summary["kinds"]
    return counts if result.graded else dict.fromkeys(counts)


def load_run(folder: str | Path, limit: int | None = None) -> AttackRun:
    """Load a finished run of `drivesem attack`, or its first `limit` frames.

        run = ds.load_run("runs/a")
        pandas.DataFrame(run.rows())

    Raises UsageError if the folder holds no finished run or the limit is below 1, FormatError for a damaged file.
    """
    if limit is not None and limit < 1:
        raise UsageError("limit", "at least 1", limit)
    return load_runs([str(folder)], limit, "folder")[0]


def load_runs(
    folders: Sequence[str], limit: int | None = None, setting: str = "--run", may_be_empty: bool = False
) -> list[AttackRun]:
    """Load finished runs.

    Args:
        folders: Their folders.
        limit: Number of frames to load of each run; all by default.
        setting: Option or argument that named the folders.
        may_be_empty: Accept runs without frames.

    Raises:
        UsageError: A folder holds no finished run of this version, or is given twice.
        FormatError: A file is damaged.
    """
    paths = [Path(folder) for folder in folders]
    repeated = sorted({str(path) for path in paths if sum(p.resolve() == path.resolve() for p in paths) > 1})
    if repeated:
        raise UsageError(setting, "each run once", repeated[0])
    base_names = [path.resolve().name for path in paths]
    names = [n if base_names.count(n) == 1 else str(path) for n, path in zip(base_names, paths, strict=True)]
    runs = [_load_run(path, name, limit, setting) for path, name in zip(paths, names, strict=True)]
    for run in runs:
        if not run.frames and not may_be_empty:
            raise UsageError(setting, "a run with frames", f"{run.folder}, which has none")
    return runs


def _load_run(folder: Path, name: str, limit: int | None, setting: str) -> AttackRun:
    for file in (CONFIG, METRICS, MANIFEST):
        files.resolve_inside(folder, file)
    if not (folder / CONFIG).is_file():
        raise UsageError(setting, "a folder of drivesem attack", folder)
    settings = files.read_yaml(folder / CONFIG)
    if (
        not isinstance(settings, dict)
        or not {"detector", "dataset", "params", "combo", "method"} <= settings.keys()
    ):
        raise UsageError(setting, "a folder of drivesem attack", f"{folder}, a run of another command")
    if not (folder / METRICS).is_file() or not (folder / MANIFEST).is_file():
        if is_locked_elsewhere(folder):
            raise UsageError(setting, "a finished run", f"{folder}, into which an attack is still writing")
        raise UsageError(
            setting, "a finished run (the same command finishes it)", f"{folder}, which stopped early"
        )
    identifiers, metrics = list_manifest_frames(folder), files.read_json(folder / METRICS)
    if not isinstance(metrics, dict) or metrics.get("schema") != SCHEMA:
        version = files.read_json(folder / MANIFEST).get("versions", {}).get("drivesem", "of another version")
        raise UsageError(setting, "a run of this version", f"{folder}, made by an earlier drivesem {version}")
    try:
        params = ",".join(metrics["params"])
    except (KeyError, TypeError) as error:
        raise FormatError(str(folder / METRICS), "params of a run", error) from error
    from_json(float | None, metrics.get("t_star"), f"{folder / METRICS}: t_star")
    return AttackRun(
        name=name,
        folder=folder,
        detector=from_json(str, settings["detector"], f"{folder / CONFIG}: detector"),
        method=from_json(str, settings.get("method"), f"{folder / CONFIG}: method"),
        params=params,
        frames=tuple(_load_run_frame(folder / "frames" / identifier) for identifier in identifiers[:limit]),
    )


def _load_run_frame(folder: Path) -> RunFrame:
    files.check_links(folder)
    pictures = {name: folder / file for name, file in PICTURES.items()}
    for path in pictures.values():
        if not path.is_file():
            raise FormatError(str(path), "a picture of the run", "none")
    return RunFrame(folder, load_frame(folder / RESULT), pictures)


def name_frames(runs: Sequence[AttackRun]) -> dict[str, tuple[AttackRun, RunFrame]]:
    """Return the frames of runs by name, which starts with that of the run if there are several."""
    return {
        f"{run.name}/{frame.result.identifier}" if len(runs) > 1 else frame.result.identifier: (run, frame)
        for run in runs
        for frame in run.frames
    }


def map_failing_frames(frames: Mapping[str, tuple[AttackRun, RunFrame]]) -> FailureMap:
    """Build one map of those frames of runs that have certain failures: all failing cells, as a gate's package has no
    other frames.

    Args:
        frames: Frames as `name_frames` returns them; the map has these names.
    """
    results = [replace(frame.result, identifier=name) for name, (_, frame) in frames.items()]
    return build_map([result for result in results if certain_losses(result)])


def rebuild_objective(
    result: FrameResult,
    folder: Path,
    attack: AttackConfig,
    params: Sequence[Parameter],
    detector: Predictor,
) -> tuple[Objective, Tensor]:
    """Rebuild the objective of a frame from the saved scene, without the data set.

    Args:
        result: The frame's result.
        folder: The frame's folder in the run.
        attack: The run's settings.
        params: The run's parameters.
        detector: The detector to evaluate.

    Returns:
        The objective, and the theta (D,) of the run.

    Raises:
        FormatError: The scene or theta is damaged.
    """
    scene = convert_scene(load_scene(folder / "scene").unperturbed(), None, detector_device(detector))
    names = [c.name for c in result.theta]
    budget = budget_for_coordinates(parse_budget(attack.budget), names)
    space = ParameterSpace(scene, params, budget, parametrisation=attack.parametrisation)
    if names != [space.name(i) for i in range(space.dim)]:
        raise FormatError(str(folder / RESULT), f"theta of {', '.join(space.params)}", "other coordinates")
    theta = torch.tensor([c.value for c in result.theta]).to(space.theta0)
    compositor = Compositor(scene, RenderSettings(backend=attack.backend))
    return Objective(compositor, space, detector, attack, Difficulty(min_contrast=result.min_contrast)), theta


@dataclass(frozen=True, slots=True)
class ChangedState:
    """A state of a frame's scene, and what the detector gets wrong there."""

    evaluation: RenderEvaluation
    """The rendered state."""
    case: GradingInput
    """The input of a grader."""
    failures: FrameFailures
    """Failures by threshold."""
    faults: tuple[Fault, ...]
    """Those of a kind."""
    hidden: bool
    """Whether the change hides an object, which makes it no counterexample."""

    def find_recorded_fault(self, record: Failure) -> Fault | None:
        """Find the fault of the run's counterexample that a record describes."""
        for fault in self.faults:
            is_lost = fault.kind in OBJECT_KINDS
            if record.error not in (None, fault.kind) or is_lost != (record.kind == "lost"):
                continue
            if fault.target == record.index if is_lost else self._is_detection(fault.detection, record):
                return fault
        return None

    def shows_by_threshold(self, record: Failure) -> bool:
        """Whether a failure of no kind occurs."""
        if record.kind == "lost":
            return record.index in self.failures.lost
        return any(self._is_detection(row, record) for row in self.failures.phantoms)

    def _is_detection(self, row: int, record: Failure) -> bool:
        box = self.evaluation.detections.boxes_xyxy[row : row + 1]
        return float(boxes.iou_matrix(box, torch.tensor([record.xyxy]).to(box))[0, 0]) >= MATCH_IOU


@dataclass(frozen=True)
class RebuiltFrame:
    """A frame of a finished run, ready to be rendered and evaluated in other states."""

    result: FrameResult
    """Contents of its result.json."""
    objective: Objective
    """The objective that was attacked."""
    feasible: FeasibleSet
    """Feasible thetas."""
    theta: Tensor
    """Theta of the counterexample (D,)."""
    nuisances: Nuisances
    """Distribution of the draws."""

    @classmethod
    def load(
        cls, folder: Path, attack: AttackConfig, params: Sequence[Parameter], detector: Predictor
    ) -> RebuiltFrame:
        """Rebuild a frame from its folder.

        Args:
            folder: The frame's folder in the run.
            attack: The run's settings.
            params: The run's parameters.
            detector: The detector to evaluate.

        Raises:
            FormatError: A file is damaged.
        """
        result = load_frame(folder / RESULT)
        objective, theta = rebuild_objective(result, folder, attack, params, detector)
        limits = FeasibilityLimits(joint_weather=result.joint_weather)
        feasible = objective.feasible_set(limits, attack.project == "bounds")
        return cls(result, objective, feasible, theta, Nuisances.parse(attack.nuisances))

    def evaluate_state(self, grader: Grader, theta: Tensor) -> ChangedState:
        """Evaluate the detector at a feasible theta (D,). grader: finds the faults."""
        objective = self.objective
        evaluation = objective.evaluate(theta)
        case = objective_grading_input(self.result.identifier, objective, evaluation)
        failures = objective.failures(evaluation, "moved")
        hidden = bool(evaluation.moved.out_of_sight.any())
        return ChangedState(evaluation, case, failures, grader.faults(case, failures), hidden)

    def neighbourhoods(self, stream: str, reach: float = 1.0) -> Iterator[tuple[Failure, Neighbourhood]]:
        """Yield each certain failure of an object, and its neighbourhood. `stream` selects the random draws."""
        for failure in certain_losses(self.result):
            assert failure.index is not None
            name = f"{self.result.identifier}:{failure.index}:{stream}"
            yield (
                failure,
                Neighbourhood(
                    self.objective, self.feasible, self.theta, failure.index, self.nuisances, name, reach
                ),
            )


VOLATILE_KEYS = ("out", "seconds")
"""Keys of metrics.json and result.json that may differ between equal runs; not hashed."""
HASHED_RUN_FIELDS = ("data", "frames_without_vehicles", "frames_failed")
HASHED_FRAME_FIELDS = (
    *("loss_trace", "queries", "passes", "active_constraints", "violated_at_start", "became_ignored"),
    *("judged", "found_before", "failures", "grade_notes", "checked_by", "change", "visits"),
)
"""Values of metrics.json and result.json that do not follow from other files. Each has its own hash, so that a change
can be named."""
_DIGITS = 16
"""Hexadecimal digits of such a hash; the hash of the whole file is complete."""
_PACKAGES = (
    "drivesem",
    "torch",
    "kornia",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "warp-lang",
    "pycocotools",
)


def build_manifest(
    config: AttackConfig, out: Path, names: Sequence[str], metrics: Mapping[str, Any]
) -> dict[str, Any]:
    """Build the manifest of a run.

    Args:
        config: The run's settings.
        out: Its folder.
        names: Its frames.
        metrics: Contents of metrics.json.
    """
    packages = [*_PACKAGES]
    packages += ["cma"] if config.method == "cma-es" else []
    packages += ["onnxruntime"] if config.detector.partition(":")[0] in (ONNX, ONNX_RUNTIME) else []
    return {
        "versions": {package: importlib.metadata.version(package) for package in packages},
        "seed": config.seed,
        "settings": result_settings(config),
        "metrics": hash_json(metrics),
        "frames": {name: hash_frame_files(out / FRAMES / name) for name in names},
        "fields": {
            "run": hash_fields(metrics, HASHED_RUN_FIELDS),
            "frames": {
                name: hash_fields(files.read_json(out / FRAMES / name / RESULT), HASHED_FRAME_FIELDS)
                for name in names
            },
        },
    }


def hash_frame_files(folder: Path) -> dict[str, str]:
    """Hash every file of a frame's folder with SHA-256, result.json without its times. Returns hashes by path.

    Raises FormatError for a file that cannot be read.
    """
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): _hash_file(path, folder) for path in paths}


def _hash_file(path: Path, folder: Path) -> str:
    return hash_json(files.read_json(path)) if path == folder / RESULT else files.sha256_digest(path)


def hash_fields(data: Mapping[str, Any], names: Sequence[str]) -> dict[str, str]:
    """Return the first digits of the SHA-256 of values of a JSON object; a missing value counts as null."""
    return {name: _sha256(data.get(name))[:_DIGITS] for name in names}


def hash_json(data: Any) -> str:
    """Return the SHA-256 of a JSON object without VOLATILE_KEYS. Raises FormatError if it is not an object."""
    if not isinstance(data, Mapping):
        raise FormatError("the metrics of a run", "an object", type(data).__name__)
    return _sha256({key: value for key, value in data.items() if key not in VOLATILE_KEYS})


def _sha256(value: Any) -> str:
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
