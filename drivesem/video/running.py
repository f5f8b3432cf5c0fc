"""`drivesem drive`: a clip taken apart, one change of each car over its whole track, and what is then missed."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

from torch import Tensor

from detectors.base import device_of
from detectors.types import CLASSES
from drivesem.attack.budgets import budget_of, reach_of
from drivesem.attack.feasibility_check import Reach, check_scene
from drivesem.attack.judging import t_star_of
from drivesem.attack.methods.placebo import Placebo
from drivesem.config.commands import Attack, Drive
from drivesem.config.devices import check_device
from drivesem.failures.grades import Grade
from drivesem.failures.second_renderer.compositor import CompositorDraw
from drivesem.report.answer import Answer
from drivesem.report.drawing import write_picture
from drivesem.report.progress import progress_bar
from drivesem.report.tables import number_of
from drivesem.report.terminal import Console
from drivesem.run import attack as attacks
from drivesem.run.folder import FRAMES, PRESENTATION, claim
from drivesem.run.frame import State as Judged
from drivesem.run.frame import case_of, detection_records, target_records
from drivesem.run.records import from_json
from drivesem.run.report import pictures
from drivesem.run.results import Failure
from drivesem.video.objective import ClipObjective, Sight
from drivesem.video.page import write_page
from drivesem.video.report import answer_of
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
from drivesem.video.taking import TakenClip, Taker, Taking, take_clip
from drivesem.video.video import write_video
from scene_ir import files
from scene_ir.io import to_uint8
from scene_ir.types import scene_to

RESULT, PAGE, VIDEO, SCENES = "drive.json", "report.html", "clip.webm", "scenes"
_WRITTEN = (RESULT, PAGE, VIDEO, SCENES, FRAMES, "drive.csv", "drive.md")
_FREE = tuple(name for name in PRESENTATION if name != "limit")
"""Settings that change no result: here the number of frames does."""
DEFAULT_PARAMS = "color,translate,mesh"
"""The same paint and shape, and a path a little aside."""


def drive_run(config: Drive) -> Answer:
    """Attack a clip, or tell what an earlier command found. Raises UsageError or SceneError for bad input."""
    start = time.perf_counter()
    asked = attack_of(config)
    params, method = attacks.params_of(asked), attacks.attack_method(asked)
    check_device(config.device)
    worker = attacks.Worker.of(asked)
    out = Path(config.out) if config.out else Path("runs") / _name(config, [str(p) for p in params])
    taking = Taking(config.clip, config.sequence, config.limit, config.seed, config.fit, config.keep_going)
    taker = Taker(taking, out / SCENES)
    claim(out, config, _WRITTEN, _FREE)
    if config.resume and (out / RESULT).is_file():
        return answer_of(from_json(DriveResult, files.read_json(out / RESULT), str(out / RESULT)))
    detector, budget = worker.detector, budget_of(asked.budget)
    clip = take_clip(taker, config)
    clip = replace(clip, scenes=scene_to(clip.scenes, None, device_of(detector)))
    objective = ClipObjective(clip, detector, params, budget, config)
    problem, theta0 = objective.problem(config.keep == "last"), objective.space.theta0
    seen, control = _Seen(clip, objective, out), theta0
    with progress_bar(Console(stderr=True)) as progress:
        task = progress.add_task(
            f"looking at {number_of(len(clip.names), 'frame')} with {number_of(objective.space.count, 'car')}",
            total=None,
        )
        objective.looked = lambda: progress.advance(task)
        search = method(problem, theta0, config.seed)
        if bool(search.theta.any()):
            control = Placebo(tuple(search.theta.tolist()))(problem, theta0, config.seed).theta
        seen.look(search.theta, control, config.certify, worker, reach=reach_of(budget))
    told = objective.space.theta_by_name(search.theta)
    result = DriveResult(
        out=str(out),
        clip=clip.name,
        detector=config.detector,
        t_star=t_star_of(detector, config.t_star),
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
    answer = answer_of(result)
    answer.write()
    return answer


def attack_of(config: Drive) -> Attack:
    """The same search as an attack on frames. Raises UsageError for settings that do not go together."""
    known = {entry.name for entry in fields(Attack)} & {entry.name for entry in fields(Drive)}
    told = {name: getattr(config, name) for name in known}
    if config.params is None and config.combo is None:
        told["params"] = DEFAULT_PARAMS
    attack = Attack(**told | {"confirm": False, "peer": "off"})
    attack.check()
    return attack


def _name(config: Drive, params: Sequence[str]) -> str:
    clip = "demo" if config.clip is None else Path(config.clip).resolve().name
    part = "" if config.sequence is None else f"-{config.sequence.replace('/', '-')}"
    method = "" if config.method == Drive().method else f"-{config.method}"
    return f"drive-{clip}{part}-{'-'.join(params)}{method}-seed{config.seed}"


@dataclass
class _Seen:
    """What is seen of a clip, frame by frame: in the photographs, changed, and changed at random."""

    clip: TakenClip
    objective: ClipObjective
    out: Path
    phantoms: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STATES, 0))
    violations: dict[str, tuple[str, ...]] = field(default_factory=dict)
    _letters: dict[tuple[int, State], list[str]] = field(default_factory=dict)
    _path: dict[int, dict[int, tuple[float, float]]] = field(default_factory=dict)
    _grades: dict[int, list[bool]] = field(default_factory=dict)

    def look(self, theta: Tensor, control: Tensor, certify: int, worker: attacks.Worker, reach: Reach) -> None:
        """Look at all frames, write their pictures, and grade what is newly missed in up to `certify` of them."""
        newly: dict[int, list[int]] = {}
        for frame, name in enumerate(self.clip.names):
            scene = self.clip.scenes[frame]
            before = self.objective.judged(frame, self.objective.frames[frame].benign)
            after = self.objective.sight(theta, frame)
            sights: dict[State, Sight] = {
                "before": before,
                "after": after,
                "control": self.objective.sight(control, frame),
            }
            for state, sight in sights.items():
                self.phantoms[state] += sight.phantoms
                for row, track in enumerate(self.clip.tracks[frame]):
                    letter = UNCOUNTED if not sight.counted[row] else FOUND if sight.found[row] else LOST
                    letters = self._letters.setdefault((track, state), [ABSENT] * len(self.clip.names))
                    letters[frame] = letter
            for row, offset in enumerate(self.objective.space.path(theta, frame).tolist()):
                along, across = (round(value, 4) for value in offset)
                self._path.setdefault(self.clip.tracks[frame][row], {})[frame] = (along, across)
            wrong = tuple(check_scene(scene, after.rendered.scene, reach=reach))
            if wrong:
                self.violations[name] = wrong
            for row in after.lost:
                newly.setdefault(self.clip.tracks[frame][row], []).append(frame)
            with files.whole_folder(self.out / FRAMES / name) as folder:
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
            found.append(CarResult.of(track, kind, states, tuple(away), paths, self._grades.get(track, [])))
        return tuple(sorted(found, key=lambda car: (-car.newly, car.track)))

    def _grade(self, frame: int, theta: Tensor, worker: attacks.Worker) -> None:
        """Whether what is newly missed in a frame is missed for certain."""
        objective, benign = self.objective.frames[frame], self.objective.frames[frame].benign
        sight = self.objective.sight(theta, frame)
        before, now = (
            Judged(seen.scene, seen.render, seen.moved, seen.detections) for seen in (benign, sight.rendered)
        )
        draw = CompositorDraw(objective.compositor, objective.labeller)
        case = case_of(self.clip.names[frame], draw, objective.judged, before, now)
        grades = worker.grader.grade(case, objective.failures(sight.rendered, "moved"))
        for row in sight.lost:
            graded = grades.lost.get(row)
            sure = graded is not None and graded.grade is not Grade.THRESHOLD
            self._grades.setdefault(self.clip.tracks[frame][row], []).append(sure)

    def _marked(self, frame: int, sight: Sight) -> pictures.Image:
        """A picture with its boxes."""
        objective, rendered = self.objective.frames[frame], sight.rendered
        targets = target_records(rendered.moved.targets, CLASSES, len(sight.found))
        missed = tuple(
            Failure("lost", targets[row].label, targets[row].xyxy, index=row)
            for row, (found, counted) in enumerate(zip(sight.found, sight.counted, strict=True))
            if counted and not found
        )
        found = detection_records(rendered.detections, objective.judged.names)
        shown = tuple(target for target in targets if target.index is not None)
        return pictures.overlay(to_uint8(rendered.render.image), shown, found, missed, objective.t_star)


def _of_all(newly: Mapping[int, Sequence[int]], most: int) -> list[int]:
    """At most so many frames of those in which cars are newly missed, some of each car as far as they go round."""
    share = math.ceil(most / max(len(newly), 1))
    return _spread(sorted({frame for frames in newly.values() for frame in _spread(frames, share)}), most)


def _spread(frames: Sequence[int], most: int) -> list[int]:
    """At most so many of them, evenly spread."""
    if len(frames) <= most:
        return list(frames)
    return [frames[round((k + 0.5) * len(frames) / most - 0.5)] for k in range(most)]
