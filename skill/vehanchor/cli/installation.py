"""Check of an installation for ``vehanchor models --check``: versions, and a bundled picture of known scale."""

from __future__ import annotations

import platform
import time
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

import onnxruntime

if TYPE_CHECKING:
    from vehanchor.engine import Engine

_NEEDED = ("numpy", "scipy", "opencv-python-headless", "onnxruntime", "pydantic", "mcp")
_EXTRAS = {"rasterio": "geo", "matplotlib": "plots", "pyarrow": "parquet", "ray": "ray"}
_PICTURE, _GSD_M_PER_PX = "bundled/check.jpg", 0.15  # a rendered car park: python -m research.scenes, seed 5
_TOLERANCE = 0.15


def installed() -> list[tuple[str, str]]:
    """List packages and versions; for missing ones, the extra to install."""
    rows = [("vehanchor", version("vehanchor")), ("python", f"{platform.python_version()} on {platform.platform()}")]
    for name in (*_NEEDED, *_EXTRAS):
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            extra = _EXTRAS.get(name)
            rows.append((name, f"missing: pip install 'vehanchor[{extra}]'" if extra else "missing: reinstall"))
    return [*rows, ("providers", ", ".join(onnxruntime.get_available_providers()))]


class PictureCheck(NamedTuple):
    """Measurement of the bundled picture.

    Attributes:
        gsd_m_per_px: measured GSD; None if there is none.
        status: status of the record.
        seconds: duration of the measurement.
    """

    gsd_m_per_px: float | None
    status: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether the scale is usable and correct."""
        if self.gsd_m_per_px is None or self.status != "ok":
            return False
        return abs(self.gsd_m_per_px / _GSD_M_PER_PX - 1) <= _TOLERANCE

    def facts(self) -> list[tuple[str, str]]:
        """Describe the result by name and value."""
        measured = "no scale" if self.gsd_m_per_px is None else f"{self.gsd_m_per_px:.4g} m/px"
        return [
            ("check", "passed" if self.passed else "FAILED: reinstall, or report this"),
            ("measured", f"{measured} ({self.status}); true: {_GSD_M_PER_PX:g} m/px"),
            ("seconds", f"{self.seconds:.1f}"),
        ]


def check_picture(engine: Engine) -> PictureCheck:
    """Measure the bundled picture."""
    picture = files("vehanchor.models").joinpath(_PICTURE).read_bytes()
    started = time.perf_counter()
    record = engine.estimate(picture)
    return PictureCheck(record.gsd_m_per_px, record.status, time.perf_counter() - started)
