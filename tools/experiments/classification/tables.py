"""The study's tables: rows of numbers by name, the paper's beside them, and how people read them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np

from drivesem.classify.objects.types import CLASSES, SPLITS
from drivesem.classify.paper import NETWORKS, REMARKS, figures
from drivesem.evaluation.resampling import Interval
from drivesem.report.tables import ReportTable
from tools.experiments.classification import pixels
from tools.experiments.classification.arms import GRADIENT, NAMES, STRATEGIES, preset
from tools.experiments.classification.figures import Predictions, judge_order
from tools.experiments.classification.lab import BENIGN, ONWARD, SINGLE
from tools.experiments.classification.results import OVERALL, StudyNetwork, ClassificationResults
from tools.experiments.realism.measures import METRICS
from tools.experiments.worth.measures import MEMBERSHIPS, Setting, gain_of, realism, worth_of

Row = dict[str, Any]
TESTS = (BENIGN, *GRADIENT)
"""Columns of what retrained networks are judged on."""
ORDERS = "orders"
_BOTH = "pose,vertex"
_COMPARED = ("vertex", "pose", _BOTH)
"""What the paper's table of parameters has."""
_HEADS = {
    "trained_on": "trained on",
    "params": "parameters",
    "at_paper_sizes": "at the paper's class sizes",
    "weighted": "realism weight",
    "source": "made against",
    "target": "asked",
    "verdict": "the paper's order",
    "ours": "first less than second, ours",
    "paper": "in the paper",
    "step_vertex": "step vertex",
    "step_pose": "step pose",
    "within_vertex": "within vertex",
    "within_pose": "within pose",
}
_SETTINGS = ("step_vertex", "step_pose", "within_vertex", "within_pose", "steps")
_PLAIN = ("pictures", "certain", "worth", "gain", "distance", *_SETTINGS)
"""Columns of numbers that are no shares."""


@dataclass(frozen=True)
class Table:
    """rows, reference: ours and the paper's, of the same columns; columns: what people are shown, in order; notes:
    with the paper's own errors; orders: whether the paper's hold; plain: whether all its numbers are no shares.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Sequence[Row]
    reference: Sequence[Row]
    notes: tuple[str, ...] = ()
    orders: Sequence[Row] = ()
    plain: bool = False

    def sheet(self, classes: bool = True) -> ReportTable:
        """For people. classes: whether each class has its column."""
        columns = [name for name in self.columns if classes or name not in CLASSES]
        lines = [tuple(self._cell(row, name) for name in columns) for row in (*self.rows, *self.reference)]
        return ReportTable(
            self.title, tuple(_HEADS.get(name, NAMES.get(name, name)) for name in columns), tuple(lines)
        )

    def _cell(self, row: Row, name: str) -> str:
        value = row.get(name)
        if value is None:
            return "-"
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, str):
            return NAMES.get(value, value)

        def number(one: float) -> str:
            if not (self.plain or name in _PLAIN):
                return f"{100 * one:.1f}"
            return str(one) if isinstance(one, int) else f"{one:.3g}"

        low, high = row.get(f"{name}_low"), row.get(f"{name}_high")
        ends = "" if low is None or high is None else f" [{number(low)}, {number(high)}]"
        return number(value) + ends


def _bounded(name: str, one: Interval) -> Row:
    found = {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}
    return {key: _rounded(value) for key, value in found.items()}


def tables_of(lab: ClassificationResults) -> list[Table]:
    """All that are wanted, and what they say of orders."""
    found = [_BUILDERS[name](lab) for name in lab.facts.tables]
    orders = [row for table in found for row in table.orders]
    if orders:
        held, turned = (sum(row["verdict"] == one for row in orders) for one in ("holds", "reversed"))
        note = (
            f"Of {len(orders)} orders of two of the paper's figures: {held} hold here, reversed: {turned}, "
            f"undecided: {len(orders) - held - turned}."
        )
        columns = ("network", "table", "first", "second", "paper", "ours", "verdict")
        found.append(Table(ORDERS, "Does the paper's order hold?", columns, orders, (), (note,)))
    return found


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 5)


def _overall(lab: ClassificationResults, answers: Predictions) -> Row:
    found = {"pictures": len(answers.correct), **_bounded("overall", answers.overall(lab.bootstrap))}
    if lab.facts.classes == CLASSES:
        sizes = [counts[0] for counts in figures()["sizes"].values()]
        found |= _bounded("at_paper_sizes", answers.overall(lab.bootstrap, sizes))
    return found


def _with_classes(lab: ClassificationResults, answers: Predictions) -> Row:
    own = zip(lab.facts.classes, answers.by_class(len(lab.facts.classes)), strict=True)
    return _overall(lab, answers) | {name: _rounded(share) for name, share in own}


def _paper(table: str, *names: str) -> Iterator[tuple[Row, Any]]:
    """The figures of one of the paper's tables, or lists of them, and of what: a network, and what `names` are."""

    def walk(node: Any, keys: tuple[str, ...]) -> Iterator[tuple[Row, Any]]:
        if isinstance(node, dict):
            for key, below in node.items():
                yield from walk(below, (*keys, key))
        else:
            yield {"network": NETWORKS[keys[0]], **dict(zip(names, keys[1:], strict=True))}, node

    return walk(figures()[table], ())


