"""Checks of an installation: what is there, whether a scene of known scale is measured, how many images of a folder."""

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
    """Names and versions of what is there, and which extra brings what is not."""
    import onnxruntime

    rows = [("vehanchor", version("vehanchor")), ("python", f"{platform.python_version()} on {platform.platform()}")]
    for name in (*_NEEDED, *_EXTRAS):
        try:
            rows.append((name, version(name)))
        except PackageNotFoundError:
            extra = _EXTRAS.get(name)
            rows.append((name, f"not there: pip install 'vehanchor[{extra}]'" if extra else "not there: reinstall"))
    return [*rows, ("providers", ", ".join(onnxruntime.get_available_providers()))]


@dataclass(frozen=True)
class SelfTest:
    """A scene of known scale, measured.

    Attributes:
        true_gsd_m_per_px: what it was rendered at.
        gsd_m_per_px: what was measured; None for nothing.
        status: of the record.
        seconds: that measuring took.
    """

    true_gsd_m_per_px: float
    gsd_m_per_px: float | None
    status: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether the scale may be used and is right."""
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
    """What became of some images.

    Attributes:
        n: images that were looked at.
        n_ok: of them with a scale that may be used.
        reasons: why the others have none: reasons of records, and codes of errors.
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
    """Estimate the scale of images and count.

    Args:
        images: paths.
        engine: measures them.
        progress: called with (images done, images in all).
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
