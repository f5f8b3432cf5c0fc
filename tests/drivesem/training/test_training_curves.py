"""The picture of a run: averages by hand, and that what is drawn shows."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from drivesem.training.card import moving_average, plot_curves, read_columns


def test_smoothed_by_hand() -> None:
    assert moving_average([1.0, 2.0, 6.0, 1.0], 1).tolist() == [1, 2, 6, 1]
    assert moving_average([1.0, 2.0, 6.0, 1.0], 3) == pytest.approx([1.5, 3.0, 3.0, 3.5])
    assert moving_average(np.full(9, 4.0), 20) == pytest.approx(np.full(9, 4.0))


def test_empty_fields_are_unknown(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("step,ap\n1,\n2,0.5\n")
    columns = read_columns(tmp_path / "a.csv")
    assert columns["step"].tolist() == [1, 2]
    assert np.isnan(columns["ap"][0])
    assert read_columns(tmp_path / "none.csv") == {}


def test_curves_are_drawn(tmp_path: Path) -> None:
    log, evaluations, out = tmp_path / "log.csv", tmp_path / "e.csv", tmp_path / "curves.png"
    plot_curves(log, evaluations, out, "nothing yet")
    assert not out.exists()
    rows = [f"{i},{i}.0,0.001,{9 / i},{5 / i},{14 / i},3" for i in range(1, 60)]
    log.write_text("step,seconds,rate,box,class,total,norm\n" + "\n".join(rows) + "\n")
    plot_curves(log, evaluations, out, "a run")
    alone = cv2.imread(str(out))
    evaluations.write_text("step,car_ap50,car_recall,ap50,f1\n30,0.4,0.5,0.3,0.2\n59,0.9,0.95,0.8,0.7\n")
    plot_curves(log, evaluations, out, "a run")
    both = cv2.imread(str(out))
    assert both.shape == alone.shape
    assert min(both.shape[:2]) > 500
    changed = np.flatnonzero((both != alone).any(axis=(1, 2)))
    assert len(changed) > 100
