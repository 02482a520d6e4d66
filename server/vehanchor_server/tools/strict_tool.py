"""A tool that takes no unknown argument, says what was wrong in one line with a code, and logs every call."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from itertools import groupby
from typing import Any

from mcp.server.mcpserver import Context
from mcp.server.mcpserver.exceptions import ToolError, UnexpectedToolError
from mcp.server.mcpserver.tools import Tool
from mcp.types import CallToolResult, InputRequiredResult, ToolAnnotations
from pydantic import Field, ValidationError

from vehanchor_server.errors import CallError, shortened
from vehanchor_server.request_log import log_call
from vehanchor_server.tools.portable_schema import listed_schema, portable_schema

_IN_WORDS = {  # pydantic's own words for these help a programmer, not a model
    "extra_forbidden": "there is no such argument",
    "missing": "it is required",
    "model_attributes_type": 'give an object, such as {"kind": "path", "path": "/data/photo.jpg"} for an image',
    "model_type": "give an object",
    "union_tag_invalid": "kind is none of 'path', 'base64', 'url'",
    "union_tag_not_found": "kind is missing: it says where the image is, path, base64 or url",
}
MAX_VALUES = 1000  # in a call's arguments; the largest that means anything, 32 points, has some 120
_SHOWN_CHARS = 200  # of a complaint
_MAX_COMPLAINTS = 3  # one wrong argument often breaks several rules; a model needs the first


class StrictTool(Tool):
    """The SDK's tool, made strict.

    Attributes:
        full_parameters: the arguments' whole schema; ``parameters`` is what a model needs of it.
        record_schema: of the whole record; ``output_schema`` is what every answer has of it.
    """

    full_parameters: dict[str, Any] = Field(default_factory=dict, exclude=True)
    record_schema: dict[str, Any] = Field(default_factory=dict, exclude=True)

    @classmethod
    def read_only(
        cls,
        function: Callable[..., Any],
        *,
        title: str,
        description: str,
        meta: dict[str, Any] | None = None,
        answered: Sequence[str] = (),
        required: Sequence[str] = (),
        unlisted: Collection[str] = (),
    ) -> StrictTool:
        """A tool that only looks: it changes nothing, and the same call gives the same answer.

        Args:
            function: named as the tool; its parameters and result are the contract, as for ``Tool.from_function``, and
                become schemas that every host can read.
            title: for people.
            description: for planners; clients keep 2 KB of it.
            meta: its ``_meta``.
            answered: fields of the record that the listed schema names; the others are there with full detail only.
                Without any, it is the record's own.
            required: arguments without which the listed schema alone knows no sense in a call.
            unlisted: arguments that are taken, but that the listed schema does not name.
        """
        annotations = ToolAnnotations(
            title=title, read_only_hint=True, destructive_hint=False, idempotent_hint=True, open_world_hint=False
        )
        tool = cls.from_function(function, title=title, description=description, annotations=annotations, meta=meta)
        assert isinstance(tool, StrictTool)
        arguments = tool.fn_metadata.arg_model
        arguments.model_config["extra"] = "forbid"  # the SDK would drop unknown arguments without a word
        arguments.model_rebuild(force=True)
        tool.full_parameters = portable_schema(arguments.model_json_schema(by_alias=True))
        tool.parameters = listed_schema(tool.full_parameters, unlisted)
        if required:
            tool.parameters["required"] = [*tool.parameters.get("required", ()), *required]
        if tool.fn_metadata.output_schema is not None:
            tool.record_schema = portable_schema(tool.fn_metadata.output_schema)
            tool.fn_metadata.output_schema = _answered(tool.record_schema, answered)
            tool.fn_metadata.output_model = None  # short and full answers are made of records, which check themselves
        return tool

    async def run(self, arguments: dict[str, Any], context: Context[Any, Any], convert_result: bool = False) -> Any:
        """Run the tool.

        Raises:
            CallError: the call failed; ``internal_error`` is one that the SDK logs with its traceback.
        """
        started = time.perf_counter()
        status, result = "cancelled", None
        try:
            if _more_values_than(arguments, MAX_VALUES):
                raise ToolError("too many values") from _too_many()
            result = await super().run(arguments, context, convert_result)
            status = "input_required" if isinstance(result, InputRequiredResult) else "ok"
            return result
        except ToolError as error:
            cause = error.__cause__
            if isinstance(cause, CallError):
                status = cause.code
                raise cause from cause.__cause__
            if isinstance(cause, ValidationError):
                status = "invalid_arguments"
                raise CallError(status, _complaints(cause)) from cause
            status = "internal_error"
            raise UnexpectedToolError(
                "internal_error: the server failed on this call; its log says why. Report it to the server's operator."
            ) from cause
        finally:
            record = result.structured_content if isinstance(result, CallToolResult) else None
            log_call(self.name, status, time.perf_counter() - started, record)


def _answered(record: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """The schema of every answer, short or full: some fields of a record by their types alone."""
    if not names:
        return record
    types: dict[str, Any] = {}
    for name in names:
        field = record["properties"][name]
        kinds = [option["type"] for option in field.get("anyOf", [field])]
        types[name] = {"type": kinds[0]} if len(kinds) == 1 else {"anyOf": [{"type": kind} for kind in kinds]}
    return {"type": "object", "properties": types}


def _too_many() -> CallError:
    return CallError(
        "invalid_arguments", f"more than {MAX_VALUES} values. Correct the arguments by the tool's input schema."
    )


def _more_values_than(arguments: Any, limit: int) -> bool:
    """Whether a JSON value holds more values than a limit, counted no further: each fault costs pydantic a record."""
    pending, n = [arguments], 0
    while pending:
        value = pending.pop()
        if isinstance(value, dict | list):
            n += len(value)
            if n > limit:
                return True
            pending.extend(value.values() if isinstance(value, dict) else value)
    return False


def _complaints(error: ValidationError) -> str:
    """The arguments' faults, without the values: an image in base64 is no help to anyone."""
    found = error.errors(include_url=False, include_context=False, include_input=False)
    lines = []
    for complaint in found[:_MAX_COMPLAINTS]:
        # pydantic names the chosen form of a union after the argument: image.path.path, target.box.box.x_min
        place = ".".join(shortened(str(part)) for part, _ in groupby(complaint["loc"])) or "arguments"
        lines.append(f"{place}: {_IN_WORDS.get(complaint['type'], complaint['msg'])[:_SHOWN_CHARS]}")
    more = f" (and {len(found) - _MAX_COMPLAINTS} more)" if len(found) > _MAX_COMPLAINTS else ""
    return "; ".join(lines) + more + ". Correct the arguments by the tool's input schema."
