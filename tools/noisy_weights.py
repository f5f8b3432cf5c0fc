"""A detector worse than it was on purpose: noise in its weights, for gates that are to notice.

    python -m tools.noisy_weights squeezedet 0.1 noisy.safetensors

Noise is normal, of so large a share of each tensor's own standard deviation. Biases and measured statistics stay.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from detectors.base import Detector, DetectorError
from detectors.registry import load_detector, save_detector


def with_noise(detector: Detector, share: float, seed: int = 0) -> Detector:
    """Add noise to the detector's weights of two or more dimensions, in place, of this share of their standard
    deviation. ValueError for a share below 0.
    """
    if not share >= 0:
        raise ValueError(f"share: expected at least 0, found {share}")
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weights in detector.parameters():
            if weights.ndim > 1:
                noise = torch.randn(weights.shape, generator=generator).to(weights)
                weights += share * weights.std() * noise
    return detector


def main() -> None:
    """Command line; exit code 2 for a detector that cannot be had."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("detector", help="a shipped one, or a file of weights")
    parser.add_argument("share", type=float, help="of each tensor's standard deviation")
    parser.add_argument("out", type=Path, help="safetensors file to write")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    try:
        detector = load_detector(options.detector)
        with_noise(detector, options.share, options.seed)
    except (DetectorError, ValueError) as error:
        parser.error(str(error))
    save_detector(detector, options.out, {"noise": f"{options.share:g}", "seed": str(options.seed)})


if __name__ == "__main__":
    main()
