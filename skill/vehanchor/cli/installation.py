"""Check of an installation for ``vehanchor models --check``: versions, and a bundled picture of known scale."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from typing import TYPE_CHECKING

import onnxruntime

if TYPE_CHECKING:
    from vehanchor.engine import Engine
    from vehanchor.records import GsdEstimate

_NEEDED = ("numpy", "scipy", "opencv-python-headless", "onnxruntime", "pydantic", "mcp")
_EXTRAS = {"rasterio": "geo", "matplotlib": "plots", "pyarrow": "parquet", "ray": "ray"}
# a rendered car park: python -m research.scenes, seed 5
_PICTURE = "bundled/check.jpg"
GSD_M_PER_PX = 0.15


def installed() -> list[tuple[str, str]]:
    """List packages and versions; for missing ones, the extra to install."""
    rows = [
        ("vehanchor", version("vehanchor")),
        ("python", f"{platform.python_version()} on {platform.platform()}"),
    ]
    for name in (*_NEEDED, *_EXTRAS):
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            extra = _EXTRAS.get(name)
            rows.append(
                (
                    name,
                    f"missing: pip install 'vehanchor[{extra}]'" if extra else "missing: reinstall",
                )
            )
    return [*rows, ("providers", ", ".join(onnxruntime.get_available_providers()))]


def check_picture(engine: Engine) -> GsdEstimate:
    """Measure the bundled picture."""
    return engine.estimate(files("vehanchor.models").joinpath(_PICTURE).read_bytes())
