"""Darknet's `.cfg` files of the YOLOv3 family: read, checked, written.

A file is a list of sections. The first, [net], says how to train and how large the input is; each of the others is
a layer, and layers are numbered from 0 after it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from detectors.base import DetectorError

ACTIVATIONS = ("leaky", "linear")
NO_MATCH = 1.0
"""Default of a head's `iou_thresh`: only the best anchor answers for an object."""
_MOST_WHOLE = 1 << 20
_NUMBERS_A_BOX = 5
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
_OF_ANY = (
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
"""Further keys that change no box, of any section and of one: of Darknet's training, its suppression, tracking and
display, and of a GPU's streams (src/parser.c of https://github.com/AlexeyAB/darknet)."""
_NEUTRAL_OF_ANY = {"dontload": "0", "dontloadscales": "0"}
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
"""Further keys that change what a layer gives, or which weights it has, and the value with which they do not; of
any section and of one."""

_MOST_LAYERS = 1000
"""YOLOv3 has 107."""
_MOST_ANCHORS = 1000
_MOST_SIDE = 63
"""px of a kernel or a window; 13 in networks that are known."""
_MOST_STRIDE = 1024
"""px of the input, whose sides are padded to multiples of it; 64 at most in networks that are known."""
_MOST_NUMBERS = 256, 4096
"""That a layer, and all of them, may give for a pixel of the input: YOLOv3's give 32 and 329."""


@dataclass(frozen=True, slots=True)
class Section:
    """[kind] and its `key=value` lines, in their order; line: where it stands in its file; 0 is nowhere."""

    kind: str
    options: Mapping[str, str] = field(default_factory=dict)
    line: int = field(default=0, compare=False)


@dataclass(frozen=True, slots=True)
class Convolution:
    """filters: output channels; padding: px on each side; normalised: by its batch, then without a bias."""

    filters: int
    size: int
    stride: int
    padding: int
    normalised: bool
    leaky: bool


@dataclass(frozen=True, slots=True)
class MaxPool:
    size: int
    stride: int


@dataclass(frozen=True, slots=True)
class Route:
    """The outputs of these layers (absolute numbers), one behind the other along the channels."""

    layers: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Shortcut:
    """The output of the layer before plus that of this layer (absolute number)."""

    layer: int


@dataclass(frozen=True, slots=True)
class Upsample:
    """Each value repeated `factor` times in both directions."""

    factor: int


@dataclass(frozen=True, slots=True)
class Head:
    """A [yolo] section. anchors_wh: of all heads, px of the input; mask: which of them this one has.

    ignore_threshold: an anchor whose box overlaps an object more than this need not be silent; match_threshold:
    further anchors whose shape overlaps an object's more than this answer for it too.
    """

    anchors_wh: tuple[tuple[float, float], ...]
    mask: tuple[int, ...]
    classes: int
    ignore_threshold: float
    match_threshold: float


Layer = Convolution | MaxPool | Route | Shortcut | Upsample | Head


@dataclass(frozen=True, slots=True)
class Cfg:
    """A network's description. layers, channels, strides: a layer's kind, how many channels it gives, and how many
    px of the input one of its cells is wide; sections: what it was read from, [net] first.
    """

    sections: tuple[Section, ...]
    layers: tuple[Layer, ...]
    channels: tuple[int, ...]
    strides: tuple[int, ...]

    @property
    def heads(self) -> tuple[tuple[int, Head], ...]:
        """(layer number, head) of each [yolo] section."""
        return tuple((i, layer) for i, layer in enumerate(self.layers) if isinstance(layer, Head))

    @property
    def classes(self) -> int:
        return self.heads[0][1].classes

    @property
    def stride(self) -> int:
        """What the sides of an input are multiples of."""
        return math.lcm(*self.strides)


def parse(text: str, source: str = "cfg") -> Cfg:
    """Read the text of a `.cfg`. Raises DetectorError, with `source` and the line, for a section or a value that
    this family does not have, and for layers that do not fit each other.
    """
    return build(_sections(text, source), source)


def build(sections: Sequence[Section], source: str = "cfg") -> Cfg:
    """The network that sections describe; errors as `parse`."""
    if not sections or sections[0].kind not in ("net", "network"):
        line = sections[0].line if sections else 1
        raise DetectorError(f"{source}:{line}: expected [net] first, found {_kind(sections)}")
    if len(sections) > _MOST_LAYERS:
        raise DetectorError(f"{source}: expected at most {_MOST_LAYERS} sections, found {len(sections)}")
    layers: list[Layer] = []
    channels: list[int] = []
    strides: list[int] = []
    numbers: list[float] = []
    width = _Reader(sections[0], source).integer("channels", 3)
    if width != 3:
        raise DetectorError(f"{source}:{sections[0].line}: channels: expected 3, found {width}")
    for section in sections[1:]:
        reader = _Reader(section, source)
        before = (channels[-1], strides[-1]) if layers else (width, 1)
        if section.kind not in _LAYERS:
            known = ", ".join(f"[{name}]" for name in _LAYERS)
            raise DetectorError(f"{source}:{section.line}: expected one of {known}, found [{section.kind}]")
        _check_keys(reader)
        layer = _LAYERS[section.kind](reader, len(layers))
        channel, stride = _output(layer, before, (channels, strides), reader)
        layers.append(layer)
        channels.append(channel)
        strides.append(stride)
        numbers.append(channel / stride**2)
        if stride > _MOST_STRIDE or numbers[-1] > _MOST_NUMBERS[0] or sum(numbers) > _MOST_NUMBERS[1]:
            most, in_all = _MOST_NUMBERS
            expected = f"a stride up to {_MOST_STRIDE}, numbers a pixel up to {most}, {in_all} in all"
            raise reader.fail("filters, stride", expected, f"{stride}, {numbers[-1]:g}, {sum(numbers):g}")
    cfg = Cfg(tuple(sections), tuple(layers), tuple(channels), tuple(strides))
    if cfg.stride > _MOST_STRIDE:
        raise DetectorError(
            f"{source}: expected strides with a multiple of at most {_MOST_STRIDE}, found {cfg.stride}"
        )
    counts = {head.classes for _, head in cfg.heads}
    if len(counts) != 1:
        found = ", ".join(map(str, sorted(counts))) or "no [yolo]"
        raise DetectorError(f"{source}: expected [yolo] sections with the same classes, found {found}")
    return cfg


def write(cfg: Cfg) -> str:
    """The text of a `.cfg`; `parse` reads the same sections from it."""
    parts = []
    for section in cfg.sections:
        lines = [f"[{section.kind}]", *(f"{key}={value}" for key, value in section.options.items())]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _sections(text: str, source: str) -> list[Section]:
    found: list[tuple[str, dict[str, str], int]] = []
    for number, raw in enumerate(text.splitlines(), 1):
        line = raw.partition("#")[0].partition(";")[0].strip()
        if not line:
            continue
        if line.startswith("[") and line.endswith("]"):
            found.append((line[1:-1].strip(), {}, number))
        elif "=" in line and found:
            key, _, value = line.partition("=")
            found[-1][1][key.strip()] = value.strip()
        else:
            raise DetectorError(f"{source}:{number}: expected [section] or key=value, found {line!r}")
    return [Section(*parts) for parts in found]


def _kind(sections: Sequence[Section]) -> str:
    return f"[{sections[0].kind}]" if sections else "no section"


@dataclass(frozen=True, slots=True)
class _Reader:
    """Values of a section; whatever cannot be read is a DetectorError with file and line."""

    section: Section
    source: str

    def fail(self, key: str, expected: str, found: object) -> DetectorError:
        return DetectorError(
            f"{self.source}:{self.section.line}: [{self.section.kind}] {key}: expected {expected}, found {found}"
        )

    def integer(self, key: str, default: int | None = None, least: int = 1, most: int = _MOST_WHOLE) -> int:
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
        """The absolute number of a layer that is named relative to this one, where negative."""
        absolute = here + index if index < 0 else index
        if not 0 <= absolute < here:
            raise self.fail(key, f"a layer before this one, number {here}", index)
        return absolute


def _check_keys(reader: _Reader) -> None:
    """DetectorError for a key that would make another network than the one that is built."""
    kind = reader.section.kind
    passed = {*_READ[kind], *_OF_ANY, *_WITHOUT_EFFECT.get(kind, ())}
    neutral = _NEUTRAL_OF_ANY | _NEUTRAL[kind]
    for key, value in reader.section.options.items():
        if key in passed:
            continue
        if key not in neutral:
            raise reader.fail(key, "a key of YOLOv3's networks", "an unknown one")
        if value != neutral[key] and not _is_number(value, neutral[key]):
            raise reader.fail(key, neutral[key], value)


def _is_number(text: str, wanted: str) -> bool:
    """Whether a text is a number written otherwise."""
    try:
        return float(text) == float(wanted)
    except ValueError:
        return False


def _stride(reader: _Reader, most: int = _MOST_WHOLE) -> int:
    """px, of both directions."""
    stride = reader.integer("stride", 1, most=most)
    for key in ("stride_x", "stride_y"):
        found = reader.integer(key, stride)
        if found != stride:
            raise reader.fail(key, f"{stride}, the stride", found)
    return stride


def _convolution(reader: _Reader, _here: int) -> Convolution:
    activation = reader.section.options.get("activation", "logistic")
    if activation not in ACTIVATIONS:
        raise reader.fail("activation", " or ".join(ACTIVATIONS), activation)
    if reader.integer("groups", 1) != 1:
        raise reader.fail("groups", "1", reader.section.options["groups"])
    size = reader.integer("size", 1, most=_MOST_SIDE)
    padding = size // 2 if reader.integer("pad", 0, 0) else reader.integer("padding", 0, 0)
    if 2 * padding != size - 1:
        raise reader.fail("pad", f"{(size - 1) / 2:g} px for a size of {size}", padding)
    return Convolution(
        filters=reader.integer("filters"),
        size=size,
        stride=_stride(reader),
        padding=padding,
        normalised=bool(reader.integer("batch_normalize", 0, 0)),
        leaky=activation == "leaky",
    )


def _max_pool(reader: _Reader, _here: int) -> MaxPool:
    stride = _stride(reader, _MOST_SIDE)
    size = reader.integer("size", stride, most=_MOST_SIDE)
    if reader.integer("padding", size - 1, 0) != size - 1:
        raise reader.fail("padding", str(size - 1), reader.section.options["padding"])
    return MaxPool(size, stride)


def _route(reader: _Reader, here: int) -> Route:
    return Route(tuple(reader.layer("layers", index, here) for index in reader.integers("layers")))


def _shortcut(reader: _Reader, here: int) -> Shortcut:
    activation = reader.section.options.get("activation", "linear")
    if activation != "linear":
        raise reader.fail("activation", "linear", activation)
    indices = reader.integers("from")
    if len(indices) != 1:
        raise reader.fail("from", "one layer", len(indices))
    return Shortcut(reader.layer("from", indices[0], here))


def _upsample(reader: _Reader, _here: int) -> Upsample:
    return Upsample(reader.integer("stride", 2))


def _head(reader: _Reader, _here: int) -> Head:
    text = reader.section.options.get("anchors", "")
    try:
        numbers = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise reader.fail("anchors", "numbers", repr(text)) from None
    if not numbers or len(numbers) % 2 or not all(0 < n < math.inf for n in numbers):
        raise reader.fail("anchors", "pairs of positive numbers", repr(text))
    anchors = tuple(zip(numbers[::2], numbers[1::2], strict=True))
    if len(anchors) > _MOST_ANCHORS:
        raise reader.fail("anchors", f"at most {_MOST_ANCHORS}", len(anchors))
    if reader.integer("num", len(anchors)) != len(anchors):
        raise reader.fail("num", f"{len(anchors)}, as many as anchors", reader.section.options["num"])
    mask = reader.integers("mask") if "mask" in reader.section.options else list(range(len(anchors)))
    if not all(0 <= index < len(anchors) for index in mask):
        raise reader.fail("mask", f"indices of {len(anchors)} anchors", mask)
    return Head(
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
    layer: Layer, before: tuple[int, int], given: tuple[Sequence[int], Sequence[int]], reader: _Reader
) -> tuple[int, int]:
    """Channels and stride of a layer. before: of the one before it; given: of all so far."""
    channels, strides = given
    channel, stride = before
    match layer:
        case Convolution():
            return layer.filters, stride * layer.stride
        case MaxPool():
            return channel, stride * layer.stride
        case Route():
            found = sorted({strides[i] for i in layer.layers})
            if len(found) != 1:
                raise reader.fail("layers", "layers of one stride", f"strides {found}")
            return sum(channels[i] for i in layer.layers), found[0]
        case Shortcut():
            other = channels[layer.layer], strides[layer.layer]
            if other != before:
                wanted = f"{channel} channels at stride {stride}"
                raise reader.fail("from", wanted, f"{other[0]} at {other[1]}")
            return before
        case Upsample():
            if stride % layer.factor:
                raise reader.fail("stride", f"a divisor of {stride}", layer.factor)
            return channel, stride // layer.factor
        case Head():
            wanted = len(layer.mask) * (_NUMBERS_A_BOX + layer.classes)
            if channel != wanted:
                raise reader.fail("mask, classes", f"{channel} numbers a cell from the layer before", wanted)
            return before
