"""`drivesem drive`: a clip taken apart, one change of each car over its whole track, and what is then missed."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from torch import Tensor

from detectors.base import detector_device
from detectors.types import CLASSES
from drivesem.attack.budgets import change_limits, parse_budget
from drivesem.attack.feasibility_check import ChangeLimits, check_scene
from drivesem.attack.methods.placebo import Placebo
from drivesem.attack.targets import resolve_t_star
from drivesem.config.commands import AttackConfig, DriveConfig
from drivesem.config.devices import check_device
from drivesem.failures.certificate import CompositorRenderer
from drivesem.failures.grades import Grade
from drivesem.report.drawing import write_picture
from drivesem.report.tables import AnalysisReport, format_count
from drivesem.report.terminal import Console, progress_bar
from drivesem.run import attack as attacks
from drivesem.run.folder import FRAMES, PRESENTATION, claim_folder
from drivesem.run.frame import EvaluatedScene as Judged
from drivesem.run.frame import build_grading_input, detection_records, target_records
from drivesem.run.records import from_json
from drivesem.run.report import pictures
from drivesem.run.results import Failure
from drivesem.video.clips import ClipDerenderer, ClipSource, DerenderedClip, derender_clip
from drivesem.video.objective import ClipObjective, FrameDetection
from drivesem.video.report import build_report, write_page, write_video
from drivesem.video.results import (
    ABSENT,
    FOUND,
    LOST,
    STATES,
    UNCOUNTED,
    CarResult,
    DriveResult,
    State,
)
from scene_ir import files
from scene_ir.io import to_uint8
from scene_ir.types import convert_scene

RESULT, PAGE, VIDEO, SCENES = "drive.json", "report.html", "clip.webm", "scenes"
_WRITTEN = (RESULT, PAGE, VIDEO, SCENES, FRAMES, "drive.csv", "drive.md")
_FREE = tuple(name for name in PRESENTATION if name != "limit")
"""Settings that change no result: here the number of frames does."""
DEFAULT_PARAMS = "color,translate,mesh"
"""The same paint and shape, and a path a little aside."""


def attack_clip(config: DriveConfig) -> AnalysisReport:
    """Attack a clip, or tell what an earlier command found. Raises UsageError or SceneError for bad input."""
    start = time.perf_counter()
    asked = to_attack_config(config)
    params, method = attacks.resolve_parameters(asked), attacks.build_attack(asked)
    check_device(config.device)
    worker = attacks.AttackWorker.from_config(asked)
    out = Path(config.out) if config.out else Path("runs") / _name(config, [str(p) for p in params])
    taking = ClipSource(config.clip, config.sequence, config.limit, config.seed, config.fit, config.keep_going)
    taker = ClipDerenderer(taking, out / SCENES)
    claim_folder(out, config, _WRITTEN, _FREE)
    if config.resume and (out / RESULT).is_file():
        return build_report(from_json(DriveResult, files.read_json(out / RESULT), str(out / RESULT)))
    detector, budget = worker.detector, parse_budget(asked.budget)
    clip = derender_clip(taker, config)
    clip = replace(clip, scenes=convert_scene(clip.scenes, None, detector_device(detector)))
    objective = ClipObjective(clip, detector, params, budget, config)
    problem, theta0 = objective.problem(config.keep == "last"), objective.space.theta0
    seen, control = _Seen(clip, objective, out), theta0
    with progress_bar(Console(stderr=True)) as progress:
        task = progress.add_task(
            f"looking at {format_count(len(clip.names), 'frame')} with {format_count(objective.space.count, 'car')}",
            total=None,
        )
        objective.on_frame = lambda: progress.advance(task)
        search = method(problem, theta0, config.seed)
        if bool(search.theta.any()):
            control = Placebo(tuple(search.theta.tolist()))(problem, theta0, config.seed).theta
        seen.look(search.theta, control, config.certify, worker, reach=change_limits(budget))
    told = objective.space.theta_by_name(search.theta)
    result = DriveResult(
        out=str(out),
        clip=clip.name,
        detector=config.detector,
        t_star=resolve_t_star(detector, config.t_star),
        params=tuple(str(p) for p in params),
        method=config.method,
        frames=len(clip.names),
        names=clip.names,
        cars=seen.cars(),
        phantoms=seen.phantoms,
        feasible=len(clip.names) - len(seen.violations),
        violations=seen.violations,
        held_back=search.active_constraints,
        failed=clip.failed,
        theta={name: str(facts["display"]) for name, facts in told.items() if facts["value"]},
        loss_trace=search.loss_trace,
        queries=search.queries,
        passes=objective.passes,
        seconds=round(time.perf_counter() - start, 3),
    )
    write_video(out / VIDEO, [out / FRAMES / name for name in clip.names])
    write_page(out / PAGE, result)
    answer = build_report(result)
    answer.write()
    return answer


def to_attack_config(config: DriveConfig) -> AttackConfig:
    """The same search as an attack on frames. Raises UsageError for settings that do not go together."""
    known = {entry.name for entry in fields(AttackConfig)} & {entry.name for entry in fields(DriveConfig)}
    told = {name: getattr(config, name) for name in known}
    if config.params is None and config.combo is None:
        told["params"] = DEFAULT_PARAMS
    attack = AttackConfig(**told | {"confirm": False, "peer": "off"})
    attack.check()
    return attack


def _name(config: DriveConfig, params: Sequence[str]) -> str:
    clip = "demo" if config.clip is None else Path(config.clip).resolve().name
    part = "" if config.sequence is None else f"-{config.sequence.replace('/', '-')}"
    method = "" if config.method == DriveConfig().method else f"-{config.method}"
    return f"drive-{clip}{part}-{'-'.join(params)}{method}-seed{config.seed}"


@dataclass
class _Seen:
    """What is seen of a clip, frame by frame: in the photographs, changed, and changed at random."""

    clip: DerenderedClip
    objective: ClipObjective
    out: Path
    phantoms: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STATES, 0))
    violations: dict[str, tuple[str, ...]] = field(default_factory=dict)
    _letters: dict[tuple[int, State], list[str]] = field(default_factory=dict)
    _path: dict[int, dict[int, tuple[float, float]]] = field(default_factory=dict)
    _grades: dict[int, list[bool]] = field(default_factory=dict)

    def look(
        self, theta: Tensor, control: Tensor, certify: int, worker: attacks.AttackWorker, reach: ChangeLimits
    ) -> None:
        """Look at all frames, write their pictures, and grade what is newly missed in up to `certify` of them."""
        newly: dict[int, list[int]] = {}
        for frame, name in enumerate(self.clip.names):
            scene = self.clip.scenes[frame]
            before = self.objective.match_frame(frame, self.objective.frames[frame].benign)
            after = self.objective.detect_frame(theta, frame)
            sights: dict[State, FrameDetection] = {
                "before": before,
                "after": after,
                "control": self.objective.detect_frame(control, frame),
            }
            for state, sight in sights.items():
                self.phantoms[state] += sight.phantoms
                for row, track in enumerate(self.clip.tracks[frame]):
                    letter = UNCOUNTED if not sight.counted[row] else FOUND if sight.found[row] else LOST
                    letters = self._letters.setdefault((track, state), [ABSENT] * len(self.clip.names))
                    letters[frame] = letter
            for row, offset in enumerate(self.objective.space.path_offsets(theta, frame).tolist()):
                along, across = (round(value, 4) for value in offset)
                self._path.setdefault(self.clip.tracks[frame][row], {})[frame] = (along, across)
            wrong = tuple(check_scene(scene, after.rendered.scene, reach=reach))
            if wrong:
                self.violations[name] = wrong
            for row in after.lost:
                newly.setdefault(self.clip.tracks[frame][row], []).append(frame)
            with files.atomic_folder(self.out / FRAMES / name) as folder:
                for state in ("before", "after"):
                    write_picture(folder / f"{state}.jpg", self._marked(frame, sights[state]))
        for frame in _of_all(newly, certify):
            self._grade(frame, theta, worker)

    def cars(self) -> tuple[CarResult, ...]:
        """What came of each car, the most missed first."""
        found = []
        for track in self.objective.space.tracks:
            rows = [(f, t.index(track)) for f, t in enumerate(self.clip.tracks) if track in t]
            away: list[float | None] = [None] * len(self.clip.names)
            for frame, row in rows:
                place = self.clip.scenes[frame].objects.translation[row]
                away[frame] = round(float(place[[0, 2]].norm()), 3)
            frame, row = rows[0]
            states: dict[str, str] = {state: "".join(self._letters[track, state]) for state in STATES}
            path = self._path[track]
            kind = CLASSES[int(self.clip.scenes[frame].objects.category[row])]
            paths = tuple(path.get(f) for f in range(len(away)))
            found.append(
                CarResult.from_states(track, kind, states, tuple(away), paths, self._grades.get(track, []))
            )
        return tuple(sorted(found, key=lambda car: (-car.new_misses, car.track)))

    def _grade(self, frame: int, theta: Tensor, worker: attacks.AttackWorker) -> None:
        """Whether what is newly missed in a frame is missed for certain."""
        objective, benign = self.objective.frames[frame], self.objective.frames[frame].benign
        sight = self.objective.detect_frame(theta, frame)
        before, now = (
            Judged(seen.scene, seen.render, seen.moved, seen.detections) for seen in (benign, sight.rendered)
        )
        draw = CompositorRenderer(objective.compositor, objective.labeller)
        case = build_grading_input(self.clip.names[frame], draw, objective.classes, before, now)
        grades = worker.grader.grade(case, objective.failures(sight.rendered, "moved"))
        for row in sight.lost:
            graded = grades.lost.get(row)
            sure = graded is not None and graded.grade is not Grade.THRESHOLD
            self._grades.setdefault(self.clip.tracks[frame][row], []).append(sure)

    def _marked(self, frame: int, sight: FrameDetection) -> pictures.Image:
        """A picture with its boxes."""
        objective, rendered = self.objective.frames[frame], sight.rendered
        targets = target_records(rendered.moved.targets, CLASSES, len(sight.found))
        missed = tuple(
            Failure("lost", targets[row].label, targets[row].xyxy, index=row)
            for row, (found, counted) in enumerate(zip(sight.found, sight.counted, strict=True))
            if counted and not found
        )
        found = detection_records(rendered.detections, objective.classes.names)
        shown = tuple(target for target in targets if target.index is not None)
        return pictures.draw_overlay(to_uint8(rendered.render.image), shown, found, missed, objective.t_star)


def _of_all(newly: Mapping[int, Sequence[int]], most: int) -> list[int]:
    """At most so many frames of those in which cars are newly missed, some of each car as far as they go round."""
    share = math.ceil(most / max(len(newly), 1))
    return _spread(sorted({frame for frames in newly.values() for frame in _spread(frames, share)}), most)


def _spread(frames: Sequence[int], most: int) -> list[int]:
    """At most so many of them, evenly spread."""
    if len(frames) <= most:
        return list(frames)
    return [frames[round((k + 0.5) * len(frames) / most - 0.5)] for k in range(most)]
