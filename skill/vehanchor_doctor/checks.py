"""Checks of an installation: versions, a scene of known scale, images of a folder."""

from __future__ import annotations

import platform
import time
from collections import Counter
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vehanchor.engine import Engine

_NEEDED = ("numpy", "scipy", "opencv-python-headless", "onnxruntime", "pydantic", "mcp")
_EXTRAS = {"rasterio": "geo", "matplotlib": "plots", "pyarrow": "parquet", "ray": "ray"}
_SCENE_GSD_M, _SCENE_PX, _SCENE_SEED = 0.1, 800, 1
_TOLERANCE = 0.15


def installed() -> list[tuple[str, str]]:
    """List packages and versions; for missing ones, the extra to install."""
    import onnxruntime

    rows = [("vehanchor", version("vehanchor")), ("python", f"{platform.python_version()} on {platform.platform()}")]
    for name in (*_NEEDED, *_EXTRAS):
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            extra = _EXTRAS.get(name)
            rows.append((name, f"missing: pip install 'vehanchor[{extra}]'" if extra else "missing: reinstall"))
    return [*rows, ("providers", ", ".join(onnxruntime.get_available_providers()))]


@dataclass(frozen=True)
class SelfTest:
    """Measurement of a scene of known scale.

    Attributes:
        true_gsd_m_per_px: GSD of the rendered scene.
        gsd_m_per_px: measured GSD; None if there is none.
        status: status of the record.
        seconds: duration of the measurement.
    """

    true_gsd_m_per_px: float
    gsd_m_per_px: float | None
    status: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether the scale is usable and correct."""
        if self.gsd_m_per_px is None or self.status != "ok":
            return False
        return abs(self.gsd_m_per_px / self.true_gsd_m_per_px - 1) <= _TOLERANCE


def self_test(engine: Engine) -> SelfTest:
    """Render a scene and measure it."""
    from vehanchor_scenes import render_scene

    scene = render_scene(
        gsd_m_per_px=_SCENE_GSD_M, width_px=_SCENE_PX, height_px=_SCENE_PX, n_vehicles=40, seed=_SCENE_SEED
    )
    started = time.perf_counter()
    record = engine.estimate(scene.image)
    return SelfTest(_SCENE_GSD_M, record.gsd_m_per_px, record.status, time.perf_counter() - started)


@dataclass
class FolderCheck:
    """Result of a trial on some images.

    Attributes:
        n: images tried.
        n_ok: images with a usable scale.
        reasons: counts for the others, by the record's reason or the error's code.
    """

    n: int = 0
    n_ok: int = 0
    reasons: Counter[str] = field(default_factory=Counter)


def check_images(
    images: Sequence[str],
    engine: Engine,
    progress: Callable[[int, int], None],
    max_megapixels: float | None = None,
) -> FolderCheck:
    """Estimate the scale of images and count the results.

    Args:
        images: paths.
        engine: measures the images.
        progress: called with (images done, images in total).
        max_megapixels: as in ``estimate_gsd``.
    """
    from vehanchor.errors import VehAnchorError

    check = FolderCheck()
    for image in images:
        check.n += 1
        try:
            record = engine.estimate(image, max_megapixels=max_megapixels)
        except VehAnchorError as error:
            check.reasons[error.code] += 1
        else:
            check.n_ok += record.status == "ok"
            if record.reason is not None:
                check.reasons[record.reason] += 1
        progress(check.n, len(images))
    return check
