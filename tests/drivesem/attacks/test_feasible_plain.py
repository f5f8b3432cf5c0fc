"""The projection held against a plain one: car by car, pair by pair, everything measured anew at every trial."""

import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drivesem.attacks.feasibility_check import overlap_area
from drivesem.attacks.feasible.constraints import FeasibilityLimits
from drivesem.attacks.feasible.projection import FeasibleSet
from drivesem.attacks.feasible.vehicles import extreme_points
from drivesem.attacks.space import COMBOS, Parameter, ParameterSpace
from scene_ir import ffd
from scene_ir.geometry import place_vertices, to_clip, yaw_matrix

SLACK = 1e-6
CROWDED = ((-2.2, 8.0), (-2.2, 12.9), (0.2, 8.3), (2.4, 10.0), (2.4, 15.2), (0.1, 14.0))
OVERLAPPING = ((0.0, 10.0), (0.5, 11.5), (3.0, 14.0), (-3.0, 9.0))


class PlainCar:
    """One car of a scene: its bounds, and all that the constraints measure of it alone."""

    def __init__(self, scene, i):
        objects, camera = scene.objects, scene.camera
        mesh = scene.meshes[int(objects.mesh_index[i])]
        unit = torch.from_numpy(extreme_points(mesh))
        self.size = objects.size_lhw[i].double()
        self.yaw, self.translation = objects.yaw[i].double(), objects.translation[i].double()
        local = ffd.deform(unit, ffd.lattice_weights(unit), objects.ffd[i].double()) * self.size
        self.low, self.high = local.amin(dim=0), local.amax(dim=0)
        matrix = camera.matrix.double()
        clip = to_clip(self.at(torch.cartesian_prod(*torch.tensor([[0.0, 1.0]] * 3).double())), matrix)
        self.near = float(clip[:, 2].min())
        pixels = clip[:, :2] / clip[:, 2:].clamp(min=0.1)
        whole = torch.cat([pixels.amin(dim=0), pixels.amax(dim=0)])
        limit = torch.tensor([camera.width - 1.0, camera.height - 1.0] * 2).double()
        self.box = torch.minimum(whole.clamp(min=0), limit)
        self.extent = self.box[2:] - self.box[:2]
        self.in_frame = float(self.extent.prod() / (whole[2:] - whole[:2]).prod().clamp(min=1e-9))
        self.road = self.road_share(scene, matrix)
        corners = [[0.0, 1, 0], [1, 1, 0], [1, 1, 1], [0, 1, 1]]
        footprint = self.at(torch.tensor(corners).double())[:, [0, 2]].numpy()
        self.footprint = footprint if _area(footprint) > 0 else footprint[::-1]

    def at(self, share):
        """Camera-space points at shares (P, 3) between the bounds."""
        return place_vertices(
            self.low + share * (self.high - self.low), torch.ones(3).double(), self.yaw, self.translation
        )

    def road_share(self, scene, matrix):
        along, across = (torch.arange(10) + 0.5) / 10, (torch.arange(16) + 0.5) / 16
        share = torch.cartesian_prod(along.double(), across.double())
        flat = self.low[[0, 2]] + share * (self.high - self.low)[[0, 2]]
        local = torch.stack([flat[:, 0], torch.zeros(160).double(), flat[:, 1]], dim=1)
        clip = to_clip(place_vertices(local, torch.ones(3).double(), self.yaw, self.translation), matrix)
        road, total, count = scene.environment.road.double().numpy(), 0.0, 0
        height, width = road.shape
        for u, v, w in clip.tolist():
            if w <= 0.1 or not (0 <= u / w <= width - 1 and 0 <= v / w <= height - 1):
                continue
            x, y = u / w, v / w
            a, b = min(int(x), width - 2), min(int(y), height - 2)
            fx, fy = x - a, y - b
            total += (road[b, a] * (1 - fx) + road[b, a + 1] * fx) * (1 - fy)
            total += (road[b + 1, a] * (1 - fx) + road[b + 1, a + 1] * fx) * fy
            count += 1
        return total / count if count * 4 >= 160 else 1.0

    def entered(self, centre, directions):
        """Distance at which rays (R, 3) enter the bounds, inf for a miss: slabs, one axis after the other."""
        rotation = yaw_matrix(self.yaw).numpy()
        origin, rays = (centre - self.translation.numpy()) @ rotation, directions @ rotation
        rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
        first, second = (self.low.numpy() - origin) / rays, (self.high.numpy() - origin) / rays
        enter, leave = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
        return np.where((enter <= leave) & (leave > 0), enter, np.inf)


def _area(polygon):
    x, y = polygon.T
    return 0.5 * float(x @ np.roll(y, -1) - y @ np.roll(x, -1))


def _gap(a, b):
    """Signed gap by separating axes: the largest of the four."""
    best = -math.inf
    for polygon in (a.footprint, b.footprint):
        for edge in (polygon[1] - polygon[0], polygon[2] - polygon[1]):
            axis = edge / np.linalg.norm(edge)
            p, q = a.footprint @ axis, b.footprint @ axis
            best = max(best, p.min() - q.max(), q.min() - p.max())
    return best


