"""Options in small frozen groups, taken alike by all verbs, commands and the server.

Each field is declared once: type and default here, help text in its metadata (``choice``), from which
``vehanchor.cli.cli_options`` builds the command-line option. A default of None means the model's own choice.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypedDict, get_args

from vehanchor.errors import FrameError, InvalidParameterError
from vehanchor.options.fields import choice, positive, set_frozen, whole
from vehanchor.options.rulers import KnownLength, Rulers
from vehanchor.options.search import Effort, Search
from vehanchor.scale.defaults import LARGEST_VEHICLE_M, LEAST_VEHICLE_M, OUTLIER_ALPHA, REGIONS, Aggregation

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping, Sequence

    from vehanchor.scale.calibration import Calibration

Coordinates: TypeAlias = Literal["pixels", "fraction", "per_mille"]
"""How places in a picture are written."""

_MIB = 1 << 20
_MEGAPIXEL = 1_000_000
DECODED_BYTES_PER_PIXEL = 10
"""What 8-bit RGB takes while it is decoded, and a little."""

_SHARES: dict[Coordinates, int] = {"fraction": 1, "per_mille": 1000}  # how far they reach along either side


@dataclass(frozen=True)
class ImageLimits:
    """What is refused before anything is decoded.

    Attributes:
        max_bytes: encoded size of what is read into memory whole.
        max_pixels: declared width x height of what is decoded whole; larger TIFFs and sequential JPEGs are read by
            windows, as JPEG 2000 always is.
        max_windowed_pixels: declared width x height of what is read by windows.
        max_decoded_bytes: memory that decoding may take: width x height x bands x depth of what is decoded whole, or of
            a strip or tile of what is read by windows, and what the decoder holds beside it.
        max_unpacked_bytes: disk that a JPEG may take while it is read by windows, three bytes a pixel.

    Raises:
        InvalidParameterError: one of them is no whole number >= 1.
    """

    max_bytes: int = 512 * _MIB
    max_pixels: int = 100_000_000
    max_windowed_pixels: int = 10_000_000_000
    max_decoded_bytes: int = 1 << 30
    max_unpacked_bytes: int = 8 << 30

    def __post_init__(self) -> None:
        for each in fields(self):
            set_frozen(self, each.name, whole(each.name, getattr(self, each.name)))


@dataclass(frozen=True)
class Lengths:
    """How the lengths of the vehicles become one.

    Attributes:
        alpha: outlier filter, ``P_i <= alpha * median`` (paper, equation 2), alpha >= 1; None switches it off.
        aggregation: ``kde``, ``weighted_kde``, ``median`` or ``mean`` (see ``vehanchor.scale.lengths.modal_length``);
            None takes the model's own choice (``kde``, the paper's, for foreign models).

    Raises:
        InvalidParameterError: alpha is no number >= 1, or the aggregation is not known.
    """

    aggregation: Aggregation | None = field(
        default=None,
        metadata=choice(
            "How lengths become one; below 5 vehicles a KDE gives way to the median. Default: the model's choice, "
            "or kde."
        ),
    )
    alpha: float | None = field(
        default=OUTLIER_ALPHA,
        metadata=choice("Drop vehicles longer than X times the median; 'none' keeps all.", metavar="X|none"),
    )

    def __post_init__(self) -> None:
        if self.aggregation is not None and self.aggregation not in get_args(Aggregation):
            raise InvalidParameterError(
                f"aggregation is {self.aggregation!r}: use one of {', '.join(get_args(Aggregation))}"
            )
        if self.alpha is not None:
            alpha = positive("alpha", self.alpha)
            if alpha < 1:
                raise InvalidParameterError(f"alpha is {alpha:g}: below 1 it drops typical vehicles; use 1 or more")
            set_frozen(self, "alpha", alpha)


@dataclass(frozen=True)
class Reference:
    """Where the reference length ``L_ref`` comes from: one of these, or, with none, the look of the vehicles.

    Attributes:
        reference_length_m: the fleet's modal vehicle length, 2 to 20 metres.
        region: take the model's reference length for a region (bundled: ``europe``,
            ``northern_europe``, ``north_america``, ``south_america``, ``south_asia``).
        calibration: take the reference length measured for this fleet and detector (see ``load_calibration``); the
            path of its file is read at once.

    Raises:
        InvalidParameterError: two of them, or a length that is no number from 2 to 20.
        CalibrationFileError: the calibration cannot be read.
    """

    reference_length_m: float | None = field(
        default=None, metadata=choice("Modal vehicle length, 2 to 20 m. Default: the model's.", metavar="M")
    )
    region: str | None = field(
        default=None,
        metadata=choice(
            f"Where it was taken, if you know: the cars' length there is taken. {', '.join(REGIONS)}.",
            metavar="NAME",
        ),
    )
    calibration: Calibration | None = field(
        default=None, metadata=choice("Take the reference length that 'vehanchor calibrate' measured.", metavar="FILE")
    )

    def __post_init__(self) -> None:
        given = [each.name for each in fields(self) if getattr(self, each.name) is not None]
        if len(given) > 1:
            raise InvalidParameterError(f"give {' or '.join(given)}, not both: each sets the reference length")
        if self.reference_length_m is not None:
            length = positive("reference_length_m", self.reference_length_m)
            if not LEAST_VEHICLE_M <= length <= LARGEST_VEHICLE_M:
                raise InvalidParameterError(
                    f"reference_length_m is {length:g}: a vehicle has {LEAST_VEHICLE_M:g} to {LARGEST_VEHICLE_M:g} m"
                )
            set_frozen(self, "reference_length_m", length)
        if self.region is not None and not isinstance(self.region, str):
            raise InvalidParameterError(f"region is {self.region!r}: give one name, such as {REGIONS[0]}")
        if self.calibration is not None:
            from vehanchor.scale.calibration import as_calibration

            set_frozen(self, "calibration", as_calibration(self.calibration))


@dataclass(frozen=True)
class Frame:
    """The resized copy of the image that the caller works in, and how places in it are written.

    Attributes:
        width_px: its width; with the height, or neither.
        height_px: its height.
        coordinates: pixels of the image, or of that copy where one is named; fraction: 0 to 1 of either side;
            per_mille: 0 to 1000 of either side.

    Raises:
        InvalidParameterError: one without the other, or no whole number >= 1.
    """

    width_px: int | None = field(default=None, metadata={"keyword": "frame_width_px"})
    height_px: int | None = field(default=None, metadata={"keyword": "frame_height_px"})
    coordinates: Coordinates = field(
        default="pixels",
        metadata=choice(
            "How points, boxes and lines are written: pixels (of the image, or of --frame), fraction (0 to 1 of a "
            "side), per_mille (0 to 1000)."
        ),
    )

    def __post_init__(self) -> None:
        if self.coordinates not in get_args(Coordinates):
            raise InvalidParameterError(
                f"coordinates is {self.coordinates!r}: use one of {', '.join(get_args(Coordinates))}"
            )
        if (self.width_px is None) != (self.height_px is None):
            raise InvalidParameterError("a frame needs both frame_width_px and frame_height_px")
        for name in ("width_px", "height_px"):
            if getattr(self, name) is not None:
                set_frozen(self, name, whole(f"frame_{name}", getattr(self, name)))

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height, pixels; None without a frame."""
        return None if self.width_px is None or self.height_px is None else (self.width_px, self.height_px)

    def extent(self, width_px: int, height_px: int) -> tuple[int, int]:
        """How far coordinates reach to the right and down, in their own units.

        Args:
            width_px: of the image.
            height_px: of the image.
        """
        share = _SHARES.get(self.coordinates)
        return (share, share) if share else self.size or (width_px, height_px)

    def check(self, width_px: int, height_px: int) -> None:
        """Refuse a frame whose aspect ratio is not the image's: it would be a crop, or another image.

        Raises:
            FrameError: more than a pixel of rounding lies between them.
        """
        if self.size is None:
            return
        width, height = self.size
        fitting = width * height_px / width_px
        slack = 1.0 + height_px / width_px  # one pixel of rounding in either side
        if abs(height - fitting) > slack:
            raise FrameError(
                f"the frame is {width} x {height} px, the image {width_px} x {height_px} "
                f"px: a copy of that width would be {round(fitting)} px high. Give the size of an uncropped copy"
            )