def _by_class(values: Sequence[float]) -> Row:
    return dict(zip((*CLASSES, "overall"), values, strict=False))


def _degradation(lab: ClassificationResults) -> Table:
    rows: list[Row] = []
    orders: list[Row] = []
    for eyes in lab.facts.networks:
        ours = {one: lab.predictions("attacked", eyes, one) for one in (BENIGN, *STRATEGIES)}
        for one, answers in ours.items():
            row = {"network": eyes.name, "strategy": one, **_with_classes(lab, answers)}
            rows.append(row | {"certain": None if one == BENIGN else lab.certain_of(eyes, one)})
        theirs = {one: figures()["degradation"][eyes.paper_network][one][-1] for one in STRATEGIES}
        orders += _order(lab, "degradation", eyes, theirs, ours)
    reference = [row | _by_class(values) for row, values in _paper("degradation", "strategy")]
    columns = ("network", "strategy", *lab.facts.classes, "overall", "at_paper_sizes", "certain")
    title, notes = "Accuracy by class and strategy, %", REMARKS["degradation"]
    return Table("degradation", title, columns, rows, reference, notes, orders)


def _parameters(lab: ClassificationResults) -> Table:
    rows: list[Row] = []
    orders: list[Row] = []
    moved = (*SINGLE[:3], _BOTH, SINGLE[3])
    for eyes, strategy in product(lab.slow_networks, GRADIENT):
        ours = {one: lab.predictions("attacked", eyes, strategy, "test" if one == _BOTH else one) for one in moved}
        row = {"network": eyes.name, "strategy": strategy}
        rows += [row | {"params": params, **_overall(lab, one)} for params, one in ours.items()]
        theirs: dict[str, float] = dict(zip(_COMPARED, figures()["parameters"]["vgg16"][strategy], strict=True))
        orders += _order(lab, f"parameters, {NAMES[strategy]}", eyes, theirs, ours)
    reference = [
        row | {"params": params, "overall": value}
        for row, values in _paper("parameters", "strategy")
        for params, value in zip(_COMPARED, values, strict=True)
    ]
    note = "The paper says that light does not matter, without figures."
    columns = ("network", "strategy", "params", "overall", "at_paper_sizes")
    return Table("parameters", "Accuracy by what is moved, %", columns, rows, reference, (note,), orders)


def _hyperparameters(lab: ClassificationResults) -> Table:
    rows, reference = [], []
    for network, strategy in product(NETWORKS, GRADIENT):
        settings = {"strategy": strategy, "settings": NETWORKS[network]}
        settings |= {key: preset(network, strategy).get(key) for key in _SETTINGS}
        for eyes in lab.slow_networks:
            answers = lab.predictions("attacked", eyes, strategy, "test" if network == eyes.paper_network else network)
            rows.append({"network": eyes.name, **settings, **_overall(lab, answers)})
        value = figures()["degradation"][network][strategy][-1]
        reference.append({"network": NETWORKS[network], **settings, "overall": value})
    columns = ("network", "strategy", "settings", *_SETTINGS, "overall")
    notes = REMARKS["hyperparameters"]
    return Table("hyperparameters", "Accuracy by settings, %", columns, rows, reference, notes)


