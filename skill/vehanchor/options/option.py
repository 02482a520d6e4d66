"""Declaration of options: name, type, limits and help, each declared once.

A field of an option group is annotated with its ``Option``, its numbers with their ``Limits``.
Keywords, command-line options, tool arguments, settings and schemas derive from the annotation.
"""

from __future__ import annotations

import math
import numbers
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeAlias

from pydantic import BeforeValidator, ConfigDict, Strict, ValidationError
from pydantic.dataclasses import dataclass as validated
from pydantic_core import PydanticCustomError, core_schema

from vehanchor.errors import InvalidParameterError, VehAnchorError

if TYPE_CHECKING:
    from collections.abc import Callable
    from dataclasses import dataclass as group  # mypy knows it; below is what runs

__all__ = ["Flag", "Limits", "Number", "Option", "group", "in_order", "refusal", "set_frozen"]

_TEXT = re.compile(r"([-+]?[\d.]+(?:e[-+]?\d+)?)\s*([a-z%]*)", re.IGNORECASE)
_UNITS = {
    "m": {"mm": 1e-3, "cm": 0.01, "m": 1.0, "km": 1e3, "in": 0.0254, "ft": 0.3048, "yd": 0.9144}
    | dict.fromkeys(("metre", "metres", "meter", "meters"), 1.0)
    | dict.fromkeys(("foot", "feet"), 0.3048)
    | {"inches": 0.0254, "yards": 0.9144},
    "mm": {"mm": 1.0},
}
_EXPECTED = {
    "bool_type": "use True or False",
    "bool_parsing": "use True or False",
    "string_type": "give one name",
    "tuple_type": "give a list",
    "missing": "it is missing",
}


class Limits(NamedTuple):
    """Valid numbers of an option; a type of numbers within ``Annotated``.

    Attributes:
        least: the smallest number; None for no such limit.
        most: the largest number; None for no such limit.
        above: exclusive lower limit; None for no such limit.
        whole: whether only whole numbers are valid.
        unit: unit of the number, in which a text may name another: "m" also takes "30 ft".
    """

    least: float | None = None
    most: float | None = None
    above: float | None = None
    whole: bool = False
    unit: str = ""

    @property
    def schema(self) -> dict[str, float]:
        """Limits by their names in JSON Schema."""
        named = {"minimum": self.least, "maximum": self.most, "exclusiveMinimum": self.above}
        return {
            name: int(limit) if limit == int(limit) else limit
            for name, limit in named.items()
            if limit is not None
        }

    def __str__(self) -> str:
        """Describe the values, as ``a finite number > 0``."""
        noun = "a whole number" if self.whole else "a finite number"
        if self.least is not None and self.most is not None:
            return f"{noun} from {self.least:.10g} to {self.most:.10g}"
        named = ((" > ", self.above), (" >= ", self.least), (", at most ", self.most))
        return noun + "".join(f"{sign}{limit:.10g}" for sign, limit in named if limit is not None)

    def check(self, name: str, value: Any) -> float:
        """Check a number, or a text with one, and convert it to Python's types, also from NumPy's.

        Raises:
            InvalidParameterError: the value is a bool, is not a finite number, or is outside the
                limits.
        """
        found = self._number(value)
        low = (self.least is not None and found < self.least) or (
            self.above is not None and found <= self.above
        )
        high = self.most is not None and found > self.most
        if not math.isfinite(found) or low or high or (self.whole and found != int(found)):
            raise InvalidParameterError(f"{name} is {_shown(value)}: use {self}")
        return int(found) if self.whole else found

    def _number(self, value: Any) -> float:
        """Read a number; NaN for what is none."""
        if isinstance(value, numbers.Real) and not isinstance(value, bool):
            try:
                return float(value)
            except OverflowError:
                return math.nan
        found = _TEXT.fullmatch(value.strip()) if isinstance(value, str) else None
        unit = found[2].lower() if found else ""
        factor = _UNITS.get(self.unit, {}).get(unit) if unit else 1.0
        try:
            return math.nan if found is None or factor is None else float(found[1]) * factor
        except ValueError:  # several points
            return math.nan

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Validate by ``check``."""

        def read(value: Any) -> float:
            try:
                return self.check("", value)
            except InvalidParameterError:
                raise PydanticCustomError("number", "use {limits}", {"limits": str(self)}) from None

        return core_schema.no_info_plain_validator_function(read)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Describe the numbers."""
        return {"type": "integer" if self.whole else "number", **self.schema}


