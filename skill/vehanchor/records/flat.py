"""Records as flat rows of data frames and batch tables, with the same columns for every record of a type.

A field with one value is a column. A field of a nested record is a column with the outer name as
prefix, unless its name has it already: ``tilt.tilt_deg`` is ``tilt_deg``, ``tilt.roll_deg`` is
``tilt_roll_deg``. Fields of ``details`` have no prefix. Each kind of ruler has
columns for its scale and its agreement. Codes of warnings are one column, separated by spaces.
Other lists are counted.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel

from vehanchor.records.ruler_registry import RULERS

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

_OF_RULERS: dict[str, type] = {"gsd_m_per_px": float, "p_right": float}
_CODES = "warning_codes"
_DETAILS = "details"


def flat_columns(kind: type[BaseModel], *, without: Collection[str] = ()) -> dict[str, type]:
    """List the columns of a type of record with the types of their values.

    Args:
        kind: the type of record.
        without: fields to leave out.

    Returns:
        ``float``, ``int``, ``bool`` or ``str`` by column; any value may be null.
    """
    found: dict[str, type] = {}
    for name, field in kind.model_fields.items():
        if name == "rulers" and name not in without:
            found |= {
                f"ruler_{ruler}_{part}": each
                for ruler in RULERS
                for part, each in _OF_RULERS.items()
            }
        elif name not in without:
            found |= _columns(name, _bare(field))
    return found


def flat_row(record: BaseModel, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Flatten a record to values by column; see ``flat_columns``.

    Args:
        record: any record.
        without: fields to leave out.
    """
    row: dict[str, Any] = dict.fromkeys(flat_columns(type(record), without=without))
    for name in type(record).model_fields:
        if name not in without:
            row |= _values(name, getattr(record, name))
    return row


def _values(name: str, value: Any) -> dict[str, Any]:
    if isinstance(value, BaseModel):
        return {_joined(name, inner): each for inner, each in flat_row(value).items()}
    if not isinstance(value, tuple):
        return {} if value is None else {name: value}
    if name == "warnings":
        return {_CODES: " ".join(notice.code for notice in value)}
    if name == "rulers":
        return {
            f"ruler_{ruler.kind}_{part}": getattr(ruler, part)
            for ruler in value
            for part in _OF_RULERS
        }
    return {f"n_{name}": len(value)}


@cache
def _columns(name: str, kind: Any) -> dict[str, type]:
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return {_joined(name, inner): each for inner, each in flat_columns(kind).items()}
    if get_origin(kind) is not tuple:
        return {name: kind}
    if name == "warnings":
        return {_CODES: str}
    return {f"n_{name}": int}


def _joined(outer: str, inner: str) -> str:
    return inner if outer == _DETAILS or inner.startswith(f"{outer}_") else f"{outer}_{inner}"


def _bare(field: FieldInfo) -> Any:
    """Give the type of a field's values without null."""
    kind = field.annotation
    kinds = get_args(field.annotation)
    if type(None) in kinds:
        kind = next(each for each in kinds if each is not type(None))
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    return type(get_args(kind)[0]) if get_origin(kind) is Literal else kind
