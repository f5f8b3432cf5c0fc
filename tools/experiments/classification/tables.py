"""The tables of the study: our rows, the paper's, and how they are printed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np

from drivesem.classify.objects.types import CLASSES, SPLITS
from drivesem.evaluation.resampling import Interval
from drivesem.reporting.tables import ReportTable
from tools.experiments.classification.arms import (
    BENIGN,
    BENIGN_RETRAINED,
    CONTROL,
    DIFFERENCES,
    GRADIENT_STRATEGIES,
    RETRAINED_TABLES,
    SINGLE_PARAMS,
    STRATEGIES,
    STRATEGY_NAMES,
    TRAINED,
    attributed_strategies,
    paper_preset,
)
from tools.experiments.classification.features import PIXEL_ATTACKS, PIXELS_HINT
from tools.experiments.classification.paper import NETWORKS, REMARKS, paper_tables
from tools.experiments.classification.results import OVERALL, ClassificationResults, Predictions, StudyNetwork
from tools.experiments.realism.metrics import METRICS
from tools.experiments.tables import interval_columns
from tools.experiments.worth.measures import MEMBERSHIPS, WorthSettings, information_gain, realism, worth_interval

Row = dict[str, Any]
TESTS = (BENIGN, *GRADIENT_STRATEGIES)
"""Pictures that retrained networks are tested on, by columns."""
ORDERS = "orders"
_BOTH = "pose,vertex"
_COMPARED = ("vertex", "pose", _BOTH)
"""Parameter sets of the paper's table."""
_HEADS = {
    "trained_on": "trained on",
    "params": "parameters",
    "at_paper_sizes": "at the paper's class sizes",
    "weighted": "realism weight",
    "source": "made against",
    "target": "tested on",
    "verdict": "the paper's order",
    "ours": "first less than second, ours",
    "paper": "in the paper",
    "step_vertex": "step vertex",
    "step_pose": "step pose",
    "within_vertex": "within vertex",
    "within_pose": "within pose",
    "as_text": "text",
    "as_code": "code",
}
_SETTINGS = ("step_vertex", "step_pose", "within_vertex", "within_pose", "steps")
_PLAIN = ("pictures", "certain", "worth", "gain", "distance", *_SETTINGS)
"""Columns of numbers that are not shares."""


@dataclass(frozen=True)
class ResultTable:
    """One table of the study."""

    name: str
    """Name of its CSV file."""
    title: str
    """Title."""
    columns: tuple[str, ...]
    """Columns to print, in order."""
    rows: Sequence[Row]
    """Our rows."""
    reference: Sequence[Row]
    """The paper's rows, with the same columns."""
    notes: tuple[str, ...] = ()
    """Notes, among them the paper's own errors."""
    orders: Sequence[Row] = ()
    """Whether orders of two of the paper's numbers hold here."""
    plain: bool = False
    """Whether no number is a share."""

    def report_table(self, classes: bool = True) -> ReportTable:
        """The table to print, with or without a column for each class."""
        columns = [name for name in self.columns if classes or name not in CLASSES]
        lines = [tuple(self._cell(row, name) for name in columns) for row in (*self.rows, *self.reference)]
        return ReportTable(
            self.title, tuple(_HEADS.get(name, STRATEGY_NAMES.get(name, name)) for name in columns), tuple(lines)
        )

    def _cell(self, row: Row, name: str) -> str:
        value = row.get(name)
        if value is None:
            return "-"
        if isinstance(value, bool):
            return "yes" if value else "no"
        if isinstance(value, str):
            return STRATEGY_NAMES.get(value, value)

        def number(one: float) -> str:
            if not (self.plain or name in _PLAIN):
                return f"{100 * one:.1f}"
            return str(one) if isinstance(one, int) else f"{one:.3g}"

        low, high = row.get(f"{name}_low"), row.get(f"{name}_high")
        ends = "" if low is None or high is None else f" [{number(low)}, {number(high)}]"
        return number(value) + ends


