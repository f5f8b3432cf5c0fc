"""Folders in stores: what a command makes there, here, on another machine, and after it was cut off anywhere."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.local import LocalFileSystem
from fsspec.implementations.memory import MemoryFileSystem

from drivesem import store
from drivesem.cli import main
from drivesem.config.errors import UsageError
from drivesem.data.registry import open_dataset
from drivesem.store import RemoteFolder, local_copy
from scene_ir.errors import FormatError
from tests.drivesem.commands.test_attack_command import contents, without_times
from tests.drivesem.invoke import refusal, run_json

ATTACK = [
    "attack",
    "--params",
    "color",
    "--method",
    "fgsm",
    "--second-detector",
    "off",
    "--no-confirm",
    "--workers",
    "1",
]


class Plain(LocalFileSystem):
    """Files without a rename. What is being written when it is cut off is there in part."""

    protocol = "plain"
    writes_left: float = float("inf")
    raised: type[BaseException] = KeyboardInterrupt

    @classmethod
    def _strip_protocol(cls, path: Any) -> Any:
        return super()._strip_protocol(str(path).removeprefix("plain://"))

    def mv(self, *arguments: Any, **options: Any) -> None:
        raise NotImplementedError("a store that cannot rename")

    mv_file = rename = move = mv

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **options: Any) -> None:
        Plain.writes_left -= 1
        if Plain.writes_left < 0:
            Path(path).write_bytes(value[: len(value) // 2])
            raise Plain.raised("cut off")
        super().pipe_file(path, value, mode, **options)

    def rm_file(self, path: str) -> None:
        Plain.writes_left -= 1
        if Plain.writes_left < 0:
            raise Plain.raised("cut off")
        super().rm_file(path)


@pytest.fixture(autouse=True)
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Begins on one machine; calling it goes on on another, which has no copies."""
    fsspec.register_implementation("plain", Plain, clobber=True)
    count = 0

    def another() -> None:
        nonlocal count
        count += 1
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / f"machine{count}"))
        store._copy_of.cache_clear()

    another()
    Plain.writes_left, Plain.raised = float("inf"), KeyboardInterrupt
    MemoryFileSystem.store.clear()
    yield another
    store.set_output_store(None)