def _learners(lab: ClassificationResults, table: str, title: str, trained: Sequence[str], what: str) -> Table:
    """Networks that were trained so, on each of TESTS. what: as of `Results.answers`."""
    rows: list[Row] = []
    orders: list[Row] = []
    for eyes in lab.slow_networks:
        for one in (BENIGN, *trained):
            row: Row = {"network": eyes.name, "trained_on": one}
            for test in TESTS:
                row |= _bounded(test, lab.predictions(what, eyes, test, one).overall(lab.bootstrap))
            rows.append(row | {"pictures": len(lab.predictions(what, eyes, BENIGN, one).correct)})
        for i, test in enumerate(TESTS):
            theirs = {one: figures()[table][eyes.paper_network][one][i] for one in (BENIGN, *GRADIENT)}
            ours = {one: lab.predictions(what, eyes, test, one) for one in theirs}
            pairs = _order(lab, f"{table}, on {NAMES[test]}", eyes, theirs, ours)
            # Is a retrained network better than the benign one?
            orders += [pair for pair in pairs if pair["first"] == BENIGN]
    reference = [row | dict(zip(TESTS, values, strict=True)) for row, values in _paper(table, "trained_on")]
    columns = ("network", "trained_on", *TESTS, "pictures")
    return Table(table, title, columns, rows, reference, REMARKS.get(table, ()), orders)


def _retraining(lab: ClassificationResults) -> Table:
    title = "Retrained networks on pictures made against the benign one, %"
    return _learners(lab, "retraining", title, (ONWARD, *GRADIENT), "known")


def _robustness(lab: ClassificationResults) -> Table:
    title = "Retrained networks on pictures made against themselves, %"
    return _learners(lab, "robustness", title, GRADIENT, "fresh")


def _worth(lab: ClassificationResults) -> Table:
    rows: list[Row] = []
    distance = lab.facts.distance
    for eyes in lab.facts.networks:
        far = {one: lab.picture_distances(eyes, one, distance) for one in STRATEGIES}
        largest = max(float(distances.max(initial=0)) for distances in far.values())
        for strategy, weighted, kind in product((BENIGN, *STRATEGIES), (False, True), MEMBERSHIPS):
            rho = np.ones(len(lab.labels)) if strategy == BENIGN else realism(far[strategy], largest)
            setting = Setting(kind, weighted)
            row: Row = {"network": eyes.name, "strategy": strategy, "membership": kind, "weighted": weighted}
            before = lab.points(eyes, strategy, rho)
            row |= _bounded("worth", worth_of(before, setting))
            if lab.is_retrained(eyes, strategy):
                after = lab.points(eyes, strategy, rho, trained=strategy)
                row |= _bounded("gain", gain_of(before, after, setting))
            rows.append(row)
    reference = [
        row | {"weighted": True, "worth": value} for row, value in _paper("worth", "membership", "strategy")
    ]
    note = (
        f"Natural logarithm. Realism by {METRICS[distance].name}, over the largest distance of a network's "
        "counterexamples. Gain: the worth before the network less that before the one retrained on such pictures."
    )
    columns = ("network", "strategy", "membership", "weighted", "worth", "gain")
    return Table("worth", "Information worth", columns, rows, reference, (note, *REMARKS["worth"]))


def _realism(lab: ClassificationResults) -> Table:
    rows = []
    for eyes, strategy, metric in product(lab.facts.networks, STRATEGIES, lab.facts.measures):
        name = f"{METRICS[metric].name}{', dB' if METRICS[metric].unit else ''}"
        row: Row = {"network": eyes.name, "strategy": strategy, "metric": name}
        kinds = (*lab.facts.classes, OVERALL)
        rows.append(row | {kind: _rounded(lab.mean(eyes, strategy, metric, kind)) for kind in kinds})
    reference = [
        row | {"metric": row["metric"].upper(), **_by_class(values)}
        for row, values in _paper("realism", "metric", "strategy")
    ]
    absent = [METRICS[name].name for name in METRICS if name not in lab.facts.measures]
    note = (
        "Pictures that were right before, and what became of them. A Frechet distance of few pictures ranks, and "
        "does not compare with the paper's. "
        + (f"Without weights on disk: {', '.join(absent)}." if absent else "")
    )
    columns = ("network", "strategy", "metric", *lab.facts.classes, "overall")
    return Table("realism", "Distances to the pictures before", columns, rows, reference, (note,), plain=True)