def _sight(scene, cars, i):
    """Visible height px, visible share, and who hides a part of car i."""
    matrix = scene.camera.matrix.double().numpy()
    inverse = np.linalg.inv(matrix[:, :3])
    box = cars[i].box.numpy()
    rays = [
        [box[0] + (c + 0.5) / 6 * (box[2] - box[0]), box[1] + (r + 0.5) / 10 * (box[3] - box[1]), 1.0]
        for r in range(10)
        for c in range(6)
    ]
    directions, centre = np.array(rays) @ inverse.T, -inverse @ matrix[:, 3]
    own = cars[i].entered(centre, directions)
    met, visible, occluders = np.isfinite(own), np.isfinite(own), set()
    for j, other in enumerate(cars):
        meets = (box[:2] <= other.box.numpy()[2:]).all() and (other.box.numpy()[:2] <= box[2:]).all()
        if j != i and meets:
            before = (other.entered(centre, directions) < own) & met
            visible &= ~before
            occluders |= {j} if before.any() else set()
    height = visible.reshape(10, 6).any(axis=1).mean() * (box[3] - box[1])
    return float(height), visible.sum() / max(met.sum(), 1), occluders


def _strain(offsets):
    axis = torch.linspace(0, 1, 5, dtype=torch.float64)
    unit = torch.cartesian_prod(axis - 0.5, axis - 1, axis - 0.5)
    jacobian = ffd.jacobian(unit, offsets)
    values = torch.linalg.svdvals(jacobian)
    height = (unit + ffd.lattice_weights(unit) @ offsets)[:, 1].max()
    return float(values.min()), float(values.max()), float(torch.linalg.det(jacobian).min()), float(height)


class PlainProjection:
    """The same search as `FeasibleSet.project`, with nothing kept from one trial to the next."""

    def __init__(self, space):
        self.space, self.limits, self.scene = space, FeasibilityLimits(), space.scene.with_objects()
        doubled = {n: getattr(space.scene.objects, n).double() for n in ("translation", "yaw", "ffd", "size_lhw")}
        self.scene = space.scene.with_objects(**doubled)
        self.start = self.measured(torch.zeros_like(space.theta0))
        self.strain0 = [_strain(f.double()) for f in space.scene.objects.ffd]

    def measured(self, theta):
        scene = self.space.apply(self.scene, theta.double())
        cars = [PlainCar(scene, i) for i in range(self.space.count)]
        sights = [_sight(scene, cars, i) for i in range(len(cars))]
        gaps = [[_gap(a, b) for b in cars] for a in cars]
        areas = [[overlap_area(a.footprint, b.footprint) for b in cars] for a in cars]
        return cars, sights, gaps, areas

    def violated(self, theta):
        """What is violated, by name: pairs of cars, twice the same for what a car violates alone."""
        cars, sights, gaps, areas = self.measured(theta)
        cars0, sights0, gaps0, areas0 = self.start
        limits, violations = self.limits, {"road": set(), "frame": set(), "visibility": set(), "collision": set()}
        for i, (car, car0) in enumerate(zip(cars, cars0, strict=True)):
            if car.road < car0.road - limits.road_loss - SLACK:
                violations["road"].add((i, i))
            if (
                car.in_frame < min(car0.in_frame, limits.in_frame) - SLACK
                or bool((car.extent < car0.extent.clamp(max=limits.minimum_px) - SLACK).any())
                or float(car.extent[1]) < limits.min_height_share * float(car0.extent[1]) - SLACK
                or car.near < min(car0.near, limits.near_m) - SLACK
            ):
                violations["frame"].add((i, i))
            (height, area, occluders), (height0, area0, _) = sights[i], sights0[i]
            if (
                height < limits.min_height_share * height0 - SLACK
                or area < min(area0, limits.min_area_share) - SLACK
            ):
                violations["visibility"] |= {(i, i), *((i, j) for j in occluders)}
            for j in range(len(cars)):
                nearer = gaps[i][j] < min(gaps0[i][j], limits.clearance_m) - SLACK
                if i != j and (nearer or areas[i][j] > areas0[i][j] + SLACK):
                    violations["collision"].add((i, j))
        return violations

    def wrong(self, theta):
        violations = self.violated(theta).values()
        return np.array(
            [any(i in pair for pairs in violations for pair in pairs) for i in range(self.space.count)]
        )

    def strained(self, theta):
        mesh, low, high = self.block(theta, Parameter.MESH), self.limits.strain[0], self.limits.strain[1]
        wrong = []
        for code, source, at_rest in zip(mesh, self.space.scene.objects.ffd, self.strain0, strict=True):
            least, most, volume, lowest = _strain(source.double() + ffd.from_symmetric(code.double()))
            wrong.append(
                least < min(low, at_rest[0]) - SLACK
                or most > max(high, at_rest[1]) + SLACK
                or (volume <= 0 < at_rest[2])
                or lowest > max(0.0, at_rest[3]) + SLACK
            )
        return np.array(wrong)

    def block(self, theta, parameter):
        where = self.space.blocks.get(parameter)
        return None if where is None else theta[where].reshape(self.space.count, -1)

    def project(self, theta):
        theta = torch.minimum(torch.maximum(theta, self.space.lower), self.space.upper)
        mesh = self.block(theta, Parameter.MESH)
        if mesh is not None:
            mesh.reshape(-1, 4, 4, 2, 3)[:, :, -1, :, 1] = 0
            goal, wrong = mesh.clone(), self.strained(theta)
            low, high = torch.zeros(len(mesh)).double(), torch.ones(len(mesh)).double()
            for _ in range(5):
                middle = 0.5 * (low + high)
                mesh[:] = goal * middle[:, None]
                good = torch.from_numpy(~self.strained(theta))
                low, high = torch.where(good, middle, low), torch.where(good, high, middle)
            mesh[:] = goal * torch.where(torch.from_numpy(wrong), low, 1.0)[:, None]
        offenders, wanted = self.wrong(theta), theta.clone()
        if not offenders.any():
            return theta
        blocks = [(p, None) for p in (Parameter.MESH, Parameter.ROTATE)]
        blocks += [(Parameter.TRANSLATE, 0), (Parameter.TRANSLATE, 1)]
        blocks = [b for b in blocks if self.space.blocks.get(b[0]) is not None]
        while True:
            theta = wanted.clone()
            for parameter, _ in blocks:
                self.block(theta, parameter)[offenders] = 0
            joined = offenders | self.wrong(theta)
            if (joined == offenders).all():
                break
            offenders = joined
        for parameter, column in blocks:
            columns = slice(None) if column is None else slice(column, column + 1)
            block, goal = (self.block(t, parameter)[:, columns] for t in (theta, wanted))

            def wrong_at(scale, block=block, goal=goal, parameter=parameter):
                block[offenders] = (goal * torch.from_numpy(scale)[:, None]).to(block)[offenders]
                wrong = self.wrong(theta)
                return (wrong | self.strained(theta) if parameter is Parameter.MESH else wrong) & offenders

            full = np.ones(len(offenders))
            search, low, high = wrong_at(full), 0 * full, full
            if not search.any():
                continue
            for _ in range(5):
                scale = np.where(search, 0.5 * (low + high), full)
                wrong = wrong_at(scale)
                search = search | wrong
                low, high = np.where(search & ~wrong, scale, low), np.where(wrong, np.minimum(high, scale), high)
            scale = np.where(search, low, full)
            while (wrong := wrong_at(scale) & (scale > 0)).any():
                scale = np.where(wrong, 0.0, scale)
        return theta


