"""A tool that refuses unknown arguments, reports errors as one line with a code, and logs every call."""

from __future__ import annotations

import json
import time
import types
from collections.abc import Callable, Sequence
from typing import Any

from mcp.server.mcpserver import Context
from mcp.server.mcpserver.exceptions import ToolError, UnexpectedToolError
from mcp.server.mcpserver.tools import Tool
from mcp.types import CallToolResult, InputRequiredResult, ToolAnnotations
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from vehanchor_server.calls.reply import PictureRequest
from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import EXAMPLE_PATH
from vehanchor_server.request_log import log_call
from vehanchor_server.tools.complaints import complaints
from vehanchor_server.tools.portable_schema import listed, portable_schema

# what a tool needs of the SDK, too
__all__ = ["CallToolResult", "Context", "InputRequiredResult", "StrictTool"]

MAX_VALUES = 1000  # per call; the largest valid call, with 32 points, has about 120
_EXACT = 2.0**53  # above, floats are no counts


class ReportedError(CallError, ToolError):
    """Failure of a call, which the SDK logs without a traceback. Workers do not know the SDK."""


class StrictTool(Tool):
    """The SDK's tool with strict arguments.

    Attributes:
        full_parameters: complete schema of the arguments; ``parameters`` is the reduced one for
            models.
        record: type of the record in full answers; ``output_schema`` has the fields of every
            answer.
        first_image: finds an image of this server for examples in errors.
    """

    full_parameters: dict[str, Any] = Field(default_factory=dict, exclude=True)
    record: type[BaseModel] | None = Field(default=None, exclude=True)
    first_image: Callable[[], str | None] | None = Field(default=None, exclude=True)

    @classmethod
    def read_only(
        cls,
        function: Callable[..., Any],
        *,
        title: str,
        description: str,
        meta: dict[str, Any] | None = None,
        record: type[BaseModel] | None = None,
        answered: Sequence[str] = (),
        kinds: Sequence[str] = (),
    ) -> StrictTool:
        """Create a read-only, idempotent tool.

        Args:
            function: the implementation; its name and parameters define the tool, as for
                ``Tool.from_function``.
            title: title for people.
            description: description for planners; clients keep 2 KB of it.
            meta: the tool's ``_meta``.
            record: type of the record in the structured content; None without any.
            answered: fields of the record in the listed schema; other fields need full detail.
                Default: all fields.
            kinds: kinds of images in the listed schema; default: all.
        """
        annotations = ToolAnnotations(
            read_only_hint=True, destructive_hint=False, idempotent_hint=True, open_world_hint=False
        )
        words: dict[str, Any] = {"title": title, "description": description}
        tool = cls.from_function(
            function, **words, annotations=annotations, meta=meta, structured_output=False
        )
        assert isinstance(tool, StrictTool)
        arguments = tool.fn_metadata.arg_model  # which drops unknown arguments silently
        tool.fn_metadata.arg_model = types.new_class(
            arguments.__name__, (arguments,), {"extra": "forbid"}
        )
        tool.full_parameters = portable_schema({"additionalProperties": False, **tool.parameters})
        tool.parameters = listed(tool.full_parameters, kinds)
        if record is not None:
            tool.record = record
            # records validate short and full answers
            tool.fn_metadata.output_schema = _answered(record, answered)
        return tool

    async def run(
        self, arguments: dict[str, Any], context: Context[Any, Any], convert_result: bool = False
    ) -> Any:
        """Run the tool.

        Raises:
            CallError: the call failed; the SDK logs the traceback of ``internal_error``.
        """
        started = time.perf_counter()
        status = "cancelled"
        result = None
        try:
            if _more_values_than(arguments, MAX_VALUES):
                many = f"more than {MAX_VALUES} values. See the tool's input schema."
                raise ToolError("too many values") from CallError("invalid_arguments", many)
            result = await super().run(_with_integers(arguments), context, convert_result)
            status = "input_required" if isinstance(result, InputRequiredResult) else "ok"
            return result
        except ToolError as error:
            cause = error.__cause__
            if isinstance(cause, CallError):
                status = cause.code
                raise ReportedError(status, cause.explanation) from cause.__cause__
            if isinstance(cause, ValidationError):
                status = "invalid_arguments"
                raise ReportedError(status, self._complaints(cause, arguments)) from cause
            status = "internal_error"
            raise UnexpectedToolError(
                "internal_error: the server failed on this call; its log has the cause. Report "
                "it to the operator."
            ) from cause
        finally:
            record = result.structured_content if isinstance(result, CallToolResult) else None
            log_call(self.name, status, seconds=time.perf_counter() - started, record=record)

    async def show(
        self, arguments: dict[str, Any], context: Context[Any, Any], picture: PictureRequest
    ) -> CallToolResult:
        """Run a measuring tool for ``view_image``, which shows what the call saw.

        Raises:
            CallError: the call failed.
        """
        try:
            checked = self.fn_metadata.validate_arguments(_with_integers(arguments))
        except ValidationError as error:
            complaint = self._complaints(error, arguments)
            raise CallError("invalid_arguments", f"of.arguments: {complaint}") from error
        result: CallToolResult = await self.fn(**checked, ctx=context, shown=picture)
        return result

    def _complaints(self, error: ValidationError, arguments: dict[str, Any]) -> str:
        words = complaints(
            error,
            arguments,
            schema=self.full_parameters,
            required=self.parameters.get("required") or ["image"],
        )
        found = self.first_image() if self.first_image is not None else None
        return (
            words if found is None else words.replace(json.dumps(EXAMPLE_PATH), json.dumps(found))
        )


def _answered(record: type[BaseModel], names: Sequence[str]) -> dict[str, Any]:
    """Return the schema of every answer, short or full: selected fields of the record with their types."""
    fields: dict[str, Any] = {}
    for name in names or record.model_fields:
        kind: Any = record.model_fields[name].annotation
        field = TypeAdapter(kind).json_schema()
        kinds = [option["type"] for option in field.get("anyOf", [field])]
        fields[name] = (
            {"type": kinds[0]} if len(kinds) == 1 else {"anyOf": [{"type": kind} for kind in kinds]}
        )
    return {"type": "object", "properties": fields}


def _with_integers(value: Any) -> Any:
    """Replace 3.0 by 3, which JSON Schema takes for the same, and leave out what is null."""
    if isinstance(value, dict):
        return {name: _with_integers(each) for name, each in value.items() if each is not None}
    if isinstance(value, list):
        return [_with_integers(each) for each in value]
    return (
        int(value)
        if isinstance(value, float) and value.is_integer() and abs(value) < _EXACT
        else value
    )


def _more_values_than(arguments: Any, limit: int) -> bool:
    """Return whether a JSON value has more values than the limit; count no further, as pydantic records each fault."""
    pending = [arguments]
    n = 0
    while pending:
        value = pending.pop()
        if isinstance(value, dict | list):
            n += len(value)
            if n > limit:
                return True
            pending.extend(value.values() if isinstance(value, dict) else value)
    return False
