"""Where the paper's code differs from its text: each setting by a case that is computed by hand, and the presets."""

import math
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
from torch import nn

from drivesem.attacks.methods.base import Problem, Score
from drivesem.attacks.methods.gradient_ascent import SGD
from drivesem.attacks.methods.gradient_free import Sampling
from drivesem.classify import training
from drivesem.classify.networks import loading
from drivesem.classify.objective import (
    ClassifierObjective,
    attacked_parameters,
    compute_attack_loss,
    create_attack,
    create_objective,
    create_space,
    parameter_bounds,
)
from drivesem.classify.scenes import DISTANCE, DRAWN_PX, ObjectScene
from drivesem.classify.space import ObjectSpace, ParameterAmounts, parse_parameters
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.config.parsing import parse
from scene_ir import files
from scene_ir.errors import FormatError, RangeError
from tests.drivesem.classify.conftest import ColourClassifier, error_line, make_model, use_solids

GREY = torch.full((3, DRAWN_PX, DRAWN_PX), 0.5)
STEPS = ParameterAmounts(0.01, 0.3, 0.2)
CORNERS = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.3]])


def config(*words):
    return parse(["classify", "attack", *words])


class FixedScores(nn.Module):
    """Scores that do not depend on the picture, but have a gradient."""

    differentiable = True
    classes = ("box", "ball", "pole")

    def __init__(self, *scores):
        super().__init__()
        self.scores = torch.tensor(scores)

    def forward(self, images):
        return self.scores.expand(len(images), -1) + 0 * images.mean(dim=(1, 2, 3))[:, None]


def make_objective(network, *words):
    settings = config(*words)
    scene = ObjectScene("box", make_model("box"), "forward", GREY, settings.lamp)
    return create_objective(scene, create_space(scene, settings), network, settings)


def test_sgd_training_steps_with_momentum(monkeypatch):
    """Loss w: gradients 1, 1, 1 at rate 0.1. Velocities 1, 1.9, 2.71, so w falls by 0.1, 0.19, 0.271."""
    monkeypatch.setattr(training.F, "cross_entropy", lambda scores, labels: scores.sum())
    module = nn.Linear(1, 1, bias=False)
    module.weight.data.fill_(2.0)
    settings = ClassifyConfig(what="train", optimiser="sgd", rate=0.1, epochs=3, batch=1)
    truth = {"train": torch.zeros(1, dtype=torch.int64)}

    def batch(rows, epoch):
        return module(torch.ones(len(rows), 1)), truth["train"][rows]

    weights = []

    def evaluate(name, epoch):
        weights.append(float(module.weight.detach()))
        return 0.0

    training._train(module, batch, evaluate, truth, settings, torch.Generator())
    assert weights[:3] == pytest.approx([1.9, 1.71, 1.439])


def test_a_diverging_training_is_an_error():
    module, truth = nn.Linear(1, 1), {"train": torch.zeros(1, dtype=torch.int64)}
    settings = ClassifyConfig(what="train", epochs=1)
    with pytest.raises(RangeError, match=r"loss in epoch 1: expected a finite number.*--rate.*found nan"):
        training._train(
            module,
            lambda *_: (module(torch.tensor([[math.nan]])), truth["train"]),
            lambda *_: 0.0,
            truth,
            settings,
            torch.Generator(),
        )


def test_a_unit_step_of_scw():
    """f = 3 * theta_0 + 4 * theta_1, weight 0.1, at theta (1, 2), start 0: the gradient of 0.1 f + theta^2 is
    (0.3 + 2, 0.4 + 4) = (2.3, 4.4), its norm 4.965, so a step of 0.5 goes to (1 - 0.2316, 2 - 0.4431).
    """
    objective = make_objective(
        FixedScores(3.0, 1.0, 0.0), "--method", "scw", "--scw-step", "unit", "--params", "pose"
    )
    theta = torch.tensor([0.3, 0.0, -0.4])
    loss, gradient = objective.loss_and_grad(theta)
    assert loss == pytest.approx(-(0.1 * 2 + 0.25))  # margin 3 - 1, theta^2 = 0.09 + 0.16
    assert gradient.tolist() == pytest.approx([-0.6, 0.0, 0.8])
    assert isinstance(create_attack(config("--method", "scw", "--scw-step", "unit")), SGD)

    def loss_and_grad(theta):
        return 0.0, -torch.tensor([0.3 + 2 * float(theta[0]), 0.4 + 2 * float(theta[1])])

    step = torch.full((2,), 0.5)
    problem = Problem(
        loss_and_grad, lambda t: _Projected(t), lambda t: Score(0.0, 0, 0, False, False), step, -step, step
    )
    end = SGD(1, form="unit").propose(problem, torch.tensor([1.0, 2.0]), torch.Generator()).thetas[-1]
    assert end.tolist() == pytest.approx([0.76838, 1.55690], abs=1e-4)