@dataclass(frozen=True)
class Reading:
    """How an image is read.

    Attributes:
        bands: three 1-based bands to take as red, green, blue; None takes the first three.
        limits: what an image may cost, checked before decoding.
        bgr: arrays have blue, green and red, as OpenCV reads them.
        max_megapixels: in the place of the limits' pixels and of the memory that decoding them takes; None leaves them.

    Raises:
        InvalidParameterError: a number has no meaning, or the bands are not three whole numbers >= 1.
    """

    bands: tuple[int, int, int] | None = field(
        default=None,
        metadata=choice("Bands to take as red, green and blue, from 1. Default: the first three.", metavar="R G B"),
    )
    limits: ImageLimits = field(default_factory=ImageLimits)
    bgr: bool = False
    max_megapixels: float | None = field(
        default=None,
        metadata=choice("Decode images of up to so many megapixels whole. Default: 100.", metavar="MP"),
    )

    def __post_init__(self) -> None:
        if self.bands is not None:
            try:
                first, second, third = self.bands
            except (TypeError, ValueError):
                raise InvalidParameterError(f"bands is {self.bands!r}: give three, from 1") from None
            set_frozen(self, "bands", tuple(whole("bands", band) for band in (first, second, third)))
        if not isinstance(self.limits, ImageLimits):
            raise InvalidParameterError(f"limits is {self.limits!r}: give vehanchor.ImageLimits(...)")
        if not isinstance(self.bgr, bool):
            raise InvalidParameterError(f"bgr is {self.bgr!r}: use True or False")
        if self.max_megapixels is not None:
            set_frozen(self, "max_megapixels", positive("max_megapixels", self.max_megapixels))
            pixels = max(1, round(self.max_megapixels * _MEGAPIXEL))
            memory = max(self.limits.max_decoded_bytes, DECODED_BYTES_PER_PIXEL * pixels)
            set_frozen(self, "limits", replace(self.limits, max_pixels=pixels, max_decoded_bytes=memory))