def build_tables(results: ClassificationResults) -> list[ResultTable]:
    """The tables of the study, and whether the paper's orders hold."""
    found = [_BUILDERS[name](results) for name in results.facts.tables]
    orders = [row for table in found for row in table.orders]
    if orders:
        held, reversed_ = (sum(row["verdict"] == one for row in orders) for one in ("holds", "reversed"))
        note = (
            f"Of {len(orders)} orders of two of the paper's numbers, {held} hold here, {reversed_} are reversed, and "
            f"{len(orders) - held - reversed_} are undecided."
        )
        columns = ("network", "table", "first", "second", "paper", "ours", "verdict")
        found.append(ResultTable(ORDERS, "Does the paper's order hold?", columns, orders, (), (note,)))
    return found


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 5)


def _overall(results: ClassificationResults, answers: Predictions) -> Row:
    found = {
        "pictures": len(answers.correct),
        **interval_columns("overall", answers.overall(results.bootstrap), 5),
    }
    if results.facts.classes == CLASSES:
        sizes = [counts[0] for counts in paper_tables()["sizes"].values()]
        found |= interval_columns("at_paper_sizes", answers.overall(results.bootstrap, sizes), 5)
    return found


def _with_classes(results: ClassificationResults, answers: Predictions) -> Row:
    own = zip(results.facts.classes, answers.by_class(len(results.facts.classes)), strict=True)
    return _overall(results, answers) | {name: _rounded(share) for name, share in own}


def _paper(table: str, *names: str) -> Iterator[tuple[Row, Any]]:
    """The numbers of one of the paper's tables, or lists of them, each with its network and what `names` are."""

    def walk(node: Any, keys: tuple[str, ...]) -> Iterator[tuple[Row, Any]]:
        if isinstance(node, dict):
            for key, below in node.items():
                yield from walk(below, (*keys, key))
        else:
            yield {"network": NETWORKS[keys[0]], **dict(zip(names, keys[1:], strict=True))}, node

    return walk(paper_tables()[table], ())


def _by_class(values: Sequence[float]) -> Row:
    return dict(zip((*CLASSES, "overall"), values, strict=False))


def _degradation(results: ClassificationResults) -> ResultTable:
    rows: list[Row] = []
    orders: list[Row] = []
    for network in results.facts.networks:
        ours = {one: results.predictions("attacked", network, one) for one in (BENIGN, *STRATEGIES)}
        for one, answers in ours.items():
            row = {"network": network.name, "strategy": one, **_with_classes(results, answers)}
            rows.append(row | {"certain": None if one == BENIGN else results.count_certain(network, one)})
        paper = {one: paper_tables()["degradation"][network.paper_network][one][-1] for one in STRATEGIES}
        orders += _order(results, "degradation", network, paper, ours)
    reference = [row | _by_class(values) for row, values in _paper("degradation", "strategy")]
    columns = ("network", "strategy", *results.facts.classes, "overall", "at_paper_sizes", "certain")
    title, notes = "Accuracy by class and strategy, %", REMARKS["degradation"]
    return ResultTable("degradation", title, columns, rows, reference, notes, orders)


def _parameters(results: ClassificationResults) -> ResultTable:
    rows: list[Row] = []
    orders: list[Row] = []
    moved = (*SINGLE_PARAMS[:3], _BOTH, SINGLE_PARAMS[3])
    for network, strategy in product(results.facts.networks, GRADIENT_STRATEGIES):
        ours = {
            one: results.predictions("attacked", network, strategy, "test" if one == _BOTH else one)
            for one in moved
        }
        row = {"network": network.name, "strategy": strategy}
        rows += [row | {"params": params, **_overall(results, one)} for params, one in ours.items()]
        paper: dict[str, float] = dict(
            zip(_COMPARED, paper_tables()["parameters"]["vgg16"][strategy], strict=True)
        )
        orders += _order(results, f"parameters, {STRATEGY_NAMES[strategy]}", network, paper, ours)
    reference = [
        row | {"params": params, "overall": value}
        for row, values in _paper("parameters", "strategy")
        for params, value in zip(_COMPARED, values, strict=True)
    ]
    note = "The paper states that light does not matter, without numbers."
    columns = ("network", "strategy", "params", "overall", "at_paper_sizes")
    return ResultTable("parameters", "Accuracy by what is moved, %", columns, rows, reference, (note,), orders)