class _Projected:
    active = ()

    def __init__(self, theta):
        self.theta = theta


def test_targeted_scw():
    scores = torch.tensor([2.0, 3.0, -1.0])
    # class 2 lies 4 below the highest other one, class 0 lies 1 below, class 1 is reached
    assert [float(compute_attack_loss(scores, 1, "hinge", target)) for target in (2, 0, 1)] == [-4.0, -1.0, 0.0]
    objective = make_objective(FixedScores(2.0, 3.0, -1.0), "--method", "scw", "--target", "ball")
    assert objective.loss_and_grad(torch.zeros_like(objective.space.theta0))[0] == 0  # the target is predicted
    pole = make_objective(FixedScores(4.0, 3.0, -1.0), "--method", "scw", "--target", "pole")
    assert not pole.score(pole.space.theta0).success
    pole.network.scores = torch.tensor([1.0, 3.0, -1.0])
    pole._evaluated.clear()
    assert not pole.score(pole.space.theta0).success  # ball is wrong, but no pole
    pole.network.scores = torch.tensor([1.0, 3.0, 5.0])
    pole._evaluated.clear()
    assert pole.score(pole.space.theta0).success


def make_parts(parts=(0, 0, 1, 1), params="vertex"):
    return ObjectSpace(CORNERS, parse_parameters(params), STEPS, parts=torch.tensor(parts))


def test_mesh_parts_are_normalised_apart():
    """Part 0 has the gradient (3, 0, 0), (0, 4, 0), of norm 5, part 1 (0.06, 0, 0), (0, 0, 0.08), of norm 0.1."""
    space = make_parts()
    slope = torch.tensor([[3.0, 0, 0], [0, 4, 0], [0.06, 0, 0], [0, 0, 0.08]])
    gradient = torch.autograd.functional.vjp(lambda t: space.change(t).offsets, space.theta0, slope)[1]
    problem = Problem(
        lambda t: (0.0, gradient), space.project, None, space.step, space.lower, space.upper, space.groups
    )
    moved = space.change(SGD(1, form="unit")._move(problem, gradient)).offsets
    expected = torch.tensor([[0.6, 0, 0], [0, 0.8, 0], [0.6, 0, 0], [0, 0, 0.8]])
    torch.testing.assert_close(moved, 0.01 * expected)
    whole = replace(problem, groups=ObjectSpace(CORNERS, parse_parameters("vertex"), STEPS).groups)
    moved = space.change(SGD(1, form="unit")._move(whole, gradient)).offsets
    assert float(moved.norm()) == pytest.approx(0.01)  # all together: a step is a step of all


def test_a_part_without_a_finite_gradient_stays():
    space = make_parts((1, 1, 0, 0), "vertex,pose")
    assert [(g.name, g.where, g.owners) for g in space.groups] == [
        ("vertex", slice(0, 6), 2),
        ("vertex", slice(6, 12), 2),
        ("pose", slice(12, 15), 0),
    ]
    gradient = torch.ones(15)
    gradient[7] = math.nan
    assert space.settle_gradient(gradient).tolist() == [1.0] * 6 + [0.0] * 6 + [1.0] * 3
    gradient[13] = math.inf
    with pytest.raises(RangeError, match=r"gradient of pose\.yaw"):
        space.settle_gradient(gradient)
    whole = ObjectSpace(CORNERS, parse_parameters("vertex"), STEPS)
    with pytest.raises(RangeError, match="gradient of vertices"):
        whole.settle_gradient(torch.full((12,), math.nan))


