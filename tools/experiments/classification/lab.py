"""A study at work: its networks, its pictures, its attacks, and the networks that learnt from these."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from drivesem.analysis.transfer.run import split_list
from drivesem.classify.attack import report_run
from drivesem.classify.networks.base import Classifier
from drivesem.classify.networks.loading import load_classifier, prepare_for_inference, save_classifier
from drivesem.classify.objects.embedded import open_objects
from drivesem.classify.objects.types import ObjectSet, Split
from drivesem.classify.paper import NETWORKS
from drivesem.classify.pictures import Shown, Studio, draw
from drivesem.classify.scenes import VIEWS, open_backgrounds
from drivesem.classify.training import embedded, fit_last
from drivesem.config.commands import ClassifyConfig
from drivesem.config.errors import UsageError
from drivesem.run.folder import FRAMES, RETRAINED, resolve_output_folder
from scene_ir import files
from tools.experiments.classification import pixels
from tools.experiments.classification.arms import GRADIENT, STRATEGIES, Arm, attack_of, preset, run_arms
from tools.experiments.classification.figures import sample_stratified
from tools.experiments.classification.looking import LOOKED, Eyes, apart, kept
from tools.experiments.realism.asking import AVAILABLE, chosen
from tools.experiments.realism.measures import load
from tools.experiments.settings import StudyConfig
from tools.experiments.worth.measures import Floats

PICTURES = "pictures"
"""Folder of the pictures that are trained on."""
EPOCHS = 20
BENIGN, ONWARD = "benign", "benign-on"
"""A network as it was, and trained on with benign pictures alone."""
SINGLE = ("vertex", "pose", "lighting", "vertex,pose,lighting")
"""What is moved in the table of parameters, beside pose and vertex, as in all others."""
_NEEDS = {
    "degradation": STRATEGIES,
    "worth": STRATEGIES,
    "realism": STRATEGIES,
    **dict.fromkeys(("parameters", "hyperparameters", "retraining", "robustness", "transfer"), GRADIENT),
    "pixels": GRADIENT[:1],
    "sizes": (),
}
TABLES = tuple(_NEEDS)
LEARNT = ("retraining", "robustness", "worth")
"""Tables of retrained networks."""
_SIZES = {"limit": (480, 36), "fresh": (232, 36), "train_pictures": (960, 144)}
"""Pictures by default, and with --quick."""


@dataclass
class Lab:
    """study: its settings, all numbers of pictures said; eyes: of each network; tables: which are wanted; arms: by
    what they are for; failed: pictures that could not be used, and why.
    """

    study: StudyConfig
    out: Path
    objects: ObjectSet
    eyes: tuple[Eyes, ...]
    tables: tuple[str, ...]
    test: tuple[Shown, ...]
    train: tuple[Shown, ...]
    arms: dict[tuple[str, str, str], Arm] = field(default_factory=dict[tuple[str, str, str], Arm])
    taught: dict[tuple[str, str], Classifier] = field(default_factory=dict[tuple[str, str], Classifier])
    failed: dict[str, str] = field(default_factory=dict[str, str])

    @classmethod
    def of(cls, study: StudyConfig) -> Lab:
        """Raises UsageError or SceneError for settings, objects or networks that cannot be used."""
        wanted = tuple(split_list(study.tables)) if study.tables is not None else TABLES
        if not wanted or not set(wanted) <= set(TABLES):
            raise UsageError("--tables", f"names among {', '.join(TABLES)}", repr(study.tables))
        sizes = {name: getattr(study, name) or pair[study.quick] for name, pair in _SIZES.items()}
        out = resolve_output_folder(study.out, Path("runs") / f"study-classification-seed{study.seed}")
        objects = open_objects(study.objects)
        open_backgrounds(study.backgrounds)
        eyes = _eyes_of(study, objects.classes, out)
        test = _some(objects, "test", sizes["limit"], study.seed)
        train = _some(objects, "train", sizes["train_pictures"], study.seed)
        return cls(replace(study, **sizes), out, objects, eyes, wanted, test, train)

    @property
    def classes(self) -> tuple[str, ...]:
        return self.objects.classes

    @property
    def deep(self) -> tuple[Eyes, ...]:
        """Networks of the tables that take long: with --quick the first alone."""
        return self.eyes[:1] if self.study.quick else self.eyes

    def wants(self, *names: str) -> bool:
        return any(name in self.tables for name in names)

    @cached_property
    def done(self) -> tuple[Shown, ...]:
        """The test pictures that could be used in all arms."""
        return tuple(one for one in self.test if one.identifier not in self.failed)

    @cached_property
    def few(self) -> tuple[Shown, ...]:
        """Those on which retrained networks are attacked; classes have their shares in them."""
        rng = np.random.default_rng(self.study.seed)
        places = sample_stratified(self.labels(self.done), self.study.fresh or len(self.done), rng)
        return tuple(self.done[place] for place in places)

    @property
    def fresh(self) -> tuple[int, ...]:
        """Places among `done` of those of `few` that could be used."""
        return tuple(i for i, one in enumerate(self.done) if one in self.few and one.identifier not in self.failed)

    @cached_property
    def replaced(self) -> list[int]:
        """Places of the pictures to train on that counterexamples replace."""
        return half(len(self.train), self.study.seed)

    def labels(self, shown: Sequence[Shown]) -> list[int]:
        return [self.classes.index(one.name.partition("/")[0]) for one in shown]

    def attack(self) -> None:
        """All attacks on the networks as they are. Raises UsageError or SceneError."""
        needed = [one for one in STRATEGIES if any(one in _NEEDS[name] for name in self.tables)]
        for eyes, strategy in product(self.eyes, needed):
            usual, grade = preset(eyes.theirs, strategy), not self.study.quick
            self._add("test", eyes, strategy, self.test, strategy, **usual, grade=grade)
        for eyes, strategy in product(self.deep, GRADIENT):
            usual = preset(eyes.theirs, strategy)
            for params in SINGLE if self.wants("parameters") else ():
                name = f"{strategy}-{params.replace(',', '-')}"
                self._add(params, eyes, strategy, self.test, name, **{**usual, "params": params})
            for network in {*NETWORKS} - {eyes.theirs} if self.wants("hyperparameters") else ():
                name = f"{strategy}-as-{network}"
                self._add(network, eyes, strategy, self.test, name, **preset(network, strategy))
            if self.wants(*LEARNT):
                shown = [self.train[place] for place in self.replaced]
                self._add("train", eyes, strategy, shown, f"{strategy}-train", **usual)
        self.failed |= run_arms(list(self.arms.values()), self.study, "attacking pictures")
        if not self.done:
            raise UsageError(
                "--objects", "pictures that can be attacked", f"none: {next(iter(self.failed.values()))}"
            )
        for key, arm in self.arms.items():
            if key[0] == "test":
                seconds = sum(frame.seconds for frame in arm.frames(self.done))
                report_run(arm.config, arm.out, self.classes, self.done, {}, seconds)

    def _add(
        self, kind: str, eyes: Eyes, strategy: str, shown: Sequence[Shown], name: str, **settings: Any
    ) -> None:
        folder, network = f"{eyes.name}-{name}", settings.pop("network", eyes.spec)
        config = attack_of(self.study, self.out, folder, network, **settings)
        self.arms[kind, eyes.name, strategy] = Arm(config, tuple(shown))

    def teach(self) -> None:
        """Networks retrained on each method's counterexamples, and attacked anew."""
        if not self.wants(*LEARNT):
            return
        settings = attack_of(self.study, self.out, "", self.eyes[0].spec)
        studio = Studio.of(settings)
        self.failed |= draw(self.train, studio, settings, self.out / PICTURES).failed
        usable = [i for i, one in enumerate(self.train) if one.identifier not in self.failed]
        shown = [self.train[i] for i in usable]
        labels = torch.tensor(self.labels(shown))
        paths = [studio.place(one, self.out / PICTURES) for one in shown]
        replaced = torch.tensor([i in set(self.replaced) for i in usable])
        for eyes in self.deep:
            benign = eyes.features("train", paths)
            self.taught[eyes.name, BENIGN] = eyes.network
            for trained in (ONWARD, *GRADIENT):
                features = benign.clone()
                if trained != ONWARD:
                    arm = self.arms["train", eyes.name, trained]
                    changed = [one for one in arm.shown if one.identifier not in self.failed]
                    features[replaced] = eyes.features(f"{trained}-train", pictures(arm, changed)[1])
                self.taught[eyes.name, trained] = retrained(
                    eyes.network, self.weights(eyes, trained), features, labels, self.study.seed, self.study.device
                )
        if self.wants("robustness"):
            self._attack_taught()

    def _attack_taught(self) -> None:
        before = set(self.arms)
        for eyes, trained, strategy in product(self.deep, GRADIENT, GRADIENT):
            usual, network = preset(eyes.theirs, strategy), str(self.weights(eyes, trained))
            name = f"{trained}-retrained-{strategy}"
            self._add(f"against {trained}", eyes, strategy, self.few, name, **usual, network=network)
        fresh = [arm for key, arm in self.arms.items() if key not in before]
        self.failed |= run_arms(fresh, self.study, "attacking retrained networks")

    def weights(self, eyes: Eyes, trained: str) -> Path:
        return self.out / RETRAINED / f"{eyes.name}-{trained}.safetensors"

    def right(self, what: str, network: str, strategy: str, other: str) -> np.ndarray:
        """Which pictures (M,) bool a network classifies rightly, as `Results.answers` says."""
        eyes = self.eyes_of(network)
        if what == "pixels":
            return self.pixels(eyes)[strategy]
        if what in ("known", "crossed"):
            target = eyes if what == "known" else self.eyes_of(other)
            judge = self.taught[network, other] if what == "known" else target.network
            return right(judge, self.features(eyes, strategy, target), self.labels(self.done))
        shown, kind = self.done, other
        if what == "fresh":
            shown = tuple(self.done[place] for place in self.fresh)
            kind = "test" if other == BENIGN else f"against {other}"
        frames = self.arms[kind, network, GRADIENT[0] if strategy == BENIGN else strategy].frames(shown)
        return np.array([one.right_before if strategy == BENIGN else one.right_after for one in frames])

    def distances(self, what: str, network: str, strategy: str, metric: str) -> Floats:
        """Distances (N,) from the pictures before, as `Results.far` says."""
        if what == "pixels":
            return self.pixels(self.eyes_of(network))[f"{strategy} apart"].astype(np.float64)
        return self.apart(network, strategy)[metric]

    def chances(self, network: str, strategy: str, trained: str) -> Floats:
        """Softmax (N, C) of a network, as it was or trained so, for the pictures against it as it was."""
        eyes = self.eyes_of(network)
        judge = self.taught[network, trained] if trained else eyes.network
        with torch.no_grad():
            return judge.last(self.features(eyes, strategy, eyes)).softmax(1).double().cpu().numpy()

    def certain(self, network: str, strategy: str) -> int | None:
        """How many failures are certain, where that was asked."""
        frames = self.arms["test", network, strategy].frames(self.done)
        return None if self.study.quick else sum(frame.grade == "certain" for frame in frames)

    def eyes_of(self, network: str) -> Eyes:
        """The network of that name."""
        return next(eyes for eyes in self.eyes if eyes.name == network)

    def features(self, source: Eyes, strategy: str, target: Eyes) -> Tensor:
        """What a network's last layer reads of counterexamples against a network; of benign pictures too."""
        benign = strategy == BENIGN
        before, after = pictures(self.arms["test", source.name, GRADIENT[0] if benign else strategy], self.done)
        if benign:
            return target.features(BENIGN, before)
        return target.features(f"{strategy} against {source.name}", after)

    def apart(self, network: str, strategy: str) -> Mapping[str, np.ndarray]:
        """How far counterexamples are from the pictures before, as `looking.apart` says."""
        before, after = pictures(self.arms["test", network, strategy], self.done)
        path = self.out / LOOKED / f"{network}-{strategy}-distances.npz"
        return apart(path, list(zip(before, after, strict=True)), self.measures)

    def pixels(self, eyes: Eyes) -> Mapping[str, np.ndarray]:
        """Of each attack on pixels: which test pictures (N,) are right after it, and their distances (N,)."""
        paths = pictures(self.arms["test", eyes.name, GRADIENT[0]], self.done)[0]

        def compute() -> Mapping[str, np.ndarray]:
            before = [files.read_image(path) for path in paths]
            images, labels = np.stack(before).transpose(0, 3, 1, 2), self.labels(self.done)
            found: dict[str, np.ndarray] = {}
            for name, after in pixels.attacked(eyes.network, images / np.float32(255), np.array(labels)).items():
                features = embedded(eyes.network, torch.from_numpy(after), self.study.device, name)
                found[name] = right(eyes.network, features, labels)
                pairs = zip(before, after.transpose(0, 2, 3, 1), strict=True)
                found[f"{name} apart"] = np.array([self.measures["perceptual"](a, b) for a, b in pairs])
            return found

        return kept(self.out / LOOKED / f"{eyes.name}-pixels.npz", eyes.about(paths), compute)

    @cached_property
    def measures(self) -> dict[str, Any]:
        return load(chosen(AVAILABLE, None, False)[0], None, False)