def write(folder: Path, texts: dict[str, str]) -> None:
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def texts(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("kind", ["memory", "plain"])
def test_a_folder_is_elsewhere_what_it_was_here(kind: str, tmp_path: Path, machine: Any) -> None:
    url = f"{kind}://{tmp_path}/bucket/run a"
    one = RemoteFolder(url, "--out")
    one.fetch()
    first = {"config.yaml": "a", "frames/0/result.json": "{}", "frames/0/ä é.png": "p", "empty": ""}
    write(one.folder, {**first, ".lock": "", "frames/.1.0123abcd.tmp/half": "-"})
    one.upload(now=True)
    plain = {name for name in one._list_marks() if not name.startswith(".store/")}
    assert plain == set(first), "what is not whole, and a lock, stay here"
    machine()
    other = RemoteFolder(url, "--out")
    other.fetch()
    assert texts(other.folder) == first
    assert other.folder.name == "run_a"
    changed = {**first, "config.yaml": "another", "metrics.json": "1"}
    del changed["empty"]
    write(other.folder, changed)
    (other.folder / "empty").unlink()
    other.upload(now=True)
    machine()
    third = RemoteFolder(url, "--out")
    third.fetch()
    assert texts(third.folder) == changed
    assert texts(local_copy(url)) == changed
    plain = {name: third._get(name) for name in third._list_marks() if not name.startswith(".store/")}
    assert plain == {name: text.encode() for name, text in changed.items()}, "others read it too"


def test_nothing_is_copied_twice_and_what_is_gone_here_comes_back(tmp_path: Path, machine: Any) -> None:
    one = RemoteFolder(f"plain://{tmp_path}/run", "--out")
    one.fetch()
    write(one.folder, {"a": "1", "b": "2"})
    one.upload(now=True)
    Plain.writes_left = 0
    again = RemoteFolder(one.url, "--out")
    shutil.rmtree(again.folder)
    again.fetch()
    assert texts(again.folder) == {"a": "1", "b": "2"}
    again.upload(now=True)
    one.upload(now=True)


def test_a_copy_bears_what_is_written_meanwhile(
    tmp_path: Path, machine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Folders that begin while files are listed stay here; files that are gone when they are read are missing."""
    one = RemoteFolder(f"plain://{tmp_path}/run", "--out")
    one.fetch()
    write(one.folder, {"a": "1", "b": "1"})
    one.upload(now=True)
    write(one.folder, {"a": "two", "b": "two", "c": "two"})
    walk, put = os.walk, one._put

    def begun(top: Path) -> Iterator[Any]:
        write(one.folder, {"frames/.0.0123abcd.tmp/half": "-"})
        return walk(top)

    def without(name: str, data: bytes) -> None:
        put(name, data)
        for gone in ("a", "c"):  # changed and copied; new and not yet copied
            (one.folder / gone).unlink(missing_ok=True)

    with monkeypatch.context() as meanwhile:
        meanwhile.setattr(os, "walk", begun)
        meanwhile.setattr(one, "_put", without)
        one.upload(now=True)
    one.upload(now=True)
    shutil.rmtree(one.folder / "frames")
    assert texts(one.folder) == {"b": "two"}
    machine()
    assert texts(local_copy(one.url)) == {"b": "two"}
    assert not [name for name in one._list_marks() if ".tmp" in name]


def test_between_commits_there_is_what_was_there_at_one(tmp_path: Path, machine: Any) -> None:
    """Cut off at each of its writes, in the middle of a file: whoever reads sees the folder before or after."""
    states = [
        {"config.yaml": "limit: 1\n", "frames/0/photo": "0" * 40, "frames/0/result.json": "[0]"},
        {
            "config.yaml": "limit: 2\n",
            "frames/0/photo": "0" * 40,
            "frames/0/result.json": "[0]",
            "frames/1/photo": "1" * 40,
            "frames/1/result.json": "[1]",
            "metrics.json": "whole",
        },
        {"config.yaml": "limit: 3\n", "frames/1/photo": "1" * 40, "metrics.json": "whole again"},
    ]
    for cut in range(40):
        Plain.writes_left = cut
        machine()
        one = RemoteFolder(f"plain://{tmp_path}/run{cut}", "--out")
        reached = -1
        try:
            one.fetch()
            for number, state in enumerate(states):
                shutil.rmtree(one.folder, ignore_errors=True)
                write(one.folder, state)
                one.upload(now=True)
                reached = number
        except KeyboardInterrupt:
            pass
        Plain.writes_left = float("inf")
        machine()
        other = RemoteFolder(one.url, "--out")
        other.fetch()
        seen = texts(other.folder) if other.folder.exists() else {}
        assert seen in ([{}] if reached < 0 else [states[reached]]) + states[reached + 1 : reached + 2], cut
        write(other.folder, states[2])
        other.upload(now=True)
        machine()
        third = RemoteFolder(one.url, "--out")
        third.fetch()
        assert texts(third.folder) == seen | states[2], "it goes on"
        if reached == 2:
            break
    assert reached == 2
    assert cut > 12


def test_on_another_machine_the_copy_lies_under_the_same_name(tmp_path: Path, machine: Any) -> None:
    one = RemoteFolder(f"plain://{tmp_path}/run", "--out")
    machine()
    other = pickle.loads(pickle.dumps(one))
    assert (other.url, other.folder) == (one.url, one.folder)
    assert RemoteFolder(one.url, "--out").folder != one.folder


def test_damaged_files_are_not_there_and_names_stay_in_the_folder(tmp_path: Path, machine: Any) -> None:
    one = RemoteFolder(f"plain://{tmp_path}/run", "--out")
    one.fetch()
    write(one.folder, {"a": "1", "b": "2"})
    one.upload(now=True)
    (tmp_path / "run" / "a").write_text("another")
    machine()
    other = RemoteFolder(one.url, "--out")
    other.fetch()
    assert texts(other.folder) == {"b": "2"}
    write(other.folder, {"a": "made anew"})
    other.upload(now=True)
    machine()
    assert texts(local_copy(one.url)) == {"a": "made anew", "b": "2"}
    for content in ({"../a": [1, 0, "0"]}, {"/etc/a": None}, {"a": [1]}, [1], {"a": 5}):
        data = json.dumps(content).encode()
        name = f"000099-{store.hashlib.sha256(data).hexdigest()[:16]}.json"
        path = tmp_path / "run" / ".store" / name
        path.write_bytes(data)
        machine()
        with pytest.raises(FormatError):
            local_copy(one.url)
        path.unlink()


def test_a_folder_of_others_is_compared_by_the_metadata_of_the_store(tmp_path: Path, machine: Any) -> None:
    files = fsspec.filesystem("memory")
    for name, text in {"a": b"1", "deep/b": b"2", "c": b"3"}.items():
        files.pipe_file(f"/data/{name}", text)
    assert texts(local_copy("memory://data")) == {"a": "1", "deep/b": "2", "c": "3"}
    files.pipe_file("/data/a", b"one")
    files.rm_file("/data/c")
    (local_copy("memory://data") / "deep" / "b").write_text("not fetched again")
    store._copy_of.cache_clear()
    assert texts(local_copy("memory://data")) == {"a": "one", "deep/b": "not fetched again"}
    assert local_copy(tmp_path) == local_copy(str(tmp_path)) == tmp_path


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["confirm", "--run", "s3://bucket/run"], "--run: expected a path on this machine"),
        (["report", "memory://run"], "--runs: expected a path on this machine"),
        (["train", "--root", "gs://bucket/kitti"], "--root: expected a path on this machine"),
        (["runs", "prune", "memory://run"], "FOLDER: expected a folder on this machine, to prune"),
        (
            ["attack", "--out", "nothing://bucket"],
            "--out: expected a folder, or a URL with a library that is installed",
        ),
        (["attack", "--dataset", "kitti", "--root", "memory://none"], "--root: expected a folder with files"),
        (["runs", "show", "memory://none"], "FOLDER: expected a folder with files"),
    ],
)
def test_urls_that_cannot_be_used_are_refused_in_one_line(words: list[str], message: str) -> None:
    assert message in refusal(*words)


def test_an_attack_on_a_store_equals_a_local_one(
    tmp_path: Path, machine: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"plain://{tmp_path}/bucket/run"
    assert main([*ATTACK, "--limit", "1", "--out", str(tmp_path / "here")]) == 0
    Plain.writes_left, Plain.raised = 6, OSError  # some files of the frame are there, and no commit
    error = refusal(*ATTACK, "--limit", "1", "--out", url)
    assert f"--out: expected a store that can be written, found {url}: OSError: cut off" in error
    copy = Path(error.partition("(the results are in ")[2].rstrip(")"))
    assert (copy / "frames" / "demo-000" / "result.json").is_file()
    Plain.writes_left = float("inf")
    here = os.environ["XDG_CACHE_HOME"]
    machine()
    assert f"FOLDER: expected a folder with files, found {url}, which is empty" in refusal("runs", "list", url)
    monkeypatch.setenv("XDG_CACHE_HOME", here)
    written = (copy / "frames" / "demo-000" / "result.json").stat().st_mtime_ns
    assert main([*ATTACK, "--limit", "1", "--out", url]) == 0
    assert (copy / "frames" / "demo-000" / "result.json").stat().st_mtime_ns == written, "nothing is made twice"
    machine()
    assert contents(local_copy(url) / "frames") == contents(tmp_path / "here" / "frames")
    metrics = [json.loads((run / "metrics.json").read_text()) for run in (local_copy(url), tmp_path / "here")]
    assert without_times(metrics[0]) == without_times(metrics[1])
    (run,) = run_json("runs", "show", url)["runs"]
    assert run["finished"]
    assert run["frames"] == 1
    assert main(["runs", "merge", url, "--out", str(tmp_path / "merged")]) == 0
    assert main(["verify", "--run", str(tmp_path / "merged")]) == 0
    assert "expected the settings of this run" in refusal(*ATTACK, "--steps", "3", "--limit", "1", "--out", url)


@pytest.mark.slow
def test_generated_frames_are_written_and_read_elsewhere(tmp_path: Path, machine: Any) -> None:
    words = ["synth", "--frames", "1", "--seed", "3", "--workers", "1", "--out"]
    assert main([*words, str(tmp_path / "here")]) == 0
    url = f"memory://{tmp_path.name}/kitti"
    assert main([*words, url]) == 0
    machine()
    (tmp_path / "here" / ".lock").unlink()
    assert contents(local_copy(url)) == contents(tmp_path / "here")
    assert open_dataset("kitti", url).identifiers == ("000000",)
    out = f"memory://{tmp_path.name}/scenes"
    taken = [
        "derender",
        "--no-fit",
        "--dataset",
        "kitti",
        "--limit",
        "1",
        "--workers",
        "1",
        "--out",
        out,
        "--root",
    ]
    assert main([*taken, url]) == 0
    machine()
    assert (local_copy(out) / "000000" / "scene.json").is_file()
    words = ["eval", "--detector", "squeezedet", "--limit", "1", "--out", str(tmp_path / "figures"), "--root"]
    assert main([*words, url]) == 0
    with pytest.raises(UsageError, match="--gt"):
        local_copy("memory://nothing", "--gt")
