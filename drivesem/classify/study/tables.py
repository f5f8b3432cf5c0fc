"""The study's tables: rows of numbers by name, the paper's beside them, and how people read them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np
from torch import Tensor

from drivesem.classify.networks.base import Classifier
from drivesem.classify.objects.types import CLASSES, SPLITS
from drivesem.classify.paper import NETWORKS, REMARKS, figures
from drivesem.classify.study import pixels
from drivesem.classify.study.arms import GRADIENT, NAMES, STRATEGIES, preset
from drivesem.classify.study.figures import Answers, verdict
from drivesem.classify.study.lab import BENIGN, ONWARD, SINGLE, Lab
from drivesem.classify.study.looking import Eyes
from drivesem.classify.study.retraining import chances, right
from drivesem.evaluation.resampling import Interval
from drivesem.questions.realism.measures import METRICS, missing
from drivesem.questions.worth.measures import (
    MEMBERSHIPS,
    Floats,
    Points,
    Setting,
    classified,
    gain_of,
    realism,
    worth_of,
)
from drivesem.questions.worth.runs import PREFERRED
from drivesem.report.tables import Sheet

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
    """rows, reference: ours and the paper's, of the same columns; columns: what people are shown, in order; plain:
    whether all its numbers are no shares.
    """

    name: str
    title: str
    columns: tuple[str, ...]
    rows: Sequence[Row]
    reference: Sequence[Row]
    notes: tuple[str, ...] = ()
    plain: bool = False

    def sheet(self, classes: bool = True) -> Sheet:
        """For people. classes: whether each class has its column."""
        columns = [name for name in self.columns if classes or name not in CLASSES]
        lines = [tuple(self._cell(row, name) for name in columns) for row in (*self.rows, *self.reference)]
        return Sheet(self.title, tuple(_HEADS.get(name, NAMES.get(name, name)) for name in columns), tuple(lines))

    def _cell(self, row: Row, name: str) -> str:
        value = row.get(name)
        if value is None:
            return "-"
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, str):
            return NAMES.get(value, value)
        plain = self.plain or name in _PLAIN
        shown = _number(value) if plain else f"{100 * value:.1f}"
        if row.get(f"{name}_low") is None:
            return shown
        ends = (row[f"{name}_low"], row[f"{name}_high"])
        low, high = (_number(end) if plain else f"{100 * end:.1f}" for end in ends)
        return f"{shown} [{low}, {high}]"


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.3g}"


def _bounded(name: str, one: Interval) -> Row:
    found = {name: one.value, f"{name}_low": one.low, f"{name}_high": one.high}
    return {key: None if value is None else round(value, 5) for key, value in found.items()}


def tables_of(lab: Lab) -> list[Table]:
    """All that are wanted, and what they say of orders."""
    found = [_BUILDERS[name](lab) for name in lab.tables]
    orders = [row for name in lab.tables for row in _ORDERS.get(name, lambda lab: [])(lab)]
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


def _overall(lab: Lab, answers: Answers) -> Row:
    found = {"pictures": len(answers.right), **_bounded("overall", answers.overall(lab.drawing))}
    if lab.classes == CLASSES:
        sizes = [counts[0] for counts in figures()["sizes"].values()]
        found |= _bounded("at_paper_sizes", answers.overall(lab.drawing, sizes))
    return found


def _with_classes(lab: Lab, answers: Answers) -> Row:
    own = zip(lab.classes, answers.by_class(len(lab.classes)), strict=True)
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


def _attacked(lab: Lab, eyes: Eyes, strategy: str) -> Answers:
    """What a network made of the test pictures, under a strategy or as they are."""
    if strategy == BENIGN:
        return lab.answers("test", eyes, lab.strategies[0], lab.done, before=True)
    return lab.answers("test", eyes, strategy, lab.done)


def _degradation(lab: Lab) -> Table:
    rows = []
    for eyes, strategy in product(lab.eyes, (BENIGN, *STRATEGIES)):
        row = {"network": eyes.name, "strategy": strategy, **_with_classes(lab, _attacked(lab, eyes, strategy))}
        rows.append(row | {"certain": None if strategy == BENIGN else lab.certain(eyes, strategy)})
    reference = [row | _by_class(values) for row, values in _paper("degradation", "strategy")]
    columns = ("network", "strategy", *lab.classes, "overall", "at_paper_sizes", "certain")
    return Table("degradation", "Accuracy by class and strategy, %", columns, rows, reference)


def _moved(lab: Lab, eyes: Eyes, strategy: str, params: str) -> Answers:
    return lab.answers("test" if params == _BOTH else params, eyes, strategy, lab.done)


def _parameters(lab: Lab) -> Table:
    moved = (*SINGLE[:3], _BOTH, SINGLE[3])
    rows = [
        {"network": eyes.name, "strategy": one, "params": what, **_overall(lab, _moved(lab, eyes, one, what))}
        for eyes, one, what in product(lab.deep, GRADIENT, moved)
    ]
    reference = [
        row | {"params": params, "overall": value}
        for row, values in _paper("parameters", "strategy")
        for params, value in zip(_COMPARED, values, strict=True)
    ]
    note = "The paper says that light does not matter, without figures."
    columns = ("network", "strategy", "params", "overall", "at_paper_sizes")
    return Table("parameters", "Accuracy by what is moved, %", columns, rows, reference, (note,))


def _hyperparameters(lab: Lab) -> Table:
    rows, reference = [], []
    for network, strategy in product(NETWORKS, GRADIENT):
        settings = {"strategy": strategy, "settings": NETWORKS[network]}
        settings |= {key: preset(network, strategy).get(key) for key in _SETTINGS}
        for eyes in lab.deep:
            answers = lab.answers("test" if network == eyes.theirs else network, eyes, strategy, lab.done)
            rows.append({"network": eyes.name, **settings, **_overall(lab, answers)})
        value = figures()["degradation"][network][strategy][-1]
        reference.append({"network": NETWORKS[network], **settings, "overall": value})
    columns = ("network", "strategy", "settings", *_SETTINGS, "overall")
    return Table("hyperparameters", "Accuracy by settings, %", columns, rows, reference)


_Tried = Callable[[Lab, Eyes, str], Mapping[str, Answers]]
"""A network that was trained so, on each of TESTS."""


def _on_tests(lab: Lab, network: str, train: str, found: Mapping[str, Answers]) -> Row:
    row: Row = {"network": network, "trained_on": train}
    for test, answers in found.items():
        row |= _bounded(test, answers.overall(lab.drawing))
    return row | {"pictures": len(found[BENIGN].right)}


def _paper_on_tests(table: str) -> list[Row]:
    return [row | dict(zip(TESTS, values, strict=True)) for row, values in _paper(table, "trained_on")]


def _known(lab: Lab, eyes: Eyes, trained: str) -> dict[str, Answers]:
    """A network, as it was or retrained, on the pictures that were made against it as it was."""
    network, labels = lab.taught[eyes.name, trained], lab.labels(lab.done)
    return {test: lab.judged(right(network, lab.features(eyes, test, eyes), labels), lab.done) for test in TESTS}


def _fresh(lab: Lab, eyes: Eyes, trained: str) -> dict[str, Answers]:
    """A network on few pictures that are made against itself."""
    few = [one for one in lab.few if one.identifier not in lab.failed]
    kind = "test" if trained == BENIGN else f"against {trained}"
    found = {BENIGN: lab.answers(kind, eyes, GRADIENT[0], few, before=True)}
    return found | {test: lab.answers(kind, eyes, test, few) for test in GRADIENT}


def _learners(lab: Lab, table: str, title: str, trained: Sequence[str], tried: _Tried) -> Table:
    rows = [
        _on_tests(lab, eyes.name, one, tried(lab, eyes, one))
        for eyes, one in product(lab.deep, (BENIGN, *trained))
    ]
    return Table(table, title, ("network", "trained_on", *TESTS, "pictures"), rows, _paper_on_tests(table))


def _retraining(lab: Lab) -> Table:
    title = "Retrained networks on pictures made against the benign one, %"
    return _learners(lab, "retraining", title, (ONWARD, *GRADIENT), _known)


def _robustness(lab: Lab) -> Table:
    return _learners(
        lab, "robustness", "Retrained networks on pictures made against themselves, %", GRADIENT, _fresh
    )


def _points(lab: Lab, network: Classifier, features: Tensor, rho: Floats) -> Points:
    """Test pictures by their features; what is drawn together are an object's."""
    answers = lab.judged([True] * len(features), lab.done)
    found = classified(chances(network, features).numpy(), answers.label, rho)
    return replace(found, unit=answers.unit)


