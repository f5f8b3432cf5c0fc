"""The page as a file: nothing from outside, every picture with a text, data that agree with the results."""

from __future__ import annotations

import base64
import hashlib
import io
import json
import re
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from drivesem.cli import main
from drivesem.config.commands import AttackConfig
from drivesem.reporting.plots import PLOT_COLOURS
from drivesem.run.report.frames import build_cards
from drivesem.run.results import load_frame
from drivesem.run.run_report import PROTOCOL, load_reported_runs
from scene_ir import files
from scene_ir.errors import FormatError

KITTI = Path(__file__).parents[4] / "shared" / "data" / "kitti" / "training" / "image_2"
MOST_BYTES_OF_100_FRAMES = 25e6


@pytest.fixture
def page(some_run: Path) -> Path:
    assert main(["report", str(some_run)]) == 0
    return some_run / "report.html"


def test_nothing_comes_from_outside(page: Path, parse: Callable[[Path], Any]) -> None:
    found = parse(page)
    assert not found.open_tags
    addresses = [
        a[key] for _, a in found.tags for key in ("src", "href", "xlink:href", "action", "data") if key in a
    ]
    assert addresses
    for address in addresses:
        assert address.startswith(("data:", "#")) or re.match(r"[\w.%/-]+$", address), address[:60]
    text = page.read_text(encoding="utf-8")
    assert "://" not in text
    assert "@import" not in text
    assert not found.having("script", src="")
    (policy,) = (a["content"] for a in found.having("meta") if "http-equiv" in a)
    script = text.partition("<script>")[2].partition("</script>")[0]
    assert policy == (
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src "
        f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"
    )
    assert text.count("<script") == 1
    assert script == resources.files("drivesem.run.report").joinpath("page.js").read_text(encoding="utf-8")


def test_every_picture_has_a_text(page: Path, parse: Callable[[Path], Any]) -> None:
    found = parse(page)
    images = found.having("img")
    assert len(images) >= 8
    assert all(len(image["alt"]) > 10 for image in images)
    drawn = found.having("svg")
    assert all(a.get("aria-hidden") == "true" or (a["role"] == "img" and a["aria-label"]) for a in drawn)
    labelled = {a["for"] for a in found.having("label") if "for" in a}
    text = page.read_text(encoding="utf-8")
    for control in (*found.having("input"), *found.having("select")):
        inside = re.search(rf"<label>[^\n]*(name|id|data-show)=\"{control.get('name', '-')}\"", text)
        named = "aria-label" in control or control.get("id") in labelled or inside
        assert named or "data-show" in control or control.get("id") == "order", control


def test_links_lead_to_the_files(page: Path, parse: Callable[[Path], Any], tmp_path: Path) -> None:
    run = page.parent
    elsewhere = tmp_path / "other" / "page.html"
    assert main(["report", str(run), "--out", str(elsewhere)]) == 0
    for where in (page, elsewhere):
        links = [a["href"] for a in parse(where).having("a")]
        pictures = [link for link in links if link.endswith(("benign.png", "counterexample.png", "result.json"))]
        assert len(pictures) == 3 * 4
        for link in pictures:
            assert (where.parent / link.replace("%20", " ")).is_file(), link
        anchors = {a["id"] for _, a in parse(where).tags if "id" in a}
        assert all(link[1:] in anchors for link in links if link.startswith("#"))


def test_filters_agree_with_the_results(page: Path, parse: Callable[[Path], Any]) -> None:
    found = parse(page)
    for tag in ("article", "tr"):
        rows = [a for a in found.having(tag) if "data-frame" in a]
        assert len(rows) == 4
        for row in rows:
            result = load_frame(page.parent / "frames" / row["data-name"] / "result.json")
            kinds = [failure.kind for failure in result.failures]
            assert int(row["data-lost"]) == kinds.count("lost")
            assert int(row["data-phantoms"]) == kinds.count("phantom")
            wanted = {"translate", "rotate", "mesh"} | ({"weather"} if row["data-name"] == "000003" else set())
            assert set(row["data-params"].split()) == wanted
            shares = [100 * abs(c.value) / (c.upper if c.value > 0 else -c.lower) for c in result.theta]
            assert float(row["data-size"]) == pytest.approx(max(shares), abs=0.051)
            assert row["data-weather"] == ("rain" if "rain" in row["data-name"] else "")
        ranks = [int(row["data-rank"]) for row in rows]
        assert ranks == [1, 2, 3, 4]
        # both failures first, then the smaller of two changes that were enough
        assert [row["data-name"] for row in rows] == ["0001/rain/00004", "000003", "000002", "000001"]


def test_boxes_are_those_of_the_results(page: Path, parse: Callable[[Path], Any]) -> None:
    found = parse(page)
    result = load_frame(page.parent / "frames" / "000002" / "result.json")
    (lost,) = result.failures
    drawn = {(a["x"], a["y"], a["width"], a["height"]) for a in found.having("rect")}
    x0, y0, x1, y1 = lost.xyxy
    assert (str(x0), str(y0), str(x1 - x0), str(y1 - y0)) in drawn
    kinds = [a["class"] for a in found.having("g")]
    # in the picture and in the close-ups of its own frame, and at the head of the page
    assert kinds.count("box lost") >= 2 + 2
    assert "0.90 → 0.30" in found.text
    assert "nothing → 0.70" in found.text


