"""How a caller names an image: one object whose ``kind`` says where the image is."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

__all__ = [
    "MAX_PATH_CHARS",
    "MAX_URL_CHARS",
    "AnyImage",
    "Base64Image",
    "Frame",
    "ImageArgument",
    "PathImage",
    "UrlImage",
]

MAX_PATH_CHARS = 4096  # Linux's PATH_MAX
MAX_URL_CHARS = 2048


class _Argument(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PathImage(_Argument):
    """An image file on the server's machine."""

    kind: Literal["path"]
    path: str = Field(
        min_length=1,
        max_length=MAX_PATH_CHARS,
        description="Absolute path, or file:// URL, of a file below a directory that the server allows.",
    )


class Base64Image(_Argument):
    """An image sent with the call, by a program: a model cannot write long base64."""

    kind: Literal["base64"]
    data: str = Field(min_length=1, description="The encoded image file (JPEG, PNG, TIFF, WebP, BMP), or a data: URI.")


class UrlImage(_Argument):
    """An image on a web server that this server's operator allows."""

    kind: Literal["url"]
    url: str = Field(min_length=1, max_length=MAX_URL_CHARS, description="https:// address on an allowed host.")


AnyImage: TypeAlias = PathImage | Base64Image | UrlImage

ImageArgument = Annotated[AnyImage, Field(discriminator="kind")]
"""The ``image`` of every tool; ``kind`` has no default, so that the published schema requires it."""


class Frame(_Argument):
    """Size of the resized copy of the image that the caller sees and works in."""

    width_px: int = Field(gt=0, le=1_000_000, description="Width of that copy, pixels.")
    height_px: int = Field(gt=0, le=1_000_000, description="Height of that copy, pixels.")
