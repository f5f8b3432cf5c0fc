"""Certain failures to train on: states around them, drawn anew, and the term that compares their two pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from detectors.base import Candidates
from detectors.registry import load_detector
from detectors.types import CLASSES
from drivesem.attacks.space import parse_params
from drivesem.failures.second_renderer.selection import SecondRenderers
from drivesem.run.folder import load_attack_config
from drivesem.run.results import Failure
from drivesem.training.failure_neighbourhoods import (
    POOL_SIZE,
    ConsistencyLoss,
    FailureNeighbourhoods,
    WorstCaseLoss,
    list_failures,
    margin_difference,
    smallest_margin_loss,
)
from drivesem.training.frames import AttackedFrame, GeneratorSamples, load_attacked_frames

BOX = torch.tensor([[10.0, 20.0, 60.0, 50.0]], dtype=torch.float64)
CAR = torch.zeros(1, dtype=torch.int64)
T_STAR = 0.5


def output(logits: Tensor, boxes_xyxy: Tensor = BOX) -> Candidates:
    """Candidates of one class at these boxes."""
    return Candidates(boxes_xyxy[:, None], torch.nn.functional.logsigmoid(logits)[:, None])


def term(before: Tensor, after: Tensor) -> Tensor:
    return margin_difference(output(before), output(after), (BOX, BOX), CAR, T_STAR)


def test_the_same_margins_are_not_apart() -> None:
    one = torch.tensor([1.5], dtype=torch.float64)
    assert float(term(one, one)) == pytest.approx(0, abs=1e-9)
    assert float(term(one, one - 0.4)) == pytest.approx(0.5 * 0.4**2, rel=0.02)
    assert float(term(one, one - 3)) == pytest.approx(3 - 0.5, rel=0.02)
    assert float(margin_difference(output(one), output(one), (BOX[:0], BOX[:0]), CAR[:0], T_STAR)) == 0


def test_the_terms_gradient_is_that_of_differences() -> None:
    """To scores and boxes of the second picture; the first one is the aim, and has none."""
    before = torch.tensor([2.0, -1.0], dtype=torch.float64, requires_grad=True)
    after = torch.tensor([0.8, -0.5], dtype=torch.float64, requires_grad=True)
    placed = torch.cat([BOX + 3, BOX - 9]).requires_grad_(True)
    two = torch.cat([BOX, BOX])

    def loss(logits: Tensor, at: Tensor) -> Tensor:
        return margin_difference(output(before, two), output(logits, at), (BOX, BOX), CAR, T_STAR)

    assert torch.autograd.gradcheck(loss, (after, placed), eps=1e-6, atol=1e-6)
    loss(after, placed).backward()
    assert before.grad is None
    assert after.grad is not None
    assert float(after.grad[0]) < 0, "more confidence brings the second picture closer"


@pytest.fixture(scope="module")
def frames(small_run: Path) -> list[AttackedFrame]:
    """A run whose first object counts as lost for certain."""
    (frame,) = load_attacked_frames(small_run)
    lost = Failure("lost", "Car", (0.0, 0.0, 1.0, 1.0), index=0, error="missed", grade="certain")
    known = AttackedFrame(frame.run, frame.name)
    known.__dict__["result"] = replace(frame.result, failures=(lost, replace(lost, index=1, grade="threshold")))
    return [known]


@pytest.fixture(scope="module")
def around(
    frames: list[AttackedFrame], small_run: Path, tmp_path_factory: pytest.TempPathFactory
) -> FailureNeighbourhoods:
    folder = tmp_path_factory.mktemp("pool")
    attack, detector = load_attack_config(small_run), load_detector("squeezedet")
    return FailureNeighbourhoods(
        frames, attack, parse_params("translate,rotate"), detector, folder, CLASSES, 1.0, 3
    )


def test_samples_are_certain_failures(frames: list[AttackedFrame], around: FailureNeighbourhoods) -> None:
    assert [index for _, index in list_failures(frames)] == [0]
    assert len(around) == 1


def test_states_are_drawn_anew_and_again_the_same(around: FailureNeighbourhoods) -> None:
    """Each is a picture of its own with labels that moved along; the same step draws the same."""
    (first, targets), (second, _) = around.state(0, 0)[0], around.state(0, 1)[0]
    photograph = around.failures[0][0].image("benign")
    assert first.shape == second.shape == photograph.shape
    assert (first != second).any()
    assert (first != photograph).any()
    assert len(targets) > 0
    judged = around.state(0, 0)[1]
    still = torch.tensor([box.xyxy for box in around.failures[0][0].result.targets_benign])
    assert not torch.equal(judged.boxes_xyxy[0], still[0])
    again = around.draw(0, 0, np.random.default_rng(5))[0]
    assert np.array_equal(around.draw(0, 0, np.random.default_rng(5))[0], again)


def test_the_pool_is_replaced_once_used(around: FailureNeighbourhoods) -> None:
    """One view a step, one failure: after as many steps as it has states."""
    seen = [
        {around.draw_number(step, np.random.default_rng(i)) for i in range(40)} for step in range(2 * POOL_SIZE)
    ]
    assert seen[0] == seen[POOL_SIZE - 1] == set(range(POOL_SIZE))
    assert seen[POOL_SIZE] == seen[-1] == set(range(POOL_SIZE, 2 * POOL_SIZE))


@pytest.mark.slow
def test_changes_are_drawn_by_the_generator(small_run: Path, tmp_path: Path) -> None:
    """With its own labels of everything, people included; once."""
    frames = load_attacked_frames(small_run)
    samples = GeneratorSamples(frames, SecondRenderers("demo", None), tmp_path, CLASSES)
    image, targets = samples[0]
    assert image.shape == frames[0].image("benign").shape
    assert (image != frames[0].image("benign")).any()
    assert len(targets) > 0
    written = (tmp_path / frames[0].name / "picture.png").stat().st_mtime_ns
    assert np.array_equal(samples[0][0], image)
    assert (tmp_path / frames[0].name / "picture.png").stat().st_mtime_ns == written


@pytest.mark.parametrize(("share", "near"), [(0.0, 0), (0.25, 2), (0.5, 4), (1.0, 8)])
def test_so_many_states_lie_near(around: FailureNeighbourhoods, tmp_path: Path, share: float, near: int) -> None:
    """Half of them, by turns, unless it is said otherwise."""
    one = FailureNeighbourhoods([], None, (), None, tmp_path, CLASSES, 1.0, 0, share)  # pyright: ignore[reportArgumentType]
    assert [one.is_near(number) for number in range(8)].count(True) == near
    assert [around.is_near(number) for number in range(4)] == [False, True, False, True]


def test_the_least_sure_state_counts() -> None:
    """Logistic loss of a margin of -1: log(1 + e)."""
    margins = [torch.tensor([2.0]), torch.tensor([-1.0]), torch.tensor([0.5])]
    assert float(smallest_margin_loss(margins)) == pytest.approx(math.log1p(math.e))
    assert float(smallest_margin_loss(margins[:1])) == pytest.approx(math.log1p(math.exp(-2.0)))


def test_the_worst_of_four_on_real_pictures(
    around: FailureNeighbourhoods, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All states of the pool are seen. Each loss is of the state with the least margin, that of the object and
    that of all that is none; and they reach the weights.
    """
    detector = load_detector("squeezedet").requires_grad_(True).eval()
    worst = WorstCaseLoss(around, 2.0, detector.t_star, 0, (224, 640))
    images = worst.images(0)
    assert images.shape == (POOL_SIZE, 3, 224, 640)
    value = worst.term(detector, detector(images), 0)
    objects, nothing = [], []
    for number in range(POOL_SIZE):
        monkeypatch.setattr(around, "pool", lambda _, number=number: range(number, number + 1))
        raw = detector(worst.images(0))
        with monkeypatch.context() as patch:
            patch.setattr(
                "drivesem.training.failure_neighbourhoods.background_margin", lambda *_: torch.tensor(float("inf"))
            )
            objects.append(float(worst.term(detector, raw, 0).detach()))
        nothing.append(float(worst.term(detector, raw, 0).detach()) - objects[-1])
    assert float(value.detach()) == pytest.approx(max(objects) + max(nothing), rel=1e-4)
    assert max(objects) > min(objects) + 1e-3
    assert max(nothing) > min(nothing) > 0
    value.backward()
    assert any(p.grad is not None and bool(p.grad.any()) for p in detector.parameters())


