"""Reach for people and programs: a table, JSON, CSV, Markdown and a plot."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import torch

from detectors.base import Detector, DetectorError
from detectors.registry import load_detector
from drivesem.attacks.objective import Objective
from drivesem.attacks.space import PAPER_PARAMETERS, ParameterSpace
from drivesem.config.errors import UsageError
from drivesem.config.options import SceneOptions
from drivesem.failures.margin_oracle import NuisanceMarginOracle
from drivesem.failures.nuisances import Nuisances
from drivesem.reporting.plots import PLOT_COLOURS, PLOT_STYLE
from drivesem.reporting.tables import AnalysisReport, ReportTable
from drivesem.scenes.sources import NoVehicleError, SceneSource, open_source
from scene_ir import files
from scene_ir.render.compositor import Compositor
from tools.bench.reach.agreement import ALL, ReachRow, SlopeAgreement
from tools.bench.reach.slopes import STEPS, ProbeSlopes, measure, probes
from tools.bench.settings import GradcheckConfig

NAME = "reach"
_KINDS = ("point", "smoothed", "repeated")
_COLUMNS = (
    "parameter",
    "objects",
    "steps",
    "point: cosine",
    "signs",
    "realised",
    "smoothed: cosine",
    "signs ",
    "realised ",
    "repeated",
)
_NOTES = (
    "Slopes of an object's margin (logits a step) over so many steps to either side, as far as bounds and what is "
    "feasible allow, against its gradient; both are means over the same draws of a camera's small changes.",
    "Point: the gradient at the photographed scene. Smoothed: the mean of gradients at random places nearby, 4 "
    "steps apart. Cosine: of all objects' slopes and gradients, with 95 % by bootstrap over objects. Signs: % of "
    "slopes of the gradient's sign; 50 is chance. Realised: share of the predicted change that the step makes. "
    "Repeated: the cosine of slopes in half of the draws and in the others; where low, slopes are mostly noise.",
)


def build_reach_report(
    out: Path, rows: Sequence[ReachRow], facts: Mapping[str, Any], failed: Mapping[str, str]
) -> AnalysisReport:
    """Build the report of all frames. facts: JSON entries before the rows."""
    everywhere = tuple(_line(row) for row in rows if row.distance == ALL)
    sheets = [ReportTable("Gradients and slopes of margins", _COLUMNS, everywhere), _by_distance(rows)]
    return AnalysisReport(
        out=out,
        name=NAME,
        heading="How far gradients hold",
        data={**facts, "rows": [asdict(row) for row in rows]},
        csv_tables={NAME: [_flat(row) for row in rows]},
        tables=sheets,
        notes=_NOTES,
        picture=partial(write_reach, rows=[row for row in rows if row.distance == ALL]),
        failed=failed,
    )


def write_reach(path: Path, rows: Sequence[ReachRow]) -> None:
    """Cosines over the width of differences, a panel a parameter."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    names = tuple(dict.fromkeys(row.row for row in rows))
    across = min(len(names), 4)
    down = -(-len(names) // across)
    series = tuple(
        zip(_KINDS, (PLOT_COLOURS[0], PLOT_COLOURS[1], PLOT_COLOURS[6]), ("-o", "--s", ":"), strict=True)
    )
    with mpl.rc_context(dict(PLOT_STYLE)):  # pyright: ignore[reportArgumentType]
        figure = Figure(figsize=(2.3 * across, 2.1 * down + 0.6), layout="constrained")
        panels = list(figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).flat)
        for panel, name in zip(panels, names, strict=False):
            own = [row for row in rows if row.row == name]
            for kind, colour, style in series:
                values: list[SlopeAgreement] = [getattr(row, kind) for row in own]
                places, cosines = [row.steps for row in own], [one.cosine for one in values]
                panel.plot(places, cosines, style, color=colour, label=kind)
            panel.axhline(0, color="#888888", linewidth=0.8)
            panel.set_title(name, fontsize=9, loc="left")
            panel.set_xscale("log", base=4)
            panel.set_xticks(STEPS, [str(step) for step in STEPS])
            panel.minorticks_off()
            panel.set_ylim(-1.02, 1.02)
        for panel in panels[len(names) :]:
            panel.set_visible(False)
        figure.supxlabel("steps to either side", fontsize=9)
        figure.supylabel("cosine to the slope", fontsize=9)
        first = figure.axes[0]
        figure.legend(*first.get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=9)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    files.write_bytes(path, buffer.getvalue())


