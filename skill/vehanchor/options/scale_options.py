"""All option groups in one object, for all verbs, commands and the server."""

from __future__ import annotations

from dataclasses import Field, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from vehanchor.errors import InvalidParameterError
from vehanchor.options.by_hand import AddedVehicle, ByHand
from vehanchor.options.frame import Frame
from vehanchor.options.lengths import Lengths
from vehanchor.options.method import Method, with_preset
from vehanchor.options.option import Option, keyword_of, option_of
from vehanchor.options.reading import Reading
from vehanchor.options.reference import Reference
from vehanchor.options.rulers import KnownLength, Rulers
from vehanchor.options.search import Search

if TYPE_CHECKING:
    from collections.abc import Mapping

_Line = TypeVar("_Line", KnownLength, AddedVehicle)


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
            self.rulers.check_lengths()

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
        extent = self.frame.extent(width_px, height_px)
        across, down = picture[0] / extent[0], picture[1] / extent[1]

        def in_picture(line: _Line) -> _Line:
            return line._replace(x1=line.x1 * across, y1=line.y1 * down, x2=line.x2 * across, y2=line.y2 * down)

        told = self
        if self.frame.coordinates != "pixels" and (self.rulers.known_lengths or self.by_hand.add):
            told = replace(
                self,
                rulers=replace(self.rulers, known_lengths=tuple(map(in_picture, self.rulers.known_lengths))),
                by_hand=replace(self.by_hand, add=tuple(map(in_picture, self.by_hand.add))),
                frame=replace(self.frame, coordinates="pixels"),
            )
        told.rulers.check(*picture)
        told.by_hand.check(*picture)
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
            InvalidParameterError: a value is invalid, or an option does not exist.
        """
        preset = keywords.get("preset") or self.method.preset
        if preset is not None:
            keywords = with_preset(preset, keywords, _defaults())
        rest, groups = dict(keywords), {each.name: getattr(self, each.name) for each in fields(self)}
        for name, group in groups.items():
            known = {each.name: keyword_of(each) for each in fields(group)}
            changes = {key: rest.pop(word) for key, word in known.items() if word in rest}
            groups[name] = replace(group, **changes) if changes else group
        if rest:
            names = ", ".join(sorted(each.keyword for each in declared_options()))
            raise InvalidParameterError(f"there is no option {next(iter(rest))!r}: the options are {names}")
        return ScaleOptions(**groups)


class DeclaredOption(NamedTuple):
    """Option of a group.

    Attributes:
        keyword: keyword of the verbs.
        field: field of the group.
        group: the group.
        declared: its declaration; None for an option of the library alone.
    """

    keyword: str
    field: Field[Any]
    group: type[Any]
    declared: Option | None


def declared_options() -> tuple[DeclaredOption, ...]:
    """List the options of all groups."""
    return tuple(
        DeclaredOption(keyword_of(each), each, type(group), option_of(each))
        for group in _groups(ScaleOptions())
        for each in fields(group)
    )


def declared_option(keyword: str) -> Option:
    """Find the declaration of an option by its keyword.

    Raises:
        KeyError: the option does not exist.
    """
    found = next((each.declared for each in declared_options() if each.keyword == keyword), None)
    if found is None:
        raise KeyError(keyword)
    return found


def _defaults() -> dict[str, Any]:
    return {keyword_of(each): getattr(group, each.name) for group in _groups(ScaleOptions()) for each in fields(group)}


def _groups(options: ScaleOptions) -> list[Any]:
    return [getattr(options, each.name) for each in fields(options)]
