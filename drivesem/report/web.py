"""Pages of one file: what they share, and what they may do."""

from __future__ import annotations

import base64
import hashlib
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup

from drivesem.report.tables import number_of


def render(template: str, script: str | None = None, **values: Any) -> str:
    """A page's text. template: `PACKAGE:FILE`, which extends `drivesem.report:base.html`; script: the same of the
    one script that the page's content security policy lets run, by its hash. Values are escaped. Templates know
    `number_of`.
    """
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, loader=jinja2.FunctionLoader(_part)
    )
    told = None if script is None else _part(script)
    return environment.get_template(template).render(
        number_of=number_of,
        style=Markup(_part("drivesem.report:style.css")),
        script=None if told is None else Markup(told),
        script_hash=None if told is None else Markup(_hash(told)),
        **values,
    )


def _part(name: str) -> str:
    package, _, file = name.partition(":")
    return resources.files(package).joinpath(file).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    """A script's source expression for `script-src`, of the text between the tags."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode('ascii')}"
