"""Questions to a detector about one scene, in Python: its detections, an object's margin, and gradients.

```pycon
>>> import drivesem as ds
>>> scene, detector = ds.demo_scene(0), ds.load_detector("squeezedet")
>>> len(ds.detect(detector, scene)) == len(ds.detect(detector, scene.photograph))
True
>>> ds.margin(scene, detector, 0) > 0  # found
True
>>> ds.gradient(scene, detector, params="translate").pixels.shape
torch.Size([3, 376, 1241])

```
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from detectors.base import Detector, detector_device, predict
from detectors.registry import AnyDetector, load_predictor
from detectors.types import CLASSES, Detections
from drivesem.attacks.labels import Labeller, visible_boxes
from drivesem.attacks.losses import candidates_from_detections
from drivesem.attacks.objective import CustomLoss, Objective
from drivesem.attacks.space import Budget, Parameter, ParameterSpace, Perturbation, parse_params
from drivesem.attacks.targets import resolve_t_star
from drivesem.config.commands import AttackConfig
from drivesem.config.errors import UsageError
from drivesem.failures.margins import object_margins
from drivesem.scenes.scene import Scene, to_image_tensor
from scene_ir.io import round_to_8bit
from scene_ir.render.compositor import Compositor
from scene_ir.types import SceneIR, convert_scene


@dataclass(frozen=True, slots=True)
class Gradient:
    """The gradient of a loss at one state of a scene."""

    loss: float
    """The loss, which an attack raises."""
    theta: dict[str, float]
    """Its derivative with respect to each coordinate of theta, by name, per unit of theta."""
    pixels: Tensor
    """(3, H, W), its derivative with respect to the RGB values of the rendered picture, which are in [0, 1]."""


def detect(detector: AnyDetector, picture: Scene | NDArray[np.uint8] | Tensor) -> Detections:
    """Detect objects in a picture or in the render of a scene.

    Args:
        detector: A name or file as for `drivesem attack --detector`, or a detector (`ds.load_detector`).
        picture: A scene, an array (H, W, 3) of uint8, or a tensor (3, H, W) in [0, 1]; RGB. A scene is rendered and
            rounded to 8 bits.

    Returns:
        Detections, best first; their labels are indices into `detector.classes`.

    Raises:
        UsageError: The picture has another type or shape.
        DetectorError: The detector cannot be used.
    """
    loaded = load_predictor(detector)
    image = round_to_8bit(picture.tensor()) if isinstance(picture, Scene) else to_image_tensor(picture)
    return predict(loaded, image[None].to(detector_device(loaded)))[0]


@torch.no_grad()
def margin(scene: Scene, detector: AnyDetector, object: int, t_star: float | None = None) -> float:
    """How far a detector is from missing an object of a scene, in logits of the score.

    The margin is the logit of the best candidate that would detect the object, minus the logit of t*. A negative
    margin is a miss; -8 is the margin of an object that no candidate matches.

    Args:
        scene: A scene in any state.
        detector: As for `detect`.
        object: Row of the object, from 0.
        t_star: Score from which a detection counts; by default the detector's own, or 0.3.

    Raises:
        UsageError: The scene has no such object, or the detector does not know its class.
    """
    loaded = load_predictor(detector)
    ir = convert_scene(scene.ir, None, detector_device(loaded))
    count = len(ir.objects)
    if isinstance(object, bool) or not isinstance(object, int) or not 0 <= object < count:
        raise UsageError("object", f"a row from 0 to {count - 1}", repr(object))
    compositor, photographed = Compositor(ir.unperturbed()), ir.unperturbed()
    labeller = Labeller(photographed, compositor.render(photographed))
    render = compositor.render(ir)
    targets = labeller.moved(ir, render).targets
    name = CLASSES[int(targets.labels[object])]
    if name not in loaded.classes:
        raise UsageError("detector", f"one that knows {name}, the class of objects[{object}]", loaded.name)
    image = round_to_8bit(render.image)[None]
    if isinstance(loaded, Detector) and type(loaded).candidates is not Detector.candidates:
        candidates = loaded.candidates(loaded(image))
    else:
        candidates = candidates_from_detections(predict(loaded, image)[0], len(loaded.classes))
    box, visible = targets.boxes_xyxy[object : object + 1], visible_boxes(render)[object : object + 1]
    visible = visible if bool((visible[:, 2:] > visible[:, :2]).all()) else box
    label = torch.tensor([tuple(loaded.classes).index(name)])
    return float(object_margins(candidates, box, label, visible, resolve_t_star(loaded, t_star)))


def gradient(
    scene: Scene,
    detector: AnyDetector,
    objective: str | CustomLoss = "objectness",
    params: str = "color,weather,foliage,translate,rotate,mesh",
) -> Gradient:
    """The gradient of an attack's loss at a state of a scene, with respect to theta and to the pixels.

    Args:
        scene: A scene in any state.
        detector: As for `detect`; it must have a gradient.
        objective: A loss of `drivesem attack --objective`, or a function of candidates, targets and t*
            (`drivesem.attacks.objective.CustomLoss`).
        params: Parameters of theta, with commas.

    Raises:
        UsageError: An unknown loss.
        FormatError: An unknown parameter.
        RangeError: The detector has no gradient, or the loss is not finite.
    """
    loaded, parameters = load_predictor(detector), parse_params(params)
    config = AttackConfig() if callable(objective) else AttackConfig(objective=cast("Any", objective))
    config.check()
    config = replace(config, objective=cast("Any", objective))
    ir = convert_scene(scene.ir, None, detector_device(loaded))
    photographed, budget = ir.unperturbed(), Budget(size=1.0, sun=1.0, night=1.0, snow=1.0, lamps=1.0)
    changes = Perturbation.between(photographed, ir)
    # parameters without a derivative keep their values
    fixed, theta0 = _space_and_theta(photographed, changes, [p for p in Parameter if p not in parameters], budget)
    start = fixed.apply(photographed, theta0)
    space, theta = _space_and_theta(photographed, changes, parameters, budget)
    theta = theta.detach().clone().requires_grad_(True)
    problem = Objective(Compositor(photographed), space, loaded, replace(config, whole=True))
    state = space.apply(start, theta)
    render = problem.compositor.render(state)
    raw = problem.differentiable(render.image[None])
    loss = problem.loss_from_predictions(raw, state, render)
    by_theta, by_pixel = torch.autograd.grad(
        loss, (theta, render.image), allow_unused=True, materialize_grads=True
    )
    space.check_gradient(by_theta)
    names = (space.name(i) for i in range(space.dim))
    return Gradient(float(loss.detach()), dict(zip(names, by_theta.tolist(), strict=True)), by_pixel.cpu())


def _space_and_theta(
    photographed: SceneIR, changes: Perturbation, parameters: Sequence[Parameter], budget: Budget
) -> tuple[ParameterSpace, Tensor]:
    """The space of some parameters, and the theta (D,) of the changes in it."""
    space = ParameterSpace(photographed, parameters, budget)
    left_out = {str(parameter): None for parameter in Parameter if parameter not in parameters}
    return space, space.flatten(replace(changes, **left_out))
