"""Reads, checks and writes Darknet `.cfg` files of the YOLOv3 family.

A file is a list of sections: first [net], with training settings and the input size, then one per layer, numbered
from 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from detectors.base import DetectorError

ACTIVATIONS = ("leaky", "linear")
NO_MATCH = 1.0
"""Default `iou_thresh` of a head: only the best anchor predicts an object."""
_MAX_INTEGER = 1 << 20
_VALUES_PER_BOX = 5
"""x, y, width, height, objectness; the classes follow."""

_READ = {
    "convolutional": (
        *("batch_normalize", "filters", "size", "stride", "stride_x", "stride_y", "pad", "padding"),
        *("activation", "groups"),
    ),
    "maxpool": ("stride", "stride_x", "stride_y", "size", "padding"),
    "route": ("layers",),
    "shortcut": ("from", "activation"),
    "upsample": ("stride",),
    "yolo": ("mask", "anchors", "classes", "num", "ignore_thresh", "iou_thresh"),
}
"""Keys of a section that are read."""
_WITHOUT_EFFECT_ANYWHERE = (
    *("learning_rate", "stopbackward", "onlyforward", "dont_update", "burnin_update", "train_only_bn", "clip"),
    *("stream", "wait_stream"),
)
_WITHOUT_EFFECT = {
    "convolutional": (
        *("assisted_excitation", "sway", "rotate", "stretch", "stretch_sway", "angle", "dot", "grad_centr"),
    ),
    "yolo": (
        *("jitter", "resize", "random", "max", "map", "truth_thresh", "iou_thresh_kind", "iou_loss"),
        *("iou_normalizer", "obj_normalizer", "cls_normalizer", "delta_normalizer", "uc_normalizer"),
        *("max_delta", "label_smooth_eps", "objectness_smooth", "focal_loss", "counters_per_class"),
        *("nms_kind", "beta_nms", "show_details", "embedding_layer", "track_history_size", "sim_thresh"),
        *("dets_for_track", "dets_for_show", "track_ciou_norm"),
    ),
}
"""Keys that change no box, in any section and per section: of Darknet's training, suppression, tracking and
display, and of GPU streams (src/parser.c of https://github.com/AlexeyAB/darknet).
"""
_NEUTRAL_ANYWHERE = {"dontload": "0", "dontloadscales": "0"}
_NEUTRAL = {
    "convolutional": {
        **dict.fromkeys(("antialiasing", "binary", "xnor", "bin_output", "cbn", "flipped", "reverse"), "0"),
        "coordconv": "0",
        "dilation": "1",
    },
    "maxpool": {"antialiasing": "0", "maxpool_depth": "0", "out_channels": "1", "maxpool_zero_nonmax": "0"},
    "route": {"groups": "1", "group_id": "0"},
    "shortcut": {"weights_type": "none", "weights_normalization": "none"},
    "upsample": {"scale": "1"},
    "yolo": {"scale_x_y": "1", "new_coords": "0"},
}
"""Keys that can change a layer's output or weights, and the value with which they do not; in any section and per
section.
"""

_MAX_LAYERS = 1000
"""YOLOv3 has 107."""
_MAX_ANCHORS = 1000
_MAX_SIDE = 63
"""Largest kernel or window, px; known networks use up to 13."""
_MAX_STRIDE = 1024
"""Largest stride of the input, px, to multiples of which its sides are padded; known networks use up to 64."""
_MAX_VALUES_PER_PIXEL = 256, 4096
"""Output values per input pixel, of one layer and of all: YOLOv3 has 32 and 329."""


@dataclass(frozen=True, slots=True)
class CfgSection:
    """[kind] and its `key=value` lines, in order."""

    kind: str
    """Name of the section."""
    options: Mapping[str, str] = field(default_factory=dict)
    """Values by key."""
    line: int = field(default=0, compare=False)
    """Line in the file; 0 if there is none."""


@dataclass(frozen=True, slots=True)
class ConvolutionLayer:
    """A [convolutional] section."""

    filters: int
    """Output channels."""
    size: int
    """Side of the kernel."""
    stride: int
    """In both directions."""
    padding: int
    """px on each side."""
    normalised: bool
    """Whether batch normalisation replaces the bias."""
    leaky: bool
    """Whether a leaky rectifier follows."""


@dataclass(frozen=True, slots=True)
class MaxPoolLayer:
    """A [maxpool] section."""

    size: int
    """Side of the window."""
    stride: int
    """In both directions."""


@dataclass(frozen=True, slots=True)
class RouteLayer:
    """Concatenation of earlier outputs along the channels."""

    layers: tuple[int, ...]
    """Absolute numbers."""


@dataclass(frozen=True, slots=True)
class ShortcutLayer:
    """Sum of the previous output and an earlier one."""

    layer: int
    """Absolute number."""


@dataclass(frozen=True, slots=True)
class UpsampleLayer:
    """Each value repeated `factor` times in both directions."""

    factor: int
    """Repetitions."""


@dataclass(frozen=True, slots=True)
class YoloHead:
    """A [yolo] section."""

    anchors_wh: tuple[tuple[float, float], ...]
    """Anchors of all heads, px of the input."""
    mask: tuple[int, ...]
    """Indices of this head's anchors."""
    classes: int
    """Number of classes."""
    ignore_threshold: float
    """Anchors with a predicted box of higher IoU with an object need not be silent."""
    match_threshold: float
    """Further anchors with a shape of higher IoU with an object's also predict it."""


Layer = ConvolutionLayer | MaxPoolLayer | RouteLayer | ShortcutLayer | UpsampleLayer | YoloHead


@dataclass(frozen=True, slots=True)
class DarknetCfg:
    """A network's description."""

    sections: tuple[CfgSection, ...]
    """The sections it was read from, [net] first."""
    layers: tuple[Layer, ...]
    """One per further section."""
    channels: tuple[int, ...]
    """Output channels of each layer."""
    strides: tuple[int, ...]
    """Input pixels per cell of each layer's output."""

    @property
    def heads(self) -> tuple[tuple[int, YoloHead], ...]:
        """(layer number, head) of each [yolo] section."""
        return tuple((i, layer) for i, layer in enumerate(self.layers) if isinstance(layer, YoloHead))

    @property
    def classes(self) -> int:
        """Number of classes."""
        return self.heads[0][1].classes

    @property
    def stride(self) -> int:
        """Input sides must be multiples of this, px."""
        return math.lcm(*self.strides)


def parse(text: str, source: str = "cfg") -> DarknetCfg:
    """Parse the text of a `.cfg`.

    Raises:
        DetectorError: An unknown section or value, or layers that do not fit together; names `source` and the
            line.
    """
    return build(_sections(text, source), source)


def build(sections: Sequence[CfgSection], source: str = "cfg") -> DarknetCfg:
    """The network described by sections.

    Raises:
        DetectorError: As `parse`.
    """
    if not sections or sections[0].kind not in ("net", "network"):
        line = sections[0].line if sections else 1
        raise DetectorError(f"{source}:{line}: expected [net] first, found {_kind(sections)}")
    if len(sections) > _MAX_LAYERS:
        raise DetectorError(f"{source}: expected at most {_MAX_LAYERS} sections, found {len(sections)}")
    layers: list[Layer] = []
    channels: list[int] = []
    strides: list[int] = []
    numbers: list[float] = []
    width = _SectionReader(sections[0], source).integer("channels", 3)
    if width != 3:
        raise DetectorError(f"{source}:{sections[0].line}: channels: expected 3, found {width}")
    for section in sections[1:]:
        reader = _SectionReader(section, source)
        previous = (channels[-1], strides[-1]) if layers else (width, 1)
        if section.kind not in _LAYERS:
            known = ", ".join(f"[{name}]" for name in _LAYERS)
            raise DetectorError(f"{source}:{section.line}: expected one of {known}, found [{section.kind}]")
        _check_keys(reader)
        layer = _LAYERS[section.kind](reader, len(layers))
        channel, stride = _output(layer, previous, (channels, strides), reader)
        layers.append(layer)
        channels.append(channel)
        strides.append(stride)
        numbers.append(channel / stride**2)
        if (
            stride > _MAX_STRIDE
            or numbers[-1] > _MAX_VALUES_PER_PIXEL[0]
            or sum(numbers) > _MAX_VALUES_PER_PIXEL[1]
        ):
            most, in_all = _MAX_VALUES_PER_PIXEL
            expected = f"a stride up to {_MAX_STRIDE}, numbers a pixel up to {most}, {in_all} in all"
            raise reader.fail("filters, stride", expected, f"{stride}, {numbers[-1]:g}, {sum(numbers):g}")
    cfg = DarknetCfg(tuple(sections), tuple(layers), tuple(channels), tuple(strides))
    if cfg.stride > _MAX_STRIDE:
        raise DetectorError(
            f"{source}: expected strides with a multiple of at most {_MAX_STRIDE}, found {cfg.stride}"
        )
    counts = {head.classes for _, head in cfg.heads}
    if len(counts) != 1:
        found = ", ".join(map(str, sorted(counts))) or "no [yolo]"
        raise DetectorError(f"{source}: expected [yolo] sections with the same classes, found {found}")
    return cfg


def write(cfg: DarknetCfg) -> str:
    """The text of a `.cfg`, from which `parse` reads the same sections."""
    parts = []
    for section in cfg.sections:
        lines = [f"[{section.kind}]", *(f"{key}={value}" for key, value in section.options.items())]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _sections(text: str, source: str) -> list[CfgSection]:
    sections: list[tuple[str, dict[str, str], int]] = []
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.partition("#")[0].partition(";")[0].strip()
        if not line:
            continue
        if line.startswith("[") and line.endswith("]"):
            sections.append((line[1:-1].strip(), {}, number))
        elif "=" in line and sections:
            key, _, value = line.partition("=")
            sections[-1][1][key.strip()] = value.strip()
        else:
            raise DetectorError(f"{source}:{number}: expected [section] or key=value, found {line!r}")
    return [CfgSection(*parts) for parts in sections]


def _kind(sections: Sequence[CfgSection]) -> str:
    return f"[{sections[0].kind}]" if sections else "no section"


@dataclass(frozen=True, slots=True)
class _SectionReader:
    """Reads values of a section; errors name file and line."""

    section: CfgSection
    source: str

    def fail(self, key: str, expected: str, found: object) -> DetectorError:
        return DetectorError(
            f"{self.source}:{self.section.line}: [{self.section.kind}] {key}: expected {expected}, found {found}"
        )

    def integer(self, key: str, default: int | None = None, least: int = 1, most: int = _MAX_INTEGER) -> int:
        text = self.section.options.get(key)
        if text is None:
            if default is None:
                raise self.fail(key, "an integer", "none")
            return default
        if not text.strip():
            raise self.fail(key, "an integer", "nothing")
        (value,) = self._integers(key, [text])
        if value < least:
            raise self.fail(key, f"an integer of at least {least}", value)
        if value > most:
            raise self.fail(key, f"at most {most}", value)
        return value

    def integers(self, key: str) -> list[int]:
        text = self.section.options.get(key)
        if not text:
            raise self.fail(key, "integers", "none")
        return self._integers(key, text.split(","))

    def _integers(self, key: str, texts: Iterable[str]) -> list[int]:
        try:
            return [int(text) for text in texts if text.strip()]
        except ValueError as error:
            raise self.fail(key, "integers", str(error).rpartition(": ")[2]) from None

    def number(self, key: str, default: float) -> float:
        text = self.section.options.get(key, str(default))
        try:
            value = float(text)
        except ValueError:
            raise self.fail(key, "a number", repr(text)) from None
        if not math.isfinite(value):
            raise self.fail(key, "a finite number", text)
        return value

    def layer(self, key: str, index: int, here: int) -> int:
        """The absolute number of a layer; negative indices are relative."""
        absolute = here + index if index < 0 else index
        if not 0 <= absolute < here:
            raise self.fail(key, f"a layer before this one, number {here}", index)
        return absolute


def _check_keys(reader: _SectionReader) -> None:
    """Raise DetectorError for a key that would describe another network than the one built."""
    kind = reader.section.kind
    passed = {*_READ[kind], *_WITHOUT_EFFECT_ANYWHERE, *_WITHOUT_EFFECT.get(kind, ())}
    neutral = _NEUTRAL_ANYWHERE | _NEUTRAL[kind]
    for key, value in reader.section.options.items():
        if key in passed:
            continue
        if key not in neutral:
            raise reader.fail(key, "a key of YOLOv3's networks", "an unknown one")
        if value != neutral[key] and not _is_number(value, neutral[key]):
            raise reader.fail(key, neutral[key], value)


def _is_number(text: str, expected: str) -> bool:
    """Whether a text is a number in another notation."""
    try:
        return float(text) == float(expected)
    except ValueError:
        return False


def _stride(reader: _SectionReader, most: int = _MAX_INTEGER) -> int:
    """The stride of both directions, px."""
    stride = reader.integer("stride", 1, most=most)
    for key in ("stride_x", "stride_y"):
        other = reader.integer(key, stride)
        if other != stride:
            raise reader.fail(key, f"{stride}, the stride", other)
    return stride


def _convolution(reader: _SectionReader, _here: int) -> ConvolutionLayer:
    activation = reader.section.options.get("activation", "logistic")
    if activation not in ACTIVATIONS:
        raise reader.fail("activation", " or ".join(ACTIVATIONS), activation)
    if reader.integer("groups", 1) != 1:
        raise reader.fail("groups", "1", reader.section.options["groups"])
    size = reader.integer("size", 1, most=_MAX_SIDE)
    padding = size // 2 if reader.integer("pad", 0, 0) else reader.integer("padding", 0, 0)
    if 2 * padding != size - 1:
        raise reader.fail("pad", f"{(size - 1) / 2:g} px for a size of {size}", padding)
    return ConvolutionLayer(
        filters=reader.integer("filters"),
        size=size,
        stride=_stride(reader),
        padding=padding,
        normalised=bool(reader.integer("batch_normalize", 0, 0)),
        leaky=activation == "leaky",
    )


def _max_pool(reader: _SectionReader, _here: int) -> MaxPoolLayer:
    stride = _stride(reader, _MAX_SIDE)
    size = reader.integer("size", stride, most=_MAX_SIDE)
    if reader.integer("padding", size - 1, 0) != size - 1:
        raise reader.fail("padding", str(size - 1), reader.section.options["padding"])
    return MaxPoolLayer(size, stride)


def _route(reader: _SectionReader, here: int) -> RouteLayer:
    return RouteLayer(tuple(reader.layer("layers", index, here) for index in reader.integers("layers")))


def _shortcut(reader: _SectionReader, here: int) -> ShortcutLayer:
    activation = reader.section.options.get("activation", "linear")
    if activation != "linear":
        raise reader.fail("activation", "linear", activation)
    indices = reader.integers("from")
    if len(indices) != 1:
        raise reader.fail("from", "one layer", len(indices))
    return ShortcutLayer(reader.layer("from", indices[0], here))


def _upsample(reader: _SectionReader, _here: int) -> UpsampleLayer:
    return UpsampleLayer(reader.integer("stride", 2))


def _head(reader: _SectionReader, _here: int) -> YoloHead:
    text = reader.section.options.get("anchors", "")
    try:
        numbers = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise reader.fail("anchors", "numbers", repr(text)) from None
    if not numbers or len(numbers) % 2 or not all(0 < n < math.inf for n in numbers):
        raise reader.fail("anchors", "pairs of positive numbers", repr(text))
    anchors = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    if len(anchors) > _MAX_ANCHORS:
        raise reader.fail("anchors", f"at most {_MAX_ANCHORS}", len(anchors))
    if reader.integer("num", len(anchors)) != len(anchors):
        raise reader.fail("num", f"{len(anchors)}, as many as anchors", reader.section.options["num"])
    mask = reader.integers("mask") if "mask" in reader.section.options else list(range(len(anchors)))
    if not all(0 <= index < len(anchors) for index in mask):
        raise reader.fail("mask", f"indices of {len(anchors)} anchors", mask)
    return YoloHead(
        anchors_wh=anchors,
        mask=tuple(mask),
        classes=reader.integer("classes", 20),
        ignore_threshold=reader.number("ignore_thresh", 0.5),
        match_threshold=reader.number("iou_thresh", NO_MATCH),
    )


_LAYERS = {
    "convolutional": _convolution,
    "maxpool": _max_pool,
    "route": _route,
    "shortcut": _shortcut,
    "upsample": _upsample,
    "yolo": _head,
}


def _output(
    layer: Layer,
    previous: tuple[int, int],
    all_outputs: tuple[Sequence[int], Sequence[int]],
    reader: _SectionReader,
) -> tuple[int, int]:
    """Output channels and stride of a layer.

    Args:
        layer: The layer.
        before: Of the previous layer.
        given: Of all layers so far.
        reader: Reader of its section, for errors.
    """
    channels, strides = all_outputs
    channel, stride = previous
    match layer:
        case ConvolutionLayer():
            return layer.filters, stride * layer.stride
        case MaxPoolLayer():
            return channel, stride * layer.stride
        case RouteLayer():
            route_strides = sorted({strides[i] for i in layer.layers})
            if len(route_strides) != 1:
                raise reader.fail("layers", "layers of one stride", f"strides {route_strides}")
            return sum(channels[i] for i in layer.layers), route_strides[0]
        case ShortcutLayer():
            other = channels[layer.layer], strides[layer.layer]
            if other != previous:
                expected = f"{channel} channels at stride {stride}"
                raise reader.fail("from", expected, f"{other[0]} at {other[1]}")
            return previous
        case UpsampleLayer():
            if stride % layer.factor:
                raise reader.fail("stride", f"a divisor of {stride}", layer.factor)
            return channel, stride // layer.factor
        case YoloHead():
            expected = len(layer.mask) * (_VALUES_PER_BOX + layer.classes)
            if channel != expected:
                raise reader.fail("mask, classes", f"{channel} numbers a cell from the layer before", expected)
            return previous


Anchors = Sequence[tuple[float, float]]
"""Widths and heights, px of the input, smallest first."""

COCO_CLASSES = 80
ANCHORS: Anchors = (
    *((10, 13), (16, 30), (33, 23)),
    *((30, 61), (62, 45), (59, 119)),
    *((116, 90), (156, 198), (373, 326)),
)
"""For COCO at 416 px: section 2.3 of the paper."""
TINY_ANCHORS: Anchors = ((10, 14), (23, 27), (37, 58), (81, 82), (135, 169), (344, 319))
"""From yolov3-tiny.cfg."""

SLIM_CLASSES = 4
SLIM_ANCHORS: Anchors = (
    *((26, 18), (13, 36), (52, 31)),
    *((33, 79), (92, 51), (70, 149)),
    *((151, 79), (228, 134), (390, 223)),
)
"""`detectors.anchors.fit_anchors` for the sizes in 3,000 generated frames (objects from 12 px on), zoomed as in
training; mean IoU 0.67.
"""

_BLOCKS = ((64, 1), (128, 2), (256, 8), (512, 8), (1024, 4))
"""Darknet-53: channels of each stage, and its residual blocks (table 1 of the paper)."""
_SLIM_BLOCKS = ((48, 1), (96, 2), (192, 3), (384, 2))
"""One stage fewer than Darknet-53, at three eighths of its width. The first convolution is strided too: at full
size its channels would cost more than all the rest.
"""
_IGNORE = 0.7
"""`ignore_thresh` of the published files; the paper states 0.5."""
_SLIM_MATCH = 0.35
"""`iou_thresh`: about three anchors predict an object, which speeds up learning."""


class _CfgBuilder:
    """Collects sections. ValueError if the number of anchors does not fit the layout."""

    def __init__(self, size_hw: tuple[int, int], anchors: Anchors, anchor_count: int) -> None:
        if len(anchors) != anchor_count:
            raise ValueError(f"anchors: expected {anchor_count}, found {len(anchors)}")
        net = {"height": str(size_hw[0]), "width": str(size_hw[1]), "channels": "3"}
        self.sections = [CfgSection("net", net)]

    def add(self, kind: str, **options: object) -> int:
        """Append a layer and return its number."""
        self.sections.append(CfgSection(kind, {key: str(value) for key, value in options.items()}))
        return len(self.sections) - 2

    def convolve(self, filters: int, size: int, stride: int = 1) -> int:
        shape = {"filters": filters, "size": size, "stride": stride, "pad": 1}
        return self.add("convolutional", batch_normalize=1, **shape, activation="leaky")

    def residual(self, channels: int) -> int:
        self.convolve(channels // 2, 1)
        self.convolve(channels, 3)
        return self.add("shortcut", **{"from": -3, "activation": "linear"})

    def head(self, anchors: Anchors, mask: Sequence[int], classes: int, **options: object) -> int:
        filters = len(mask) * (5 + classes)
        self.add("convolutional", size=1, stride=1, pad=1, filters=filters, activation="linear")
        return self.add(
            "yolo",
            mask=",".join(map(str, mask)),
            anchors=", ".join(f"{w:g},{h:g}" for w, h in anchors),
            classes=classes,
            num=len(anchors),
            **options,
        )


def yolov3(classes: int = COCO_CLASSES, anchors: Anchors = ANCHORS) -> DarknetCfg:
    """Darknet-53 and three heads at strides 32, 16 and 8; nine anchors."""
    layers = _CfgBuilder((416, 416), anchors, len(ANCHORS))
    layers.convolve(32, 3)
    ends = []
    for channels, blocks in _BLOCKS:
        layers.convolve(channels, 3, 2)
        ends.append([layers.residual(channels) for _ in range(blocks)][-1])
    for level, (channels, skip) in enumerate(((512, None), (256, ends[3]), (128, ends[2]))):
        if skip is not None:
            layers.add("route", layers=-4)
            layers.convolve(channels, 1)
            layers.add("upsample", stride=2)
            layers.add("route", layers=f"-1, {skip}")
        for _ in range(3):
            layers.convolve(channels, 1)
            layers.convolve(2 * channels, 3)
        first = 3 * (2 - level)
        layers.head(anchors, range(first, first + 3), classes, ignore_thresh=_IGNORE, truth_thresh=1)
    return build(layers.sections, "yolov3")


def yolov3_tiny(classes: int = COCO_CLASSES, anchors: Anchors = TINY_ANCHORS) -> DarknetCfg:
    """Seven convolutions with poolings, and two heads at strides 32 and 16; six anchors."""
    layers = _CfgBuilder((416, 416), anchors, len(TINY_ANCHORS))
    for channels in (16, 32, 64, 128):
        layers.convolve(channels, 3)
        layers.add("maxpool", size=2, stride=2)
    skip = layers.convolve(256, 3)
    layers.add("maxpool", size=2, stride=2)
    layers.convolve(512, 3)
    layers.add("maxpool", size=2, stride=1)
    layers.convolve(1024, 3)
    layers.convolve(256, 1)
    layers.convolve(512, 3)
    layers.head(anchors, (3, 4, 5), classes, ignore_thresh=_IGNORE, truth_thresh=1)
    layers.add("route", layers=-4)
    layers.convolve(128, 1)
    layers.add("upsample", stride=2)
    layers.add("route", layers=f"-1, {skip}")
    layers.convolve(256, 3)
    layers.head(anchors, (0, 1, 2), classes, ignore_thresh=_IGNORE, truth_thresh=1)
    return build(layers.sections, "yolov3-tiny")


def yolov3_slim(classes: int = SLIM_CLASSES, anchors: Anchors = SLIM_ANCHORS) -> DarknetCfg:
    """A Darknet of eight narrow residual blocks, and three heads with short necks at strides 32, 16 and 8."""
    layers = _CfgBuilder((384, 1248), anchors, len(SLIM_ANCHORS))
    layers.convolve(24, 3, 2)
    ends = []
    for channels, blocks in _SLIM_BLOCKS:
        layers.convolve(channels, 3, 2)
        ends.append([layers.residual(channels) for _ in range(blocks)][-1])
    layers.convolve(128, 1)
    layers.convolve(256, 3)
    for level, skip in enumerate((None, ends[2], ends[1])):
        if skip is not None:
            layers.add("route", layers=-4)
            layers.convolve(32, 1)
            layers.add("upsample", stride=2)
            layers.add("route", layers=f"-1, {skip}")
        channels = 128 if skip is None else 64
        layers.convolve(channels, 1)
        layers.convolve(2 * channels, 3)
        first = 3 * (2 - level)
        mask = range(first, first + 3)
        layers.head(anchors, mask, classes, ignore_thresh=0.5, truth_thresh=1, iou_thresh=_SLIM_MATCH)
    return build(layers.sections, "yolov3-slim")
