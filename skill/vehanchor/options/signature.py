"""Signatures of functions whose parameters are declared elsewhere: as options, settings or fields.

Two libraries read the signature and the annotations of a function:

* Typer makes the options of a command from them.
* The MCP SDK makes the arguments of a tool, and its JSON Schema, from them.

``help`` shows both, and the docstring.
"""

from __future__ import annotations

import inspect
import textwrap
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


def share_keywords(function: Callable[..., Any], like: Callable[..., Any]) -> None:
    """Let ``help`` show the parameters of another function, to which this one passes its own.

    Args:
        function: the function to change; it returns something else than the other.
        like: the other function; its docstring has a section ``Args``.
    """
    own = inspect.signature(function)
    other = inspect.signature(like)
    shared = other.replace(return_annotation=own.return_annotation)
    function.__signature__ = shared  # type: ignore[attr-defined]
    _, _, arguments = inspect.getdoc(like).partition("Args:")  # type: ignore[union-attr]
    arguments, _, _ = arguments.partition("\n\n")
    function.__doc__ = f"{inspect.getdoc(function)}\n\nArgs:{arguments}\n"


def list_keywords(function: Callable[..., Any], *groups: Iterable[str]) -> None:
    """Let ``help`` list the keywords that a function takes as ``**keywords``.

    Args:
        function: the function whose docstring grows.
        groups: names of keywords.
    """
    names = [name for group in groups for name in sorted(group)]
    listed = textwrap.fill(
        ", ".join(names), width=88, initial_indent="    ", subsequent_indent="    "
    )
    function.__doc__ = f"{inspect.getdoc(function)}\n\nKeywords:\n{listed}\n"
