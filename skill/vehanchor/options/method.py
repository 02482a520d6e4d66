"""The option group ``Method``: named presets."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias, get_args

from vehanchor.errors import InvalidParameterError
from vehanchor.options.option import Words, check_fields, option
from vehanchor.scale.defaults import NMS_IOU, OUTLIER_ALPHA

if TYPE_CHECKING:
    from collections.abc import Mapping

Preset: TypeAlias = Literal["paper"]
"""Names of the presets."""

PRESETS: dict[str, dict[str, Any]] = {
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
        "drop": (),
        "add": (),
    }
}
"""Options of each preset by keyword."""


@dataclass(frozen=True)
class Method:
    """Preset of the method.

    Attributes:
        preset: ``paper`` sets every option to the paper's value, with the paper's confidence C and resolution guard;
            None changes no option.

    Raises:
        InvalidParameterError: the preset is unknown.
    """

    panel: ClassVar[str] = "Method"

    preset: Preset | None = field(
        default=None,
        metadata=option(
            "Named preset: paper is exactly the paper's method, with its confidence and its resolution guard.",
            Words(get_args(Preset)),
        ),
    )

    def __post_init__(self) -> None:
        check_fields(self)


def with_preset(preset: str, keywords: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Add the options of a preset to those of the caller.

    Args:
        preset: name of the preset.
        keywords: options of the caller.
        defaults: defaults of all options.

    Raises:
        InvalidParameterError: the caller sets an option of the preset to another value.
    """
    chosen = PRESETS.get(preset, {})
    for name, value in chosen.items():
        given = keywords.get(name, defaults[name])
        if (tuple(given) if isinstance(given, list) else given) not in (value, defaults[name]):
            raise InvalidParameterError(f"the preset {preset} sets {name}: leave {name} out, or leave the preset out")
    return {**keywords, **chosen}
