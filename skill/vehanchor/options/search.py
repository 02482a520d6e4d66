"""How an image is searched, and when the search ends: the option group ``Search``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias, get_args

from vehanchor.errors import InvalidParameterError
from vehanchor.options.fields import choice, positive, set_frozen, share, whole
from vehanchor.scale.defaults import NMS_IOU

Effort: TypeAlias = Literal["full", "auto", "fast"]
"""How much of a large image is searched."""

Stopped: TypeAlias = Literal["all_searched", "settled", "max_tiles", "max_seconds"]
"""Why a search ended."""


@dataclass(frozen=True)
class Search:
    """How an image is searched for vehicles.

    Attributes:
        min_score: lowest detection score, 0..1; None takes the model's (0.1, the paper's, for foreign models).
        nms_iou: IoU, 0..1, above which the weaker of two boxes is dropped.
        search_scales: search reduced copies of the image, too, for vehicles longer than the model was trained on; None
            takes the model's own choice (no, for foreign models).
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
        default=None, metadata=choice("Lowest detection score, 0 to 1. Default: the model's.", metavar="P")
    )
    nms_iou: float = field(
        default=NMS_IOU,
        metadata=choice("Of two boxes that overlap by more (IoU) one is dropped.", metavar="P", flag="nms-iou"),
    )
    search_scales: bool | None = field(
        default=None,
        metadata=choice(
            "Search copies at 1/2, 1/4 and 1/8, too, for vehicles longer than the model was trained on. Default: the "
            "model's choice.",
        ),
    )
    tile_px: int | None = field(
        default=None, metadata=choice("Side of a tile, pixels. Default: 1024, or the model's input.", metavar="PX")
    )
    stride_px: int | None = field(
        default=None, metadata=choice("Step between tiles, pixels. Default: 3/4 of the tile.", metavar="PX")
    )

    effort: Effort = field(
        default="auto",
        metadata=choice(
            "Of an image of 16 megapixels and more: full visits every tile, auto ends when more of them cannot narrow "
            "the interval, fast sooner. Of smaller images these leave out resolutions at which no car can be."
        ),
    )
    max_tiles: int | None = field(
        default=None,
        metadata=choice("End after so many tiles, those where cars are likely first. Default: no limit.", metavar="N"),
    )
    max_seconds: float | None = field(
        default=None,
        metadata=choice(
            "End the search after so many seconds; the result then depends on the machine. Default: no limit.",
            metavar="S",
        ),
    )

    def __post_init__(self) -> None:
        if self.min_score is not None:
            set_frozen(self, "min_score", share("min_score", self.min_score))
        set_frozen(self, "nms_iou", share("nms_iou", self.nms_iou))
        if self.search_scales is not None and not isinstance(self.search_scales, bool):
            raise InvalidParameterError(f"search_scales is {self.search_scales!r}: use True, False or None")
        for name in ("tile_px", "stride_px", "max_tiles"):
            if getattr(self, name) is not None:
                set_frozen(self, name, whole(name, getattr(self, name)))
        if self.max_seconds is not None:
            set_frozen(self, "max_seconds", positive("max_seconds", self.max_seconds))
        if self.effort not in get_args(Effort):
            raise InvalidParameterError(f"effort is {self.effort!r}: use one of {', '.join(get_args(Effort))}")
