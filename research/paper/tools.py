"""Tools for a language model: those of the server, within this process and without a transport."""

from __future__ import annotations

import json
import logging
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Protocol

from anyio.from_thread import start_blocking_portal
from mcp import Client
from mcp.types import TextContent

from vehanchor_server.app import create_server
from vehanchor_server.schemas import anthropic_definition, openai_definition
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.registry import create_tools

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from mcp.types import CallToolResult

# Hundreds of numbers without use to a model.
_DRAWING_FIELDS = ("outline",)


class ToolCaller(Protocol):
    """Tools for a model.

    Attributes:
        anthropic_tools: tool definitions for the Messages API.
        openai_tools: tool definitions for the Chat Completions API.
    """

    anthropic_tools: list[dict[str, Any]]
    openai_tools: list[dict[str, Any]]

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        """Execute a tool call; return the text for the model and whether it is an error."""


class InProcessTools:
    """A server with its client: a context manager for use from any thread.

    Args:
        settings: the operator's options; images are read only below its roots.

    Attributes:
        anthropic_tools: tool definitions for the Messages API, as in ``schemas/anthropic.json``.
        openai_tools: tool definitions for the Chat Completions API; ``schemas/openai.json`` is for
            Responses.
    """

    def __init__(self, settings: Settings) -> None:
        services = create_services(settings)
        contract = create_tools(services)
        self.anthropic_tools = [anthropic_definition(tool) for tool in contract]
        self.openai_tools = [_below_function(openai_definition(tool)) for tool in contract]
        self._services = services
        self._server = create_server(services)
        self._stack = ExitStack()

    def __enter__(self) -> InProcessTools:
        log = logging.getLogger("vehanchor_server.calls")  # the log of calls is for operators
        self._stack.callback(log.setLevel, log.level)
        log.setLevel(logging.WARNING)
        self._portal = self._stack.enter_context(start_blocking_portal())
        self._client = self._stack.enter_context(
            self._portal.wrap_async_context_manager(Client(self._server))
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        self._services.close()

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        """Call a tool.

        Args:
            name: name of the tool.
            arguments: arguments of the call.

        Returns:
            The text for the model (a sentence, then the record as JSON), and whether it is an
            error.
        """
        result = self._portal.call(self._client.call_tool, name, arguments)
        return _text(result), bool(result.is_error)


def open_tools(
    roots: Sequence[Path],
    *,
    detector: str | None = None,
    segmenter: tuple[Path, Path] | None = None,
) -> InProcessTools:
    """Open the tools for a model.

    Args:
        roots: directories of images.
        detector: bundled name or path; None for the default.
        segmenter: encoder and decoder; None for the bundled one.

    Raises:
        SettingsError: a directory does not exist.
    """
    return InProcessTools(
        Settings(roots=tuple(roots), detector=detector, segmenter=segmenter, isolation="in-process")
    )


def _below_function(definition: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "function",
        "function": {key: value for key, value in definition.items() if key != "type"},
    }


def _text(result: CallToolResult) -> str:
    lines = [block.text for block in result.content if isinstance(block, TextContent)]
    record = result.structured_content
    if record is not None and not result.is_error:
        lines.append(
            json.dumps({key: value for key, value in record.items() if key not in _DRAWING_FIELDS})
        )
    return "\n".join(lines)
