"""All rulers, one line each; every list of rulers in the library, the server and the page derives from here."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from vehanchor.errors import InvalidParameterError

if TYPE_CHECKING:
    from vehanchor.options import Rulers
    from vehanchor.rulers.ruler import Ruler

RULERS: dict[str, str] = {
    "vehicles": "vehanchor.rulers.vehicles:Vehicles",
    "scene_scale": "vehanchor.rulers.scene_scale:SceneScale",
    "camera": "vehanchor.rulers.camera:Camera",
    "known_length": "vehanchor.rulers.known_length:KnownLengths",
    "height": "vehanchor.rulers.given_height:GivenHeight",
    "courts": "vehanchor.rulers.courts:Courts",
    "positions": "vehanchor.rulers.positions:Positions",
}
"""Class of each ruler by its kind, as ``module:Class``; loaded when it is first used."""


def ruler_kinds() -> tuple[str, ...]:
    """Kinds of all rulers."""
    return tuple(RULERS)


def ruler_class(kind: str) -> type[Ruler]:
    """Class of a ruler.

    Raises:
        KeyError: there is no such ruler.
    """
    module, _, name = RULERS[kind].partition(":")
    found: type[Ruler] = getattr(import_module(module), name)
    assert found.kind == kind, f"{RULERS[kind]} has the kind {found.kind!r}, not {kind!r}"
    return found


def check_rulers(options: Rulers) -> None:
    """Refuse names of rulers that do not exist.

    Raises:
        InvalidParameterError: there is no such ruler.
    """
    unknown = [name for name in options.rulers or () if name not in RULERS]
    if unknown:
        raise InvalidParameterError(f"rulers is {options.rulers!r}: use some of {', '.join(RULERS)}")


def active_rulers(options: Rulers) -> tuple[Ruler, ...]:
    """Rulers that the caller allows, in the order of the registry.

    Raises:
        InvalidParameterError: as ``check_rulers``.
    """
    check_rulers(options)
    allowed = (ruler_class(kind) for kind in RULERS if options.rulers is None or kind in options.rulers)
    return tuple(ruler() for ruler in allowed if options.metadata or not ruler.reads_metadata)


def uses(options: Rulers, kind: str) -> bool:
    """Whether the caller allows a ruler."""
    return any(ruler.kind == kind for ruler in active_rulers(options))


def needs_search(options: Rulers) -> bool:
    """Whether the detector has to run."""
    return any(ruler.needs_search for ruler in active_rulers(options))


def rulers_help() -> str:
    """Help of the option that chooses rulers."""
    return f"Rulers to use, with commas: {', '.join(RULERS)}. Default: all."
