"""Signatures of functions whose parameters are declared elsewhere: as options, settings or fields.

Two libraries read the signature and the annotations of a function:

* Typer makes the options of a command from them.
* The MCP SDK makes the arguments of a tool, and its JSON Schema, from them.
"""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


def set_signature(
    function: Callable[..., Any],
    parameters: Iterable[inspect.Parameter],
    *,
    returns: Any = inspect.Signature.empty,
) -> None:
    """Give a function these parameters, all keyword-only, in place of its own.

    The function still receives what Typer or the MCP SDK passes by these names, usually as
    ``**arguments``.

    Args:
        function: the function to change.
        parameters: its parameters; their annotations are types, not texts.
        returns: annotation of its result.
    """
    keywords = []
    annotations = {}
    for parameter in parameters:
        keywords.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))
        annotations[parameter.name] = parameter.annotation
    signature = inspect.Signature(keywords, return_annotation=returns)
    function.__signature__ = signature  # type: ignore[attr-defined]
    function.__annotations__ = annotations