def pictures(arm: Arm, shown: Sequence[Shown]) -> tuple[list[Path], list[Path]]:
    """An arm's pictures before and after."""
    folders = [arm.out / FRAMES / one.identifier for one in shown]
    return [one / "benign.png" for one in folders], [one / "counterexample.png" for one in folders]


def _some(objects: ObjectSet, split: Split, size: int, seed: int) -> tuple[Shown, ...]:
    every = [Shown(split, name, view) for name, view in product(objects.names(split), VIEWS)]
    if not every:
        raise UsageError("--objects", f"objects to {split}", "none")
    labels = [objects.classes.index(one.name.partition("/")[0]) for one in every]
    return tuple(every[place] for place in sample_stratified(labels, size, np.random.default_rng(seed)))


def _eyes_of(study: StudyConfig, classes: tuple[str, ...], out: Path) -> tuple[Eyes, ...]:
    specs = split_list(study.networks)
    names = [Path(spec).stem for spec in specs]
    if not specs or len(set(names)) < len(names):
        raise UsageError("--networks", "networks with commas, each of another name", repr(study.networks))
    loaded = [load_classifier(spec, classes, study.device) for spec in specs]
    found = zip(names, specs, loaded, strict=True)
    return tuple(Eyes(name, spec, network, out, study.device) for name, spec, network in found)


def half(count: int, seed: int) -> list[int]:
    """Places of half of so many pictures, at random, in order."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(seed))
    return sorted(order[: count // 2].tolist())


def retrained(
    network: Classifier, path: Path, features: Tensor, labels: Tensor, seed: int, device: str
) -> Classifier:
    """The network with its last layer trained on for EPOCHS, from what it is, as in the paper; kept in a file."""
    if not path.is_file():
        learner = copy.deepcopy(network)
        learner.last.requires_grad_(True)
        config = ClassifyConfig(what="train", epochs=EPOCHS, layers="last")
        truth = labels.to(device)
        known, labelled = {"train": features, "val": features}, {"train": truth, "val": truth}
        fit_last(learner, known, labelled, config, torch.Generator().manual_seed(seed), onward=True)
        save_classifier(prepare_for_inference(learner, device), path, {"trained_on": str(len(labels))})
    return load_classifier(str(path), network.classes, device)


@torch.no_grad()
def right(network: Classifier, features: Tensor, labels: Sequence[int]) -> np.ndarray:
    """Which pictures (N,) bool a network's last layer classifies rightly by their features (N, K)."""
    return network.last(features).argmax(1).cpu().numpy() == np.asarray(labels)
