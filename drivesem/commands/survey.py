"""`drivesem survey` makes the page that asks people."""

from __future__ import annotations

from drivesem.config.commands import Survey
from drivesem.report.answer import print_json
from drivesem.report.tables import number_of
from drivesem.report.terminal import Console
from drivesem.run.finished import load_runs
from drivesem.run.folder import folder_of
from scene_ir import files
from tools.experiments.survey.page import (
    CHANGED,
    KEY,
    PAGE,
    UNCHANGED,
    items_of,
    render_page,
    survey_name,
    write_key,
)


def run(config: Survey) -> int:
    """Make the page and its key; exit code 0. Raises UsageError or SceneError for bad input."""
    runs = load_runs(config.runs, setting="RUN")
    out = folder_of(config.out, runs[0].folder / "survey")
    chosen = items_of(runs, config.items, config.controls, config.seed)
    items = [item for item, _ in chosen]
    page = render_page(chosen)
    files.write_text(out / PAGE, page)
    write_key(out / KEY, items, {"runs": [str(one.folder) for one in runs], "seed": config.seed})
    counts = {kind: sum(item.kind == kind for item in items) for kind in (CHANGED, UNCHANGED)}
    data = {"survey": survey_name(items), "page": str(out / PAGE), "key": str(out / KEY), **counts}
    data["megabytes"] = round(len(page) / 1e6, 2)
    console = Console(stderr=True)
    if config.json:
        print_json(data)
    if counts[CHANGED] < config.items:
        console.print(
            f"only {counts[CHANGED]} of {number_of(config.items, 'picture')}: the runs have no more",
            soft_wrap=True,
        )
    console.print(f"give people {out / PAGE}, keep {out / KEY}", soft_wrap=True, highlight=False)
    return 0
