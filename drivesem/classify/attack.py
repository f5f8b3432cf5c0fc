"""`drivesem classify attack`: attacks pictures of objects, grades the failures, and resumes runs."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from drivesem.attacks.methods.base import Attack
from drivesem.classify.networks.architectures import ImageClassifier
from drivesem.classify.networks.loading import open_network
from drivesem.classify.objective import (
    ClassLogits,
    attacked_parameters,
    create_attack,
    create_objective,
    create_space,
)
from drivesem.classify.pictures import ObjectRenderer, ObjectView, interleave_classes, parse_views
from drivesem.classify.results import (
    SCHEMA,
    WRITTEN,
    ClassifiedPicture,
    ClassifyMetrics,
    ClassPrediction,
    write_run_report,
)
from drivesem.classify.scenes import ObjectScene
from drivesem.classify.space import ObjectSpace
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.failures.certificate import CertificateRule, SampleVerdict, count_samples
from drivesem.failures.grades import AGREEMENT_RULE, Certificate, Grade, SecondOpinion
from drivesem.failures.nuisances import Nuisances, NuisanceSample
from drivesem.run.driver import ProgressSettings, run_frame_jobs
from drivesem.run.folder import FRAMES, claim_folder, resolve_output_folder
from drivesem.run.labels import RESULT
from drivesem.run.records import dump_record
from scene_ir import files
from scene_ir.errors import FormatError, RangeError, ShapeError
from scene_ir.io import to_uint8

EMBEDDED_LIMIT = 48
"""Default number of attacked pictures of the embedded objects: four of each class."""

_Classify = Callable[[Tensor], ClassLogits]


@dataclass(frozen=True, slots=True)
class PictureGrader:
    """Tests failures under nuisances, as for detectors."""

    nuisances: Nuisances
    """Nuisances of a sample."""
    rule: CertificateRule
    """Number of samples in which a certain failure must hold."""
    seed: int
    """Seed of the samples."""

    @torch.no_grad()
    def certify(self, identifier: str, classify: _Classify, before: Tensor, after: Tensor) -> Certificate:
        """Count samples before the change that are correct and samples after it that are wrong.

        It stops once no further sample can decide whether the failure is certain; samples after the change come first.

        Args:
            identifier: Name of the picture.
            classify: Classifies a picture (3, H, W).
            before: Picture before the change (3, H, W).
            after: Picture after it (3, H, W).
        """

        def judge(changed: bool, number: int, _: Sequence[int]) -> list[SampleVerdict]:
            sample = self._sample("certificate", identifier, number, before)
            prediction = classify(sample.degrade_image(after if changed else before))
            return [(prediction.correct != changed, prediction.margin)]

        return count_samples(1, judge, self.rule)[0]

    @torch.no_grad()
    def compare_second_render(
        self, identifier: str, classify: _Classify, renderer: str, before: Tensor, after: Tensor
    ) -> SecondOpinion:
        """Test whether a failure persists in samples of a second renderer's pictures.

        Args:
            identifier: Name of the picture.
            classify: Classifies a picture (3, H, W).
            renderer: Name of the second renderer.
            before: Its picture before the change (3, H, W).
            after: Its picture after it (3, H, W).
        """
        samples = [self._sample("confirm", identifier, number, before) for number in range(AGREEMENT_RULE[1])]
        correct_before, correct_after = (
            [classify(sample.degrade_image(picture)).correct for sample in samples] for picture in (before, after)
        )
        return SecondOpinion(renderer, sum(correct_before), correct_after.count(False), len(samples))

    def _sample(self, purpose: str, identifier: str, number: int, picture: Tensor) -> NuisanceSample:
        size = int(picture.shape[1]), int(picture.shape[2])
        return self.nuisances.sample_for_image(f"{purpose}:{identifier}:{self.seed}", number, size)


@dataclass(frozen=True)
class Attacker:
    """Per-process state of a run, built once and reused for all pictures."""

    config: ClassifyConfig
    """Settings of the run."""
    renderer: ObjectRenderer
    """Loads and renders objects."""
    network: ImageClassifier
    """The attacked network."""
    method: Attack
    """The algorithm."""
    grader: PictureGrader
    """Grades failures."""

    @classmethod
    def from_config(cls, config: ClassifyConfig, shared: Attacker | None = None) -> Attacker:
        """Load objects and network.

        Args:
            config: Settings of the run.
            shared: An attacker with the same objects; its network is reused if it has the same name.

        Raises:
            UsageError: Settings that cannot be used.
            SceneError: Objects or a network that cannot be used.
        """
        own = shared is None
        renderer = ObjectRenderer.from_config(config) if own else replace(shared.renderer, lamp=config.lamp)
        if shared is not None and shared.config.network == config.network:
            network = shared.network
        else:
            network = open_network(config.network, renderer.objects.classes, config.device)
        grader = PictureGrader(Nuisances.parse(config.nuisances), CertificateRule(config.draws), config.seed)
        attacked_parameters(config)
        if config.target is not None and config.target not in network.classes:
            raise UsageError("--target", f"one of {', '.join(network.classes)}", config.target)
        method = create_attack(config)
        if method.needs_gradient and not network.differentiable:
            raise UsageError("--method", f"random or halton: {config.network} has no gradient", config.method)
        return cls(config, renderer, network, method, grader)

    def select_views(self) -> list[ObjectView]:
        """Select the pictures to attack: classes alternate, and so do the views of objects."""
        config, objects = self.config, self.renderer.objects
        names, views = interleave_classes(objects.names(config.split)), parse_views(config)
        if not names:
            raise UsageError("--split", "a split with objects", config.split)
        limit = config.limit
        if limit is None and config.objects is None:
            limit = EMBEDDED_LIMIT
        every = [ObjectView(config.split, name, view) for name in names for view in views]
        if limit is None or limit >= len(every):
            return every
        # One view each of many objects rather than all views of few.
        classes = len(objects.classes)
        alternating = [
            ObjectView(config.split, name, views[(i // classes + turn) % len(views)])
            for turn in range(len(views))
            for i, name in enumerate(names)
        ]
        return alternating[:limit]

    def load_scene(self, view: ObjectView) -> tuple[ObjectScene, ObjectSpace]:
        """Load a picture's scene and its parameters. Raises SceneError."""
        scene = self.renderer.load_scene(view)
        return scene, create_space(scene, self.config)

    def attack(self, view: ObjectView, out: Path) -> None:
        """Attack a picture and write its folder.

        One that is misclassified unchanged is attacked only by the setting, one of the target class never.

        Args:
            view: The picture.
            out: Folder of the run.

        Raises:
            SceneError: An object that cannot be used.
        """
        start = time.perf_counter()
        scene, space = self.load_scene(view)
        try:
            objective = create_objective(scene, space, self.network, self.config)
            attackable = objective.benign.correct or self.config.attack_misclassified
            attackable = attackable and scene.model.label != objective.target
            search = self.method(objective.problem(), space.theta0, self.config.seed) if attackable else None
        except (RangeError, ShapeError) as error:
            raise type(error)(f"{view.identifier}: {error.field}", error.expected, error.actual) from error
        theta = space.theta0 if search is None else search.theta
        before, after = objective.render(space.theta0), objective.render(theta)
        attacked, passes = objective.evaluate(theta), objective.passes
        failed, certificate = objective.benign.correct and not attacked.correct, None
        if failed and self.config.grade:
            certificate = self.grader.certify(scene.identifier, objective.classify, before, after)
        certain = certificate is not None and self.grader.rule.holds(certificate)
        classes = self.network.classes
        result = ClassifiedPicture(
            identifier=view.identifier,
            object=view.name,
            label=classes[scene.model.label],
            view=view.view,
            benign=_to_prediction(objective.benign, classes),
            attacked=_to_prediction(attacked, classes),
            grade=str(Grade.CERTAIN if certain else Grade.THRESHOLD) if failed else None,
            count=certificate,
            sizes=space.max_changes(theta),
            moved=space.format_scalars(theta),
            loss_trace=() if search is None else search.loss_trace,
            queries=0 if search is None else search.queries,
            passes=passes,
            seconds=round(time.perf_counter() - start, 3),
        )
        with files.atomic_folder(out / FRAMES / view.identifier) as folder:
            files.write_png(folder / "benign.png", to_uint8(before))
            files.write_png(folder / "counterexample.png", to_uint8(after))
            files.write_npz(folder / "theta.npz", {"theta": theta.numpy().astype(np.float32)})
            files.write_text(folder / RESULT, dump_record(result, SCHEMA))