class OptionKeywords(TypedDict, total=False):
    """The fields of all groups under the names that the verbs take as keywords; a test holds them to the groups."""

    min_score: float | None
    nms_iou: float
    search_scales: bool | None
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
    known_lengths: Sequence[tuple[float, float, float, float, float]]
    height_m: float | None
    focal_35mm: float | None


@dataclass(frozen=True)
class ScaleOptions:
    """All groups; the defaults are the paper's, or the model's own where that is None.

    Attributes:
        search: how the image is searched.
        lengths: how lengths become one.
        reference: where the reference length comes from.
        frame: the caller's resized copy.
        reading: how the image is read.
        rulers: what the scale is taken from.
    """

    search: Search = field(default_factory=Search)
    lengths: Lengths = Lengths()
    reference: Reference = Reference()
    frame: Frame = Frame()
    reading: Reading = Reading()
    rulers: Rulers = field(default_factory=Rulers)

    def __post_init__(self) -> None:
        if self.frame.coordinates == "pixels":
            self.rulers.check_lengths()

    def in_pixels(self, width_px: int, height_px: int) -> ScaleOptions:
        """The same choices with the lines of known length in pixels of the frame, or of the image where none is named.

        Args:
            width_px: of the image.
            height_px: of the image.

        Raises:
            KnownLengthError: a line is shorter than five pixels, or leaves the picture.
        """
        picture = self.frame.size or (width_px, height_px)
        extent = self.frame.extent(width_px, height_px)
        across, down = picture[0] / extent[0], picture[1] / extent[1]
        lines = tuple(
            KnownLength(line.x1 * across, line.y1 * down, line.x2 * across, line.y2 * down, line.metres)
            for line in self.rulers.known_lengths
        )
        told = self
        if lines and self.frame.coordinates != "pixels":
            told = replace(
                self, rulers=replace(self.rulers, known_lengths=lines), frame=replace(self.frame, coordinates="pixels")
            )
        told.rulers.check(*picture)
        return told

    @classmethod
    def of(cls, keywords: Mapping[str, Any]) -> ScaleOptions:
        """The groups that hold the verbs' keywords (``OptionKeywords``).

        Raises:
            InvalidParameterError: a value has no meaning, or there is no such option.
        """
        rest = dict(keywords)
        groups: dict[str, Any] = {}
        for name, group in _GROUPS.items():
            known = {each.name: each.metadata.get("keyword", each.name) for each in fields(group)}
            groups[name] = group(**{key: rest.pop(word) for key, word in known.items() if word in rest})
        if rest:
            names = ", ".join(sorted(OptionKeywords.__annotations__))
            raise InvalidParameterError(f"there is no option {next(iter(rest))!r}: the options are {names}")
        return cls(**groups)


_GROUPS: dict[str, type[Any]] = {
    "search": Search,
    "lengths": Lengths,
    "reference": Reference,
    "frame": Frame,
    "reading": Reading,
    "rulers": Rulers,
}
