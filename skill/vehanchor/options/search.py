"""The option group ``Search``: search of an image, and its end."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, TypeAlias

from vehanchor.options.option import Flag, Limits, Option, group
from vehanchor.scale.defaults import NMS_IOU

Effort: TypeAlias = Literal["full", "auto", "fast"]
"""Extents of the search of a large image."""

_Share = Annotated[float, Limits(0, 1)]
_Count = Annotated[int, Limits(least=1, whole=True)]
_Tiles = Annotated[int, Limits(1, 1_000_000_000, whole=True)]
_Seconds = Annotated[float, Limits(above=0, most=86_400)]


@group(frozen=True)
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

    min_score: Annotated[
        _Share | None, Option("Lowest accepted detection score, 0 to 1. Default: the model's.", metavar="P")
    ] = None
    nms_iou: Annotated[_Share, Option("IoU, 0 to 1, above which the weaker of two boxes is dropped.", metavar="P")] = (
        NMS_IOU
    )
    search_scales: Annotated[
        Flag | None,
        Option(
            "Also search copies at 1/2, 1/4 and 1/8, for vehicles longer than the model was trained on. Default: the "
            "model's choice."
        ),
    ] = None
    verify: Annotated[Flag, Option("Score candidates again by the verifiers.", cli=False)] = True
    tile_px: Annotated[
        _Count | None, Option("Side of a tile, pixels. Default: 1024, or the model's input.", metavar="PX")
    ] = None
    stride_px: Annotated[
        _Count | None, Option("Step between tiles, pixels. Default: 3/4 of the tile.", metavar="PX")
    ] = None
    effort: Annotated[
        Effort,
        Option(
            "Search extent: full (every tile), auto (ends when more tiles would not help) or fast.",
            tools="estimate",
            listed=False,
        ),
    ] = "auto"
    max_tiles: Annotated[
        _Tiles | None,
        Option(
            "Maximum number of tiles to search, likeliest first. Default: no limit.",
            metavar="N",
            tools="estimate",
            listed=False,
        ),
    ] = None
    max_seconds: Annotated[
        _Seconds | None,
        Option(
            "Maximum search time in seconds; the result then depends on the machine. Default: no limit.",
            metavar="S",
            tools="estimate",
            listed=False,
        ),
    ] = None
