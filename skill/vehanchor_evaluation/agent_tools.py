"""Tools for a language model under evaluation, provided through entry points.

The evaluation does not depend on a server. A distribution registers, in the group ``vehanchor.agent_tools``, a function
``(roots, *, detector, segmenter)`` that returns a context manager of a ``ToolCaller``. VehAnchor's server does this.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Protocol

from vehanchor.errors import MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from contextlib import AbstractContextManager
    from pathlib import Path

GROUP = "vehanchor.agent_tools"


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


class ToolsFactory(Protocol):
    """Type of the entry point's object."""

    def __call__(
        self, roots: Sequence[Path], *, detector: str | None, segmenter: tuple[Path, Path] | None
    ) -> AbstractContextManager[ToolCaller]:
        """Open tools that read only images below ``roots``, with these models; None for the bundled ones."""


def open_agent_tools(
    roots: Sequence[Path], *, detector: str | None = None, segmenter: tuple[Path, Path] | None = None
) -> AbstractContextManager[ToolCaller]:
    """Open the installed tools; if there are several, the first by name.

    Args:
        roots: folders whose images the tools may read.
        detector: path or name of a model; None for the bundled one.
        segmenter: paths of encoder and decoder; None for the bundled one.

    Raises:
        MissingExtraError: no tools are installed, or they cannot be loaded.
    """
    registered = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    if not registered:
        raise MissingExtraError(
            f"--agent needs tools for models, but no installed package has any (entry points of {GROUP!r}): install "
            "vehanchor with its server"
        )
    try:
        factory: ToolsFactory = registered[0].load()
    except (ImportError, AttributeError) as error:
        raise MissingExtraError(
            f"--agent needs tools for models, but {registered[0].value!r} cannot be loaded ({error}): reinstall it"
        ) from None
    return factory(roots, detector=detector, segmenter=segmenter)
