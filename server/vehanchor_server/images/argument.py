"""The image argument of every tool: an object whose ``kind`` names the source."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field

from vehanchor_server.base_model import FrozenModel

MAX_PATH_CHARS = 4096  # Linux's PATH_MAX
MAX_URL_CHARS = 2048
EXAMPLE_PATH = "car_park.jpg"


class PathImage(FrozenModel):
    """An image file on the server's machine."""

    kind: Literal["path"]
    path: str = Field(min_length=1, max_length=MAX_PATH_CHARS)


class Base64Image(FrozenModel):
    """An image within the call, for programs; models cannot write long base64."""

    kind: Literal["base64"]
    data: str = Field(min_length=1)


class UrlImage(FrozenModel):
    """An image on a web server that the operator allows."""

    kind: Literal["url"]
    url: str = Field(min_length=1, max_length=MAX_URL_CHARS)


AnyImage: TypeAlias = PathImage | Base64Image | UrlImage

ImageArgument = Annotated[
    AnyImage,
    Field(
        discriminator="kind",
        description="The uncropped image. A path is absolute, or relative to an allowed folder.",
        examples=[{"kind": "path", "path": EXAMPLE_PATH}],
    ),
]
"""The ``image`` of every tool; ``kind`` has no default, so that the schema requires it."""
