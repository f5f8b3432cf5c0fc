"""The study of image classifiers: the paper's experiments on them, with the paper's numbers for comparison."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from drivesem.analysis.transfer import split_list
from drivesem.attacks.methods.base import GRADIENT_PASSES
from drivesem.classify.networks.architectures import RENDERED_MEAN, RENDERED_STD, Classifier
from drivesem.classify.networks.loading import load_classifier, prepare_for_inference, save_classifier
from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.types import SPLITS, ObjectSet, Split
from drivesem.classify.pictures import ObjectRenderer, ObjectView, picture_path, read_images, render_pictures
from drivesem.classify.results import write_run_report
from drivesem.classify.scenes import VIEWS, open_backgrounds
from drivesem.classify.space import Lamp
from drivesem.classify.training import compute_features, train_all_layers, train_last_layer
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.reporting.tables import AnalysisReport, Console
from drivesem.run.folder import ARMS, FRAMES, PRESENTATION, RETRAINED, claim_folder, resolve_output_folder
from scene_ir import files
from scene_ir.errors import RangeError
from tools.experiments.classification.arms import (
    BENIGN,
    BENIGN_RETRAINED,
    CONTROL,
    DIFFERENCES,
    GRADIENT_STRATEGIES,
    READINGS,
    RETRAINED_TABLES,
    SINGLE_PARAMS,
    STRATEGIES,
    TRAINED,
    ClassificationArm,
    arm_config,
    attack_settings,
    attributed_strategies,
    code_settings,
    run_classification_arms,
)
from tools.experiments.classification.features import (
    FEATURES,
    NetworkFeatures,
    attack_pixels,
    has_pixel_attacks,
    load_or_compute,
    measure_distances,
    set_distance,
)
from tools.experiments.classification.paper import NETWORKS
from tools.experiments.classification.results import (
    ClassificationResults,
    Floats,
    StudyFacts,
    StudyNetwork,
    load_results,
    sample_stratified,
    save_results,
)
from tools.experiments.classification.tables import ORDERS, build_tables
from tools.experiments.realism.metrics import load_metrics, why_missing
from tools.experiments.realism.report import AVAILABLE, choose_metrics
from tools.experiments.settings import StudyConfig
from tools.experiments.tables import RESULTS, study_command
from tools.experiments.worth.points import PREFERRED_DISTANCES

PICTURES = "pictures"
"""Folder of the pictures to train on."""
EPOCHS = 20
_MOST_PASSES = 1 + 5 * (GRADIENT_PASSES + 1)
"""Passes of the network in an attack of five steps that does not stop early."""
_TABLE_STRATEGIES: dict[str, Collection[str]] = {
    "degradation": STRATEGIES,
    "worth": STRATEGIES,
    "realism": STRATEGIES,
    **dict.fromkeys(
        ("parameters", "hyperparameters", "retraining", "robustness", "transfer"), GRADIENT_STRATEGIES
    ),
    "attribution": (),
    "pixels": GRADIENT_STRATEGIES[:1],
    "sizes": (),
}
TABLES = tuple(_TABLE_STRATEGIES)
_LONG_TABLES = ("parameters", "hyperparameters", "pixels")
"""Tables that --quick leaves out by default."""
_SIZES = {"limit": (480, 12), "fresh": (232, 3), "train_pictures": (960, 12), "whole_pictures": (240, 0)}
"""Number of pictures by default and with --quick."""


_WRITTEN = (
    *("study.md", "study.json", *(f"{name}.csv" for name in (*TABLES, ORDERS))),
    *(ARMS, RESULTS, FEATURES, RETRAINED, PICTURES),
)
_FREE_SETTINGS = (*PRESENTATION, "bootstrap", "tables", "readings", "networks", "fresh")
"""Settings that may differ when a study is continued: they add attacks, and change none."""
_TEXT_COLUMNS = (
    *("network", "strategy", "trained on", "parameters", "settings", "made against", "tested on", "class"),
    *("membership", "realism weight", "metric", "table", "first", "second", "the paper's order"),
    "difference",
)
_NOTE = (
    "Overall: mean over classes weighted by their sizes, which is the share of all pictures; in brackets 95 % of "
    "{draws} bootstrap draws of objects. A picture that is misclassified unchanged counts as wrong before and after, "
    "except with networks named -code, which are trained and attacked by configs/paper-code.yaml (with "
    "--whole-pictures 0 their last layer is trained). "
    "The paper's numbers are for ShapeNet's objects, photographs and another renderer: a comparison, not a target."
)


@dataclass
class ClassificationStudy:
    """A study at work: its networks, pictures, attacks and retrained networks."""

    study: StudyConfig
    """Settings, with all numbers of pictures filled in."""
    out: Path
    """Folder of the study."""
    objects: ObjectSet
    """Objects to draw."""
    networks: tuple[NetworkFeatures, ...]
    """The networks."""
    tables: tuple[str, ...]
    """Tables to make."""
    test: tuple[ObjectView, ...]
    """Pictures to test on."""
    train: tuple[ObjectView, ...]
    """Pictures to train on."""
    arms: dict[tuple[str, str, str], ClassificationArm] = field(
        default_factory=dict[tuple[str, str, str], ClassificationArm]
    )
    """Attacks by purpose, network and strategy."""
    retrained: dict[tuple[str, str], Classifier] = field(default_factory=dict[tuple[str, str], Classifier])
    """Networks by name and by what they were trained on."""
    failed: dict[str, str] = field(default_factory=dict[str, str])
    """Reason by picture that could not be used."""

    @classmethod
    def from_config(cls, study: StudyConfig) -> ClassificationStudy:
        """Load objects and networks. Raises UsageError or SceneError for what cannot be used."""
        usual = tuple(name for name in TABLES if not (study.quick and name in _LONG_TABLES))
        tables = tuple(split_list(study.tables)) if study.tables is not None else usual
        readings = split_list(study.readings)
        if not readings or not set(readings) <= set(READINGS):
            raise UsageError("--readings", f"names among {', '.join(READINGS)}", repr(study.readings))
        if not tables or not set(tables) <= set(TABLES):
            raise UsageError("--tables", f"names among {', '.join(TABLES)}", repr(study.tables))
        typed = {name: getattr(study, name) for name in _SIZES}
        sizes = {name: _SIZES[name][study.quick] if size is None else size for name, size in typed.items()}
        out = resolve_output_folder(study.out, Path("runs") / f"study-classification-seed{study.seed}")
        objects = open_objects(study.objects)
        open_backgrounds(study.backgrounds)
        text = _load_networks(study, objects.classes, out)
        code = [_code_network(one) for one in text] if "code" in readings else []
        networks = (*(text if "text" in readings else ()), *code)
        test = _sample_views(objects, "test", sizes["limit"], study.seed)
        train = _sample_views(objects, "train", sizes["train_pictures"], study.seed)
        return cls(replace(study, **sizes), out, objects, networks, tables, test, train)

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of objects."""
        return self.objects.classes

    def wants(self, *names: str) -> bool:
        """Whether any of these tables is to be made."""
        return any(name in self.tables for name in names)

    @cached_property
    def usable(self) -> tuple[ObjectView, ...]:
        """Test pictures that could be used in all arms."""
        return tuple(one for one in self.test if one.identifier not in self.failed)

    @cached_property
    def retested(self) -> tuple[ObjectView, ...]:
        """Pictures on which retrained networks are attacked; classes keep their shares."""
        rng = np.random.default_rng(self.study.seed)
        places = sample_stratified(self.labels(self.usable), self.study.fresh or len(self.usable), rng)
        return tuple(self.usable[place] for place in places)

    @property
    def retested_places(self) -> tuple[int, ...]:
        """Indices among `usable` of those of `retested` that could be used."""
        return tuple(
            i for i, one in enumerate(self.usable) if one in self.retested and one.identifier not in self.failed
        )

    @cached_property
    def replaced(self) -> list[int]:
        """Indices of the training pictures that counterexamples replace."""
        return draw_half(len(self.train), self.study.seed)

    def labels(self, views: Sequence[ObjectView]) -> list[int]:
        """Class indices of pictures."""
        return [self.classes.index(one.name.partition("/")[0]) for one in views]

    def attack(self) -> None:
        """Attack the original networks. Raises UsageError or SceneError."""
        attributed = {one for name in DIFFERENCES for one in attributed_strategies(name, self.study.quick)}
        needed = {**_TABLE_STRATEGIES, "attribution": attributed}
        strategies = [one for one in STRATEGIES if any(one in needed[name] for name in self.tables)]
        for network, strategy in product(self.networks, strategies):
            settings, grade = self._settings(network, strategy), not self.study.quick
            self._add("test", network, strategy, self.test, strategy, **settings, grade=grade)
        for network, strategy in product(self.networks, GRADIENT_STRATEGIES):
            settings = self._settings(network, strategy)
            for params in SINGLE_PARAMS if self.wants("parameters") else ():
                name = f"{strategy}-{params.replace(',', '-')}"
                self._add(params, network, strategy, self.test, name, **{**settings, "params": params})
            for paper_network in {*NETWORKS} - {network.paper_network} if self.wants("hyperparameters") else ():
                name, preset = f"{strategy}-as-{paper_network}", self._settings(network, strategy, paper_network)
                self._add(paper_network, network, strategy, self.test, name, **preset)
            if self.wants(*RETRAINED_TABLES):
                views = [self.train[place] for place in self.replaced]
                self._add("train", network, strategy, views, f"{strategy}-train", **settings)
        variants = {one: {"code"} for one in self.networks if one.text is not None}
        if self.wants("attribution"):
            variants |= {one: self._add_differences(one) for one in self.networks if one.text is None}
        self._announce_hours(variants)
        for network, names in variants.items():
            for name in sorted(names):
                self._train_variant(network.text or network, name, Path(self._variant_path(network, name)))
        self.failed |= run_classification_arms(list(self.arms.values()), self.study, "attacking pictures")
        if not self.usable:
            raise UsageError(
                "--objects", "pictures that can be attacked", f"none: {next(iter(self.failed.values()))}"
            )
        for key, arm in self.arms.items():
            if key[0] == "test":
                seconds = sum(frame.seconds for frame in arm.frames(self.usable))
                write_run_report(arm.config, arm.out, self.classes, self.usable, {}, seconds)

    def _settings(self, network: NetworkFeatures, strategy: str, paper_network: str = "") -> dict[str, Any]:
        """Settings of an attack on a network, under its reading and with the steps for one of the paper's networks."""
        reading = code_settings() if network.reading == "code" else {}
        return attack_settings(paper_network or network.paper_network, strategy, reading)

    def _add_differences(self, network: NetworkFeatures) -> set[str]:
        """Add the arms of the table of attribution, and return the names of the networks to train for them."""
        measured = {"normalisation": network.takes_normalisation, "training": self._trains_whole(network)}
        names = [one for one in DIFFERENCES if measured.get(one, True)]
        for difference in (*names, CONTROL):
            settings = {} if difference == CONTROL else code_settings(difference)
            trained = difference in (*TRAINED, CONTROL)
            spec = self._variant_path(network, difference) if trained else network.spec
            for strategy in attributed_strategies(difference, self.study.quick):
                attack = attack_settings(network.paper_network, strategy, settings)
                name = f"{strategy}-with-{difference}"
                self._add(f"with {difference}", network, strategy, self.test, name, **attack, network=spec)
        return {CONTROL, *names} & {CONTROL, *TRAINED}

    def _trains_whole(self, network: NetworkFeatures) -> bool:
        return bool(self.study.whole_pictures) and network.takes_normalisation

    def _variant_path(self, network: NetworkFeatures, name: str) -> str:
        return network.spec if name == "code" else str(self._weights(network, f"with-{name}"))

    @cached_property
    def whole(self) -> tuple[ObjectView, ...]:
        """Training pictures for networks of the code, or all; classes keep their shares."""
        rng = np.random.default_rng(self.study.seed)
        size = self.study.whole_pictures or len(self.train)
        return tuple(self.train[place] for place in sample_stratified(self.labels(self.train), size, rng))

    def _render(self, views: Sequence[ObjectView], lamp: Lamp) -> list[Path]:
        """Paths of training pictures under a lamp, which are rendered where they are missing."""
        config = replace(arm_config(self.study, self.out, "", ""), lamp=lamp)
        folder = self.out / PICTURES / lamp
        self.failed |= render_pictures(views, ObjectRenderer.from_config(config), config, folder).failed
        return [picture_path(one, folder) for one in views if one.identifier not in self.failed]

    def _train_variant(self, network: NetworkFeatures, name: str, path: Path) -> None:
        """Train a network further with one difference of the paper's code, all of them (`code`) or none (CONTROL)."""
        if path.is_file():
            return
        known = {CONTROL: {}, "code": code_settings()}
        settings = dict(known[name] if name in known else code_settings(name))
        lamp: Lamp = settings.pop("lamp", "white")
        paths = self._render(self.whole, lamp)
        usable = [one for one in self.whole if one.identifier not in self.failed]
        labels = torch.tensor(self.labels(usable), device=self.study.device)
        learner = copy.deepcopy(network.network).requires_grad_(True)
        if settings.get("normalisation") == "rendered" and network.takes_normalisation:
            learner.normalise_by(RENDERED_MEAN, RENDERED_STD)
        trained = DIFFERENCES["training"][0] if self._trains_whole(network) else ()
        options = {one: settings[one] for one in trained if one in settings}
        config = ClassifyConfig(what="train", device=self.study.device, **{"epochs": EPOCHS, **options})
        images, generator = read_images(paths), torch.Generator().manual_seed(self.study.seed)
        torch.manual_seed(self.study.seed)  # dropout draws from torch's own
        truth = {"train": labels, "val": labels[:1]}
        if config.layers == "all":
            pictures, checkpoint = {"train": images, "val": images[:1]}, path.with_suffix(".checkpoint")
            try:
                train_all_layers(learner, pictures, truth, config, generator, checkpoint)
            except RangeError as error:
                raise UsageError("--whole-pictures", f"0, since {network.name} diverges", error) from error
            checkpoint.unlink()
        else:
            learner.eval()
            features = compute_features(learner, images, self.study.device, f"features of {network.name}, {name}")
            known_features = {"train": features, "val": features[:1]}
            train_last_layer(learner, known_features, truth, config, generator, continued=True)
        save_classifier(prepare_for_inference(learner, self.study.device), path, {"trained_on": str(len(labels))})

    def _announce_hours(self, variants: Mapping[NetworkFeatures, set[str]]) -> None:
        """Attack two pictures on each network of the user, and print how long all others may take."""
        hours, count = 0.0, 0
        for base in dict.fromkeys(one.text or one for one in self.networks):
            shape = self._settings(base, GRADIENT_STRATEGIES[0])
            config = arm_config(self.study, self.out, f"{base.name}-timing", base.spec, **shape)
            arm = ClassificationArm(config, self.test[:2])
            if self.arms and not run_classification_arms([arm], self.study, f"timing {base.name}"):
                frame = arm.frames(arm.views)[-1]  # the first one loads libraries
                own = [one for one in self.networks if base in (one, one.text)]
                jobs = sum(one.pending for key, one in self.arms.items() if key[1] in {x.name for x in own})
                jobs += len(own) * 9 * (self.study.fresh or 0) if self.wants("robustness") else 0
                whole = sum(len(names & {"code", "training"}) for net, names in variants.items() if net in own)
                passes = jobs * _MOST_PASSES + whole * EPOCHS * (self.study.whole_pictures or 0) * GRADIENT_PASSES
                hours, count = hours + passes * frame.seconds / frame.passes / 3600, count + jobs
        text = f"{count} attacks are left, for at most {hours:.2g} hours of one process at its present speed"
        Console(stderr=True).print(text, highlight=False)

    def _add(
        self,
        kind: str,
        features: NetworkFeatures,
        strategy: str,
        views: Sequence[ObjectView],
        name: str,
        **settings: Any,
    ) -> None:
        """Add an arm; `network` among the settings is a retrained one's file."""
        spec = settings.pop("network", features.spec)
        config = arm_config(self.study, self.out, f"{features.name}-{name}", spec, **settings)
        self.arms[kind, features.name, strategy] = ClassificationArm(config, tuple(views))

    def retrain(self) -> None:
        """Retrain networks on each method's counterexamples, and attack them anew."""
        if not self.wants(*RETRAINED_TABLES):
            return
        lamps = {
            one.name: self._settings(one, GRADIENT_STRATEGIES[0]).get("lamp", "white") for one in self.networks
        }
        for lamp in sorted(set(lamps.values())):
            self._render(self.train, lamp)
        usable = [i for i, one in enumerate(self.train) if one.identifier not in self.failed]
        views = [self.train[i] for i in usable]
        labels = torch.tensor(self.labels(views))
        replaced = torch.tensor([i in set(self.replaced) for i in usable])
        for network in self.networks:
            paths = [picture_path(one, self.out / PICTURES / lamps[network.name]) for one in views]
            benign = network.features("train", paths)
            self.retrained[network.name, BENIGN] = network.network
            for trained in (BENIGN_RETRAINED, *GRADIENT_STRATEGIES):
                features = benign.clone()
                if trained != BENIGN_RETRAINED:
                    arm = self.arms["train", network.name, trained]
                    changed = [one for one in arm.views if one.identifier not in self.failed]
                    features[replaced] = network.features(f"{trained}-train", _picture_paths(arm, changed)[1])
                path = self._weights(network, trained)
                self.retrained[network.name, trained] = retrain_last_layer(
                    network.network, path, features, labels, self.study.seed, self.study.device
                )
        if self.wants("robustness"):
            self._attack_retrained()

    def _attack_retrained(self) -> None:
        before = set(self.arms)
        for network, trained, strategy in product(self.networks, GRADIENT_STRATEGIES, GRADIENT_STRATEGIES):
            settings = {**self._settings(network, strategy), "network": str(self._weights(network, trained))}
            name = f"{trained}-retrained-{strategy}"
            self._add(f"against {trained}", network, strategy, self.retested, name, **settings)
        fresh = [arm for key, arm in self.arms.items() if key not in before]
        self.failed |= run_classification_arms(fresh, self.study, "attacking retrained networks")

    def _weights(self, network: NetworkFeatures, trained: str) -> Path:
        return self.out / RETRAINED / f"{network.name}-{trained}.safetensors"

    def correct(self, what: str, network: str, strategy: str, other: str) -> np.ndarray:
        """See `ResultSource`."""
        own = self._network(network)
        if what == "pixels":
            return self._pixel_attacks(own)[strategy]
        if what in ("known", "crossed"):
            target = own if what == "known" else self._network(other)
            judge = self.retrained[network, other] if what == "known" else target.network
            return classify_features(judge, self._features(own, strategy, target), self.labels(self.usable))
        views, kind = self.usable, other
        if what == "fresh":
            views = tuple(self.usable[place] for place in self.retested_places)
            kind = "test" if other == BENIGN else f"against {other}"
        arm = self.arms[kind, network, GRADIENT_STRATEGIES[0] if strategy == BENIGN else strategy]
        frames = arm.frames(views)
        return np.array([one.correct_before if strategy == BENIGN else one.correct_after for one in frames])

    def distances(self, what: str, network: str, strategy: str, metric: str) -> Floats:
        """See `ResultSource`."""
        if what == "pixels":
            return self._pixel_attacks(self._network(network))[f"{strategy} apart"].astype(np.float64)
        return self._distances_to_original(network, strategy)[metric]

    def set_distance(self, network: str, strategy: str, metric: str, among: np.ndarray) -> float | None:
        """See `ResultSource`."""
        return set_distance(self._distances_to_original(network, strategy), metric, among)

    def probabilities(self, network: str, strategy: str, trained: str) -> Floats:
        """See `ResultSource`; the pictures are those against the original network."""
        own = self._network(network)
        judge = self.retrained[network, trained] if trained else own.network
        with torch.no_grad():
            return judge.last(self._features(own, strategy, own)).softmax(1).double().cpu().numpy()

    def count_certain(self, network: str, strategy: str) -> int | None:
        """See `ResultSource`."""
        frames = self.arms["test", network, strategy].frames(self.usable)
        return None if self.study.quick else sum(frame.grade == "certain" for frame in frames)

    def _network(self, name: str) -> NetworkFeatures:
        return next(network for network in self.networks if network.name == name)

    def _features(self, source: NetworkFeatures, strategy: str, target: NetworkFeatures) -> Tensor:
        """Features of one network for pictures attacked on another, or for benign ones."""
        benign = strategy == BENIGN
        arm = self.arms["test", source.name, GRADIENT_STRATEGIES[0] if benign else strategy]
        before, after = _picture_paths(arm, self.usable)
        if benign:
            return target.features(BENIGN, before)
        return target.features(f"{strategy} against {source.name}", after)

    def _distances_to_original(self, network: str, strategy: str) -> Mapping[str, np.ndarray]:
        before, after = _picture_paths(self.arms["test", network, strategy], self.usable)
        path = self.out / FEATURES / f"{network}-{strategy}-distances.npz"
        return measure_distances(path, list(zip(before, after, strict=True)), self.measures)

    def _pixel_attacks(self, network: NetworkFeatures) -> Mapping[str, np.ndarray]:
        """For each attack on pixels: which test pictures (N,) stay correct, and their distances (N,)."""
        paths = _picture_paths(self.arms["test", network.name, GRADIENT_STRATEGIES[0]], self.usable)[0]

        def compute() -> Mapping[str, np.ndarray]:
            before = [files.read_image(path) for path in paths]
            images, labels = np.stack(before).transpose(0, 3, 1, 2), self.labels(self.usable)
            attacked = attack_pixels(network.network, images / np.float32(255), np.array(labels))
            arrays: dict[str, np.ndarray] = {}
            for name, after in attacked.items():
                features = compute_features(network.network, torch.from_numpy(after), self.study.device, name)
                arrays[name] = classify_features(network.network, features, labels)
                pairs = zip(before, after.transpose(0, 2, 3, 1), strict=True)
                arrays[f"{name} apart"] = np.array([self.measures["perceptual"](a, b) for a, b in pairs])
            return arrays

        path = self.out / FEATURES / f"{network.name}-pixels.npz"
        return load_or_compute(path, network.cache_key(paths), compute)

    @cached_property
    def measures(self) -> dict[str, Any]:
        """The metrics of realism that are available."""
        return load_metrics(choose_metrics(AVAILABLE, None, False)[0], None, False)

    def facts(self, settings: StudyConfig) -> StudyFacts:
        """The facts of the study once its attacks and networks are done; settings: as they were typed."""

        def count_by_class(names: list[str]) -> dict[str, int]:
            kinds = [name.partition("/")[0] for name in names]
            return {one: kinds.count(one) for one in self.classes}

        return StudyFacts(
            settings=settings,
            classes=self.classes,
            networks=tuple(
                StudyNetwork(one.name, one.paper_network, one.reading, one.takes_normalisation)
                for one in self.networks
            ),
            tables=self.tables,
            measures=tuple(self.measures) if self.wants("realism") else (),
            distance=next(name for name in PREFERRED_DISTANCES if why_missing(name, None) is None),
            toolbox=has_pixel_attacks(),
            pictures=tuple(one.name for one in self.usable),
            retested=self.retested_places,
            counts={
                "test": len(self.usable),
                "train": len(self.train),
                "retrained": len(self.retested),
                "whole": self.study.whole_pictures or 0,
            },
            objects={split: count_by_class(list(self.objects.names(split))) for split in SPLITS},
            used={
                split: count_by_class([one.name for one in views])
                for split, views in (("test", self.test), ("train", self.train))
            },
            failed=dict(sorted(self.failed.items())),
        )


