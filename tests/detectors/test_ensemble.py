"""Ensembles: members' losses, candidates and detections on one scale."""

import math
from pathlib import Path

import pytest
import torch

from detectors.base import DetectorError
from detectors.ensemble import T_STAR, Ensemble, parse_member_names
from detectors.registry import find_code_to_run, load_detector, save_detector
from detectors.squeezedet import SqueezeDet
from detectors.types import Targets

SPEC = "ensemble:squeezedet+yolov3-slim"
CAR = Targets(torch.tensor([[30.0, 20.0, 90.0, 60.0]]), torch.tensor([0]), torch.tensor([False]))


@pytest.fixture(scope="module")
def both() -> Ensemble:
    detector = load_detector(SPEC)
    assert isinstance(detector, Ensemble)
    return detector


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    return torch.rand(2, 3, 96, 160, generator=torch.Generator().manual_seed(0))


def test_a_loss_is_the_mean_of_the_members(both: Ensemble, images: torch.Tensor) -> None:
    raw = both(images)
    members = [load_detector(name) for name in parse_member_names(SPEC)]
    for name, value in both.loss(raw, [CAR, CAR]).items():
        own = [float(one.loss(one(images), [CAR, CAR])[name]) for one in members]
        assert float(value) == pytest.approx(sum(own) / 2, rel=1e-4), name
    assert (len(raw), len(raw.select(1))) == (2, 1)
    images = images.clone().requires_grad_(True)
    both.loss(both(images), [CAR, CAR])["objectness"].backward()
    assert images.grad is not None
    assert bool(images.grad.any())


def test_member_thresholds_map_to_the_ensembles(tmp_path: Path) -> None:
    """The same detector twice, with other thresholds: a score at t* of either is T_STAR of the ensemble."""
    paths = []
    for t_star in (0.2, 0.7):
        detector = SqueezeDet(t_star=t_star)
        detector.initialise(torch.Generator().manual_seed(1))
        with torch.no_grad():
            detector.conv1.weight *= 0.01
        paths.append(tmp_path / f"{t_star}.safetensors")
        save_detector(detector, paths[-1])
    pair = load_detector(f"ensemble:{paths[0]}+{paths[1]}")
    assert pair.t_star == T_STAR
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(2))
    logs = pair.candidates(pair(image)).log_scores
    first, second = (torch.logit(part.double().exp()) for part in logs.chunk(2))

    def logit(p: float) -> float:
        return math.log(p / (1 - p))

    assert torch.allclose(first - second, torch.full_like(first, logit(0.7) - logit(0.2)), atol=1e-3)
    own = load_detector(paths[0])
    theirs = torch.logit(own.candidates(own(image)).log_scores.double().exp())
    assert torch.allclose(first, theirs - logit(0.2), atol=1e-3)
    (found,), best = pair.decode(pair(image)), logs.exp().max()
    assert len(found)
    # What the surer member says of a place stands; the other's equal box goes.
    assert float(found.scores[0]) == pytest.approx(float(best), rel=1e-4)
    assert len(found) == len(own.decode(own(image))[0])


def test_invalid_ensembles() -> None:
    for spec in ("ensemble:squeezedet", "ensemble:", "ensemble:squeezedet+"):
        with pytest.raises(DetectorError, match=r"expected ensemble:A\+B, at least two detectors"):
            load_detector(spec)
    with pytest.raises(DetectorError, match="squeezedett"):
        load_detector("ensemble:squeezedet+squeezedett")
    members = [SqueezeDet(), SqueezeDet(classes=("Car",))]
    with pytest.raises(
        DetectorError, match="expected squeezedet's classes, Car, Truck, Pedestrian, Cyclist, found Car"
    ):
        Ensemble(members)


@pytest.mark.parametrize("t_star", [0.0, 1.0])
def test_thresholds_of_0_and_1_are_refused(t_star: float) -> None:
    with pytest.raises(DetectorError, match=rf"squeezedet: expected a t\* above 0 and below 1, found {t_star:g}"):
        Ensemble([SqueezeDet(), SqueezeDet(t_star=t_star)])


def test_code_of_a_member_is_found() -> None:
    assert find_code_to_run(SPEC) is None
    assert find_code_to_run("ensemble:squeezedet+module:own.py") == find_code_to_run("module:own.py") == "own.py"
