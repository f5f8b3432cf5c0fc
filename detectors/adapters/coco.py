"""The 80 classes of COCO, in the orders in which detectors trained on it number them."""

from collections.abc import Iterable

NAMES = (
    "person", "bicycle", "car", "motorcycle", "airplane", "bus", "train", "truck", "boat", "traffic light",
    "fire hydrant", "stop sign", "parking meter", "bench", "bird", "cat", "dog", "horse", "sheep", "cow",
    "elephant", "bear", "zebra", "giraffe", "backpack", "umbrella", "handbag", "tie", "suitcase", "frisbee",
    "skis", "snowboard", "sports ball", "kite", "baseball bat", "baseball glove", "skateboard", "surfboard",
    "tennis racket", "bottle", "wine glass", "cup", "fork", "knife", "spoon", "bowl", "banana", "apple",
    "sandwich", "orange", "broccoli", "carrot", "hot dog", "pizza", "donut", "cake", "chair", "couch",
    "potted plant", "bed", "dining table", "toilet", "tv", "laptop", "mouse", "remote", "keyboard",
    "cell phone", "microwave", "oven", "toaster", "sink", "refrigerator", "book", "clock", "vase", "scissors",
    "teddy bear", "hair drier", "toothbrush",
)  # fmt: skip
_OURS = {"car": "Car"}


def ours(names: Iterable[str]) -> tuple[str, ...]:
    """COCO's names, "car" as this project's class."""
    return tuple(_OURS.get(name, name) for name in names)


CLASSES = ours(NAMES)
"""Their names, "car" as this project's class. The others keep COCO's: its trucks, buses and trains divide vans,
trucks and trams otherwise than KITTI does, and its people may ride. Who judges cars passes over them."""

_NEVER_USED = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
_numbers = [number for number in range(1, 91) if number not in _NEVER_USED]
CLASSES_91 = tuple(
    CLASSES[_numbers.index(number)] if number in _numbers else "" for number in range(_numbers[-1] + 1)
)
"""By the numbers in COCO's own files, as torchvision's detectors have them: 0 is the background, and ten were
never given ("")."""
