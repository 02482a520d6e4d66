"""Kinds of rulers in records: strings that the JSON schema and the columns of tables list."""

from __future__ import annotations

from importlib import import_module
from typing import Annotated, Any, TypeAlias, cast

from pydantic import Field


def ruler_kinds() -> tuple[str, ...]:
    """List the kinds of all rulers; the registry is imported late, because rulers import records."""
    return cast("tuple[str, ...]", import_module("vehanchor.rulers.registry").ruler_kinds())


def _named(schema: dict[str, Any]) -> None:
    schema["enum"] = list(ruler_kinds())


RulerKind: TypeAlias = Annotated[str, Field(json_schema_extra=_named)]
"""Kind of a ruler: its name in options, records and tables."""
