"""Tool arguments derived from the library's options: the same limits, the same help."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import Field

from vehanchor.options import declared_option
from vehanchor.options.option import Limits

if TYPE_CHECKING:
    from vehanchor.options.option import Option


def option_field(declared: str | Option) -> Any:
    """Make the pydantic field of an argument that is an option.

    Args:
        declared: the option, or its keyword.
    """
    found = declared_option(declared) if isinstance(declared, str) else declared
    return Field(description=found.help, **_limits(found.takes))


def limits_field(limits: str | Limits) -> Any:
    """Make the pydantic field of a number with the limits of an option.

    Args:
        limits: the limits, or the keyword of the option.
    """
    takes = declared_option(limits).takes if isinstance(limits, str) else limits
    return Field(**_limits(takes))


def _limits(takes: Any) -> dict[str, Any]:
    found: dict[str, Any] = {} if takes is None else dict(takes.schema)
    if isinstance(takes, Limits) and not takes.whole:
        found["allow_inf_nan"] = False
    return found
