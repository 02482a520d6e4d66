"""Input photographs of a flight and their names."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

from vehanchor.errors import InvalidParameterError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.sources.opening import ImageSource


class InputPhotograph(NamedTuple):
    """Input photograph of a flight.

    Attributes:
        name: name in the record.
        image: as in ``estimate_gsd``.
        film: path of the video, if it is a frame of one: its key in a journal; None otherwise.
    """

    name: str
    image: ImageSource
    film: str | None = None


def check_many(images: Any) -> None:
    """Check that several photographs are given, and not one whose characters, bytes or rows would be taken for many.

    Raises:
        InvalidParameterError: the images are a path, bytes, an array, or no collection.
    """
    one = isinstance(images, str | bytes | os.PathLike | InputPhotograph) or hasattr(
        images, "__array__"
    )
    if one or not isinstance(images, Iterable):
        shown = (
            repr(images) if isinstance(images, str | os.PathLike) else f"a {type(images).__name__}"
        )
        raise InvalidParameterError(
            f"images is {shown}: give a list of photographs; vehanchor.find_images makes one of "
            "a folder or a pattern"
        )


def named(images: Iterable[ImageSource | InputPhotograph]) -> Iterator[InputPhotograph]:
    """Name photographs: paths by themselves, others by their number from 1.

    Args:
        images: the photographs; one is held in memory at a time.

    Yields:
        Each with its name.

    Raises:
        InvalidParameterError: two have the same name.
    """
    seen: set[str] = set()
    for number, image in enumerate(images, start=1):
        if isinstance(image, InputPhotograph):
            taken = image
        elif isinstance(image, str | os.PathLike):
            taken = InputPhotograph(
                os.fspath(image).encode("utf-8", "backslashreplace").decode(), image
            )
        else:
            taken = InputPhotograph(f"#{number}", image)
        if taken.name in seen:
            raise InvalidParameterError(
                f"the photograph {taken.name!r} is given twice: give each once"
            )
        seen.add(taken.name)
        yield taken