def _line(row: ReachRow) -> tuple[str, ...]:
    cells = [cell for one in (row.point, row.smoothed) for cell in _cells(one)]
    return (row.row, str(row.objects), str(row.steps), *cells, f"{row.repeated.cosine:.2f}")


def _cells(one: SlopeAgreement) -> tuple[str, str, str]:
    bounds = "" if one.low is None or one.high is None else f" [{one.low:.2f}, {one.high:.2f}]"
    return (f"{one.cosine:.2f}{bounds}", f"{100 * one.signs:.0f}", f"{one.realised:.2f}")


def _by_distance(rows: Sequence[ReachRow]) -> ReportTable:
    """Cosines and signs of point gradients, a pair of columns a band."""
    bands = tuple(dict.fromkeys(row.distance for row in rows if row.distance != ALL))
    known = {(row.row, row.steps, row.distance): row for row in rows}
    lines = []
    for name, steps in dict.fromkeys((row.row, row.steps) for row in rows):
        line = [name, str(steps)]
        for band in bands:
            row = known.get((name, steps, band))
            line += ["-", "-"] if row is None else [f"{row.point.cosine:.2f}", f"{100 * row.point.signs:.0f}"]
        lines.append(tuple(line))
    columns = [word for band in bands for word in (f"{band}: cosine", f"{band}: signs")]
    return ReportTable("Point gradients by distance", ("parameter", "steps", *columns), tuple(lines))


def _flat(row: ReachRow) -> dict[str, Any]:
    line: dict[str, Any] = {"parameter": row.row, "distance": row.distance, "steps": row.steps}
    line |= {"objects": row.objects, "slopes": row.slopes}
    for kind in _KINDS:
        line |= {f"{kind}_{key}": value for key, value in asdict(getattr(row, kind)).items()}
    return line


@dataclass(frozen=True)
class ReachWorker:
    """What one process needs."""

    config: GradcheckConfig
    source: SceneSource
    detector: Detector
    folder: Path | None
    """Folder of what is done, by frame; None keeps nothing."""

    @classmethod
    def of(cls, config: GradcheckConfig) -> ReachWorker:
        """Raises UsageError or SceneError for settings that cannot be."""
        source = open_source(config)
        try:
            detector = load_detector(config.detector, config.device)
        except DetectorError as error:
            raise UsageError.from_detector_error("--detector", "a detector with gradients", error) from error
        if type(detector).candidates is Detector.candidates:
            raise UsageError("--detector", "one with candidates", detector.name)
        return cls(config, source, detector, None if config.out is None else Path(config.out) / "frames")

    def measure(self, name: str) -> tuple[ProbeSlopes, ...]:
        """Of a frame; what another call has done with the same settings is read."""
        settings: dict[str, Any] = {
            field.name: str(getattr(self.config, field.name)) for field in fields(SceneOptions)
        }
        settings |= {"detector": self.config.detector, "draws": self.config.draws}
        settings.pop("limit")
        path = None if self.folder is None else self.folder / f"{name}.json"
        if path is not None and self.config.resume and path.is_file():
            known = files.read_json(path)
            if known["settings"] == settings:
                return tuple(_of_json(row) for row in known["slopes"])
        found = self._measure(name)
        if path is not None:
            files.write_json(path, {"settings": settings, "slopes": [asdict(one) for one in found]})
        return found

    def _measure(self, name: str) -> tuple[ProbeSlopes, ...]:
        scene = self.source.scene(name)
        if not len(scene.objects):
            raise NoVehicleError(f"frame {name}", "a vehicle that can be de-rendered", "none")
        space = ParameterSpace(scene, PAPER_PARAMETERS)
        objective = Objective(Compositor(scene), space, self.detector)
        views = NuisanceMarginOracle.for_objective(objective, Nuisances(), f"reach:{name}:{self.config.seed}")
        generator = torch.Generator().manual_seed(self.config.seed)
        tried = probes(space, generator)
        return measure(views, objective.feasible_set(), tried, self.config.draws, generator)


def build_reach_worker(config: GradcheckConfig) -> Callable[[str], tuple[ProbeSlopes, ...]]:
    """`ReachWorker.measure` of another process."""
    return ReachWorker.of(config).measure


def _of_json(row: dict[str, Any]) -> ProbeSlopes:
    drawn: dict[str, Any] = {key: tuple(map(tuple, row[key])) for key in ("point", "smoothed", "wide")}
    return ProbeSlopes(**(row | drawn))