def _worth(lab: Lab) -> Table:
    rows: list[Row] = []
    distance = next(name for name in PREFERRED if missing(name, None) is None)
    for eyes in lab.eyes:
        far = {one: lab.apart(eyes, one).pairs[distance] for one in STRATEGIES}
        largest = max(float(distances.max(initial=0)) for distances in far.values())
        for strategy, weighted, kind in product((BENIGN, *STRATEGIES), (False, True), MEMBERSHIPS):
            rho = np.ones(len(lab.done)) if strategy == BENIGN else realism(far[strategy], largest)
            features = lab.features(eyes, strategy, eyes)
            setting = Setting(kind, weighted, draws=lab.drawing.draws, seed=lab.drawing.seed)
            row: Row = {"network": eyes.name, "strategy": strategy, "membership": kind, "weighted": weighted}
            before = _points(lab, eyes.network, features, rho)
            row |= _bounded("worth", worth_of(before, setting))
            if strategy in GRADIENT and (eyes.name, strategy) in lab.taught:
                after = _points(lab, lab.taught[eyes.name, strategy], features, rho)
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
    return Table("worth", "Information worth", columns, rows, reference, (note,))


def _realism(lab: Lab) -> Table:
    labels, rows = np.array(lab.labels(lab.done)), []
    for eyes, strategy in product(lab.eyes, STRATEGIES):
        far, counted = lab.apart(eyes, strategy), _attacked(lab, eyes, BENIGN).right
        for metric in lab.measures:
            name = f"{METRICS[metric].name}{', dB' if METRICS[metric].unit else ''}"
            kept = {one: counted & (labels == place) for place, one in enumerate(lab.classes)}
            values = {one: _rounded(far.mean(metric, which)) for one, which in kept.items()}
            rows.append(
                {"network": eyes.name, "strategy": strategy, "metric": name, **values}
                | {"overall": _rounded(far.mean(metric, counted))}
            )
    reference = [
        row | {"metric": row["metric"].upper(), **_by_class(values)}
        for row, values in _paper("realism", "metric", "strategy")
    ]
    absent = [METRICS[name].name for name in METRICS if name not in lab.measures]
    note = (
        "Pictures that were right before, and what became of them. A Frechet distance of few pictures ranks, and "
        "does not compare with the paper's. "
        + (f"Without weights on disk: {', '.join(absent)}." if absent else "")
    )
    columns = ("network", "strategy", "metric", *lab.classes, "overall")
    return Table("realism", "Distances to the pictures before", columns, rows, reference, (note,), plain=True)