@pytest.mark.parametrize(
    ("positions", "number", "seed", "reached"),
    [
        (CROWDED, 2, 1, {"collision", "strain"}),
        (CROWDED, 1, 2, {"collision"}),
        (OVERLAPPING, 1, 4, {"road", "visibility"}),
        (OVERLAPPING, 2, 5, {"strain"}),
        (((0.0, 7.0), (3.0, 13.0), (-3.0, 16.0)), 1, 6, set()),
        (((6.9, 9.0), (0.0, 9.0)), 1, 7, set()),
    ],
)
def test_projection_is_the_plain_one(street, positions, number, seed, reached):
    scene = street(positions_xz=positions, road_edge_x_m=4.0, tilt=0.01)
    space = ParameterSpace(scene, COMBOS[number])
    theta = torch.randn(space.dim, generator=torch.Generator().manual_seed(seed)) * 10 * space.step
    violations = FeasibleSet(space).project(theta)
    assert reached <= {name.split(": ")[1] for name in violations.active}
    torch.testing.assert_close(violations.theta, PlainProjection(space).project(theta), atol=1e-6, rtol=1e-6)


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**31), scale=st.floats(1.0, 20.0))
def test_violations_are_the_plain_ones(street, seed, scale):
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(5, 2, generator=generator) * torch.tensor([12.0, 16.0]) + torch.tensor([-6.0, 7.0])
    space = ParameterSpace(street(positions_xz=positions.tolist(), road_edge_x_m=3.0), COMBOS[1])
    theta = (torch.randn(space.dim, generator=generator) * scale * space.step).clamp(space.lower, space.upper)
    expected = PlainProjection(space).violated(theta)
    named = {f"objects[{i}]: {name}" for name, pairs in expected.items() for i, _ in pairs}
    assert set(FeasibleSet(space).violations(theta)) == named


def test_strained_sources_keep_what_they_have(street):
    scene = street(positions_xz=CROWDED[:3])
    scene = scene.with_objects(ffd=0.15 * torch.randn(3, 64, 3, generator=torch.Generator().manual_seed(8)))
    space = ParameterSpace(scene, ("mesh",))
    theta = torch.randn(space.dim, generator=torch.Generator().manual_seed(9)) * 6 * space.step
    expected = PlainProjection(space).project(theta)
    torch.testing.assert_close(FeasibleSet(space).project(theta).theta, expected, atol=1e-6, rtol=1e-6)
