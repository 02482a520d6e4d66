"""The option group ``Method``: named presets."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from vehanchor.options.option import Option, group
from vehanchor.scale.defaults import NMS_IOU, OUTLIER_ALPHA, Preset

PRESETS: dict[Preset, dict[str, Any]] = {
    "paper": {
        "min_score": 0.1,
        "nms_iou": NMS_IOU,
        "search_scales": False,
        "verify": False,
        "effort": "full",
        "max_tiles": None,
        "max_seconds": None,
        "aggregation": "kde",
        "alpha": OUTLIER_ALPHA,
        "reference_length_m": 5.045,  # paper, equation 4
        "region": None,
        "calibration": None,
        "rulers": ("vehicles",),
        "metadata": False,
        "known_lengths": (),
        "height_m": None,
        "height_basis": "assumed",
        "height_tolerance_m": None,
        "focal_35mm": None,
        "gsd_m_per_px": None,
        "drop": (),
        "add": (),
    }
}
"""Options of each preset by keyword."""


@group(frozen=True)
class Method:
    """Preset of the method.

    Attributes:
        preset: ``paper`` sets every option to the paper's value, with the paper's confidence C and resolution guard;
            None changes no option.

    Raises:
        InvalidParameterError: the preset is unknown.
    """

    panel: ClassVar[str] = "Method"

    preset: Annotated[
        Preset | None,
        Option(
            "Named preset: paper is exactly the paper's method, with its confidence and its resolution guard.",
            first=True,
        ),
    ] = None
