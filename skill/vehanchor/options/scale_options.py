"""All option groups in one object, for all verbs, commands and the server."""

from __future__ import annotations

import typing
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
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

    from vehanchor.options.pixel_grid import PixelGrid

_Line = TypeVar("_Line", KnownLength, AddedVehicle)

# Options of the method that a preset leaves to the caller.
_FREE = ("tile_px", "stride_px")


def _no_option(name: str) -> str:
    """Refuse an option that does not exist, and name the nearest ones."""
    names = sorted(declared_options())
    nearest = [option for option in names if option.startswith(name)]
    nearest = nearest or get_close_matches(name, names)
    hint = f"; the nearest is {' or '.join(nearest)}" if nearest else ""
    return f"there is no option {name!r}{hint}. The options are {', '.join(names)}"


def _method_defaults() -> dict[str, Any]:
    """Collect the defaults of all options of the method that a preset sets."""
    defaults: dict[str, Any] = {}
    for kind in (Search, Lengths, Reference, Rulers, ByHand):
        defaults |= vars(kind())
    return {name: default for name, default in defaults.items() if name not in _FREE}


PRESETS: dict[Preset, dict[str, Any]] = {
    "paper": {
        **_method_defaults(),
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
"""Values of each preset by keyword."""


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

    def check_for_several_images(self) -> None:
        """Refuse what belongs to one photograph, before the work on several.

        A line drawn in one photograph would scale all of them.

        Raises:
            InvalidParameterError: a line is given, or vehicles are dropped or added.
        """
        name = self.by_hand.given
        if self.rulers.known_lengths:
            name = "a line of known length"
        if name is not None:
            raise InvalidParameterError(
                f"{name} belongs to one image: estimate that image by itself"
            )

    def in_pixels(self, grid: PixelGrid) -> ScaleOptions:
        """Convert lines and added vehicles to pixels of the frame, or of the file without a frame.

        Args:
            grid: pixels of the image.

        Raises:
            KnownLengthError: a line is shorter than five pixels, or ends outside the image.
            InvalidParameterError: an added vehicle does so.
        """
        coordinates = CoordinateFrame(self.frame, grid)
        picture_size = coordinates.size_px
        options = self
        has_lines = self.rulers.known_lengths or self.by_hand.add
        if self.frame.coordinates != "pixels" and has_lines:
            extent = coordinates.extent
            across = picture_size[0] / extent[0]
            down = picture_size[1] / extent[1]
            options = self._with_scaled_lines(across, down)
        options._check_lines(picture_size)
        return options

    def _with_scaled_lines(self, across: float, down: float) -> ScaleOptions:
        """Convert lines and added vehicles to pixels by the pixels per unit of coordinates."""

        def scaled(line: _Line) -> _Line:
            return replace(
                line,
                x1=line.x1 * across,
                y1=line.y1 * down,
                x2=line.x2 * across,
                y2=line.y2 * down,
            )

        known_lengths = [scaled(line) for line in self.rulers.known_lengths]
        added = [scaled(axis) for axis in self.by_hand.add]
        rulers = replace(self.rulers, known_lengths=tuple(known_lengths))
        by_hand = replace(self.by_hand, add=tuple(added))
        frame = replace(self.frame, coordinates="pixels")
        return replace(self, rulers=rulers, by_hand=by_hand, frame=frame)

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
        if self.method.preset is not None:
            # Reset what the preset has set, so that only the caller's values are compared with it.
            preset_names = PRESETS[self.method.preset]
            declared = declared_options()
            reset = {name: declared[name].default for name in preset_names}
            keywords = {**reset, **keywords}
        options = self._with_values(keywords)
        return options._with_preset()

    def _with_values(self, keywords: Mapping[str, Any]) -> ScaleOptions:
        """Copy the options with other values of single fields, whatever the preset."""
        values_by_group: dict[str, dict[str, Any]] = {}
        for name, value in keywords.items():
            declared = declared_options().get(name)
            if declared is None:
                raise InvalidParameterError(_no_option(name))
            values_by_group.setdefault(declared.group, {})[name] = value
        groups = {
            group: replace(getattr(self, group), **values)
            for group, values in values_by_group.items()
        }
        return replace(self, **groups)

    def _with_preset(self) -> ScaleOptions:
        """Copy the options with the values of their preset.

        Raises:
            InvalidParameterError: an option has neither its default nor the value of the preset.
        """
        preset = self.method.preset
        if preset is None:
            return self
        values = PRESETS[preset]
        if all(self.value(name) == value for name, value in values.items()):
            return self
        for name, value in values.items():
            default = declared_options()[name].default
            if self.value(name) not in (value, default):
                raise InvalidParameterError(
                    f"the preset {preset} sets {name}: leave {name} out, or leave the preset out"
                )
        return self._with_values(values)

    def value(self, keyword: str) -> Any:
        """Get the value of an option."""
        group = getattr(self, declared_options()[keyword].group)
        return getattr(group, keyword)


class DeclaredOption(NamedTuple):
    """Option of a group.

    Attributes:
        keyword: keyword of the verbs, and field of the group.
        group: name of the group in ``ScaleOptions``.
        option: its declaration.
        annotation: its type with limits and declaration.
        kind: its type without None, limits and declaration.
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
    declared = {}
    for group_name, group in vars(ScaleOptions()).items():
        annotations = typing.get_type_hints(type(group), include_extras=True)
        kinds = typing.get_type_hints(type(group))
        for keyword, default in vars(group).items():
            annotation = annotations[keyword]
            parts = annotation.__metadata__
            option = next(part for part in parts if isinstance(part, Option))
            declared[keyword] = DeclaredOption(
                keyword=keyword,
                group=group_name,
                option=option,
                annotation=annotation,
                kind=_without_none(kinds[keyword]),
                default=default,
            )
    return declared


def _without_none(kind: Any) -> Any:
    """Return the type ``X`` of ``X | None``, and any other type as it is."""
    members = typing.get_args(kind)
    if type(None) not in members:
        return kind
    return next(member for member in members if member is not type(None))
