"""Photographs of a flight before they are looked at, and their names."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

from vehanchor.errors import InvalidParameterError

if TYPE_CHECKING:
    from collections.abc import Iterator

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


def check_many(images: Any) -> None:
    """Refuse one photograph where many are expected: its characters, bytes or rows are no photographs.

    Raises:
        InvalidParameterError: the images are a path, bytes, an array, or no collection at all.
    """
    one = isinstance(images, str | bytes | os.PathLike | InputPhotograph) or hasattr(images, "__array__")
    if one or not isinstance(images, Iterable):
        shown = repr(images) if isinstance(images, str | os.PathLike) else f"a {type(images).__name__}"
        raise InvalidParameterError(
            f"images is {shown}: give a list of photographs; vehanchor.find_images makes one of a folder or a pattern"
        )


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