def _transfer(lab: Lab) -> Table:
    labels, rows = lab.labels(lab.done), []
    for source, target in product(lab.eyes, lab.eyes):
        for strategy in (BENIGN, *GRADIENT) if source is not target else ():
            said = right(target.network, lab.features(source, strategy, target), labels)
            row = {"source": source.name, "target": target.name, "strategy": strategy}
            rows.append(row | _with_classes(lab, lab.judged(said, lab.done)))
    other = dict(zip(NETWORKS.values(), reversed(NETWORKS.values()), strict=True))
    reference = [
        row | {"source": row["network"], "target": other[row["network"]], **_by_class(values)}
        for row, values in _paper("transfer", "strategy")
    ]
    note = () if rows else ("Two networks are needed: --networks squeezenet,FILE.",)
    columns = ("source", "target", "strategy", *lab.classes, "overall", "at_paper_sizes")
    return Table("transfer", "Accuracy on another network's counterexamples, %", columns, rows, reference, note)


def _pixels(lab: Lab) -> Table:
    rows: list[Row] = []
    for eyes in lab.deep if pixels.available() else ():
        found = lab.pixels(eyes)
        for attack in pixels.ATTACKS:
            answers = lab.judged(found[attack].tolist(), lab.done)
            far = {"distance": round(float(found[f"{attack} apart"].mean()), 5)}
            rows.append({"network": eyes.name, "strategy": attack, **_overall(lab, answers), **far})
    note = f"Distance: {METRICS['perceptual'].name}, as in the table of realism."
    notes = (note,) if rows else (f"Attacks on pixels need another library: {pixels.NEEDS}.",)
    columns = ("network", "strategy", "pictures", "overall", "distance")
    return Table("pixels", "Accuracy after attacks on pixels, for comparison, %", columns, rows, (), notes)


