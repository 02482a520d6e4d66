"""Tools that a language model may use while it is evaluated; whoever has them registers an entry point.

The evaluation knows no server. A distribution with tools names, in the group ``vehanchor.agent_tools``, a function
``(roots, *, detector, segmenter)`` that returns a context manager of a ``ToolCaller``; VehAnchor's own server does so.
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
        anthropic_tools: their definitions for the Messages API.
        openai_tools: their definitions for the Chat Completions API.
    """

    anthropic_tools: list[dict[str, Any]]
    openai_tools: list[dict[str, Any]]

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        """Do what the model asks for; gives what it reads and whether that tells an error."""


class ToolsFactory(Protocol):
    """The object that an entry point names."""

    def __call__(
        self, roots: Sequence[Path], *, detector: str | None, segmenter: tuple[Path, Path] | None
    ) -> AbstractContextManager[ToolCaller]:
        """Open tools that read images below ``roots`` only, with these models; None takes the bundled ones."""


def open_agent_tools(
    roots: Sequence[Path], *, detector: str | None = None, segmenter: tuple[Path, Path] | None = None
) -> AbstractContextManager[ToolCaller]:
    """Open the tools that are installed; of several the first by name.

    Args:
        roots: folders whose images the tools may read.
        detector: path or name of a model; None for the bundled one.
        segmenter: paths of encoder and decoder; None for the bundled one.

    Raises:
        MissingExtraError: there are none, or they cannot be loaded.
    """
    registered = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    if not registered:
        raise MissingExtraError(
            f"--agent needs tools for models, and no installed package has any (entry points of {GROUP!r}): install "
            "vehanchor with its server"
        )
    try:
        factory: ToolsFactory = registered[0].load()
    except (ImportError, AttributeError) as error:
        raise MissingExtraError(
            f"--agent needs tools for models, and {registered[0].value!r} cannot be loaded ({error}): reinstall them"
        ) from None
    return factory(roots, detector=detector, segmenter=segmenter)
