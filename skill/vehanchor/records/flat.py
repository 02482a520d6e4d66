"""Records as flat rows of data frames and batch tables; all records of a type have equal columns.

A field with one value is a column. A field of a nested record is a column with the outer name as
prefix, unless its name has it already: ``tilt.tilt_deg`` is ``tilt_deg``, ``tilt.roll_deg`` is
``tilt_roll_deg``. Fields of ``details`` have no prefix. Each kind of ruler has a column for its
scale and one for its chance of being right. The codes of all warnings are one column, separated by
spaces. Other lists are counted.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel

from vehanchor.records.ruler_registry import RULERS

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo

# Fields of each ruler that are columns.
_RULER_FIELDS: dict[str, type] = {"gsd_m_per_px": float, "p_right": float}
_WARNING_CODES = "warning_codes"
_DETAILS = "details"


def flat_columns(kind: type[BaseModel], *, without: Collection[str] = ()) -> dict[str, type]:
    """List the columns of a type of record with the types of their values.

    Args:
        kind: the type of record.
        without: fields to leave out.

    Returns:
        ``float``, ``int``, ``bool`` or ``str`` by column; any value may be null.
    """
    columns: dict[str, type] = {}
    for name, field in kind.model_fields.items():
        if name in without:
            continue
        if name == "rulers":
            columns |= _ruler_columns()
        else:
            columns |= _field_columns(name, _bare_type(field))
    return columns


def flat_row(record: BaseModel, *, without: Collection[str] = ()) -> dict[str, Any]:
    """Flatten a record to values by column; see ``flat_columns``.

    Args:
        record: any record.
        without: fields to leave out.
    """
    # Fields that are null in this record keep their columns.
    kind = type(record)
    row: dict[str, Any] = dict.fromkeys(flat_columns(kind, without=without))
    for name in kind.model_fields:
        if name not in without:
            value = getattr(record, name)
            row |= _field_values(name, value)
    return row


def _field_values(name: str, value: Any) -> dict[str, Any]:
    """Flatten a field to values by column."""
    if value is None:
        return {}
    if isinstance(value, BaseModel):
        inner_row = flat_row(value)
        return {_joined(name, inner): item for inner, item in inner_row.items()}
    if not isinstance(value, tuple):
        return {name: value}
    if name == "warnings":
        return {_WARNING_CODES: " ".join(notice.code for notice in value)}
    if name == "rulers":
        return {
            _ruler_column(ruler.kind, field): getattr(ruler, field)
            for ruler in value
            for field in _RULER_FIELDS
        }
    return {f"n_{name}": len(value)}


@cache
def _field_columns(name: str, kind: Any) -> dict[str, type]:
    """List the columns of a field with the types of their values."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        inner_columns = flat_columns(kind)
        return {_joined(name, inner): item for inner, item in inner_columns.items()}
    if get_origin(kind) is not tuple:
        return {name: kind}
    if name == "warnings":
        return {_WARNING_CODES: str}
    return {f"n_{name}": int}


def _ruler_columns() -> dict[str, type]:
    return {
        _ruler_column(ruler, field): kind
        for ruler in RULERS
        for field, kind in _RULER_FIELDS.items()
    }


def _ruler_column(ruler: str, field: str) -> str:
    return f"ruler_{ruler}_{field}"


def _joined(outer: str, inner: str) -> str:
    """Join the names of a field and of a field of the record in it."""
    has_prefix = inner.startswith(f"{outer}_")
    return inner if outer == _DETAILS or has_prefix else f"{outer}_{inner}"


def _bare_type(field: FieldInfo) -> Any:
    """Return the type of a field's values without null, limits and literals."""
    kind = field.annotation
    members = get_args(kind)
    if type(None) in members:
        kind = next(member for member in members if member is not type(None))
    if get_origin(kind) is Annotated:
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        return type(get_args(kind)[0])
    return kind
