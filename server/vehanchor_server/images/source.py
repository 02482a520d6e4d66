"""Convert the image argument to an input of the library: a descriptor's name, a file object, or bytes."""

from __future__ import annotations

import base64
import binascii
import re
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, TypeAlias

from vehanchor.errors import VehAnchorError
from vehanchor.records.escaping import on_one_line
from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import AnyImage, Base64Image, PathImage, UrlImage

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from vehanchor_server.images.fetch import Fetcher
    from vehanchor_server.images.path_access import PathAccess

OpenedImage: TypeAlias = str | bytes | BinaryIO
"""An input of ``vehanchor.imagery.sources.opening.open_raster``: a descriptor's name, bytes, or a file object."""

_DATA_URI = re.compile(r"data:[\w.+/-]*(;[\w=.+-]+)*,", re.ASCII | re.IGNORECASE)
_MAX_URI_HEAD = 256


@dataclass(frozen=True)
class ImageSources:
    """Image sources of a server.

    Attributes:
        paths: access to files by path.
        fetcher: access to web servers; its largest image is the largest within a call, too.
    """

    paths: PathAccess
    fetcher: Fetcher

    async def fetched(
        self, images: Sequence[AnyImage]
    ) -> tuple[tuple[AnyImage, bytes | None], ...]:
        """Give each image the bytes of its URL; together they share the size limit of one image.

        Raises:
            CallError: an image cannot be fetched, or the total is too large.
        """
        found: list[tuple[AnyImage, bytes | None]] = []
        n_bytes = 0
        most = self.fetcher.max_bytes
        for image in images:
            fetched = await self.fetcher.fetch(image.url) if isinstance(image, UrlImage) else None
            n_bytes += len(fetched or b"")
            if n_bytes > most:
                raise CallError(
                    "image_too_large",
                    f"the images have more than {most} bytes together. Send fewer images, or "
                    "smaller copies.",
                )
            found.append((image, fetched))
        return tuple(found)

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
        if text[:5].lower() == "data:":
            head = _DATA_URI.match(text[:_MAX_URI_HEAD])
            if head is None or not head.group().lower().endswith(";base64,"):
                raise CallError(
                    "base64_invalid", "the data: URI is not base64. Send data:image/png;base64,..."
                )
            text = text[head.end() :]
        if len(text) * 3 // 4 > self.fetcher.max_bytes + 2:
            raise CallError(
                "image_too_large",
                f"the image has more than {self.fetcher.max_bytes} bytes. Send a smaller one.",
            )
        try:
            return base64.b64decode("".join(text.split()), validate=True)
        except (binascii.Error, ValueError) as error:
            raise CallError(
                "base64_invalid", f"the data is not base64 ({error}). Encode the file's bytes."
            ) from None


@contextmanager
def library_errors(source: OpenedImage) -> Iterator[None]:
    """Convert library errors to call errors, without the server's name of the open file.

    Raises:
        CallError: for a ``VehAnchorError``, with its code.
    """
    try:
        yield
    except VehAnchorError as error:
        message = str(error)
        if isinstance(source, str):
            message = message.replace(repr(source), "image").replace(source, "image")
        raise CallError(
            error.code, on_one_line(message if message.endswith(".") else f"{message}.")
        ) from error
