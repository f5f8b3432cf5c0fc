"""`drivesem classify attack`: a run of attacks on a classifier, resumable, and its report."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from drivesem.attack.methods.base import Attack
from drivesem.classify.grading import PictureGrader
from drivesem.classify.networks.base import Scorer
from drivesem.classify.networks.loading import load_classifier
from drivesem.classify.networks.onnx import OnnxClassifier
from drivesem.classify.objective import ClassifierObjective, Seen
from drivesem.classify.page import write_page
from drivesem.classify.pictures import Shown, Studio, views_of
from drivesem.classify.protocol import aimed_by, attack_of, params_of, reach_of, steps_of
from drivesem.classify.results import SCHEMA, ClassifiedFrame, ClassifiedRun, Verdict
from drivesem.classify.scenes import ObjectScene, in_turn
from drivesem.classify.space import ObjectSpace
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.failures.certificate import CertificateRule
from drivesem.failures.grades import Grade
from drivesem.failures.nuisances import Nuisances
from drivesem.report.tables import rows_to_csv
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.finished import METRICS
from drivesem.run.folder import FRAMES, claim_folder, resolve_output_folder
from drivesem.run.frame import RESULT
from drivesem.run.records import dump_record, load_record
from drivesem.run.report.runs import PAGE
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.io import to_uint8

CSV = "classified.csv"
WRITTEN = (FRAMES, METRICS, PAGE, CSV)
"""What a run leaves in its folder."""
EMBEDDED_LIMIT = 48
"""Pictures of the embedded objects that are attacked where --limit is not given: of each class four."""


def network_of(name_or_path: str, classes: Sequence[str], device: str) -> Scorer:
    """A network to attack: as `load_classifier`, or an ONNX file. Raises FormatError."""
    if Path(name_or_path).suffix == ".onnx":
        return OnnxClassifier(Path(name_or_path), classes)
    return load_classifier(name_or_path, classes, device)


@dataclass(frozen=True)
class Attacker:
    """What one process needs: built once, used for many pictures."""

    config: ClassifyConfig
    studio: Studio
    network: Scorer
    method: Attack
    grader: PictureGrader

    @classmethod
    def of(cls, config: ClassifyConfig, like: Attacker | None = None) -> Attacker:
        """like: one that shows the same objects, and attacks the same network where it has that name. Raises
        UsageError or SceneError for settings, objects or a network that cannot be used.
        """
        studio = Studio.of(config) if like is None else like.studio
        if like is not None and like.config.network == config.network:
            network = like.network
        else:
            network = network_of(config.network, studio.objects.classes, config.device)
        grader = PictureGrader(Nuisances.parse(config.nuisances), CertificateRule(config.draws), config.seed)
        params_of(config)
        method = attack_of(config)
        if method.needs_gradient and not network.differentiable:
            raise UsageError("--method", f"random or halton: {config.network} has no gradient", config.method)
        return cls(config, studio, network, method, grader)

    def shown(self) -> list[Shown]:
        """The pictures to attack: classes in turn, and of an object its views in turn with the others'."""
        names, views = in_turn(self.studio.objects.names(self.config.split)), views_of(self.config)
        if not names:
            raise UsageError("--split", "a split with objects", self.config.split)
        limit = self.config.limit
        if limit is None and self.config.objects is None:
            limit = EMBEDDED_LIMIT
        every = [Shown(self.config.split, name, view) for name in names for view in views]
        if limit is None or limit >= len(every):
            return every
        # Rather a view of many objects than all of a few.
        classes = len(self.studio.objects.classes)
        turned = [
            Shown(self.config.split, name, views[(i // classes + turn) % len(views)])
            for turn in range(len(views))
            for i, name in enumerate(names)
        ]
        return turned[:limit]

    def scene(self, shown: Shown) -> tuple[ObjectScene, ObjectSpace]:
        """A picture's scene, and what may move in it. Raises SceneError."""
        config, scene = self.config, self.studio.scene(shown)
        return scene, ObjectSpace(
            scene.vertices, params_of(config), steps_of(config), reach_of(config), config.shape
        )

    def attack(self, shown: Shown, out: Path) -> None:
        """One picture, to its folder; one that is misclassified as it is stays as it is. Raises SceneError."""
        start = time.perf_counter()
        scene, space = self.scene(shown)
        try:
            objective = ClassifierObjective(scene, space, self.network, aimed_by(self.config))
            wrong = not objective.benign.right
            search = None if wrong else self.method(objective.problem(), space.theta0, self.config.seed)
        except (RangeError, ShapeError) as error:
            raise type(error)(f"{shown.identifier}: {error.field}", error.expected, error.actual) from error
        theta = space.theta0 if search is None else search.theta
        before, after = objective.picture(space.theta0), objective.picture(theta)
        attacked, passes = objective.see(theta), objective.passes
        failed, count = search is not None and not attacked.right, None
        if failed and self.config.grade:
            count = self.grader.count(scene.identifier, objective.look, before, after)
        certain = count is not None and self.grader.rule.holds(count)
        classes = self.network.classes
        record = ClassifiedFrame(
            identifier=shown.identifier,
            object=shown.name,
            label=classes[scene.model.label],
            view=shown.view,
            benign=verdict(objective.benign, classes),
            attacked=verdict(attacked, classes),
            grade=str(Grade.CERTAIN if certain else Grade.THRESHOLD) if failed else None,
            count=count,
            sizes=space.sizes(theta),
            moved=space.few(theta),
            loss_trace=() if search is None else search.loss_trace,
            queries=0 if search is None else search.queries,
            passes=passes,
            seconds=round(time.perf_counter() - start, 3),
        )
        with files.atomic_folder(out / FRAMES / shown.identifier) as part:
            files.write_png(part / "benign.png", to_uint8(before))
            files.write_png(part / "counterexample.png", to_uint8(after))
            files.write_npz(part / "theta.npz", {"theta": theta.numpy().astype(np.float32)})
            files.write_text(part / RESULT, dump_record(record, SCHEMA))


def verdict(seen: Seen, classes: tuple[str, ...]) -> Verdict:
    """What a network said, as it is written."""
    return Verdict(classes[seen.predicted], round(seen.confidence, 6), round(seen.margin, 6))


def attack_run(config: ClassifyConfig) -> ClassifiedRun:
    """Attack all pictures, as far as that is not done, and write report and figures. Raises UsageError or
    SceneError.
    """
    start = time.perf_counter()
    attacker = Attacker.of(config)
    shown, params = attacker.shown(), tuple(str(one) for one in params_of(config))
    name = f"classify-{Path(config.network).stem}-{config.method}-{'-'.join(params)}-seed{config.seed}"
    out = resolve_output_folder(config.out, Path("runs") / name)
    claim_folder(out, config, WRITTEN)
    todo = [one for one in shown if not (out / FRAMES / one.identifier / RESULT).is_file()]
    work, build = partial(attacker.attack, out=out), partial(_attacker, config, out)
    failed = run_frame_jobs(
        todo, work, build, config, ProgressSettings("attacking pictures"), lambda one: one.identifier
    ).failed
    done = [one for one in shown if one.identifier not in failed]
    if not done:
        raise FormatError("--objects", "a picture that can be attacked", f"none: {next(iter(failed.values()))}")
    return report_run(config, out, attacker.network.classes, done, failed, time.perf_counter() - start)


def report_run(
    config: ClassifyConfig,
    out: Path,
    classes: tuple[str, ...],
    done: Sequence[Shown],
    failed: Mapping[str, str],
    seconds: float,
) -> ClassifiedRun:
    """Write report and figures of pictures that are attacked. Raises FormatError for a file that is not whole."""
    frames = frames_of(out, done)
    run = ClassifiedRun.of(
        frames,
        classes,
        out=str(out),
        objects=config.objects or "embedded",
        network=config.network,
        method=config.method,
        params=tuple(str(one) for one in params_of(config)),
        frames_failed=dict(sorted(failed.items())),
        seconds=round(seconds, 3),
    )
    files.write_json(out / METRICS, run.to_json())
    files.write_text(out / CSV, rows_to_csv([frame.row() for frame in frames]))
    write_page(out / PAGE, run, frames)
    return run


def frames_of(out: Path, done: Sequence[Shown]) -> list[ClassifiedFrame]:
    """What came of pictures that are attacked. Raises FormatError."""
    return [load_record(out / FRAMES / one.identifier / RESULT, ClassifiedFrame, SCHEMA) for one in done]


def _attacker(config: ClassifyConfig, out: Path) -> Callable[[Shown], None]:
    return partial(Attacker.of(config).attack, out=out)