def _hyperparameters(results: ClassificationResults) -> ResultTable:
    rows, reference = [], []
    for paper_network, strategy in product(NETWORKS, GRADIENT_STRATEGIES):
        settings = {"strategy": strategy, "settings": NETWORKS[paper_network]}
        settings |= {key: paper_preset(paper_network, strategy).get(key) for key in _SETTINGS}
        for network in results.facts.networks:
            arms = "test" if paper_network == network.paper_network else paper_network
            answers = results.predictions("attacked", network, strategy, arms)
            rows.append({"network": network.name, **settings, **_overall(results, answers)})
        value = paper_tables()["degradation"][paper_network][strategy][-1]
        reference.append({"network": NETWORKS[paper_network], **settings, "overall": value})
    columns = ("network", "strategy", "settings", *_SETTINGS, "overall")
    notes = REMARKS["hyperparameters"]
    return ResultTable("hyperparameters", "Accuracy by settings, %", columns, rows, reference, notes)


def _learners(
    results: ClassificationResults, table: str, title: str, trained: Sequence[str], what: str
) -> ResultTable:
    """Networks that were trained so, on each of TESTS; `what` as in `ClassificationResults.predictions`."""
    rows: list[Row] = []
    orders: list[Row] = []
    for network in results.facts.networks:
        for one in (BENIGN, *trained):
            row: Row = {"network": network.name, "trained_on": one}
            for test in TESTS:
                row |= interval_columns(
                    test, results.predictions(what, network, test, one).overall(results.bootstrap), 5
                )
            rows.append(row | {"pictures": len(results.predictions(what, network, BENIGN, one).correct)})
        for i, test in enumerate(TESTS):
            paper = {
                one: paper_tables()[table][network.paper_network][one][i] for one in (BENIGN, *GRADIENT_STRATEGIES)
            }
            ours = {one: results.predictions(what, network, test, one) for one in paper}
            pairs = _order(results, f"{table}, on {STRATEGY_NAMES[test]}", network, paper, ours)
            # Is a retrained network better than the benign one?
            orders += [pair for pair in pairs if pair["first"] == BENIGN]
    reference = [row | dict(zip(TESTS, values, strict=True)) for row, values in _paper(table, "trained_on")]
    columns = ("network", "trained_on", *TESTS, "pictures")
    return ResultTable(table, title, columns, rows, reference, REMARKS.get(table, ()), orders)


def _retraining(results: ClassificationResults) -> ResultTable:
    title = "Retrained networks on pictures made against the benign one, %"
    return _learners(results, "retraining", title, (BENIGN_RETRAINED, *GRADIENT_STRATEGIES), "known")


def _robustness(results: ClassificationResults) -> ResultTable:
    title = "Retrained networks on pictures made against themselves, %"
    return _learners(results, "robustness", title, GRADIENT_STRATEGIES, "fresh")


def _is_retrained(results: ClassificationResults, strategy: str) -> bool:
    """Whether the network was retrained on this attack's counterexamples."""
    made = any(name in results.facts.tables for name in RETRAINED_TABLES)
    return strategy in GRADIENT_STRATEGIES and made


