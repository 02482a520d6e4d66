"""Convert the image argument to an input of the library.

That is the name of a descriptor, a file object, or bytes.
"""

from __future__ import annotations

import base64
import binascii
import re
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, TypeAlias

from vehanchor.errors import ImageTooLargeError, VehAnchorError
from vehanchor.imagery.limits import check_bytes
from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import AnyImage, Base64Image, PathImage, UrlImage

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vehanchor_server.images.fetch import Fetcher
    from vehanchor_server.images.path_access import PathAccess

OpenedImage: TypeAlias = str | bytes | BinaryIO
"""An input of ``vehanchor.imagery.sources.opening.open_raster``."""

_DATA_URI = re.compile(r"data:[\w.+/-]*(;[\w=.+-]+)*,", re.ASCII | re.IGNORECASE)
_MAX_URI_HEAD = 256  # characters before the data


@dataclass(frozen=True)
class ImageSources:
    """Image sources of a server.

    Attributes:
        paths: access to files by path.
        fetcher: access to web servers; its size limit also holds for base64.
    """

    paths: PathAccess
    fetcher: Fetcher

    async def fetched(
        self, images: Sequence[AnyImage]
    ) -> tuple[tuple[AnyImage, bytes | None], ...]:
        """Return each image with the bytes of its URL, or None if it has no URL.

        Together the fetched images share the size limit of one image.

        Raises:
            CallError: an image cannot be fetched, or the total is too large.
        """
        pairs: list[tuple[AnyImage, bytes | None]] = []
        n_bytes = 0
        max_bytes = self.fetcher.max_bytes
        for image in images:
            if not isinstance(image, UrlImage):
                pairs.append((image, None))
                continue
            fetched = await self.fetcher.fetch(image.url)
            n_bytes += len(fetched)
            if n_bytes > max_bytes:
                raise CallError(
                    "image_too_large",
                    f"the images have more than {max_bytes} bytes together. Send fewer images, or "
                    "smaller copies.",
                )
            pairs.append((image, fetched))
        return tuple(pairs)

    @contextmanager
    def open(self, image: AnyImage, fetched: bytes | None = None) -> Iterator[OpenedImage]:
        """Open the image for the duration of the context.

        Args:
            image: the caller's argument.
            fetched: the bytes of its URL.

        Raises:
            CallError: the image is not allowed, missing, or malformed.
        """
        if isinstance(image, PathImage):
            with self.paths.open(image.path) as file:
                yield file
        elif isinstance(image, Base64Image):
            yield self._decoded(image.data)
        else:
            assert fetched is not None
            yield fetched

    def _decoded(self, text: str) -> bytes:
        """Decode base64, also in a ``data:`` URI."""
        if text[:5].lower() == "data:":
            head = _DATA_URI.match(text[:_MAX_URI_HEAD])
            if head is None or not head.group().lower().endswith(";base64,"):
                raise CallError(
                    "base64_invalid", "the data: URI is not base64. Send data:image/png;base64,..."
                )
            text = text[head.end() :]
        # Four characters hold three bytes; up to two of them are padding.
        min_bytes = len(text) * 3 // 4 - 2
        try:
            check_bytes(min_bytes, self.fetcher.max_bytes)
        except ImageTooLargeError as error:
            raise CallError.of(error) from None
        try:
            return base64.b64decode("".join(text.split()), validate=True)
        except (binascii.Error, ValueError) as error:
            raise CallError(
                "base64_invalid", f"the data is not base64 ({error}). Encode the file's bytes."
            ) from None


@contextmanager
def library_errors(source: OpenedImage) -> Iterator[None]:
    """Convert library errors to call errors without the server's name of the open file.

    Raises:
        CallError: for a ``VehAnchorError``, with its code.
    """
    try:
        yield
    except VehAnchorError as error:
        message = str(error)
        if isinstance(source, str):
            message = message.replace(repr(source), "image").replace(source, "image")
        raise CallError.of(error, message) from error
