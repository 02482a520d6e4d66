"""Kinds of rulers in records: any string, named one by one in the JSON schema and in the columns of tables."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any, TypeAlias, cast

from pydantic import Field


def ruler_kinds() -> tuple[str, ...]:
    """Kinds of all rulers, from the registry; it is loaded late, because rulers are made of records."""
    return cast("tuple[str, ...]", import_module("vehanchor.rulers.registry").ruler_kinds())


def _named(schema: dict[str, Any]) -> None:
    schema["enum"] = list(ruler_kinds())


RulerKind: TypeAlias = Annotated[str, Field(json_schema_extra=_named)]
"""Kind of a ruler: its name in options, records and tables."""