def _picture_paths(arm: ClassificationArm, views: Sequence[ObjectView]) -> tuple[list[Path], list[Path]]:
    """An arm's pictures before and after."""
    folders = [arm.out / FRAMES / one.identifier for one in views]
    return [one / "benign.png" for one in folders], [one / "counterexample.png" for one in folders]


def _sample_views(objects: ObjectSet, split: Split, size: int, seed: int) -> tuple[ObjectView, ...]:
    every = [ObjectView(split, name, view) for name, view in product(objects.names(split), VIEWS)]
    if not every:
        raise UsageError("--objects", f"objects to {split}", "none")
    labels = [objects.classes.index(one.name.partition("/")[0]) for one in every]
    return tuple(every[place] for place in sample_stratified(labels, size, np.random.default_rng(seed)))


def _load_networks(study: StudyConfig, classes: tuple[str, ...], out: Path) -> tuple[NetworkFeatures, ...]:
    specs = split_list(study.networks)
    names = [Path(spec).stem for spec in specs]
    if not specs or len(set(names)) < len(names):
        raise UsageError("--networks", "networks with commas, each of another name", repr(study.networks))
    networks = [
        NetworkFeatures(name, spec, classes, out, study.device) for name, spec in zip(names, specs, strict=True)
    ]
    for network in networks:
        network.network.eval()  # which loads it: a file that cannot be used is refused now
    return tuple(networks)


