"""Check of an installation: versions, and a bundled picture of known scale."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from typing import TYPE_CHECKING

import onnxruntime

from vehanchor.errors import how_to_install

if TYPE_CHECKING:
    from vehanchor.engine import Engine
    from vehanchor.records import GsdEstimate

_NEEDED = ("numpy", "scipy", "opencv-python-headless", "onnxruntime", "pydantic", "mcp")
_EXTRAS = {"rasterio": "geo", "matplotlib": "plots", "pyarrow": "parquet", "ray": "ray"}
# A rendered car park: python -m research.scenes, seed 5.
_PICTURE = "bundled/check.jpg"
GSD_M_PER_PX = 0.15
"""True scale of the picture."""


def installed() -> list[tuple[str, str]]:
    """List packages and versions; for missing ones, the extra to install."""
    rows = [
        ("vehanchor", version("vehanchor")),
        ("python", f"{platform.python_version()} on {platform.platform()}"),
    ]
    for name in (*_NEEDED, *_EXTRAS):
        rows.append((name, _version_or_remedy(name)))
    providers = ", ".join(onnxruntime.get_available_providers())
    return [*rows, ("providers", providers)]


def _version_or_remedy(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        extra = _EXTRAS.get(package)
        remedy = how_to_install(extra) if extra else "reinstall"
        return f"missing: {remedy}"


def check_picture(engine: Engine) -> GsdEstimate:
    """Estimate the scale of the bundled picture."""
    picture = files("vehanchor.models").joinpath(_PICTURE)
    return engine.estimate(picture.read_bytes())
