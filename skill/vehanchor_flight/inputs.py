"""Input photographs of a flight and their names."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

from vehanchor.errors import InvalidParameterError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.sources.opening import ImageSource


class InputPhotograph(NamedTuple):
    """Input photograph of a flight.

    Attributes:
        name: name in the record.
        image: as in ``estimate_gsd``.
        film: path of the video, if it is a frame of one: its key in a journal; None otherwise.
        camera: camera facts of a frame; None without any.
    """

    name: str
    image: ImageSource
    film: str | None = None
    camera: CameraMetadata | None = None


def check_many(images: Any) -> None:
    """Check that the images are a collection of photographs.

    Iterating over a single photograph would take its characters, bytes or rows for many.

    Raises:
        InvalidParameterError: the images are a path, bytes, an array, or no collection.
    """
    is_single = isinstance(images, str | bytes | os.PathLike | InputPhotograph)
    if hasattr(images, "__array__"):
        is_single = True
    if isinstance(images, Iterable) and not is_single:
        return
    shown = f"a {type(images).__name__}"
    if isinstance(images, str | os.PathLike):
        shown = repr(images)
    raise InvalidParameterError(
        f"images is {shown}: give a list of photographs; vehanchor.find_images makes one of "
        "a folder or a pattern"
    )


def name_photographs(
    images: Iterable[ImageSource | InputPhotograph],
) -> Iterator[InputPhotograph]:
    """Name photographs: paths by themselves, others by their number from 1.

    Args:
        images: the photographs; one is held in memory at a time.

    Yields:
        Each with its name.

    Raises:
        InvalidParameterError: two have the same name.
    """
    names: set[str] = set()
    for number, image in enumerate(images, start=1):
        if isinstance(image, InputPhotograph):
            photograph = image
        elif isinstance(image, str | os.PathLike):
            # A file name may hold bytes that are not UTF-8, and records are UTF-8.
            name = os.fspath(image).encode("utf-8", "backslashreplace").decode()
            photograph = InputPhotograph(name, image)
        else:
            photograph = InputPhotograph(f"#{number}", image)
        if photograph.name in names:
            raise InvalidParameterError(
                f"the photograph {photograph.name!r} is given twice: give each once"
            )
        names.add(photograph.name)
        yield photograph
