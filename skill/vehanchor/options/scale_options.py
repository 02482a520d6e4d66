"""All option groups in one object, for all verbs, commands and the server."""

from __future__ import annotations

import typing
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from vehanchor.errors import InvalidParameterError, KnownLengthError
from vehanchor.options.method import Lengths, Method, Reference, Search
from vehanchor.options.option import Option
from vehanchor.options.reading import CoordinateFrame, Frame, Reading
from vehanchor.options.rulers import AddedVehicle, ByHand, KnownLength, Rulers
from vehanchor.scale.defaults import Preset

if TYPE_CHECKING:
    from collections.abc import Mapping

_Line = TypeVar("_Line", KnownLength, AddedVehicle)

_OF_METHOD = [vars(group) for group in (Search(), Lengths(), Reference(), Rulers(), ByHand())]
_FREE = ("tile_px", "stride_px")  # a preset leaves them to the caller
PRESETS: dict[Preset, dict[str, Any]] = {
    "paper": {
        **{
            name: default
            for group in _OF_METHOD
            for name, default in group.items()
            if name not in _FREE
        },
        "min_score": 0.1,
        "search_scales": False,
        "verify": False,
        "effort": "full",
        "aggregation": "kde",
        "reference_length_m": 5.045,  # paper, equation 4
        "rulers": ("vehicles",),
        "metadata": False,
    }
}
"""Options of each preset by keyword."""


@dataclass(frozen=True)
class ScaleOptions:
    """All option groups; a default is the paper's value, or None for the model's own.

    Attributes:
        search: search of the image.
        lengths: statistics of the vehicles' lengths.
        reference: source of the reference length.
        frame: the caller's resized copy.
        reading: reading of the image.
        rulers: rulers to use, and known facts about the scale.
        by_hand: vehicles that the caller drops or adds.
        method: preset of all options.
    """

    search: Search = field(default_factory=Search)
    lengths: Lengths = field(default_factory=Lengths)
    reference: Reference = field(default_factory=Reference)
    frame: Frame = field(default_factory=Frame)
    reading: Reading = field(default_factory=Reading)
    rulers: Rulers = field(default_factory=Rulers)
    by_hand: ByHand = field(default_factory=ByHand)
    method: Method = field(default_factory=Method)

    def __post_init__(self) -> None:
        if self.frame.coordinates == "pixels":
            self._check_lines(None)

    def _check_lines(self, size: tuple[int, int] | None) -> None:
        for line in self.rulers.known_lengths:
            line.check("the line of known length", KnownLengthError, size)
        for number, axis in enumerate(self.by_hand.add, 1):
            axis.check(f"add {number}", InvalidParameterError, size)

    def in_pixels(self, width_px: int, height_px: int) -> ScaleOptions:
        """Convert lines and added vehicles to pixels of the frame, or of the image without a frame.

        Args:
            width_px: width of the image.
            height_px: height of the image.

        Raises:
            KnownLengthError: a line is shorter than five pixels, or ends outside the image.
            InvalidParameterError: so does an added vehicle.
        """
        picture = self.frame.size or (width_px, height_px)
        extent = CoordinateFrame(self.frame, width_px, height_px).extent
        across = picture[0] / extent[0]
        down = picture[1] / extent[1]

        def in_picture(line: _Line) -> _Line:
            return replace(
                line, x1=line.x1 * across, y1=line.y1 * down, x2=line.x2 * across, y2=line.y2 * down
            )

        told = self
        if self.frame.coordinates != "pixels" and (self.rulers.known_lengths or self.by_hand.add):
            told = replace(
                self,
                rulers=replace(
                    self.rulers, known_lengths=tuple(map(in_picture, self.rulers.known_lengths))
                ),
                by_hand=replace(self.by_hand, add=tuple(map(in_picture, self.by_hand.add))),
                frame=replace(self.frame, coordinates="pixels"),
            )
        told._check_lines(picture)
        return told

    @classmethod
    def of(cls, keywords: Mapping[str, Any]) -> ScaleOptions:
        """Make options from keywords.

        Raises:
            InvalidParameterError: a value is invalid, or an option does not exist.
        """
        return cls().with_keywords(keywords)

    def with_keywords(self, keywords: Mapping[str, Any]) -> ScaleOptions:
        """Copy the options with other values of single fields.

        Raises:
            InvalidParameterError: a value is invalid, an option does not exist, or contradicts the
                preset.
        """
        # its values give way to those of the caller, and are then compared
        if self.method.preset is not None:
            keywords = {
                **{name: declared_options()[name].default for name in PRESETS[self.method.preset]},
                **keywords,
            }
        changes: dict[str, dict[str, Any]] = {}
        for name, value in keywords.items():
            declared = declared_options().get(name)
            if declared is None:
                names = ", ".join(sorted(declared_options()))
                raise InvalidParameterError(f"there is no option {name!r}: the options are {names}")
            changes.setdefault(declared.group, {})[name] = value
        told = replace(
            self,
            **{group: replace(getattr(self, group), **values) for group, values in changes.items()},
        )
        preset = told.method.preset
        if preset is None or all(
            told.value(name) == value for name, value in PRESETS[preset].items()
        ):
            return told
        for name, value in PRESETS[preset].items():
            if told.value(name) not in (value, declared_options()[name].default):
                raise InvalidParameterError(
                    f"the preset {preset} sets {name}: leave {name} out, or leave the preset out"
                )
        return told.with_keywords(PRESETS[preset])

    def value(self, keyword: str) -> Any:
        """Get the value of an option."""
        return getattr(getattr(self, declared_options()[keyword].group), keyword)


class DeclaredOption(NamedTuple):
    """Option of a group.

    Attributes:
        keyword: keyword of the verbs, and field of the group.
        group: name of the group in ``ScaleOptions``.
        option: its declaration.
        annotation: its type with limits and declaration.
        kind: type of its values alone.
        default: its default.
    """

    keyword: str
    group: str
    option: Option
    annotation: Any
    kind: Any
    default: Any


@cache
def declared_options() -> dict[str, DeclaredOption]:
    """List the options of all groups by their keywords."""
    found = {}
    for group, options in vars(ScaleOptions()).items():
        annotations, kinds = (
            typing.get_type_hints(type(options), include_extras=extras) for extras in (True, False)
        )
        for name, default in vars(options).items():
            option = next(
                part for part in annotations[name].__metadata__ if isinstance(part, Option)
            )
            given = [kind for kind in typing.get_args(kinds[name]) if kind is not type(None)]
            kind = given[0] if type(None) in typing.get_args(kinds[name]) else kinds[name]
            found[name] = DeclaredOption(
                name, group, option=option, annotation=annotations[name], kind=kind, default=default
            )
    return found