def test_parts_are_materials():
    model = make_model("box")
    colours = model.diffuse.clone()
    colours[: len(colours) // 2] = 0.9
    parts = replace(model, diffuse=colours).vertex_parts()
    first, second = (model.mesh.faces[rows].unique() for rows in (slice(None, 6), slice(6, None)))
    low = 0 if float(colours[-1, 0]) < 0.9 else 1  # unique rows are sorted
    alone = set(first.tolist()) - set(second.tolist())
    assert set(parts[list(second.tolist())].tolist()) == {low}  # shared corners count to the first part
    assert all(int(parts[i]) == 1 - low for i in alone)
    assert make_model("box").vertex_parts().tolist() == [0] * len(model.mesh.vertices)


def compose_space(params="pose,vertex"):
    return ObjectSpace(CORNERS, parse_parameters(params), STEPS, turns="compose")


def test_turns_compose():
    """A quarter turn by yaw and then one by pitch: the first acts on the object, the second on what it has become."""
    space, quarter = compose_space("pose"), math.pi / 2
    yaw, pitch = torch.tensor([0.0, quarter, 0.0]), torch.tensor([quarter, 0.0, 0.0])
    theta = space.advance(space.advance(space.theta0, yaw), pitch)
    scene = ObjectScene("box", make_model("box"), "forward", GREY)
    rest = scene.vertices * torch.tensor([-1.0, -1.0, 1.0])  # camera axes: x right, y down, z forward
    mean = rest.mean(dim=0)
    x, y, z = (rest - mean).T
    # yaw: (x, y, z) -> (z, y, -x); then pitch: (x, y, z) -> (x, -z, y)
    expected = mean + torch.stack([z, x, y], dim=1) + torch.tensor([0.0, 0.0, DISTANCE])
    turned = scene.camera_vertices(space.change(theta))
    torch.testing.assert_close(turned, expected, atol=1e-5, rtol=0)
    added = ObjectSpace(CORNERS, parse_parameters("pose"), STEPS)
    assert torch.equal(added.advance(yaw, pitch), yaw + pitch)


@pytest.mark.parametrize("params", ["pose,vertex", "vertex", "pose"])
def test_a_step_continues_from_the_vertices_as_they_stand(params):
    """What theta renders after a step is what the move made of the vertices before it, about their centre."""
    model = make_model("pole")
    scene = ObjectScene("pole", model, "top", GREY)
    space = ObjectSpace(scene.vertices, parse_parameters(params), STEPS, turns="compose")
    generator = torch.Generator().manual_seed(0)
    theta, standing = space.theta0, scene.camera_vertices(space.change(space.theta0))
    for _ in range(3):
        move = 0.2 * torch.randn(space.dim, generator=generator)
        change = space.change(move)
        standing = standing if change.offsets is None else standing + change.offsets
        if change.angles is not None:
            (p, y, r), mean = change.angles.tolist(), standing.mean(dim=0)
            about = {"x": (p, 1, 2), "y": (y, 2, 0), "z": (r, 0, 1)}
            shifted = standing - mean
            for axis in ("y", "x", "z"):
                angle, i, j = about[axis]
                a, b = shifted[:, i].clone(), shifted[:, j].clone()
                shifted[:, i] = math.cos(angle) * a - math.sin(angle) * b
                shifted[:, j] = math.sin(angle) * a + math.cos(angle) * b
            standing = mean + shifted
        before, theta = theta, space.advance(theta, move)
        torch.testing.assert_close(scene.camera_vertices(space.change(theta)), standing, atol=1e-5, rtol=0)
        torch.testing.assert_close(scene.camera_vertices(space.change(before, move)), standing, atol=1e-5, rtol=0)


def test_pictures_that_are_wrong_are_attacked_and_the_last_counts(monkeypatch, tmp_path, classify):
    """Every picture is a ball until three have been seen, and then a box: the final prediction is right."""

    class LateClassifier(ColourClassifier):
        seen = 0

        def forward(self, images):
            scores = super().forward(images)
            return scores + 100 * torch.tensor([1.0, 0, 0] if type(self).seen >= 3 else [0, 1.0, 0])

    use_solids(monkeypatch, lambda name: LateClassifier())
    evaluate = ClassifierObjective.evaluate

    def count(self, theta):
        LateClassifier.seen += 1
        self._evaluated.clear()
        return evaluate(self, theta)

    monkeypatch.setattr(ClassifierObjective, "evaluate", count)
    words = ("attack", "--params", "pose", "--views", "forward", "--limit", "1", "--json")
    code, data, _ = classify(*words, "--out", tmp_path / "text")
    assert (code, data["queries"], data["accuracy"]) == (0, 0, {"benign": 0.0, "attacked": 0.0})
    LateClassifier.seen = 0
    code, data, _ = classify(*words, "--attack-misclassified", "--out", tmp_path / "code")
    assert (code, data["queries"] > 0, data["accuracy"]) == (0, True, {"benign": 0.0, "attacked": 1.0})
    assert data["grades"]["threshold"] == 0
    assert data["confusion"] == {
        "benign": [[0, 1, 0], [0, 0, 0], [0, 0, 0]],
        "attacked": [[1, 0, 0], [0, 0, 0], [0, 0, 0]],
    }
    assert data["top"]["benign"][0] == 0.0
    assert data["top"]["attacked"] == [1.0, 1.0, 1.0]
    page = (tmp_path / "code" / "report.html").read_text()
    assert "<h3>Before the change</h3>" in page
    assert "so not attacked" not in page


def test_rendered_normalisation_is_stored_with_the_weights(monkeypatch, tmp_path):
    monkeypatch.setitem(loading.ARCHITECTURES, "colours", ColourClassifier)
    network = ColourClassifier()
    network.normalise_by((0.6109, 0.7387, 0.7765), (0.2715, 0.3066, 0.3395))
    loading.save_classifier(network, tmp_path / "a.safetensors", {})
    again = loading.load_classifier(str(tmp_path / "a.safetensors"), network.classes)
    # (0.8824 - 0.6109) / 0.2715 = 1; (0.7387 - 0.7387) = 0; (0.4370 - 0.7765) / 0.3395 = -1; times ten
    picture = torch.tensor([0.8824, 0.7387, 0.4370]).view(1, 3, 1, 1).expand(1, 3, 8, 8)
    assert again(picture)[0].tolist() == pytest.approx([10.0, 0.0, -10.0], abs=1e-3)
    facts, tensors = loading.read_weights(tmp_path / "a.safetensors")
    loading.write_weights(tmp_path / "b.safetensors", facts | {"normalisation": "[1]"}, tensors)
    with pytest.raises(FormatError, match=r"b\.safetensors: normalisation: expected mean and deviation"):
        loading.load_classifier(str(tmp_path / "b.safetensors"), network.classes)


def test_training_sets_the_normalisation(solids, tmp_path, classify, monkeypatch):
    monkeypatch.setitem(loading.ARCHITECTURES, "colours", ColourClassifier)
    network = ColourClassifier()
    network.score = nn.Linear(3, 3)
    monkeypatch.setattr(training, "load_for_training", lambda *words: network)
    words = ("train", "--network", "colours", "--views", "left", "--limit", "3", "--epochs", "1", "--json")
    assert classify(*words, "--normalisation", "rendered", "--out", tmp_path / "a")[0] == 0
    assert network.mean.flatten().tolist() == pytest.approx([0.6109, 0.7387, 0.7765])


def test_the_coloured_lamp():
    """Light of (20, 30, 20) relative to their mean, from 100 before the object: a surface that faces the camera gets
    0.85 * (6, 9, 6) / 7, and 0.1 more red alone is 1.1 times as much red.
    """
    scene = ObjectScene("box", make_model("box"), "forward", GREY, "coloured")
    space = ObjectSpace(scene.vertices, parse_parameters("lighting"), STEPS, lamp="coloured")
    assert [space.name(i) for i in range(3)] == ["light.red", "light.green", "light.blue"]
    assert space.step.tolist() == pytest.approx([0.2, 0.2 * 2 / 3, 0.2])  # 4,000 units of each
    lights = scene.lights(space.change(torch.tensor([0.1, 0.0, 0.0])))
    assert lights.point.tolist() == pytest.approx([0, 0, DISTANCE - 100])
    assert lights.strength.flatten().tolist() == pytest.approx([1.1 * 0.85 * 6 / 7, 0.85 * 9 / 7, 0.85 * 6 / 7])
    assert float(lights.environment) == pytest.approx(0.3)
    plain, red = (scene.render(space.change(theta)) for theta in (space.theta0, torch.tensor([0.5, 0.0, 0.0])))
    assert not torch.equal(plain[0], red[0])
    assert torch.equal(plain[1:], red[1:])


def test_samples_of_vertices_and_one_turn():
    settings = config("--method", "halton", "--sampled", "vertex,turn")
    assert [str(one) for one in attacked_parameters(settings)] == ["vertex", "pose"]
    bounds = parameter_bounds(settings)
    assert (bounds.vertex, bounds.pose) == (0.005, 0.3)
    scene = ObjectScene("box", make_model("box"), "forward", GREY)
    space = create_space(scene, settings)
    assert space.dim == 3 * 8 + 1
    assert space.name(24) == "pose.turn"
    assert space.change(0.2 * torch.eye(25)[24]).angles.tolist() == pytest.approx([0.2, 0.2, 0.2])
    thetas = []

    def score(theta):
        thetas.append(theta)
        return Score(0.0, 0, 0, False, False)

    problem = Problem(None, space.project, score, space.step, space.lower, space.upper, space.groups)
    for kind in ("random", "halton"):
        Sampling(5, kind=kind)(problem, space.theta0, 0)
    samples = torch.stack(thetas)
    assert 0.004 < float(samples[:, :24].abs().max()) <= 0.005
    assert 0.15 < float(samples[:, 24].abs().max()) <= 0.3
    assert (
        parameter_bounds(config("--method", "halton", "--sampled", "vertex,turn", "--within-pose", "0.75")).pose
        == 0.75
    )


def test_halton_of_thousands_of_coordinates():
    points = Sampling(5, kind="halton")._unit_points(3000, torch.Generator().manual_seed(0))
    assert points.shape == (5, 3000)
    assert abs(float(points.mean()) - 0.5) < 0.01


def test_presets():
    text, code = (files.read_yaml(Path("configs") / f"paper-{name}.yaml") for name in ("text", "code"))
    defaults = {field.name: field.default for field in fields(ClassifyConfig)}
    assert {key: value for key, value in text.items() if key != "for"} == {
        key: defaults[key] for key in text if key != "for"
    }
    assert code.keys() - text.keys() == {"batch", "rate", "epochs"}
    assert all(code[key] != text[key] for key in text if key != "for")
    for what in ("train", "attack"):
        network = ["--network", "vgg16"]
        parse(["classify", what, "--config", "paper-text", *network])
        settings = parse(["classify", what, "--config", "paper-code", *network])
        assert (settings.layers, settings.batch, settings.rate) == ("all", 4, 0.001)
    with pytest.raises(UsageError, match="--network: expected vgg16"):
        parse(["classify", "train", "--config", "paper-code"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--method scw --scw-step unit --norm 1", "--norm: expected 2 with --scw-step unit, found 1"),
        ("--method scw --turns compose", "--turns: expected add with --method scw --scw-step adam, found compose"),
        (
            "--shape smooth --vertex-groups part",
            "--vertex-groups: expected object with --shape smooth, found part",
        ),
        (
            "--method random --sampled vertex,turn --params pose",
            "--params: expected vertex and pose with --sampled vertex,turn, found pose",
        ),
        ("--target car", "--target: expected only with --method scw, found --method si-fgsm"),
        ("--method scw --target cow", "--target: expected one of box, ball, pole, found cow"),
        ("--config paper-code --shape smooth", "--vertex-groups: expected object with --shape smooth, found part"),
    ],
)
def test_contradictions_are_one_line_and_exit_code_2(solids, tmp_path, classify, words, message):
    code, _, printed = classify("attack", *words.split(), "--out", tmp_path / "run", "--limit", "1")
    assert code == 2
    assert message in error_line(printed)


@pytest.mark.parametrize("method", ["si-fgsm", "sgd", "scw", "random", "halton"])
def test_the_code_attacks(solids, tmp_path, classify, method):
    words = ("--config", "paper-code", "--method", method, "--limit", "3", "--no-grade", "--json")
    code, data, printed = classify("attack", *words, "--out", tmp_path / "run")
    assert code == 0, printed
    assert data["params"] == ["vertex", "pose"]
    assert data["pictures"] == 3