Number: TypeAlias = Annotated[float, Limits()]
Flag: TypeAlias = Annotated[bool, Strict()]


@dataclass(frozen=True)
class Option:
    """Declaration of an option beside its type.

    Attributes:
        help: one or two short sentences for ``--help``, tools and settings.
        metavar: placeholder of the value on the command line.
        flag: name on the command line; empty for the field's name without its unit.
        repeated: whether the command line repeats it, once for each item.
        cli: whether the command line offers it.
        first: whether ``--help`` shows it; others are for a file of options.
        tools: whether no tool, all measuring tools, or only those of lengths and areas take it as
            argument.
        listed: whether the listed schemas of these tools show it to models.
        error: class of errors in its value.
    """

    help: str
    metavar: str = ""
    flag: str = ""
    repeated: bool = False
    cli: bool = True
    first: bool = False
    tools: Literal["", "all", "estimate", "measure"] = ""
    listed: bool = True
    error: type[InvalidParameterError] = InvalidParameterError

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Describe the option by its help."""
        return {**handler(schema), "description": self.help}


def _shown(value: Any) -> str:
    return f"{value:.10g}" if isinstance(value, float) else repr(value)


if not TYPE_CHECKING:

    def group(*, frozen: bool) -> Callable[[type], type]:
        """Make a frozen dataclass that checks its fields, and refuses them by an error of this library."""

        def decorate(kind: type) -> type:
            config = ConfigDict(
                extra="forbid",
                allow_inf_nan=False,
                json_schema_extra=lambda s: s.pop("description", 0),
            )
            made = validated(frozen=frozen, config=config)(kind)
            initialise = made.__init__

            def checked(self: Any, *args: Any, **values: Any) -> None:
                try:
                    initialise(self, *args, **values)
                except ValidationError as error:
                    raise refusal(made, error) from None

            made.__init__ = checked
            return made

        return decorate


def refusal(kind: Any, error: ValidationError) -> VehAnchorError:
    """Convert pydantic's error in the fields of a group to an error of this library."""
    first = error.errors(include_url=False)[0]
    cause = first.get("ctx", {}).get("error")
    if isinstance(cause, VehAnchorError):
        return cause
    place = [
        str(part) for part in first["loc"] if str(part).isidentifier() or isinstance(part, int)
    ]
    field = kind.__pydantic_fields__.get(place[0]) if place else None
    options = [each for each in (field.metadata if field else ()) if isinstance(each, Option)]
    made: Any = getattr(kind, "error", options[0].error if options else InvalidParameterError)
    words = _EXPECTED.get(first["type"]) or first["msg"].replace("Input should be", "use")
    if first["type"] == "literal_error":
        words = f"use one of {first['ctx']['expected'].replace(' or ', ', ').replace(chr(39), '')}"
    refused: VehAnchorError = made(f"{'.'.join(place)} is {_shown(first['input'])}: {words}")
    return refused


def in_order(*names: str) -> BeforeValidator:
    """Make a validator that reads the fields of a group from their values in order, or from one text."""

    def read(value: Any) -> Any:
        values = value.replace(",", " ").split() if isinstance(value, str) else value
        if isinstance(values, dict) or not isinstance(values, Iterable):
            return values
        # no group has the fields "0", "1", ...
        return dict(zip((*names, *map(str, range(64))), values, strict=False))

    return BeforeValidator(read)


def set_frozen(group: Any, name: str, value: Any) -> None:
    """Set a field of a frozen group in its ``__post_init__``."""
    object.__setattr__(group, name, value)