def _class_means(values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Mean of each picture's class (N,)."""
    return (np.bincount(labels, values) / np.maximum(np.bincount(labels), 1))[labels]


def _worth(results: ClassificationResults) -> ResultTable:
    rows: list[Row] = []
    distance = results.facts.distance
    for network in results.facts.networks:
        by_picture = {one: results.picture_distances(network, one, distance) for one in STRATEGIES}
        by_class = {one: _class_means(values, results.labels) for one, values in by_picture.items()}
        distances = {"no": by_picture, "picture": by_picture, "class": by_class}
        for strategy, weighted, kind in product((BENIGN, *STRATEGIES), distances, MEMBERSHIPS):
            far = distances[weighted]
            largest = max(float(values.max(initial=0)) for values in far.values())
            rho = np.ones(len(results.labels)) if strategy == BENIGN else realism(far[strategy], largest)
            setting = WorthSettings(kind, weighted != "no")
            row: Row = {"network": network.name, "strategy": strategy, "membership": kind, "weighted": weighted}
            before = results.points(network, strategy, rho)
            row |= interval_columns("worth", worth_interval(before, setting), 5)
            if _is_retrained(results, strategy):
                after = results.points(network, strategy, rho, trained=strategy)
                row |= interval_columns("gain", information_gain(before, after, setting), 5)
            rows.append(row)
    reference = [
        row | {"weighted": "picture", "worth": value} for row, value in _paper("worth", "membership", "strategy")
    ]
    note = (
        f"Natural logarithm. Realism by {METRICS[distance].name}, of the picture or the mean of its class, "
        "relative to the largest one of a network's counterexamples. Gain: the worth under the network less that under "
        "the one retrained on such pictures."
    )
    columns = ("network", "strategy", "membership", "weighted", "worth", "gain")
    return ResultTable("worth", "Information worth", columns, rows, reference, (note, *REMARKS["worth"]))


def _realism(results: ClassificationResults) -> ResultTable:
    rows = []
    for network, strategy, metric in product(results.facts.networks, STRATEGIES, results.facts.measures):
        name = f"{METRICS[metric].name}{', dB' if METRICS[metric].unit else ''}"
        row: Row = {"network": network.name, "strategy": strategy, "metric": name}
        kinds = (*results.facts.classes, OVERALL)
        rows.append(
            row | {kind: _rounded(results.mean_distance(network, strategy, metric, kind)) for kind in kinds}
        )
    reference = [
        row | {"metric": row["metric"].upper(), **_by_class(values)}
        for row, values in _paper("realism", "metric", "strategy")
    ]
    absent = [METRICS[name].name for name in METRICS if name not in results.facts.measures]
    note = (
        "Of pictures that were correct before the attack. A Frechet distance of few pictures ranks, and is not "
        "comparable with the paper's. " + (f"Without weights on disk: {', '.join(absent)}." if absent else "")
    )
    columns = ("network", "strategy", "metric", *results.facts.classes, "overall")
    return ResultTable(
        "realism", "Distances to the pictures before", columns, rows, reference, (note,), plain=True
    )


def _transfer(results: ClassificationResults) -> ResultTable:
    rows = []
    for source, target in product(results.facts.networks, results.facts.networks):
        crossed = source is not target and source.reading == target.reading
        for strategy in (BENIGN, *GRADIENT_STRATEGIES) if crossed else ():
            row = {"source": source.name, "target": target.name, "strategy": strategy}
            rows.append(
                row | _with_classes(results, results.predictions("crossed", source, strategy, target.name))
            )
    other = dict(zip(NETWORKS.values(), reversed(NETWORKS.values()), strict=True))
    reference = [
        row | {"source": row["network"], "target": other[row["network"]], **_by_class(values)}
        for row, values in _paper("transfer", "strategy")
    ]
    note = () if rows else ("This table needs two networks: --networks squeezenet,FILE.",)
    columns = ("source", "target", "strategy", *results.facts.classes, "overall", "at_paper_sizes")
    return ResultTable(
        "transfer", "Accuracy on another network's counterexamples, %", columns, rows, reference, note
    )


def _pixels(results: ClassificationResults) -> ResultTable:
    rows: list[Row] = []
    for network, attack in product(results.facts.networks if results.facts.toolbox else (), PIXEL_ATTACKS):
        row: Row = {"network": network.name, "strategy": attack}
        row |= _overall(results, results.predictions("pixels", network, attack, ""))
        rows.append(
            row | {"distance": round(float(results.picture_distances(network, attack, "", "pixels").mean()), 5)}
        )
    note = f"Distance: {METRICS['perceptual'].name}, as in the table of realism."
    notes = (note,) if rows else (f"Attacks on pixels need a library: {PIXELS_HINT}.",)
    columns = ("network", "strategy", "pictures", "overall", "distance")
    return ResultTable("pixels", "Accuracy after attacks on pixels, for comparison, %", columns, rows, (), notes)


def _attribution(results: ClassificationResults) -> ResultTable:
    rows = []
    counts = results.facts.counts
    whole = counts.get("whole", 0)
    for network, difference in product(results.facts.networks, DIFFERENCES):
        measured = {"normalisation": network.takes_normalisation}
        measured["training"] = network.takes_normalisation and whole > 0
        if network.reading != "text" or not measured.get(difference, True):
            continue
        for strategy in attributed_strategies(difference, results.facts.settings.quick):
            arms = (f"with {CONTROL}" if difference in TRAINED else "test", f"with {difference}")
            before, after = (results.predictions("attacked", network, strategy, arm) for arm in arms)
            row: Row = {"network": network.name, "difference": difference, "strategy": strategy}
            row |= {"pictures": len(before.correct)}
            for name, one in (("as_text", before), ("as_code", after)):
                row[name] = _rounded(one.overall(results.bootstrap).value)
            rows.append(row | interval_columns("effect", before.accuracy_drop(after, results.bootstrap), 5))
    note = (
        "Accuracy after the attack with one setting of the paper's code, and its paired difference from the text's. "
        f"Networks for {', '.join(TRAINED)} are trained further on {whole or counts['train']} pictures, and so is the "
        "last layer of the network without the difference."
    )
    columns = ("network", "difference", "strategy", "pictures", "as_text", "as_code", "effect")
    title = "What each difference between the paper's text and code changes, points of accuracy"
    return ResultTable("attribution", title, columns, rows, (), (note,))


def _sizes(results: ClassificationResults) -> ResultTable:
    objects, used = results.facts.objects, results.facts.used
    rows = [
        {"class": one, **{f"{split} objects": objects[split][one] for split in SPLITS}}
        | {f"{split} pictures": used[split][one] for split in used}
        for one in results.facts.classes
    ]
    reference = [
        {"class": f"{one} (paper)"}
        | {f"{split} objects": n for split, n in zip(("test", "train", "val"), counts, strict=True)}
        for one, counts in paper_tables()["sizes"].items()
    ]
    columns = ("class", *(f"{split} objects" for split in SPLITS), "train pictures", "test pictures")
    return ResultTable("sizes", "Sizes", columns, rows, reference, plain=True)


def _order(
    results: ClassificationResults,
    table: str,
    network: StudyNetwork,
    paper: Mapping[str, float],
    ours: Mapping[str, Predictions],
) -> Iterator[Row]:
    """Each two of the paper's numbers that differ, and whether ours differ in the same direction; paired."""
    for first, second in combinations(paper, 2):
        difference = paper[second] - paper[first]
        if difference:
            one = ours[first].accuracy_drop(ours[second], results.bootstrap)
            row: Row = {"network": network.name, "table": table, "first": first, "second": second}
            yield row | {
                "paper": round(difference, 4),
                **interval_columns("ours", one, 5),
                "verdict": _judge_order(difference, one),
            }


_BUILDERS: dict[str, Callable[[ClassificationResults], ResultTable]] = {
    "degradation": _degradation,
    "worth": _worth,
    "realism": _realism,
    "parameters": _parameters,
    "retraining": _retraining,
    "robustness": _robustness,
    "transfer": _transfer,
    "attribution": _attribution,
    "hyperparameters": _hyperparameters,
    "pixels": _pixels,
    "sizes": _sizes,
}


def _judge_order(paper: float, ours: Interval) -> str:
    """Whether two numbers are ordered as in the paper; undecided if our interval contains 0.

    Both arguments state how much lower the first number is than the second.
    """
    if ours.value is None or ours.low is None or ours.high is None or ours.low <= 0 <= ours.high:
        return "undecided"
    return "holds" if math.copysign(1, paper) == math.copysign(1, ours.value) else "reversed"
