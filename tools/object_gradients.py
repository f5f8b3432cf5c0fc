"""How well the gradient to an object's vertices tells what happens: directional derivatives beside differences.

    python -m tools.object_gradients [bus/0080:left ...] [--steps 0.0003 0.001] [--directions 12] [--places 1]

All vertices move at random, each by itself, by the step in the root mean square of each coordinate (object sizes).
The value is the picture times smooth noise. Printed is the cosine, over directions, of derivatives by gradient
with central differences. --places: both are averaged over so many places within a step around, which leaves out
what only jumps.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from torch import Tensor

from drivesem.classify.objects.sources import open_objects
from drivesem.classify.scenes import SEEN_PX, VIEWS, ObjectScene, generated_background
from drivesem.classify.space import Amounts, ObjectSpace, moved_of

_USUAL = ("car/0080:forward", "bus/0080:left", "mailbox/0080:forward", "helmet/0081:right", "motorcycle/0080:top")


def value_of(scene: ObjectScene, space: ObjectSpace) -> Callable[[Tensor], Tensor]:
    """theta (D,) to a number: the picture times smooth noise."""
    noise = torch.randn(1, 3, SEEN_PX, SEEN_PX, generator=torch.Generator().manual_seed(0))
    weight = torch.nn.functional.avg_pool2d(noise, 9, 1, 4)[0].double()
    return lambda theta: (scene.picture(space.change(theta)).double() * weight).sum()


def slopes(
    value: Callable[[Tensor], Tensor], directions: Tensor, step: float, places: int
) -> tuple[Tensor, Tensor]:
    """Derivatives (N,) along directions (N, D), by gradient and by differences, each a mean over places."""
    generator = torch.Generator().manual_seed(2)
    told, measured = torch.zeros(2, len(directions), dtype=torch.float64)
    for place in range(places):
        at = step * torch.randn(directions.shape[1], generator=generator) * (place > 0)
        leaf = at.requires_grad_(True)
        (gradient,) = torch.autograd.grad(value(leaf), leaf)
        told += directions.double() @ gradient.double() / places
        with torch.no_grad():
            for i, d in enumerate(directions):
                measured[i] += (value(at + step * d) - value(at - step * d)) / (2 * step * places)
    return told, measured


def main() -> None:
    """Print a line an object and step."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=_USUAL, help="OBJECT:VIEW")
    parser.add_argument("--objects", help="a folder of meshes; without it, the embedded objects")
    parser.add_argument("--steps", nargs="+", type=float, default=(3e-4, 1e-3))
    parser.add_argument("--directions", type=int, default=12)
    parser.add_argument("--places", type=int, default=1)
    told = parser.parse_args()
    objects = open_objects(told.objects)
    for word in told.names:
        name, _, view = word.partition(":")
        scene = ObjectScene(name, objects.load(name), view or next(iter(VIEWS)), generated_background(name))
        space = ObjectSpace(scene.vertices, moved_of("vertex"), Amounts(0.002, 0.15, 0.2))
        generator = torch.Generator().manual_seed(1)
        directions = torch.randn(told.directions, space.dim, generator=generator)
        for step in told.steps:
            gradient, differences = slopes(value_of(scene, space), directions, step, told.places)
            cosine = float(torch.nn.functional.cosine_similarity(gradient, differences, dim=0))
            ratio = float(differences.norm() / gradient.norm())
            print(
                f"{word}, {space.dim} coordinates, step {step:g}: cosine {cosine:.4f}, norms {ratio:.3f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