def test_consistency_on_real_pictures(around: FailureNeighbourhoods, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its weight scales it, and its gradient reaches the detector's weights."""
    detector = load_detector("squeezedet").requires_grad_(True).eval()
    once, twice = (ConsistencyLoss(around, weight, detector.t_star, 0, (224, 640)) for weight in (1.0, 2.0))
    images = once.images(0)
    assert images.shape == (2, 3, 224, 640)
    assert torch.equal(images, once.images(0))
    raw = detector(images)
    value = once.term(detector, raw, 0)
    assert float(value.detach()) > 0
    assert float(twice.term(detector, raw, 0).detach()) == pytest.approx(2 * float(value.detach()))
    output = {}
    for name, pair in {"alike": (1.0, 1.0), "nearer": (1.0, -2.0), "farther": (-2.0, 1.0)}.items():
        margins = iter(map(torch.tensor, pair))
        with monkeypatch.context() as patch:
            patch.setattr(
                "drivesem.training.failure_neighbourhoods.background_margin",
                lambda *_, margins=margins: next(margins),
            )
            output[name] = float(once.term(detector, raw, 0).detach())
    assert output["nearer"] == pytest.approx(output["alike"] + 2.5), (
        "background is nearer to a phantom than it was"
    )
    assert output["farther"] == pytest.approx(output["alike"]), "which is no harm the other way round"
    value.backward()
    assert any(p.grad is not None and bool(p.grad.any()) for p in detector.parameters())
