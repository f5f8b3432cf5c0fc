"""Arms of two classes on hand-made frames: no renderer, no detector."""

from collections.abc import Sequence
from dataclasses import replace

from detectors.types import CLASSES
from drivesem.attacks.targets import HEADLINE, EvaluatedClasses
from drivesem.config.commands import AttackConfig
from drivesem.run.results import BoxRecord, Coordinate, FrameResult
from tests.drivesem.counting import summary_of
from tools.experiments.detection.arms import ArmRun, AttackArm
from tools.experiments.detection.counts import ArmCounts

WIDTH_PX, HEIGHT_PX = 50.0, 30.0


def box(x: float, score: float | None = None, index: int | None = None) -> BoxRecord:
    return BoxRecord((x, 20.0, x + WIDTH_PX, 20.0 + HEIGHT_PX), HEADLINE, score=score, index=index)


def frame(
    name: str,
    moved_by: float = 0.0,
    found: bool = True,
    success: bool = False,
    queries: int = 10,
    yaw: float = 0.1,
) -> FrameResult:
    """A frame of two cars. moved_by: px by which the first car and its moved label go to the right; found: whether
    the detector follows it; it always finds the second.
    """
    cars = (box(10.0, index=0), box(200.0, index=1))
    seen = tuple(replace(one, score=0.9, index=None) for one in cars)
    after = (box(10.0 + moved_by, 0.9), seen[1]) if found else (seen[1],)
    return FrameResult(
        identifier=name,
        objects=2,
        queries=queries,
        loss_trace=(0.0,),
        theta=(Coordinate("objects[0].yaw", "rad", yaw, -0.35, 0.35, ""),),
        active_constraints=(),
        violations=(),
        targets_benign=cars,
        targets_moved=(box(10.0 + moved_by, index=0), cars[1]),
        detections_benign=seen,
        detections_rerendered=seen,
        detections_attacked=after,
        failures=(),
        became_ignored=(),
        judged=(0,),
        found_before=(0,),
        success_paper=success,
        success_moved=success,
        identity_psnr_db=None,
        seconds=0.0,
    )


def arm_run(arm: AttackArm, results: Sequence[FrameResult]) -> ArmRun:
    judged = EvaluatedClasses(CLASSES, CLASSES)
    return ArmRun(arm, summary_of(arm.config, results), tuple(results), judged)


def counted(arm: AttackArm, results: Sequence[FrameResult]) -> ArmCounts:
    return ArmCounts.from_run(arm_run(arm, results))


def arm(
    name: str, reference: float | None = None, control: tuple[str, str] | None = None, **of: object
) -> AttackArm:
    """An arm by name, with settings of its attack."""
    kind, control_rows = control or (None, None)
    return AttackArm(name, name, AttackConfig(**of), reference, kind, control_rows)  # pyright: ignore[reportArgumentType]
