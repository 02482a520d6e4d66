"""The option group ``Search``: search of an image, and its end."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeAlias, get_args

from vehanchor.options.option import Flag, Limits, Words, check_fields, option
from vehanchor.scale.defaults import NMS_IOU

Effort: TypeAlias = Literal["full", "auto", "fast"]
"""Extents of the search of a large image."""

_SHARE, _COUNT = Limits(0, 1), Limits(least=1, whole=True)
_TILES = Limits(1, 1_000_000_000, whole=True)


@dataclass(frozen=True)
class Search:
    """Options of the search for vehicles.

    Attributes:
        min_score: lowest detection score, 0..1; None takes the model's, or for foreign models
            ``vehanchor.detection.card.MIN_SCORE``.
        nms_iou: IoU, 0..1, above which the weaker of two boxes is dropped.
        search_scales: also search reduced copies of the image, for vehicles longer than the model was trained on; None
            takes the model's own choice (no, for foreign models).
        verify: score candidates again with the model's verifiers, if it has any, and correct the boxes of few vehicles.
        tile_px: tile side; None is 1024, or the model's fixed input size.
        stride_px: step between tiles; None is three quarters of the tile.
        effort: ``full`` searches every tile; ``auto`` and ``fast`` search likely tiles first, and end when more tiles
            would not change the scale (see ``vehanchor.detection.convergence``). In images below 4 megapixels they
            skip only resolutions at which, by the scene-scale prior, no car has a valid size.
        max_tiles: largest number of tiles, likely ones first; None for all.
        max_seconds: largest time in seconds; None for no limit. With it, results depend on the machine.

    Raises:
        InvalidParameterError: a number is invalid, or the effort is unknown.
    """

    panel: ClassVar[str] = "Search"

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
    verify: bool = field(default=True, metadata=option("Score candidates again by the verifiers.", Flag(), cli=False))
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
