"""Choice of the rulers that a call uses, from ``vehanchor.records.ruler_registry``."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from vehanchor.errors import InvalidParameterError
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.records.ruler_registry import RULERS
from vehanchor.rulers.standards import check_name

if TYPE_CHECKING:
    from vehanchor.options import Rulers
    from vehanchor.rulers.ruler import Ruler


def ruler_class(kind: str) -> type[Ruler]:
    """Import the class of a ruler.

    Raises:
        KeyError: the ruler does not exist.
    """
    module_name, _, class_name = RULERS[kind].partition(":")
    ruler: type[Ruler] = getattr(import_module(module_name), class_name)
    assert ruler.kind == kind, f"{RULERS[kind]} has the kind {ruler.kind!r}, not {kind!r}"
    return ruler


def check_rulers(options: Rulers) -> None:
    """Check that all named rulers and things of known size exist.

    Raises:
        InvalidParameterError: a ruler does not exist.
        KnownLengthError: a thing of known size is not in the catalogue.
    """
    for line in options.known_lengths:
        check_name(line.what)
    if options.rulers is None:
        return
    if any(name not in RULERS for name in options.rulers):
        raise InvalidParameterError(
            f"rulers is {options.rulers!r}: use some of {', '.join(RULERS)}"
        )


def allowed_rulers(options: Rulers) -> tuple[type[Ruler], ...]:
    """List the rulers that the caller allows, in the order of the registry.

    Raises:
        InvalidParameterError: as ``check_rulers``.
    """
    check_rulers(options)
    allowed = []
    for ruler in map(ruler_class, RULERS):
        is_named = options.rulers is None or ruler.kind in options.rulers
        may_read = options.metadata or not ruler.reads_metadata
        if is_named and may_read:
            allowed.append(ruler)
    return tuple(allowed)


def active_rulers(options: Rulers) -> tuple[Ruler, ...]:
    """Make the allowed rulers, without those that need a fact which the caller does not state."""
    return tuple(
        ruler()
        for ruler in allowed_rulers(options)
        if ruler.fact is None or getattr(options, ruler.fact)
    )


def unused_facts(options: Rulers) -> tuple[Notice, ...]:
    """Warn of facts from the caller whose rulers the caller leaves out."""
    if options.rulers is None:
        return ()
    notices = []
    for ruler in map(ruler_class, RULERS):
        is_given = ruler.fact is not None and getattr(options, ruler.fact)
        if is_given and ruler.kind not in options.rulers:
            message = f"The {ruler.label} is not used: the chosen rulers leave out {ruler.kind}."
            notices.append(Notice(code=NoticeCode.FACT_UNUSED, message=message))
    return tuple(notices)


def uses(options: Rulers, kind: str) -> bool:
    """Test whether a call uses a ruler."""
    return any(ruler.kind == kind for ruler in active_rulers(options))


def needs_search(options: Rulers) -> bool:
    """Test whether the detector must run."""
    return any(ruler.needs_search for ruler in active_rulers(options))


def rulers_help() -> str:
    """Make the help of the option ``rulers``."""
    return (
        f"Rulers to use, with commas: {', '.join(RULERS)}. Default: all. 'vehanchor models "
        "--rulers' states what each needs."
    )