def _to_prediction(logits: ClassLogits, classes: tuple[str, ...]) -> ClassPrediction:
    confidence, margin = round(logits.confidence, 6), round(logits.margin, 6)
    return ClassPrediction(classes[logits.predicted], confidence, margin, logits.rank)


def attack_pictures(config: ClassifyConfig) -> ClassifyMetrics:
    """Attack the pictures that have no result yet, and write the report. Raises UsageError or SceneError."""
    start = time.perf_counter()
    attacker = Attacker.from_config(config)
    views, params = attacker.select_views(), map(str, attacked_parameters(config))
    name = f"classify-{Path(config.network).stem}-{config.method}-{'-'.join(params)}-seed{config.seed}"
    out = resolve_output_folder(config.out, Path("runs") / name)
    claim_folder(out, config, WRITTEN)
    unfinished = [view for view in views if not (out / FRAMES / view.identifier / RESULT).is_file()]
    failed = run_frame_jobs(
        unfinished,
        partial(attacker.attack, out=out),
        partial(_make_worker, config, out),
        config,
        ProgressSettings("attacking pictures"),
        lambda view: view.identifier,
    ).failed
    done = [view for view in views if view.identifier not in failed]
    if not done:
        raise FormatError("--objects", "a picture that can be attacked", f"none: {next(iter(failed.values()))}")
    return write_run_report(config, out, attacker.network.classes, done, failed, time.perf_counter() - start)


def _make_worker(config: ClassifyConfig, out: Path) -> Callable[[ObjectView], None]:
    return partial(Attacker.from_config(config).attack, out=out)
