"""Strict tool: refuse unknown arguments, report errors as one line with a code, log every call."""

from __future__ import annotations

import json
import time
import types
from collections.abc import Callable, Mapping, Sequence
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
from vehanchor_server.tools.portable_schema import listed, portable_schema, without_marks

# All but StrictTool are the SDK's. Tools import them from here when they are created, because the
# SDK loads slowly.
__all__ = ["CallToolResult", "Context", "InputRequiredResult", "StrictTool"]

MAX_VALUES = 7000  # per call; 16 polygons of 400 numbers have 6,400, and a call with points 120
_MAX_SHOWN_PATH = 200  # characters of a call's own path in an example
_EXACT = 2.0**53  # above, a float cannot hold each whole number


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
        listed_fields: Sequence[str] = (),
        image_kinds: Sequence[str] = (),
    ) -> StrictTool:
        """Create a read-only, idempotent tool.

        Args:
            function: the implementation; its name and parameters define the tool, as for
                ``Tool.from_function``.
            title: title for people.
            description: description for planners; clients keep 2 KB of it.
            meta: the tool's ``_meta``.
            record: type of the record in the structured content; None without any.
            listed_fields: fields of the record in the listed schema; other fields need full
                detail. Default: all fields.
            image_kinds: kinds of images in the listed schema; default: all.
        """
        annotations = ToolAnnotations(
            read_only_hint=True, destructive_hint=False, idempotent_hint=True, open_world_hint=False
        )
        tool = cls.from_function(
            function,
            title=title,
            description=description,
            annotations=annotations,
            meta=meta,
            structured_output=False,
        )
        assert isinstance(tool, StrictTool)
        # The SDK's model drops unknown arguments silently; its subclass refuses them.
        arguments = tool.fn_metadata.arg_model
        tool.fn_metadata.arg_model = types.new_class(
            arguments.__name__, (arguments,), {"extra": "forbid"}
        )
        marked = portable_schema({"additionalProperties": False, **tool.parameters})
        tool.full_parameters = without_marks(marked)
        tool.parameters = listed(marked, image_kinds)
        if record is not None:
            tool.record = record
            tool.fn_metadata.output_schema = _answer_schema(record, listed_fields)
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
            if _has_more_values(arguments, MAX_VALUES):
                refusal = f"more than {MAX_VALUES} values. See the tool's input schema."
                raise ToolError("too many values") from CallError("invalid_arguments", refusal)
            result = await super().run(_with_integers(arguments), context, convert_result)
            status = "ok"
            if isinstance(result, InputRequiredResult):
                status = "input_required"
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
            seconds = time.perf_counter() - started
            record = None
            if isinstance(result, CallToolResult):
                record = result.structured_content
            log_call(self.name, status, seconds=seconds, record=record)

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
        """Describe invalid arguments; the example names the call's image, or one of the server."""
        text = complaints(
            error,
            arguments,
            schema=self.full_parameters,
            required=self.parameters.get("required") or ["image"],
        )
        # Models copy examples, so that the example names the image of the call.
        image = _path_in(arguments)
        if image is None and self.first_image is not None:
            image = self.first_image()
        if image is None:
            return text
        return text.replace(json.dumps(EXAMPLE_PATH), json.dumps(image))


def _path_in(arguments: Mapping[str, Any]) -> str | None:
    """Return the path of the image in a call's arguments; None without a usable one.

    Models also give the path alone, in place of the object.
    """
    image = arguments.get("image")
    path = image.get("path") if isinstance(image, dict) else image
    if not isinstance(path, str) or not path or len(path) > _MAX_SHOWN_PATH:
        return None
    return path


def _answer_schema(record: type[BaseModel], names: Sequence[str]) -> dict[str, Any]:
    """Return a schema that short and full answers satisfy: the types of selected fields."""
    fields: dict[str, Any] = {}
    for name in names or record.model_fields:
        annotation: Any = record.model_fields[name].annotation
        schema = TypeAdapter(annotation).json_schema()
        variants = [{"type": variant["type"]} for variant in schema.get("anyOf", [schema])]
        if len(variants) == 1:
            fields[name] = variants[0]
        else:
            fields[name] = {"anyOf": variants}
    return {"type": "object", "properties": fields}


def _with_integers(value: Any) -> Any:
    """Replace 3.0 by 3, which JSON Schema takes for the same, and leave out null fields."""
    if isinstance(value, dict):
        return {name: _with_integers(item) for name, item in value.items() if item is not None}
    if isinstance(value, list):
        return [_with_integers(item) for item in value]
    if isinstance(value, float) and value.is_integer() and abs(value) < _EXACT:
        return int(value)
    return value


def _has_more_values(arguments: Any, limit: int) -> bool:
    """Return whether a JSON value has more values than the limit.

    Counting stops at the limit, and happens before pydantic records each fault.
    """
    pending = [arguments]
    n_values = 0
    while pending:
        value = pending.pop()
        if not isinstance(value, dict | list):
            continue
        n_values += len(value)
        if n_values > limit:
            return True
        pending.extend(value.values() if isinstance(value, dict) else value)
    return False
