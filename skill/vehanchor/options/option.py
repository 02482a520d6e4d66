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
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeAlias, TypeGuard

from pydantic import BeforeValidator, ConfigDict, Field, Strict, ValidationError
from pydantic.dataclasses import dataclass as validated
from pydantic_core import PydanticCustomError, core_schema

from vehanchor.errors import InvalidParameterError, VehAnchorError

if TYPE_CHECKING:
    from collections.abc import Callable
    from dataclasses import dataclass as group  # mypy understands it; ``group`` below is used

__all__ = [
    "UNLISTED",
    "UNLISTED_KEY",
    "Flag",
    "Limits",
    "Number",
    "Option",
    "group",
    "in_order",
    "refusal",
    "set_frozen",
]

_NUMBER_WITH_UNIT = re.compile(r"([-+]?[\d.]+(?:e[-+]?\d+)?)\s*([a-z%]*)", re.IGNORECASE)
_INCH_M = 0.0254
FOOT_M = 0.3048
_YARD_M = 0.9144
_METRES = {
    "mm": 1e-3,
    "cm": 0.01,
    "km": 1e3,
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("in", "inches"), _INCH_M),
    **dict.fromkeys(("ft", "foot", "feet"), FOOT_M),
    **dict.fromkeys(("yd", "yards"), _YARD_M),
}
# Factors of the units that a text may name, by the unit of the option.
_FACTORS = {"m": _METRES, "mm": {"mm": 1.0}}
# What to give instead, by pydantic's type of the error.
_EXPECTED = {
    "bool_type": "use True or False",
    "bool_parsing": "use True or False",
    "string_type": "give one name",
    "tuple_type": "give a list",
    "missing": "it is missing",
}


def is_number(value: Any) -> TypeGuard[float]:
    """Test whether a value is a real number of any library; truth values are none."""
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


class Limits(NamedTuple):
    """Valid numbers of an option; within ``Annotated``, pydantic validates by them.

    Attributes:
        least: the smallest number; None for no such limit.
        most: the largest number; None for no such limit.
        above: exclusive lower limit; None for no such limit.
        whole: whether only whole numbers are valid.
        unit: unit of the number. A text may name another unit: "m" also accepts "30 ft".
    """

    least: float | None = None
    most: float | None = None
    above: float | None = None
    whole: bool = False
    unit: str = ""

    @property
    def schema(self) -> dict[str, float]:
        """Limits by their names in JSON Schema."""
        limits = {
            "minimum": self.least,
            "maximum": self.most,
            "exclusiveMinimum": self.above,
        }
        schema: dict[str, float] = {}
        for name, limit in limits.items():
            if limit is None:
                continue
            is_whole = limit == int(limit)
            schema[name] = int(limit) if is_whole else limit
        return schema

    def __str__(self) -> str:
        """Describe the valid numbers, such as ``a finite number > 0``."""
        noun = "a whole number" if self.whole else "a finite number"
        if self.least is not None and self.most is not None:
            return f"{noun} from {self.least:.10g} to {self.most:.10g}"
        text = noun
        if self.above is not None:
            text += f" > {self.above:.10g}"
        if self.least is not None:
            text += f" >= {self.least:.10g}"
        if self.most is not None:
            text += f", at most {self.most:.10g}"
        return text

    def check(self, name: str, value: Any) -> float:
        """Check a number or a text with a number, and convert it to a number of Python.

        Raises:
            InvalidParameterError: the value is a bool, is not a finite number, or is outside the
                limits.
        """
        number = self._read(value)
        if not self._contains(number):
            raise InvalidParameterError(f"{name} is {_shown(value)}: use {self}")
        return int(number) if self.whole else number

    def _contains(self, number: float) -> bool:
        if not math.isfinite(number):
            return False
        if self.least is not None and number < self.least:
            return False
        if self.above is not None and number <= self.above:
            return False
        if self.most is not None and number > self.most:
            return False
        return not self.whole or number == int(number)

    def _read(self, value: Any) -> float:
        """Read a number of any library, or a text with a number; NaN for anything else."""
        if isinstance(value, str):
            return self._read_text(value)
        if not is_number(value):
            return math.nan
        try:
            return float(value)
        except OverflowError:
            return math.nan

    def _read_text(self, text: str) -> float:
        """Read a number with or without a unit; NaN for another text or an unknown unit."""
        match = _NUMBER_WITH_UNIT.fullmatch(text.strip())
        if match is None:
            return math.nan
        digits, unit = match.groups()
        factor: float | None = 1.0
        if unit:
            factors = _FACTORS.get(self.unit, {})
            factor = factors.get(unit.lower())
        if factor is None:
            return math.nan
        try:
            return float(digits) * factor
        except ValueError:  # The digits have several decimal points.
            return math.nan

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Validate by ``check``."""

        def read(value: Any) -> float:
            try:
                return self.check("", value)
            except InvalidParameterError:
                context = {"limits": str(self)}
                raise PydanticCustomError("number", "use {limits}", context) from None

        return core_schema.no_info_plain_validator_function(read)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Describe the numbers."""
        kind = "integer" if self.whole else "number"
        return {"type": kind, **self.schema}


