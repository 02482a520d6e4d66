"""The page as one self-contained HTML document: inline styles and script, allowed by their hashes.

Two variants share most parts: one for MCP App hosts, one for ``vehanchor view``.
"""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from vehanchor.imagery.formats.header import SUFFIXES
from vehanchor.options import declared_options
from vehanchor.records.columns import COLUMNS
from vehanchor.rulers.standards import standards
from vehanchor.scale.countries import COUNTRY_LENGTHS_M, REGIONS
from vehanchor.scale.defaults import INTERVAL_PREMISE

if TYPE_CHECKING:
    from collections.abc import Iterable

    from mcp.server.apps import Apps

APP_URI = "ui://vehanchor/panel.html"
APP_META: dict[str, Any] = {"ui": {"resourceUri": APP_URI}}
"""The ``_meta`` of each tool whose results the page shows."""

PAGE_ONLY_META: dict[str, Any] = {"ui": {"resourceUri": APP_URI, "visibility": ["app"]}}
"""The ``_meta`` of a tool that the page calls and models do not see."""

_SHARED = (
    "elements",
    "units",
    "sections",
    "shapes",
    "zoom",
    "picture",
    "measuring",
    "known",
    "correcting",
    "crosshair",
    "fitting",
    "tools",
    "rulers",
    "record",
    "facts",
    "panel",
)
# The scripts of each page, in this order.
_HOST_PARTS = ("call", "host", *_SHARED, "embedded")
_VIEW_PARTS = ("call", "local", *_SHARED, "exporting", "thumbnails", "overview", "chooser")


def app_extension() -> Apps:
    """Create the MCP Apps extension with the page as its only resource.

    Tools refer to it by ``APP_META``.
    """
    from mcp.server.apps import Apps, ResourceCsp

    apps = Apps()
    apps.add_html_resource(
        APP_URI,
        page_html(),
        name="panel",
        title="VehAnchor panel",
        description="Shows a result: the picture, all rulers, the record.",
        csp=ResourceCsp(connect_domains=[], resource_domains=[]),  # the page loads nothing
        prefers_border=True,
    )
    return apps


@cache
def page_html() -> str:
    """Return the page for MCP App hosts, an HTML5 document."""
    return _assembled(("panel.css",), _HOST_PARTS, "img-src data:")


@cache
def view_html() -> str:
    """Return the page of ``vehanchor view``: the shared parts and a list of photographs."""
    return _assembled(
        ("panel.css", "view.css"),
        _VIEW_PARTS,
        "img-src data:",
        "connect-src 'self'",
        photograph_list=_part("list.html"),
    )


def scale_arguments() -> list[str]:
    """List the arguments of a result that a measurement with the same scale repeats."""
    options = [
        name
        for name, declared in declared_options().items()
        if declared.option.tools in ("all", "measure")
    ]
    return ["image", *options]


def _options(names: Iterable[str]) -> str:
    """Return the entries of a drop-down list."""
    entries = [f'<option value="{name}">{name.replace("_", " ")}</option>' for name in names]
    return "".join(entries)


def _accepted_files() -> str:
    """Return what the browser's dialog offers: all images, and those that it may not know."""
    return ",".join(["image/*", *SUFFIXES])


def _assembled(
    styles: tuple[str, ...],
    scripts: tuple[str, ...],
    *sources: str,
    photograph_list: str = "",
) -> str:
    """Assemble a page.

    Args:
        styles: names of its style sheets.
        scripts: names of its scripts, in order, without suffix.
        sources: directives of the content security policy that allow sources.
        photograph_list: HTML of a list of photographs before the rest.
    """
    style = "\n".join(map(_part, styles))
    script = _in_one_function(scripts)
    policy = "; ".join(
        [
            "default-src 'none'",
            *sources,
            f"style-src {_hash_source(style)}",
            f"script-src {_hash_source(script)}",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    page = _part("page.html")
    values = {
        "list": photograph_list,
        "suffixes": _accepted_files(),
        "scale_arguments": " ".join(scale_arguments()),
        "interval_premise": INTERVAL_PREMISE,
        "table_columns": " ".join(COLUMNS),
        "regions": _options((*REGIONS, *COUNTRY_LENGTHS_M)),
        "known_sizes": _options(standards()),
        "policy": policy,
        "style": style,
        "script": script,
    }
    for name, text in values.items():
        page = page.replace(f"{{{{{name}}}}}", text)
    return page


def _in_one_function(names: tuple[str, ...]) -> str:
    """Wrap the script's parts in one function, to avoid global names."""
    parts = "\n".join(_part(f"{name}.js") for name in names)
    return f'"use strict";\n(() => {{\n{parts}}})();\n'


def _part(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8")


def _hash_source(text: str) -> str:
    """Return the hash of an inline style or script for the content security policy."""
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return f"'sha256-{digest}'"
