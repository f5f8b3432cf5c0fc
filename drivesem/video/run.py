"""`drivesem drive`: de-renders a clip, changes each object consistently over its track, and reports new misses."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from detectors.base import detector_device
from detectors.types import CLASSES
from drivesem.attacks.budgets import change_limits, parse_budget
from drivesem.attacks.feasibility_check import ChangeLimits, check_scene
from drivesem.attacks.methods.gradient_free import Placebo
from drivesem.attacks.targets import resolve_t_star
from drivesem.config.commands import AttackConfig, DriveConfig
from drivesem.config.devices import check_device
from drivesem.failures.certificate import CompositorRenderer
from drivesem.failures.grades import Grade
from drivesem.reporting.drawing import write_picture
from drivesem.reporting.tables import AnalysisReport, Console, format_count, progress_bar
from drivesem.run import attack as attacks
from drivesem.run.folder import FRAMES, PRESENTATION, claim_folder
from drivesem.run.frame import EvaluatedScene, build_grading_input, detection_records, target_records
from drivesem.run.records import from_json
from drivesem.run.report import pictures
from drivesem.run.results import Failure
from drivesem.video.clips import ClipDerenderer, ClipSource, DerenderedClip, derender_clip
from drivesem.video.objective import ClipObjective, FrameDetection
from drivesem.video.report import (
    ABSENT,
    FOUND,
    LOST,
    STATES,
    UNCOUNTED,
    DriveResult,
    State,
    TrackResult,
    build_report,
    write_page,
    write_video,
)
from scene_ir import files
from scene_ir.io import to_uint8
from scene_ir.types import convert_scene

RESULT, PAGE, VIDEO, SCENES = "drive.json", "report.html", "clip.webm", "scenes"
_WRITTEN = (RESULT, PAGE, VIDEO, SCENES, FRAMES, "drive.csv", "drive.md")
_FREE = tuple(name for name in PRESENTATION if name != "limit")
"""Settings that do not change the result; the number of frames does."""
DEFAULT_PARAMS = "color,translate,mesh"
"""Default parameters: paint, shape, and a shifted path."""


def attack_clip(config: DriveConfig) -> AnalysisReport:
    """Attack a clip, or load a finished result. Raises UsageError or SceneError for bad input."""
    start = time.perf_counter()
    attack_config = to_attack_config(config)
    params, method = attacks.resolve_parameters(attack_config), attacks.build_attack(attack_config)
    check_device(config.device)
    worker = attacks.AttackWorker.from_config(attack_config)
    out = Path(config.out) if config.out else Path("runs") / _name(config, [str(p) for p in params])
    source = ClipSource(
        folder=config.clip,
        name=config.sequence,
        limit=config.limit,
        seed=config.seed,
        fit=config.fit,
        keep_going=config.keep_going,
        people=config.moves_people,
    )
    derenderer = ClipDerenderer(source, out / SCENES)
    claim_folder(out, config, _WRITTEN, _FREE)
    if config.resume and (out / RESULT).is_file():
        return build_report(from_json(DriveResult, files.read_json(out / RESULT), str(out / RESULT)))
    detector, budget = worker.detector, parse_budget(attack_config.budget)
    clip = derender_clip(derenderer, config)
    clip = replace(clip, scenes=convert_scene(clip.scenes, None, detector_device(detector)))
    objective = ClipObjective(clip, detector, params, budget, config)
    problem, theta0 = objective.problem(config.keep == "last"), objective.space.theta0
    recorder, control = _ClipRecorder(clip, objective, out), theta0
    with progress_bar(Console(stderr=True)) as progress:
        task = progress.add_task(
            f"evaluating {format_count(len(clip.names), 'frame')} with {format_count(objective.space.count, 'object')}",
            total=None,
        )
        objective.on_frame = lambda: progress.advance(task)
        search = method(problem, theta0, config.seed)
        if bool(search.theta.any()):
            control = Placebo(tuple(search.theta.tolist()))(problem, theta0, config.seed).theta
        recorder.record(search.theta, control, config.certify, worker, reach=change_limits(budget))
    coordinates = objective.space.theta_by_name(search.theta)
    result = DriveResult(
        out=str(out),
        clip=clip.name,
        detector=config.detector,
        t_star=resolve_t_star(detector, config.t_star),
        params=tuple(str(p) for p in params),
        method=config.method,
        frames=len(clip.names),
        names=clip.names,
        tracks=recorder.tracks(),
        phantoms=recorder.phantoms,
        feasible=len(clip.names) - len(recorder.violations),
        violations=recorder.violations,
        held_back=search.active_constraints,
        failed=clip.failed,
        theta={name: str(facts["display"]) for name, facts in coordinates.items() if facts["value"]},
        loss_trace=search.loss_trace,
        queries=search.queries,
        passes=objective.passes,
        seconds=round(time.perf_counter() - start, 3),
    )
    write_video(out / VIDEO, [out / FRAMES / name for name in clip.names])
    write_page(out / PAGE, result)
    report = build_report(result)
    report.write()
    return report


def to_attack_config(config: DriveConfig) -> AttackConfig:
    """Convert to the settings of an attack on frames. Raises UsageError for settings that conflict."""
    shared = {entry.name for entry in fields(AttackConfig)} & {entry.name for entry in fields(DriveConfig)}
    settings: dict[str, Any] = {name: getattr(config, name) for name in shared}
    if config.params is None and config.combo is None:
        settings["params"] = DEFAULT_PARAMS
    settings |= {"confirm": False, "second_detector": "off"}
    attack = AttackConfig(**settings)
    attack.check()
    return attack


def _name(config: DriveConfig, params: Sequence[str]) -> str:
    clip = "demo" if config.clip is None else Path(config.clip).resolve().name
    part = "" if config.sequence is None else f"-{config.sequence.replace('/', '-')}"
    method = "" if config.method == DriveConfig().method else f"-{config.method}"
    return f"drive-{clip}{part}-{'-'.join(params)}{method}-seed{config.seed}"


@dataclass
class _ClipRecorder:
    """Collects the detections in a clip frame by frame: original, attacked, and changed at random."""

    clip: DerenderedClip
    objective: ClipObjective
    out: Path
    phantoms: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STATES, 0))
    violations: dict[str, tuple[str, ...]] = field(default_factory=dict)
    _states: dict[tuple[int, State], list[str]] = field(default_factory=dict)
    _path: dict[int, dict[int, tuple[float, float]]] = field(default_factory=dict)
    _grades: dict[int, list[bool]] = field(default_factory=dict)

    def record(
        self, theta: Tensor, control: Tensor, certify: int, worker: attacks.AttackWorker, reach: ChangeLimits
    ) -> None:
        """Detect in all frames, write their images, and grade new misses in up to `certify` of them.

        Args:
            theta: (D,) the attack's result.
            control: (D,) a random change of the same size.
            certify: Maximum number of frames to grade.
            worker: Grades the misses.
            reach: Limits of the change.
        """
        new_misses: dict[int, list[int]] = {}
        for frame, name in enumerate(self.clip.names):
            scene = self.clip.scenes[frame]
            before = self.objective.match_frame(frame, self.objective.frames[frame].benign)
            after = self.objective.detect_frame(theta, frame)
            frame_detections: dict[State, FrameDetection] = {
                "before": before,
                "after": after,
                "control": self.objective.detect_frame(control, frame),
            }
            for state, detection in frame_detections.items():
                self.phantoms[state] += detection.phantoms
                for row, track in enumerate(self.clip.tracks[frame]):
                    letter = UNCOUNTED if not detection.counted[row] else FOUND if detection.found[row] else LOST
                    letters = self._states.setdefault((track, state), [ABSENT] * len(self.clip.names))
                    letters[frame] = letter
            for row, offset in enumerate(self.objective.space.path_offsets(theta, frame).tolist()):
                along, across = (round(value, 4) for value in offset)
                self._path.setdefault(self.clip.tracks[frame][row], {})[frame] = (along, across)
            wrong = tuple(check_scene(scene, after.rendered.scene, limits=reach))
            if wrong:
                self.violations[name] = wrong
            for row in after.lost:
                new_misses.setdefault(self.clip.tracks[frame][row], []).append(frame)
            with files.atomic_folder(self.out / FRAMES / name) as folder:
                for state in ("before", "after"):
                    write_picture(folder / f"{state}.jpg", self._marked(frame, frame_detections[state]))
        for frame in _choose_frames(new_misses, certify):
            self._grade(frame, theta, worker)

    def tracks(self) -> tuple[TrackResult, ...]:
        """Result of each object, by descending number of new misses."""
        found = []
        for track in self.objective.space.tracks:
            rows = [(f, t.index(track)) for f, t in enumerate(self.clip.tracks) if track in t]
            away: list[float | None] = [None] * len(self.clip.names)
            for frame, row in rows:
                place = self.clip.scenes[frame].objects.translation[row]
                away[frame] = round(float(place[[0, 2]].norm()), 3)
            frame, row = rows[0]
            states: dict[str, str] = {state: "".join(self._states[track, state]) for state in STATES}
            path = self._path[track]
            kind = CLASSES[int(self.clip.scenes[frame].objects.category[row])]
            paths = tuple(path.get(f) for f in range(len(away)))
            found.append(
                TrackResult.from_states(track, kind, states, tuple(away), paths, self._grades.get(track, []))
            )
        return tuple(sorted(found, key=lambda one: (-one.new_misses, one.track)))

    def _grade(self, frame: int, theta: Tensor, worker: attacks.AttackWorker) -> None:
        """Grade the new misses in a frame."""
        objective, benign = self.objective.frames[frame], self.objective.frames[frame].benign
        detection = self.objective.detect_frame(theta, frame)
        before, now = (
            EvaluatedScene(one.scene, one.render, one.moved, one.detections)
            for one in (benign, detection.rendered)
        )
        draw = CompositorRenderer(objective.compositor, objective.labeller)
        case = build_grading_input(self.clip.names[frame], draw, objective.classes, before, now)
        grades = worker.grader.grade(case, objective.failures(detection.rendered, "moved"))
        for row in detection.lost:
            graded = grades.lost.get(row)
            is_certain = graded is not None and graded.grade is not Grade.THRESHOLD
            self._grades.setdefault(self.clip.tracks[frame][row], []).append(is_certain)

    def _marked(self, frame: int, detection: FrameDetection) -> pictures.Image:
        """Draw the boxes into a frame's image."""
        objective, rendered = self.objective.frames[frame], detection.rendered
        targets = target_records(rendered.moved.targets, CLASSES, len(detection.found))
        missed = tuple(
            Failure("lost", targets[row].label, targets[row].xyxy, index=row)
            for row, (found, counted) in enumerate(zip(detection.found, detection.counted, strict=True))
            if counted and not found
        )
        found = detection_records(rendered.detections, objective.classes.names)
        drawn_targets = tuple(target for target in targets if target.index is not None)
        return pictures.draw_overlay(
            to_uint8(rendered.render.image), drawn_targets, found, missed, objective.t_star
        )


def _choose_frames(new_misses: Mapping[int, Sequence[int]], most: int) -> list[int]:
    """Choose at most `most` frames with new misses, spread over objects."""
    share = math.ceil(most / max(len(new_misses), 1))
    return _choose_evenly(
        sorted({frame for frames in new_misses.values() for frame in _choose_evenly(frames, share)}), most
    )


def _choose_evenly(frames: Sequence[int], most: int) -> list[int]:
    """Choose at most `most` of them, evenly spaced."""
    if len(frames) <= most:
        return list(frames)
    return [frames[round((k + 0.5) * len(frames) / most - 0.5)] for k in range(most)]
