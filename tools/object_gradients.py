"""Agreement of gradients to an object's vertices, pose and light with central differences.

    python -m tools.object_gradients [bus/0080:left ...] [--params vertex pose lighting] [--points 8]

Along random directions, in which all coordinates move by a step in the root mean square (vertices: each by itself),
gradients are compared with central differences: through the picture, times smooth noise, and through the shipped
classifier's score of the true class. The tool prints cosines over directions: with the gradient in the middle, and
with the mean of gradients along the way between the ends of the difference. The first one is lower where the slope
itself changes over the step, as a network's does; the second one is not, because a continuous change is the integral
of its slopes. For the score, two more cosines separate the sources of the rest: the network's gradient in the middle
times the change of the picture, against the change of the score (no gradient of the renderer involved); and the whole
gradient in the middle against that product (the same linear network on both sides). By default for one held-out
object of each class, in a view that is not straight ahead.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from drivesem.classify.networks.loading import load_classifier
from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.scenes import SEEN_PX, VIEWS, ObjectScene, generate_background
from drivesem.classify.space import ClassifyParameter, ObjectSpace, ParameterAmounts

STEPS = {"vertex": 1e-4, "pose": 1e-3, "lighting": 1e-2}
"""Object sizes, rad, shares."""


@dataclass(frozen=True, slots=True)
class PictureScore:
    """picture: theta (D,) to (3, H, W); score: of a picture, (); noise (3, H, W)."""

    picture: Callable[[Tensor], Tensor]
    score: Callable[[Tensor], Tensor]
    noise: Tensor

    def __call__(self, theta: Tensor) -> Tensor:
        """(2,): what is made of the picture, by the noise and by the network."""
        picture = self.picture(theta)
        return torch.stack([(picture.double() * self.noise).sum(), self.score(picture).double()])

    def by_the_network(self, step: Tensor) -> Tensor:
        """Half of what the score would change by, (), from one step (D,) before to one behind, if the network were
        the linear one that it is in the middle.
        """
        with torch.no_grad():
            middle, before, behind = (self.picture(place) for place in (0 * step, -step, step))
        (gradient,) = torch.autograd.grad(self.score(middle.requires_grad_(True)), middle)
        return (gradient.double() * (behind.double() - before.double())).sum() / 2


def slopes(values: PictureScore, theta: Tensor, direction: Tensor) -> Tensor:
    """Derivatives (2,) along a direction (D,) at theta (D,), by the gradient."""
    leaf = theta.clone().requires_grad_(True)
    found = values(leaf)
    gradients = [torch.autograd.grad(value, leaf, retain_graph=True)[0] for value in found]
    return torch.stack([gradient.double() @ direction.double() for gradient in gradients])


@torch.no_grad()
def difference(values: PictureScore, step: Tensor) -> Tensor:
    """The change (2,) of values from one step (D,) before to one behind."""
    return (values(step) - values(-step)) / 2


def cosines(values: PictureScore, directions: Tensor, step: float, points: int) -> Tensor:
    """(6,): through the picture, in the middle and along the way, and through the score; of the score what the
    network's slope leaves, and what the renderer's does; of directions (N, D).
    """
    middle, mean, changes, linear = [], [], [], []
    for direction in directions:
        changes.append(difference(values, step * direction) / step)
        linear.append(values.by_the_network(step * direction) / step)
        middle.append(slopes(values, torch.zeros_like(direction), direction))
        places = [((2 * point + 1) / points - 1) * step * direction for point in range(points)]
        mean.append(torch.stack([slopes(values, place, direction) for place in places]).mean(dim=0))
    wanted = torch.stack(changes)
    found = [F.cosine_similarity(torch.stack(one), wanted, dim=0) for one in (middle, mean)]
    network = F.cosine_similarity(torch.stack(linear), wanted[:, 1], dim=0)
    renderer = F.cosine_similarity(torch.stack(middle)[:, 1], torch.stack(linear), dim=0)
    return torch.cat([torch.stack(found).T.reshape(-1), network[None], renderer[None]])


def main() -> None:
    """Print a line an object and parameter, and the least and the middle of each parameter."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", help="OBJECT:VIEW")
    parser.add_argument("--objects", help="a folder of meshes; without it, the embedded objects")
    parser.add_argument("--params", nargs="+", choices=list(STEPS), default=list(STEPS))
    parser.add_argument("--step", type=float, help="instead of each parameter's own")
    parser.add_argument("--directions", type=int, default=6)
    parser.add_argument("--points", type=int, default=8, help="along each way, at which gradients are taken")
    arguments = parser.parse_args()
    objects = open_objects(arguments.objects)
    network = load_classifier("squeezenet", objects.classes)
    noise = torch.randn(1, 3, SEEN_PX, SEEN_PX, generator=torch.Generator().manual_seed(0))
    noise = F.avg_pool2d(noise, 9, 1, 4)[0].double()
    views = list(VIEWS)[1:]
    usual = [f"{kind}/0080:{views[place % 3]}" for place, kind in enumerate(objects.classes)]
    found: dict[str, list[Tensor]] = {name: [] for name in arguments.params}
    print(
        "cosines through the picture: in the middle, along the way; through the score: the same; "
        "what the network's slope leaves of it, what the renderer's does"
    )
    for word in arguments.names or usual:
        name, _, view = word.partition(":")
        scene = ObjectScene(name, objects.load(name), view or views[0], generate_background(name))
        for parameter in arguments.params:
            space = ObjectSpace(
                scene.vertices, (ClassifyParameter(parameter),), ParameterAmounts(0.002, 0.15, 0.2)
            )

            def picture(theta: Tensor, scene: ObjectScene = scene, space: ObjectSpace = space) -> Tensor:
                return scene.render(space.change(theta))

            def score(picture: Tensor, label: int = scene.model.label) -> Tensor:
                return network(picture[None])[0, label]

            values = PictureScore(picture, score, noise)
            directions = torch.randn(arguments.directions, space.dim, generator=torch.Generator().manual_seed(1))
            row = cosines(values, directions, arguments.step or STEPS[parameter], arguments.points)
            found[parameter].append(row)
            print(f"{word}, {parameter}, {space.dim} coordinates: {_row(row)}", flush=True)
    for parameter, rows in found.items():
        table = torch.stack(rows)
        print(f"{parameter}: least {_row(table.amin(dim=0))}; median {_row(table.median(dim=0).values)}")


def _row(values: Tensor) -> str:
    return " ".join(f"{float(value):.4f}" for value in values)


if __name__ == "__main__":
    main()
