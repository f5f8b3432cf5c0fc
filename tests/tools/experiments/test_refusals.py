"""What each experiment refuses, in one line that names the option."""

from collections.abc import Callable
from pathlib import Path

import pytest

from scene_ir import files
from tests.drivesem.commands.conftest import write_finished_run
from tests.tools.experiments.test_worth_command import TABLE, write_study

REFUSALS = [
    ("fifty", "found fifty"),
    ("single --steps 0", "--steps: expected at least 1, found 0"),
    ("samples --queries 0", "--queries: expected at least 1, found 0"),
    ("single --bootstrap -1", "--bootstrap: expected at least 0"),
    ("single --dataset kitti", "--root: expected the folder of data set 'kitti'"),
    ("single --t-star 2", "--t-star: expected a score"),
    ("single --budget huge", "--budget"),
    ("multi --other-detector yolov3", "--other-detector: expected"),
    ("multi --from {folder}", "study.json: expected a readable"),
    ("multi --from {folder}/none", "--results: expected"),
    ("transfer --detectors squeezdet", "--detectors: expected detectors (squeezedet, "),
    ("transfer --detectors ,", "--detectors: expected detectors with commas"),
    ("transfer --sources squeezedet,squeezedet", "--sources: expected each detector once, found squeezedet"),
    ("transfer --detector squeezdet", "--detector: expected a detector"),
    ("transfer --t-star 0", "--t-star: expected a score"),
    ("retrain --train-steps 0", "--train-steps: expected at least 1, found 0"),
    ("retrain --fresh 0", "--fresh: expected at least 1, found 0"),
    ("retrain --benign-frames -3", "--benign-frames: expected at least 1, found -3"),
    ("retrain --held-out x", "--held-out, --benign-root: expected none with the embedded frames"),
    ("retrain --detector squeezdet", "--detector: expected a detector that can be trained"),
    ("retrain --detector onnx:none.onnx", "--detector: none.onnx: expected an ONNX file"),
    ("retrain --mix half", "half"),
    ("retrain --dataset kitti", "--root: expected the folder of data set 'kitti'"),
    ("plausibility", "--run: expected a folder of drivesem attack, found nothing"),
    ("plausibility --run {folder}", "--run: expected a folder of drivesem attack"),
    ("plausibility --run {run} --limit 0", "--limit: expected at least 1"),
    ("realism", "RUN: expected folders of drivesem attack, found nothing"),
    ("realism {folder}", "RUN: expected a folder of drivesem attack"),
    ("realism {run} {run}", "each run once"),
    ("realism {run} --metrics psnr,beauty", "--metrics: expected available, or psnr"),
    ("realism {run} --metrics lpips-alex", "alexnet-owt-*.pth"),
    ("realism {run} --weights {run}/metrics.json", "--weights: expected a folder"),
    ("realism {run} --limit 0", "--limit: expected at least 1"),
    ("realism {run} --bootstrap -1", "--bootstrap: expected at least 0"),
    ("realism {run} --out {run}/metrics.json", "--out: expected a folder"),
    ("realism {resized} --metrics psnr", "expected pictures of one size"),
    ("realism {damaged} --metrics psnr", "counterexample.png: expected an image"),
    ("worth", "RUN: expected folders of drivesem attack, or --table, or --study, found nothing"),
    ("worth {run} --table x.csv", "found several of them"),
    ("worth {run} --after x.csv", "--after: expected --table"),
    ("worth --table x.csv --second squeezedet", "--second: expected runs"),
    ("worth {run} --base 1", "--base: expected e, or a number above 1, found '1'"),
    ("worth {run} --base two", "--base"),
    ("worth {run} --bootstrap 20", "--bootstrap: expected --study"),
    ("worth {run} --metrics ssim", "--metrics: expected --study"),
    ("worth {run} --distance psnr", "--distance: expected none, perceptual"),
    ("worth {run} --distance none --second nobody", "--second: expected a detector"),
    ("worth {folder}", "RUN: expected a folder of drivesem attack"),
    ("worth {run} {other}", "RUN: expected runs against one detector"),
    ("worth --table {table} --after {relabelled}", "--after: expected the classes and labels of table"),
    ("worth --study {run}", "--study: expected the folder of a finished study"),
    ("worth --study {study}", "--study: expected a finished run"),
    ("survey", "RUN: expected folders"),
    ("survey {run} --items 0", "--items: expected at least 1"),
    ("survey {run} --out {table}", "--out: expected a folder"),
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run, one against another detector, damaged ones, a study with an unfinished run, tables of answers."""
    folder = tmp_path_factory.mktemp("inputs")
    paths = {
        name: folder / name for name in ("run", "other", "resized", "damaged", "study", "table", "relabelled")
    }
    for name in ("run", "other", "resized", "damaged"):
        write_finished_run(paths[name])
    config = paths["other"] / "config.yaml"
    files.write_text(config, files.read_text(config).replace("squeezedet", "yolov3-slim"))
    picture = files.read_image(paths["run"] / "frames" / "a" / "rerender.png")
    files.write_png(paths["resized"] / "frames" / "a" / "rerender.png", picture[:70, :90])
    (paths["damaged"] / "frames" / "a" / "counterexample.png").write_bytes(b"no picture")
    write_study(paths["study"], "multi", "combo-1")
    (paths["study"] / "arms" / "combo-1" / "metrics.json").unlink()
    paths["table"].write_text(TABLE)
    paths["relabelled"].write_text(TABLE.replace("bus,0.2", "bench,0.2"))
    return paths | {"folder": folder}


@pytest.mark.parametrize(("words", "message"), REFUSALS)
def test_refusal(
    words: str,
    message: str,
    inputs: dict[str, Path],
    refused: Callable[..., str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    assert message in refused(*(word.format_map(inputs) for word in words.split()))
