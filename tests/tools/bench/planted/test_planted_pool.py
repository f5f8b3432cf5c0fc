"""What a fault does to cars that were seen without it: by hand, and beside the detector that has the fault."""

from pathlib import Path

import pytest
import torch

from detectors.base import predict
from detectors.planted import PlantedDetector, PlantedFault
from detectors.registry import load_detector
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import ParameterSpace
from drivesem.failures.neighbourhood import SceneSampler
from drivesem.failures.nuisances import Nuisances
from drivesem.run.records import dump_record, load_record
from drivesem.synth.demo import demo_scene
from scene_ir.render.compositor import Compositor
from tools.bench.planted.pool import SCHEMA, CachingDetector, CarObservation, FramePool

NAMES = ("height_px", "lightness")
DARK = PlantedFault.parse("lightness=0.1:0.3")


def car(lightness: float, score: float = 0.9, index: int = 0, *others: tuple[float, ...]) -> CarObservation:
    """Seen once, at a shade; its label is ten per cent lighter."""
    told = ((score, 40.0, 1.5, 0.5, lightness, 0.2), *others)
    return CarObservation(index, (41.0, 1.1 * lightness), 1.0, told)


def test_a_car_in_the_band_is_lost() -> None:
    assert car(0.2).lost(DARK, 0.5)
    assert car(0.2).hidden(DARK, 0.5)
    assert not car(0.6).lost(DARK, 0.5)
    lost = CarObservation(0, (41.0, 0.6), -1.0, car(0.6).best_candidates)
    assert lost.lost(DARK, 0.5)
    assert not lost.hidden(DARK, 0.5), "it was not found before"
    assert car(0.2).best == (40.0, 1.5, 0.5, 0.2, 0.2)
    assert CarObservation(0, (41.0, 0.6), -1.0, ()).best is None


@pytest.fixture(scope="module")
def objective() -> Objective:
    scene = demo_scene(0, 0)
    detector = CachingDetector(load_detector("squeezedet"))
    return Objective(Compositor(scene), ParameterSpace(scene, ("color", "translate")), detector)


@pytest.fixture(scope="module")
def pool(objective: Objective) -> FramePool:
    return FramePool.make(objective, "demo-000", 0, 3)


def test_a_pool_comes_back_from_its_file(pool: FramePool, tmp_path: Path) -> None:
    (tmp_path / "pool.json").write_text(dump_record(pool, SCHEMA))
    assert load_record(tmp_path / "pool.json", FramePool, SCHEMA) == pool
    assert (len(pool.camera_samples), len(pool.states)) == (4, 3)
    assert set(NAMES) < set(pool.names)


def test_what_a_fault_hides_is_what_its_detector_does_not_find(objective: Objective, pool: FramePool) -> None:
    """Bands about the shade of a car in each state: the detector with that fault finds the others."""
    hidden = seen = 0
    for number, state in enumerate(pool.states):
        shades = [one.best[3] for one in state if one.margin > 0.5 and one.best is not None]
        fault = PlantedFault.parse(f"lightness={shades[0] - 0.08:.4f}:{shades[0] + 0.08:.4f}")
        planted = PlantedDetector(objective.differentiable, fault).requires_grad_(False)
        with_fault = Objective(objective.compositor, objective.space, planted)
        everywhere = SceneSampler(with_fault, with_fault.feasible_set(), Nuisances(), "planted:demo-000:0")
        margins = everywhere.margins(everywhere.sample(number))
        for one in state:
            if one.index in margins:  # it is found as photographed with the fault too
                assert (margins[one.index] < 0) == one.lost(fault, pool.t_star)
                hidden, seen = hidden + one.hidden(fault, pool.t_star), seen + (margins[one.index] > 0)
    assert min(hidden, seen) >= 1


def test_a_detector_that_remembers_says_the_same() -> None:
    plain = load_detector("squeezedet")
    remembering = CachingDetector(plain)
    images = torch.rand(2, 3, 128, 256, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        first, again = (predict(remembering, images[:1])[0] for _ in range(2))
        other, whole = predict(remembering, images[1:])[0], predict(plain, images[:1])[0]
    assert torch.equal(first.scores, again.scores)
    assert torch.equal(first.scores, whole.scores)
    assert torch.equal(first.boxes_xyxy, whole.boxes_xyxy)
    assert first.scores.shape != other.scores.shape or not torch.equal(first.scores, other.scores)
    assert remembering.images_seen == 2