def test_paper_results_only_with_the_papers_protocol(
    tmp_path: Path,
    page: Path,
    frame: Callable[..., Any],
    make_run: Callable[..., Path],
    parse: Callable[[Path], Any],
) -> None:
    text = parse(page).text
    assert "65.9" not in text
    assert "does not follow the paper's protocol" in text
    theirs = make_run(tmp_path / "theirs", [frame("1", lost=True)], AttackConfig(**PROTOCOL))  # pyright: ignore[reportArgumentType]
    assert main(["report", str(theirs)]) == 0
    text = parse(theirs / "report.html").text
    assert "99.4 → 65.9" in text
    assert "This run follows the paper's protocol" in text
    both = tmp_path / "own"
    own = make_run(both, [frame("1")])
    assert main(["report", str(own), str(theirs), "--out", str(tmp_path / "both.html")]) == 0
    assert "paper's mAP after" in parse(tmp_path / "both.html").text


def test_the_page_shows_the_metrics(page: Path, parse: Callable[[Path], Any]) -> None:
    found = parse(page)
    metrics = json.loads((page.parent / "metrics.json").read_text())
    text = " ".join(found.text.split())
    assert f"{100 * metrics['benign']['ap50']:.1f} → {100 * metrics['attacked']['moved']['ap50']:.1f}" in text
    assert "squeezedet loses 2 objects and reports 2, in 3 of 4 attacked frames" in text
    for what in ("+0.21 m", "−0.08 m", "+17.2°", "1 offsets, up to 0.04 m", "drivesem attack"):
        assert what in text


def test_a_cap_on_pictures_keeps_all_frames_in_the_table(some_run: Path, parse: Callable[[Path], Any]) -> None:
    assert main(["report", str(some_run), "--frames", "2"]) == 0
    found = parse(some_run / "report.html")
    assert len(found.having("article")) == 2
    assert len([a for a in found.having("tr") if "data-frame" in a]) == 4
    assert "Pictures of the 2 worst of 4 frames" in found.text


def test_a_missing_picture_is_named(some_run: Path) -> None:
    embedded, _ = load_reported_runs([str(some_run)])
    (some_run / "frames" / "000002" / "benign.png").unlink()
    with pytest.raises(FormatError, match=r"000002/benign.png: expected a picture of the run, found none"):
        build_cards(embedded, 4)


def test_a_hundred_frames_stay_small(
    frame: Callable[..., Any], make_run: Callable[..., Path], tmp_path: Path
) -> None:
    """A street's photograph where the shared data are, else noise of much the same weight, at KITTI's size."""
    photographs = sorted(KITTI.glob("*.png"))
    if photographs:
        image = files.read_image(photographs[0])
    else:
        coarse = np.random.default_rng(0).integers(0, 255, (47, 156, 3)).astype(np.uint8)
        image = np.asarray(Image.fromarray(coarse).resize((1242, 375), Image.Resampling.BICUBIC))
    run = make_run(tmp_path / "run", [frame("one", lost=True, phantom=True)])
    for name in ("benign", "counterexample"):
        files.write_png(run / "frames" / "one" / f"{name}.png", image)
    assert main(["report", str(run)]) == 0
    text = (run / "report.html").read_text(encoding="utf-8")
    article = text[text.index("<article") : text.index("</article>")]
    assert 100 * len(article.encode()) < MOST_BYTES_OF_100_FRAMES
    source = re.findall(r'src="data:image/webp;base64,([^"]+)"', article)[0]
    embedded, full = Image.open(io.BytesIO(base64.b64decode(source))), Image.fromarray(image)
    assert embedded.size == full.size
    # in grey: colour has half the resolution, as in any JPEG
    grey = [np.asarray(picture.convert("L"), np.float64) for picture in (embedded, full)]
    assert 10 * np.log10(255**2 / np.mean((grey[0] - grey[1]) ** 2)) > 30


def _luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def _contrast(a: str, b: str) -> float:
    high, low = sorted((_luminance(a), _luminance(b)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_colours_are_distinguishable() -> None:
    """WCAG 2.1 AA: 4.5 for text, 3 for lines, where they are not yellow or light blue with a dash as well."""
    style = resources.files("drivesem.reporting").joinpath("style.css").read_text(encoding="utf-8")
    light, dark = (
        dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", part)) for part in re.findall(r":root {(.+?)}", style, re.S)
    )
    for colours in (light, light | dark):
        for text in ("fg", "soft", "accent", "bad", "good"):
            for ground in ("bg", "card", "wash"):
                assert _contrast(colours[text], colours[ground]) >= 4.5, (text, ground)
        assert all(_contrast(colours[f"s{i}"], colours["card"]) >= 3 for i in (0, 1, 2))
        for kind in ("true", "found", "lost", "phantom"):
            assert _contrast(colours[kind], "#000000") >= 4.5
    assert [light[f"s{i}"].upper() for i in range(7)] == list(PLOT_COLOURS)
