"""Self-contained HTML pages from Jinja templates, with a strict content security policy."""

from __future__ import annotations

import base64
import functools
import hashlib
from importlib import resources
from typing import Any

import jinja2
from markupsafe import Markup

from drivesem.reporting.tables import format_count


def render_page(template: str, script: str | None = None, **values: Any) -> str:
    """Return the text of a page.

    Args:
        template: `PACKAGE:FILE` of a template that extends `drivesem.reporting:base.html`; it may call
            `format_count`.
        script: `PACKAGE:FILE` of the only script that the content security policy allows, by its hash.
        values: Variables of the template; they are escaped.
    """
    source = None if script is None else _read_resource(script)
    return _load_template(template).render(
        format_count=format_count,
        style=Markup(_read_resource("drivesem.reporting:style.css")),
        script=None if source is None else Markup(source),
        script_hash=None if source is None else Markup(_hash_script(source)),
        **values,
    )


@functools.cache
def _load_template(name: str) -> jinja2.Template:
    """Return a compiled template."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, loader=jinja2.FunctionLoader(_read_resource)
    )
    return environment.get_template(name)


def _read_resource(name: str) -> str:
    package, _, file = name.partition(":")
    return resources.files(package).joinpath(file).read_text(encoding="utf-8")


def _hash_script(script: str) -> str:
    """Return the `script-src` source expression of a script."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode('ascii')}"
