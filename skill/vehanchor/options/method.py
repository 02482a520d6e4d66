"""Options of the method: search, lengths of vehicles, reference length, and named presets."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from pydantic import BeforeValidator, Field

from vehanchor.errors import InvalidParameterError
from vehanchor.options.models import CALIBRATION
from vehanchor.options.option import Flag, Limits, Option, group
from vehanchor.scale.countries import REGIONS
from vehanchor.scale.defaults import (
    MAX_VEHICLE_M,
    MIN_VEHICLE_M,
    NMS_IOU,
    OUTLIER_ALPHA,
    Aggregation,
    Preset,
)

Effort: TypeAlias = Literal["full", "auto", "fast"]
"""How much of a large image is searched."""

_Share = Annotated[float, Limits(0, 1)]
_Count = Annotated[int, Limits(least=1, whole=True)]
_Tiles = Annotated[int, Limits(1, 1_000_000_000, whole=True)]
_Seconds = Annotated[float, Limits(above=0, most=86_400)]


@group(frozen=True)
class Search:
    """Options of the search for vehicles.

    Attributes:
        min_score: lowest accepted detection score, 0..1; None uses the model's, or for a model
            without one ``vehanchor.detection.card.MIN_SCORE``.
        nms_iou: IoU, 0..1, above which the weaker of two boxes is dropped.
        search_scales: also search reduced copies of the image, for vehicles longer than the model
            was trained on; None uses the model's choice, or False for a model without one.
        verify: score candidates again with the model's verifier and chip network, if it has any,
            and measure bodies.
        tile_px: tile side, pixels; None is 1024, or the model's fixed input size.
        stride_px: step between tiles, pixels; None is three quarters of the tile.
        effort: ``full`` searches every tile; ``auto`` and ``fast`` search likely tiles first, and
            end when more tiles would not change the scale (see ``vehanchor.analysis.convergence``).
            In images below 4 megapixels they skip only resolutions at which, by the scene-scale
            prior, no car has a valid size.
        max_tiles: maximum number of tiles, likely ones first; None for all.
        max_seconds: maximum search time in seconds; None for no limit. With a limit, results depend
            on the machine.

    Raises:
        InvalidParameterError: a number is invalid, or the effort is unknown.
    """

    min_score: Annotated[
        _Share | None,
        Option("Lowest accepted detection score, 0 to 1. Default: the model's.", metavar="P"),
    ] = None
    nms_iou: Annotated[
        _Share, Option("IoU, 0 to 1, above which the weaker of two boxes is dropped.", metavar="P")
    ] = NMS_IOU
    search_scales: Annotated[
        Flag | None,
        Option(
            "Also search copies at 1/2, 1/4 and 1/8, for vehicles longer than the model was "
            "trained on. Default: the model's choice."
        ),
    ] = None
    verify: Annotated[Flag, Option("Score candidates again, and measure bodies.", cli=False)] = True
    tile_px: Annotated[
        _Count | None,
        Option("Side of a tile, pixels. Default: 1024, or the model's input.", metavar="PX"),
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
            "Maximum search time in seconds; the result then depends on the machine. Default: no "
            "limit.",
            metavar="S",
            tools="estimate",
            listed=False,
        ),
    ] = None


def _number_or_none(value: Any) -> Any:
    """Read the texts ``none`` and ``off`` as no filter."""
    if isinstance(value, str) and value.strip().lower() in ("none", "off"):
        return None
    return value


@group(frozen=True)
class Lengths:
    """Statistics of the vehicles' lengths.

    Attributes:
        aggregation: ``kde``, ``weighted_kde``, ``median`` or ``mean`` (see
            ``vehanchor.scale.lengths.modal_length``); None uses the model's choice, or the paper's
            ``kde`` for a model without one.
        alpha: outlier filter, ``P_i <= alpha * median`` (paper, equation 2), alpha >= 1; None
            switches it off.

    Raises:
        InvalidParameterError: alpha is not a number >= 1, or the aggregation is unknown.
    """

    aggregation: Annotated[
        Aggregation | None,
        Option(
            "Statistic of the lengths; below 5 vehicles a KDE is replaced by the median. Default: "
            "the model's, or kde."
        ),
    ] = None
    alpha: Annotated[
        Annotated[float, Limits(least=1)] | None,
        BeforeValidator(_number_or_none),
        Option("Drop vehicles longer than X times the median; 'none' keeps all.", metavar="X|none"),
    ] = OUTLIER_ALPHA


if TYPE_CHECKING:
    from vehanchor.scale.calibration import Calibration
else:
    Calibration = Any  # Few calls need the class, so its module is imported on first use.


def _read_calibration(calibration: Any) -> Any:
    """Read a calibration if its path is given."""
    if calibration is None:
        return None
    from vehanchor.scale.calibration import as_calibration

    return as_calibration(calibration)


@group(frozen=True)
class Reference:
    """Source of the reference length ``L_ref``; without one, the appearance of the vehicles.

    Attributes:
        reference_length_m: the fleet's modal vehicle length, 2 to 20 metres.
        region: a region with a reference length in the model (bundled model:
            ``vehanchor.scale.countries.REGIONS``), or a country by its ISO 3166-1 alpha-2 code
            (``vehanchor.scale.countries``).
        calibration: reference length measured for this fleet and detector (see
            ``load_calibration``); a path is read at once.

    Raises:
        InvalidParameterError: two sources are given, or the length is not from 2 to 20.
        CalibrationFileError: the calibration cannot be read.
    """

    reference_length_m: Annotated[
        Annotated[float, Limits(MIN_VEHICLE_M, MAX_VEHICLE_M, unit="m")] | None,
        Option(
            "Known length of local cars, metres; not with a region. Default: the model's.",
            metavar="M",
            tools="all",
            listed=False,
        ),
    ] = None
    region: Annotated[
        Annotated[str, Field(max_length=64)] | None,
        Option(
            f"Country (ISO code such as FR), else a region, if known: {', '.join(REGIONS)}.",
            metavar="NAME",
            first=True,
            tools="all",
        ),
    ] = None
    calibration: Annotated[Calibration | None, BeforeValidator(_read_calibration), CALIBRATION] = (
        None
    )

    def __post_init__(self) -> None:
        names = [field.name for field in fields(self)]
        sources = [name for name in names if getattr(self, name) is not None]
        if len(sources) > 1:
            raise InvalidParameterError(
                f"give {' or '.join(sources)}, not both: each sets the reference length"
            )


@group(frozen=True)
class Method:
    """Preset of the method.

    Attributes:
        preset: ``paper`` sets every option to the paper's value, with the paper's confidence C and
            resolution guard; None changes no option.

    Raises:
        InvalidParameterError: the preset is unknown.
    """

    preset: Annotated[
        Preset | None,
        Option(
            "Named preset: paper is exactly the paper's method, with its confidence and resolution "
            "guard.",
            first=True,
        ),
    ] = None
