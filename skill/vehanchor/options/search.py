"""How an image is searched, and when the search ends: the option group ``Search``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias, get_args

from vehanchor.options.option import Flag, Limits, Words, check_fields, option
from vehanchor.scale.defaults import NMS_IOU

Effort: TypeAlias = Literal["full", "auto", "fast"]
"""How much of a large image is searched."""

_SHARE, _COUNT = Limits(0, 1), Limits(least=1, whole=True)
_TILES = Limits(1, 1_000_000_000, whole=True)


@dataclass(frozen=True)
class Search:
    """How an image is searched for vehicles.

    Attributes:
        min_score: lowest detection score, 0..1; None takes the model's (0.1, the paper's, for foreign models).
        nms_iou: IoU, 0..1, above which the weaker of two boxes is dropped.
        search_scales: search reduced copies of the image, too, for vehicles longer than the model was trained on; None
            takes the model's own choice (no, for foreign models).
        verify: score candidates again by the model's verifier, if it has one.
        tile_px: tile side; None is 1024, or the model's input where that is fixed.
        stride_px: step between tiles; None is three quarters of the tile.
        effort: ``full`` visits every tile; ``auto`` and ``fast`` visit those where cars are likely first, and end when
            more of them cannot narrow the interval (see ``vehanchor.detection.convergence``). Of images of less than 16
            megapixels these two leave out only resolutions at which, by the ground, no car is of a size that counts.
        max_tiles: end after so many tiles, those where cars are likely first; None for all.
        max_seconds: the same after so many seconds. The only choice with which a result depends on the machine.

    Raises:
        InvalidParameterError: a number has no meaning, or the effort is not known.
    """

    min_score: float | None = field(
        default=None,
        metadata=option("Lowest accepted detection score, 0 to 1. Default: the model's.", _SHARE, metavar="P"),
    )
    nms_iou: float = field(
        default=NMS_IOU,
        metadata=option(
            "IoU, 0 to 1, above which the weaker of two boxes is dropped.", _SHARE, metavar="P", flag="nms-iou"
        ),
    )
    search_scales: bool | None = field(
        default=None,
        metadata=option(
            "Also search copies at 1/2, 1/4 and 1/8, for vehicles longer than the model was trained on. Default: the "
            "model's choice.",
            Flag(),
        ),
    )
    verify: bool = field(default=True, metadata=option("Score candidates again by the verifier.", Flag(), cli=False))
    tile_px: int | None = field(
        default=None,
        metadata=option("Side of a tile, pixels. Default: 1024, or the model's input.", _COUNT, metavar="PX"),
    )
    stride_px: int | None = field(
        default=None,
        metadata=option("Step between tiles, pixels. Default: 3/4 of the tile.", _COUNT, metavar="PX"),
    )

    effort: Effort = field(
        default="auto",
        metadata=option(
            "Search extent: full (every tile), auto (ends when more tiles would not help) or fast.",
            Words(get_args(Effort)),
        ),
    )
    max_tiles: int | None = field(
        default=None,
        metadata=option("Maximum number of tiles to search, likeliest first. Default: no limit.", _TILES, metavar="N"),
    )
    max_seconds: float | None = field(
        default=None,
        metadata=option(
            "Maximum search time in seconds; the result then depends on the machine. Default: no limit.",
            Limits(above=0, most=86_400),
            metavar="S",
        ),
    )

    def __post_init__(self) -> None:
        check_fields(self)