UNLISTED_KEY = "x-unlisted"
"""Key of a JSON schema whose field tools do not list to models."""

UNLISTED = Field(json_schema_extra={UNLISTED_KEY: True})
"""Mark of a field, within ``Annotated``, that tools take from programs but do not list to models.

An ``Option`` has ``listed`` instead.
"""

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
        first: whether ``--help`` shows it; other options are for an options file.
        tools: tools that take it as an argument: none, all, only the one that estimates a scale, or
            only those that measure areas and distances.
        listed: whether the listed schemas of these tools show it to models.
        error: class of the errors about its value.
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
        described = {**handler(schema), "description": self.help}
        if not self.listed:
            described[UNLISTED_KEY] = True
        return described


def _shown(value: Any) -> str:
    return f"{value:.10g}" if isinstance(value, float) else repr(value)


if not TYPE_CHECKING:

    def group(*, frozen: bool) -> Callable[[type], type]:
        """Make a dataclass whose fields pydantic checks, with errors of this library."""

        def decorate(kind: type) -> type:
            config = ConfigDict(
                extra="forbid", allow_inf_nan=False, json_schema_extra=_drop_description
            )
            checked_kind = validated(frozen=frozen, config=config)(kind)
            initialise = checked_kind.__init__

            def initialise_or_refuse(self: Any, *args: Any, **values: Any) -> None:
                try:
                    initialise(self, *args, **values)
                except ValidationError as error:
                    raise refusal(checked_kind, error) from None

            checked_kind.__init__ = initialise_or_refuse
            return checked_kind

        return decorate

    def _drop_description(schema: dict[str, Any]) -> None:
        """Remove the docstring of a group from its schema: it is for programmers."""
        schema.pop("description", None)


def refusal(kind: Any, error: ValidationError) -> VehAnchorError:
    """Convert pydantic's error about the fields of a group to an error of this library."""
    detail: Any = error.errors(include_url=False)[0]
    cause = detail.get("ctx", {}).get("error")
    if isinstance(cause, VehAnchorError):
        return cause
    # Names that are neither fields nor indices are pydantic's own, such as "function-before".
    path = []
    for part in detail["loc"]:
        if isinstance(part, int) or part.isidentifier():
            path.append(str(part))
    error_class = _error_class(kind, path)
    value = _shown(detail["input"])
    return error_class(f"{'.'.join(path)} is {value}: {_expectation(detail)}")


def _error_class(kind: Any, path: list[str]) -> type[InvalidParameterError]:
    """Return the class of errors of a group, of the option at a path, or the general one."""
    if hasattr(kind, "error"):
        group_error: type[InvalidParameterError] = kind.error
        return group_error
    if not path:
        return InvalidParameterError
    field = kind.__pydantic_fields__.get(path[0])
    if field is None:
        return InvalidParameterError
    for annotation in field.metadata:
        if isinstance(annotation, Option):
            return annotation.error
    return InvalidParameterError


def _expectation(detail: Any) -> str:
    """Say what to give instead of a value that pydantic refuses."""
    kind = detail["type"]
    if kind == "literal_error":
        # Pydantic writes "'a', 'b' or 'c'".
        expected = detail["ctx"]["expected"]
        names = expected.replace(" or ", ", ").replace("'", "")
        return f"use one of {names}"
    message: str = detail["msg"]
    return _EXPECTED.get(kind) or message.replace("Input should be", "use")


def in_order(*names: str) -> BeforeValidator:
    """Make a validator that reads the fields of a group from a sequence or a text."""

    def read(value: Any) -> Any:
        values = value
        if isinstance(value, str):
            values = value.replace(",", " ").split()
        if isinstance(values, int | float):
            form = ", ".join(names)
            raise PydanticCustomError(
                "in_order", "give a list of items, each ({form})", {"form": form}
            )
        if isinstance(values, dict) or not isinstance(values, Iterable):
            return values
        # Surplus values get the names "0", "1", ..., which no group has, so pydantic refuses them.
        surplus = map(str, range(64))
        keys = (*names, *surplus)
        return dict(zip(keys, values, strict=False))

    return BeforeValidator(read)


def set_frozen(group: Any, name: str, value: Any) -> None:
    """Set a field of a frozen group in its ``__post_init__``."""
    object.__setattr__(group, name, value)
