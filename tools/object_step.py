"""Time of the renderer in one step of an attack on a classifier, and of whole attack steps.

    python -m tools.object_step [bus/0080:top ...] [--network vgg16] [--rounds 12] [--threads 2]

A step is the gradient of the true class's score to pose and vertices, half a step away from the original object.
Measured in turn are the whole step, the picture with its gradient, and the network with its gradient to the picture:
medians and quartiles of CPU milliseconds, which other work on the machine affects less than wall time. Then si-FGSM
takes five steps without early stop, each with an evaluation. Weights are random: they do not change the time.
"""

from __future__ import annotations

import argparse

import torch

from drivesem.attacks.methods.gradient_ascent import SiFGSM
from drivesem.bench.timing import CallTime, PairedTimer, Spread
from drivesem.classify.networks.architectures import Classifier
from drivesem.classify.networks.loading import ARCHITECTURES, prepare_for_inference
from drivesem.classify.objective import ClassifierObjective, compute_attack_loss
from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.scenes import ObjectScene, generate_background
from drivesem.classify.space import ClassifyParameter, ObjectSpace, ParameterAmounts
from drivesem.run.allocation import keep_freed_memory

USUAL = ("bus/0080:top", "helmet/0080:right")
STEPS = 5
"""Of the paper's attacks."""


class ObjectStep:
    """The parts of a step on one object before a network."""

    def __init__(self, scene: ObjectScene, network: Classifier) -> None:
        self.scene, self.network = scene, network
        self.space = ObjectSpace(
            scene.vertices, (ClassifyParameter.VERTEX, ClassifyParameter.POSE), ParameterAmounts(0.002, 0.15, 0.2)
        )
        self.objective = ClassifierObjective(scene, self.space, network, "logit")
        chance = torch.rand(self.space.dim, generator=torch.Generator().manual_seed(0))
        self.theta = self.space.step * (chance - 0.5)
        self.seen = self.objective.render(self.theta)
        self.gradient = torch.randn(self.seen.shape, generator=torch.Generator().manual_seed(1))

    def whole(self) -> None:
        self.objective.loss_and_grad(self.theta)

    def drawing(self) -> None:
        """The picture, and from a gradient of it to theta."""
        leaf = self.theta.clone().requires_grad_(True)
        picture = self.scene.render(self.space.change(leaf))
        torch.autograd.grad(picture, leaf, self.gradient)

    def run_network(self) -> None:
        """The network's score, and its gradient to the picture."""
        leaf = self.seen.clone().requires_grad_(True)
        torch.autograd.grad(
            compute_attack_loss(self.network(leaf[None])[0], self.scene.model.label, "logit"), leaf
        )

    def attack(self) -> CallTime:
        """Five steps, from a new objective."""
        objective = ClassifierObjective(self.scene, self.space, self.network, "logit")
        search = SiFGSM(STEPS, early_stop=False)
        return PairedTimer().time_call(lambda: search(objective.problem(), self.space.theta0, 0))


def main() -> None:
    """Print a line an object."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=USUAL, help="OBJECT:VIEW")
    parser.add_argument("--objects", help="a folder of meshes; without it, the embedded objects")
    parser.add_argument("--network", choices=list(ARCHITECTURES), default="vgg16")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--threads", type=int, help="of torch and of the kernels")
    arguments = parser.parse_args()
    keep_freed_memory()
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    objects = open_objects(arguments.objects)
    torch.manual_seed(0)
    network = prepare_for_inference(ARCHITECTURES[arguments.network](objects.classes))
    for word in arguments.names:
        name, _, view = word.partition(":")
        scene = ObjectScene(name, objects.load(name), view or "forward", generate_background(name))
        stepping, clock = ObjectStep(scene, network), PairedTimer()
        parts = (stepping.whole, stepping.drawing, stepping.run_network)
        for part in parts:
            part()  # what is loaded once
        taken = [[clock.time_call(part).cpu_ms for part in parts] for _ in range(arguments.rounds)]
        step, drawing, network_time = (Spread.from_values(column) for column in zip(*taken, strict=True))
        share = Spread.from_values([100 * drawn / (drawn + network_ms) for _, drawn, network_ms in taken])
        attack = stepping.attack()
        print(
            f"{word}, {len(scene.mesh.faces)} triangles, {arguments.network}: renderer {share.median:.1f} % "
            f"[{share.q1:.1f}, {share.q3:.1f}] of a step; processor ms: step {_format_spread(step)}, renderer "
            f"{_format_spread(drawing)}, network {_format_spread(network_time)}; {STEPS} steps "
            f"{attack.ms / 1e3:.2f} s, {attack.cpu_ms / 1e3:.2f} s of the processor",
            flush=True,
        )


def _format_spread(spread: Spread) -> str:
    return f"{spread.median:.0f} [{spread.q1:.0f}, {spread.q3:.0f}]"


if __name__ == "__main__":
    main()
