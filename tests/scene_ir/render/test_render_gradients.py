"""Analytic gradients of the rendered picture against central differences, per parameter."""

from collections.abc import Callable
from dataclasses import dataclass

import kornia
import pytest
import torch
from torch import Tensor

from scene_ir.ffd import from_symmetric
from scene_ir.render import reflections
from scene_ir.render.compositor import Compositor
from scene_ir.render.prepare import RenderSettings
from scene_ir.types import FOLIAGE_DIM, LATTICE, LIGHT_DIM, TEXTURE_DIM, WEATHER_DIM, SceneIR

FUNCTIONALS = 3
COSINE, RELATIVE = 0.99, 0.05


@dataclass(frozen=True)
class Parameter:
    """A parameter of the scene: its size, its effect, the step of differences, and the scale of random values."""

    dim: int
    apply: Callable[[SceneIR, Tensor], SceneIR]
    step: float
    scale: float
    positive: bool = False


def _texture(scene: SceneIR, theta: Tensor) -> SceneIR:
    return scene.with_objects(texture_code=theta.reshape(3, TEXTURE_DIM))


def _translate(scene: SceneIR, theta: Tensor) -> SceneIR:
    move = theta.reshape(3, 2)
    still = torch.zeros_like(move[:, :1])
    return scene.with_objects(
        translation=scene.objects.translation + torch.cat([move[:, :1], still, move[:, 1:]], dim=1)
    )


def _ffd(scene: SceneIR, theta: Tensor) -> SceneIR:
    """Offsets of the upper three lattice layers in random symmetric directions of the three cars together."""
    generator = torch.Generator().manual_seed(5)
    codes = torch.randn(theta.shape[0], 3, 96, generator=generator, dtype=theta.dtype)
    offsets = from_symmetric(torch.einsum("k,kno->no", theta, codes)).reshape(3, *LATTICE, 3)
    offsets = offsets * offsets.new_tensor([1.0, 1.0, 1.0, 0.0])[:, None, None]
    return scene.with_objects(ffd=scene.objects.ffd + offsets.reshape(3, -1, 3))


def _in_weather(scene: SceneIR, theta: Tensor) -> SceneIR:
    """Moved in front of a covered sky on a wet road: cars hide both."""
    return _translate(scene.with_environment(weather=theta.new_tensor([0.2, 0.6, 0.1, 0.8])), theta)


def _by_night(scene: SceneIR, theta: Tensor) -> SceneIR:
    """Moved with lamps on, in their glare on a wet road."""
    return _translate(scene.with_environment(weather=theta.new_tensor([0.2, 0.5, 0.0, 0.5, 0.7])), theta)


PARAMETERS = {
    "texture": Parameter(3 * TEXTURE_DIM, _texture, 1e-4, 0.4),
    "weather": Parameter(WEATHER_DIM, lambda s, t: s.with_environment(weather=t), 1e-4, 0.5, True),
    "foliage": Parameter(FOLIAGE_DIM, lambda s, t: s.with_environment(foliage=t), 1e-4, 0.5),
    "sun": Parameter(LIGHT_DIM, lambda s, t: s.with_environment(light=t), 1e-4, 0.9),
    "translate": Parameter(6, _translate, 1e-4, 0.3),
    "translate in weather": Parameter(6, _in_weather, 1e-4, 0.3),
    "translate by night": Parameter(6, _by_night, 1e-4, 0.3),
    "rotate": Parameter(3, lambda s, t: s.with_objects(yaw=s.objects.yaw + t), 1e-4, 0.12),
    "mesh": Parameter(15, _ffd, 1e-4, 0.01),
    "size": Parameter(3, lambda s, t: s.with_objects(size_lhw=s.objects.size_lhw * (1 + t)[:, None]), 1e-4, 0.1),
}


def _functionals() -> Tensor:
    """Smooth random weights (K, 3, H, W): low-passed noise."""
    noise = torch.randn(FUNCTIONALS, 3, 80, 144, generator=torch.Generator().manual_seed(11), dtype=torch.float64)
    smooth = kornia.filters.gaussian_blur2d(noise, (13, 13), (2.5, 2.5))
    return smooth / smooth.std()


def _compare(scene: SceneIR, parameter: Parameter, theta: Tensor) -> tuple[Tensor, Tensor]:
    compositor = Compositor(scene, RenderSettings(backend="reference"))
    weights = _functionals()

    def values(at: Tensor) -> Tensor:
        return (compositor.render(parameter.apply(scene, at)).image * weights).flatten(1).sum(dim=1)

    live = theta.clone().requires_grad_()
    outputs = values(live)
    analytic = torch.stack([torch.autograd.grad(v, live, retain_graph=True)[0] for v in outputs])
    columns = []
    with torch.no_grad():
        for i in range(parameter.dim):
            step = torch.zeros_like(theta)
            step[i] = parameter.step
            columns.append((values(theta + step) - values(theta - step)) / (2 * parameter.step))
    return analytic, torch.stack(columns, dim=1)


@pytest.mark.parametrize("where", ["zero", "random"])
@pytest.mark.parametrize("name", PARAMETERS)
def test_gradient_matches_central_differences(
    photographed: SceneIR, name: str, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    parameter = PARAMETERS[name]
    # Which surface a wet road mirrors jumps with the depth and has no slope: differences keep the first choice.
    chosen: dict[torch.Size, Tensor] = {}
    find = reflections._first_above
    monkeypatch.setattr(
        reflections, "_first_above", lambda values, limits: chosen.setdefault(values.shape, find(values, limits))
    )
    generator = torch.Generator().manual_seed(3)
    theta = torch.zeros(parameter.dim, dtype=torch.float64)
    if where == "random":
        theta = (2 * torch.rand(parameter.dim, generator=generator, dtype=torch.float64) - 1) * parameter.scale
        theta = theta.abs() if parameter.positive else theta
    analytic, numeric = _compare(photographed, parameter, theta)
    cosine = torch.nn.functional.cosine_similarity(analytic.flatten(), numeric.flatten(), dim=0)
    error = (analytic - numeric).norm() / numeric.norm()
    assert float(numeric.norm()) > 1e-3
    assert float(cosine) >= COSINE, f"cosine {float(cosine):.4f}, relative error {float(error):.4f}"
    assert float(error) <= RELATIVE, f"cosine {float(cosine):.4f}, relative error {float(error):.4f}"
