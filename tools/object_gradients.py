"""How well gradients to an object's vertices, pose and light tell what happens: derivatives beside differences.

    python -m tools.object_gradients [bus/0080:left ...] [--params vertex pose lighting] [--times 4]

Along random directions, in which all coordinates move by a step in the root mean square (vertices: each by
itself), derivatives by the gradient stand beside central differences: through the picture, times smooth noise,
and through the shipped classifier's score of the true class. Printed are cosines over directions: with
differences of the same, and with those of the picture drawn so many times as finely and averaged down, in which
faces thinner than a pixel do not come and go; the score is linear in these, with its gradient at the picture. By
default of one held-out object of each class, in a view that is not straight ahead.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from drivesem.classify.networks.base import Classifier
from drivesem.classify.networks.loading import load_classifier
from drivesem.classify.objects.sources import open_objects
from drivesem.classify.scenes import DRAWN_PX, SEEN_PX, VIEWS, ObjectScene, camera, generated_background
from drivesem.classify.space import Amounts, Moved, ObjectSpace
from scene_ir.render.lit import over

STEPS = {"vertex": 1e-4, "pose": 3e-3, "lighting": 1e-2}
"""Object sizes, rad, shares."""
Value = Callable[[Tensor], Tensor]


def pictured(scene: ObjectScene, space: ObjectSpace, times: int) -> Value:
    """theta (D,) to the picture (3, SEEN_PX, SEEN_PX), drawn `times` as finely as it is for networks."""
    size = times * DRAWN_PX
    background = F.interpolate(scene.background[None], (size, size), mode="bilinear")[0]

    def picture(theta: Tensor) -> Tensor:
        change = space.change(theta)
        drawn = scene.mesh.render(scene.placed(change), camera(size), scene.lights(change))
        whole = over(drawn, background)[None]
        return F.interpolate(whole, (SEEN_PX, SEEN_PX), mode="bilinear", antialias=True)[0]

    return picture


def along(value: Value, directions: Tensor) -> Tensor:
    """Derivatives (N,) along directions (N, D) at 0, by the gradient."""
    leaf = torch.zeros(directions.shape[1], requires_grad=True)
    (gradient,) = torch.autograd.grad(value(leaf), leaf)
    return directions.double() @ gradient.double()


@torch.no_grad()
def differences(value: Value, directions: Tensor, step: float) -> Tensor:
    """The same by central differences."""
    return torch.stack([(value(step * d) - value(-step * d)) / (2 * step) for d in directions])


def cosines(
    scene: ObjectScene, parameter: str, network: Classifier, told: argparse.Namespace
) -> tuple[int, Tensor]:
    """How many coordinates a parameter has, and (4,): through the picture and through the score, each with
    differences of the same and of the finer picture.
    """
    space = ObjectSpace(scene.vertices, (Moved(parameter),), Amounts(0.002, 0.15, 0.2))
    directions = torch.randn(told.directions, space.dim, generator=torch.Generator().manual_seed(1))
    picture, finer = (pictured(scene, space, times) for times in (told.drawn, told.times))
    noise = torch.randn(1, 3, SEEN_PX, SEEN_PX, generator=torch.Generator().manual_seed(0))
    seen = picture(space.theta0).requires_grad_(True)
    (felt,) = torch.autograd.grad(score(network, seen, scene), seen)
    found = []
    for weight, same in (
        (F.avg_pool2d(noise, 9, 1, 4)[0], None),
        (felt, lambda theta: score(network, picture(theta), scene)),
    ):

        def weighed(draw: Value, weight: Tensor = weight) -> Value:
            return lambda theta: (draw(theta).double() * weight).sum()

        own = same or weighed(picture)
        slopes, step = along(own, directions), told.step or STEPS[parameter]
        for value in (own, weighed(finer)):
            found.append(F.cosine_similarity(slopes, differences(value, directions, step), dim=0))
    return space.dim, torch.stack(found)


def score(network: Classifier, picture: Tensor, scene: ObjectScene) -> Tensor:
    """Of the true class."""
    return network(picture[None])[0, scene.model.label].double()


def main() -> None:
    """Print a line an object and parameter, and the least and the middle of each parameter."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", help="OBJECT:VIEW")
    parser.add_argument("--objects", help="a folder of meshes; without it, the embedded objects")
    parser.add_argument("--params", nargs="+", choices=list(STEPS), default=list(STEPS))
    parser.add_argument("--step", type=float, help="instead of each parameter's own")
    parser.add_argument("--directions", type=int, default=10)
    parser.add_argument("--times", type=int, default=4, help="how much finer the picture is drawn for differences")
    parser.add_argument("--drawn", type=int, default=1, help="and for gradients")
    told = parser.parse_args()
    objects = open_objects(told.objects)
    network = load_classifier("squeezenet", objects.classes)
    views = list(VIEWS)[1:]
    usual = [f"{kind}/0080:{views[place % 3]}" for place, kind in enumerate(objects.classes)]
    found: dict[str, list[Tensor]] = {name: [] for name in told.params}
    print("cosines through the picture: same, finer; through the score: same, finer")
    for word in told.names or usual:
        name, _, view = word.partition(":")
        scene = ObjectScene(name, objects.load(name), view or views[0], generated_background(name))
        for parameter in told.params:
            count, row = cosines(scene, parameter, network, told)
            found[parameter].append(row)
            print(f"{word}, {parameter}, {count} coordinates: {_row(row)}", flush=True)
    for parameter, rows in found.items():
        table = torch.stack(rows)
        print(f"{parameter}: least {_row(table.amin(dim=0))}; median {_row(table.median(dim=0).values)}")


def _row(values: Tensor) -> str:
    return " ".join(f"{float(value):.4f}" for value in values)


if __name__ == "__main__":
    main()