def _transfer(lab: ClassificationResults) -> Table:
    rows = []
    for source, target in product(lab.facts.networks, lab.facts.networks):
        for strategy in (BENIGN, *GRADIENT) if source is not target else ():
            row = {"source": source.name, "target": target.name, "strategy": strategy}
            rows.append(row | _with_classes(lab, lab.predictions("crossed", source, strategy, target.name)))
    other = dict(zip(NETWORKS.values(), reversed(NETWORKS.values()), strict=True))
    reference = [
        row | {"source": row["network"], "target": other[row["network"]], **_by_class(values)}
        for row, values in _paper("transfer", "strategy")
    ]
    note = () if rows else ("Two networks are needed: --networks squeezenet,FILE.",)
    columns = ("source", "target", "strategy", *lab.facts.classes, "overall", "at_paper_sizes")
    return Table("transfer", "Accuracy on another network's counterexamples, %", columns, rows, reference, note)


def _pixels(lab: ClassificationResults) -> Table:
    rows: list[Row] = []
    for eyes, attack in product(lab.slow_networks if lab.facts.toolbox else (), pixels.ATTACKS):
        row: Row = {"network": eyes.name, "strategy": attack}
        row |= _overall(lab, lab.predictions("pixels", eyes, attack, ""))
        rows.append(row | {"distance": round(float(lab.picture_distances(eyes, attack, "", "pixels").mean()), 5)})
    note = f"Distance: {METRICS['perceptual'].name}, as in the table of realism."
    notes = (note,) if rows else (f"Attacks on pixels need another library: {pixels.NEEDS}.",)
    columns = ("network", "strategy", "pictures", "overall", "distance")
    return Table("pixels", "Accuracy after attacks on pixels, for comparison, %", columns, rows, (), notes)


def _sizes(lab: ClassificationResults) -> Table:
    objects, used = lab.facts.objects, lab.facts.used
    rows = [
        {"class": one, **{f"{split} objects": objects[split][one] for split in SPLITS}}
        | {f"{split} pictures": used[split][one] for split in used}
        for one in lab.facts.classes
    ]
    reference = [
        {"class": f"{one} (paper)"}
        | {f"{split} objects": n for split, n in zip(("test", "train", "val"), counts, strict=True)}
        for one, counts in figures()["sizes"].items()
    ]
    columns = ("class", *(f"{split} objects" for split in SPLITS), "train pictures", "test pictures")
    return Table("sizes", "Sizes", columns, rows, reference, plain=True)


def _order(
    lab: ClassificationResults, table: str, eyes: StudyNetwork, theirs: Mapping[str, float], ours: Mapping[str, Predictions]
) -> Iterator[Row]:
    """Each two of the paper's figures that differ, and whether ours differ alike, paired over pictures."""
    for first, second in combinations(theirs, 2):
        apart = theirs[second] - theirs[first]
        if apart:
            one = ours[first].accuracy_drop(ours[second], lab.bootstrap)
            row: Row = {"network": eyes.name, "table": table, "first": first, "second": second}
            yield row | {"paper": round(apart, 4), **_bounded("ours", one), "verdict": judge_order(apart, one)}


_BUILDERS: dict[str, Callable[[ClassificationResults], Table]] = {
    "degradation": _degradation,
    "worth": _worth,
    "realism": _realism,
    "parameters": _parameters,
    "retraining": _retraining,
    "robustness": _robustness,
    "transfer": _transfer,
    "hyperparameters": _hyperparameters,
    "pixels": _pixels,
    "sizes": _sizes,
}
