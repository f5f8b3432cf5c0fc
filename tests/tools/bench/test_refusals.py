"""What each benchmark refuses, in one line that names the option."""

from pathlib import Path

import pytest

from tools.bench.__main__ import main


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("derender --frames 0", "--frames: expected at least 1, found 0"),
        ("derender --frames -3", "--frames: expected at least 1, found -3"),
        ("derender --workers 0", "--workers"),
        ("derender --device quantum", "quantum"),
        ("found --detector onnx:gone.onnx", "gone.onnx: expected an ONNX file, found none"),
        ("found --detector nowhere", "--detector: expected a detector (squeezedet"),
        ("found --dataset kitti", "--root: expected the folder of data set 'kitti'"),
        ("found --dataset kitti --root . --scenes .", "--scenes: expected no --dataset"),
        ("found --device meta", "--device: expected cpu"),
        ("found --scenes .", "expected scenes as drivesem derender writes them, found none"),
        ("gradcheck --dataset kitti", "--root"),
        ("gradcheck --dataset kitty --root .", "kitty"),
        ("gradcheck --root somewhere", "--root"),
        ("gradcheck --directions 0", "--directions: expected at least 1, found 0"),
        ("gradcheck --min-cosine 2", "--min-cosine"),
        ("gradcheck --max-error 0", "--max-error"),
        ("gradcheck --max-error nan", "--max-error"),
        ("gradcheck --detector nowhere.safetensors", "nowhere.safetensors"),
        ("gradcheck --device quantum", "--device"),
        ("gradcheck --draws 3", "--draws: expected --reach"),
        ("gradcheck --reach --draws 1", "--draws: expected at least 2"),
        ("gradcheck --reach --directions 4", "--directions: expected no --reach"),
        ("gradcheck --reach --max-error 0.1", "--max-error: expected no --reach"),
        ("gradcheck --reach --detector a.safetensors", "--detector: a.safetensors: expected a weights file"),
        ("depth --dataset kitti --root nowhere", "nowhere"),
        ("depth --scenes nowhere", "nowhere"),
        ("depth --device meta", "--device: expected cpu"),
        ("label-free --dataset kitti --root nowhere", "nowhere"),
        ("label-free --device meta", "--device: expected cpu"),
        ("detector --detector onnx:graph.onnx", "--detector: graph.onnx: expected an ONNX file"),
        ("climb --device cuda", "--device"),
        ("planted --across 4 --naming climb", "--naming: expected no --across"),
        ("planted --searched 4", "--searched: expected --across"),
        ("planted --across 4 --budget mars", "--budget: expected"),
        ("planted --methods halton,luck", "--methods: expected names among"),
        ("planted --methods halton,climb --naming corners", "--naming: expected names among halton, climb"),
        ("synth --frames 3", "--frames: expected at least 10, found 3"),
        ("planted --passes 3", "--passes: expected at least"),
    ],
)
def test_refusal(
    words: str,
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("python -m tools.bench: ")
    assert message in line
