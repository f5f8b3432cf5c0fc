"""The paper's figures of detection, to stand beside ours: fractions of 1. Parameters by name."""

from __future__ import annotations

PAPER_BENIGN = 0.994
"""The paper's mAP of SqueezeDet before any change."""
PAPER_SINGLE = {
    "color": 0.995,
    "weather": 0.988,
    "foliage": 0.997,
    "translate": 0.992,
    "rotate": 0.982,
    "mesh": 0.987,
}
PAPER_COMBOS = {1: 0.82, 2: 0.659, 3: 0.808, 4: 0.987}
"""The paper's mAP after the attack, by parameter and by combination."""
PAPER_LPIPS, PAPER_FID = 0.52, 0.10
"""Of the paper's pictures and their photographs; of which of them, and by which network, it does not say."""
PAPER_TRANSFER = (0.9128, 0.875)
"""The paper's mAP of a YOLOv3, trained on KITTI: on benign frames, and on counterexamples against SqueezeDet."""
