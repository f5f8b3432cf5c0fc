"""How well margins of unseen frames are predicted."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from drivesem.failures.search_log import OBJECT_FEATURES
from drivesem.run.search_memory import MARGINS, Experience
from tools.margin_model import compare_features, judge_model, main

FRAMES, OBJECTS = 10, 30


def rows(seed: int, informative: bool = True) -> np.ndarray:
    """Margins (R, F + 1) that the last feature determines, or none."""
    rng = np.random.default_rng(seed)
    features = rng.random((OBJECTS, len(OBJECT_FEATURES)))
    margins = 8 * (features[:, -1] if informative else rng.random(OBJECTS)) - 3
    return np.column_stack([features, margins]).astype(np.float32)


@pytest.mark.parametrize("informative", [True, False])
def test_only_what_features_determine_is_explained(informative: bool) -> None:
    both = np.concatenate([rows(seed, informative) for seed in range(FRAMES)])
    explained, auc, inside = judge_model(both, np.repeat(np.arange(FRAMES), OBJECTS))
    assert explained > 0.9 if informative else explained < 0.1
    assert auc > 0.95 if informative else auc == pytest.approx(0.5, abs=0.1)
    assert 0.5 < inside <= 1


def write_run(folder: Path, frames: int) -> Path:
    for number in range(frames):
        path = folder / "frames" / f"{number:06d}" / MARGINS
        path.parent.mkdir(parents=True)
        empty = Experience.empty()
        Experience(rows(number), empty.scene, empty.objects, empty.cells).write(path)
    return folder


def test_a_feature_that_is_left_out_is_missed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = {row[0]: row for row in compare_features(write_run(tmp_path, FRAMES))}
    assert len(table) == len(OBJECT_FEATURES) + 1
    assert table["all"][1:3] == (f"{FRAMES}", f"{FRAMES * OBJECTS}")
    assert float(table["all"][4]) > 0.9 > 0.2 > float(table[f"without {OBJECT_FEATURES[-1]}"][4])
    main([str(tmp_path)])
    assert "| all | 10 | 300 |" in capsys.readouterr().out


def test_a_run_of_few_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([str(write_run(tmp_path, 4))])
    assert end.value.code == 2
    assert capsys.readouterr().err == f"run: expected 5 frames with margins.npz or more, found 4 in {tmp_path}\n"
