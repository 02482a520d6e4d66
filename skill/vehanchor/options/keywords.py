"""Keywords of the verbs, for type checkers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypedDict

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence

    from vehanchor.options.frame import Coordinates
    from vehanchor.options.image_limits import ImageLimits
    from vehanchor.options.method import Preset
    from vehanchor.options.rulers import Basis
    from vehanchor.options.search import Effort
    from vehanchor.scale.calibration import Calibration
    from vehanchor.scale.defaults import Aggregation


class OptionKeywords(TypedDict, total=False):
    """Keywords for the fields of all groups; a test compares their types."""

    min_score: float | None
    nms_iou: float
    search_scales: bool | None
    verify: bool
    tile_px: int | None
    stride_px: int | None
    effort: Effort
    max_tiles: int | None
    max_seconds: float | None
    aggregation: Aggregation | None
    alpha: float | None
    reference_length_m: float | None
    region: str | None
    calibration: Calibration | str | os.PathLike[str] | None
    frame_width_px: int | None
    frame_height_px: int | None
    coordinates: Coordinates
    bands: tuple[int, int, int] | None
    limits: ImageLimits
    bgr: bool
    max_megapixels: float | None
    rulers: Sequence[str] | None
    metadata: bool
    known_lengths: Sequence[Sequence[Any]]
    height_m: float | None
    height_basis: Basis
    height_tolerance_m: float | None
    focal_35mm: float | None
    confirm: Sequence[int]
    drop: Sequence[int]
    add: Sequence[Sequence[float]]
    preset: Preset | None