def _code_network(text: NetworkFeatures) -> NetworkFeatures:
    """The network that is trained from a network as the paper's code does."""
    name = f"{text.name}-code"
    path = text.folder / RETRAINED / f"{name}.safetensors"
    return NetworkFeatures(name, str(path), text.classes, text.folder, text.device, text)


def draw_half(count: int, seed: int) -> list[int]:
    """Draw half of `count` indices at random, in order."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    return sorted(order[: count // 2].tolist())


def retrain_last_layer(
    network: Classifier, path: Path, features: Tensor, labels: Tensor, seed: int, device: str
) -> Classifier:
    """Train the last layer of a network further for EPOCHS, as in the paper.

    Args:
        network: The network.
        path: File of the weights; if it exists, they are loaded.
        features: Features to train on (N, K).
        labels: Their classes (N,).
        seed: Seed of the training.
        device: torch device.
    """
    if not path.is_file():
        learner = copy.deepcopy(network)
        learner.last.requires_grad_(True)
        config = ClassifyConfig(what="train", epochs=EPOCHS, layers="last")
        truth = labels.to(device)
        known, labelled = {"train": features, "val": features}, {"train": truth, "val": truth}
        train_last_layer(learner, known, labelled, config, torch.Generator().manual_seed(seed), continued=True)
        save_classifier(prepare_for_inference(learner, device), path, {"trained_on": str(len(labels))})
    return load_classifier(str(path), network.classes, device)


@torch.no_grad()
def classify_features(network: Classifier, features: Tensor, labels: Sequence[int]) -> np.ndarray:
    """Whether a network's last layer classifies pictures correctly (N,) bool.

    Args:
        network: The network.
        features: Features (N, K).
        labels: True classes (N).
    """
    return network.last(features).argmax(1).cpu().numpy() == np.asarray(labels)


def run_classification_study(study: StudyConfig) -> AnalysisReport:
    """Run or continue the study, or report stored results with --from.

    Returns:
        The report, which is written into the study's folder; with --from only if --out is given.

    Raises:
        UsageError: Bad settings.
        SceneError: Objects or networks that cannot be used, or damaged results.
    """
    if study.results is not None:
        folder = Path(study.results)
        results, out = load_results(folder), resolve_output_folder(study.out, folder)
        if study.bootstrap is not None:
            settings = replace(results.facts.settings, bootstrap=study.bootstrap)
            results.facts = replace(results.facts, settings=settings)
        report = _build_report(results, out)
        if study.out is not None:
            report.write()
        return report
    work = ClassificationStudy.from_config(study)
    claim_folder(work.out, work.study, _WRITTEN, _FREE_SETTINGS)
    work.attack()
    work.retrain()
    results = ClassificationResults(work.facts(study), work)
    report = _build_report(results, work.out)
    save_results(work.out / RESULTS, results)
    report.write()
    return report


def _build_report(results: ClassificationResults, out: Path) -> AnalysisReport:
    tables, facts, draws = build_tables(results), results.facts, results.bootstrap.draws
    return AnalysisReport(
        out=out,
        name="study",
        heading="Image classifiers",
        data={
            "study": facts.settings.name,
            "out": str(out),
            "networks": [one.name for one in facts.networks],
            "objects": facts.settings.objects or "embedded",
            "pictures": facts.counts,
            "bootstrap": draws,
            "tables": {
                one.name: {"rows": one.rows, "reference": one.reference, "notes": one.notes} for one in tables
            },
            "frames_failed": facts.failed,
        },
        csv_tables={one.name: one.rows for one in tables if one.rows},
        tables=[one.report_table() for one in tables],
        notes=[_NOTE.format(draws=draws), *(note for one in tables for note in one.notes)],
        text_columns=_TEXT_COLUMNS,
        printed_tables=[one.report_table(classes=False) for one in tables if one.name != ORDERS],
        intro=[f"`{study_command(facts.settings)}`", ""],
        failed=facts.failed,
    )
