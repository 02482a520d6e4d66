"""Photographs of a flight before they are looked at, and their names."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import InvalidParameterError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from vehanchor.imagery.sources.opening import ImageSource


class InputPhotograph(NamedTuple):
    """A photograph of a flight before it is looked at.

    Attributes:
        name: in the record.
        image: as in ``estimate_gsd``.
        film: path of the video that it is a frame of, by which a journal knows it again; None for none.
    """

    name: str
    image: ImageSource
    film: str | None = None


def named(images: Iterable[ImageSource | InputPhotograph]) -> Iterator[InputPhotograph]:
    """Name photographs: a path by itself, anything else by its number from 1.

    Args:
        images: the photographs; held one at a time.

    Yields:
        Each with its name.

    Raises:
        InvalidParameterError: two are of one name.
    """
    seen: set[str] = set()
    for number, image in enumerate(images, start=1):
        if isinstance(image, InputPhotograph):
            taken = image
        elif isinstance(image, str | os.PathLike):
            taken = InputPhotograph(os.fspath(image).encode("utf-8", "backslashreplace").decode(), image)
        else:
            taken = InputPhotograph(f"#{number}", image)
        if taken.name in seen:
            raise InvalidParameterError(f"the photograph {taken.name!r} is given twice: give each once")
        seen.add(taken.name)
        yield taken