def _sizes(lab: Lab) -> Table:
    names = {split: [one.partition("/")[0] for one in lab.objects.names(split)] for split in SPLITS}
    used = {split: [one.name.partition("/")[0] for one in getattr(lab, split)] for split in ("test", "train")}
    rows = [
        {"class": one, **{f"{split} objects": names[split].count(one) for split in SPLITS}}
        | {f"{split} pictures": used[split].count(one) for split in used}
        for one in lab.classes
    ]
    reference = [
        {"class": f"{one} (paper)"}
        | {f"{split} objects": n for split, n in zip(("test", "train", "val"), counts, strict=True)}
        for one, counts in figures()["sizes"].items()
    ]
    columns = ("class", *(f"{split} objects" for split in SPLITS), "train pictures", "test pictures")
    return Table("sizes", "Sizes", columns, rows, reference, plain=True)


def _order(
    lab: Lab, table: str, eyes: Eyes, theirs: Mapping[str, float], ours: Mapping[str, Answers]
) -> Iterator[Row]:
    """Each two of the paper's figures that differ, and whether ours differ alike, paired over pictures."""
    for first, second in combinations(theirs, 2):
        apart = theirs[second] - theirs[first]
        if apart:
            one = ours[first].below(ours[second], lab.drawing)
            row: Row = {"network": eyes.name, "table": table, "first": first, "second": second}
            yield row | {"paper": round(apart, 4), **_bounded("ours", one), "verdict": verdict(apart, one)}


def _strategies_in_order(lab: Lab) -> list[Row]:
    rows: list[Row] = []
    for eyes in lab.eyes:
        theirs = {one: figures()["degradation"][eyes.theirs][one][-1] for one in STRATEGIES}
        rows += _order(lab, "degradation", eyes, theirs, {one: _attacked(lab, eyes, one) for one in STRATEGIES})
    return rows


def _parameters_in_order(lab: Lab) -> list[Row]:
    rows: list[Row] = []
    for eyes, strategy in product(lab.deep, GRADIENT):
        theirs: dict[str, float] = dict(zip(_COMPARED, figures()["parameters"]["vgg16"][strategy], strict=True))
        ours = {one: _moved(lab, eyes, strategy, one) for one in _COMPARED}
        rows += _order(lab, f"parameters, {NAMES[strategy]}", eyes, theirs, ours)
    return rows


def _learners_in_order(lab: Lab, table: str, tried: _Tried) -> list[Row]:
    """For each test: is a retrained network better than the benign one?"""
    rows: list[Row] = []
    for eyes in lab.deep:
        found = {trained: tried(lab, eyes, trained) for trained in (BENIGN, *GRADIENT)}
        for i, test in enumerate(TESTS):
            theirs = {trained: figures()[table][eyes.theirs][trained][i] for trained in found}
            ours = {trained: one[test] for trained, one in found.items()}
            pairs = _order(lab, f"{table}, on {NAMES[test]}", eyes, theirs, ours)
            rows += [row for row in pairs if row["first"] == BENIGN]
    return rows


_BUILDERS: dict[str, Callable[[Lab], Table]] = {
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
_ORDERS: dict[str, Callable[[Lab], list[Row]]] = {
    "degradation": _strategies_in_order,
    "parameters": _parameters_in_order,
    "retraining": lambda lab: _learners_in_order(lab, "retraining", _known),
    "robustness": lambda lab: _learners_in_order(lab, "robustness", _fresh),
}


def flat(rows: Sequence[Row]) -> list[Row]:
    """Rows of the same columns, for a CSV file."""
    columns = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name) for name in columns} for row in rows]


def remarks(table: Table) -> tuple[str, ...]:
    """What is to be said below a table: ours, and the paper's own errors."""
    return (*table.notes, *REMARKS.get(table.name, ()))
