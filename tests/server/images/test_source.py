from __future__ import annotations

import base64

import pytest

from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import Base64Image, UrlImage
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.path_access import PathAccess
from vehanchor_server.images.source import ImageSources


@pytest.fixture
def sources() -> ImageSources:
    return ImageSources(PathAccess([]), Fetcher((), 100, 1))


def decoded(sources: ImageSources, data: str) -> object:
    with sources.open(Base64Image(kind="base64", data=data)) as opened:
        return opened


@pytest.mark.parametrize(
    "data",
    [
        "AAEC",
        "AA\r\nEC\n",
        "data:image/png;base64,AAEC",
        "DATA:image/png;name=a.png;BASE64,AAEC",
        "data:;base64,AAEC",
    ],
)
def test_base64_becomes_bytes(sources: ImageSources, data: str) -> None:
    assert decoded(sources, data) == b"\0\1\2"


@pytest.mark.parametrize(
    "data",
    [
        "not base64!",
        "AAE",
        "A",
        "AA=C",
        "AAE-_",
        "ÄÖÜ=",
        "AAEC\0",
        "data:image/png,AAEC",
        "data:image/png;base64",
        "data:base64,AAEC",
        "data:" + "x" * 1000,
    ],
)
def test_what_is_not_base64_is_told(sources: ImageSources, data: str) -> None:
    with pytest.raises(CallError, match="base64_invalid: "):
        decoded(sources, data)


def test_size_is_checked_before_decoding(sources: ImageSources) -> None:
    assert decoded(sources, base64.b64encode(b"x" * 100).decode()) == b"x" * 100
    with pytest.raises(CallError, match="image_too_large: "):
        decoded(sources, "!" * 200)


@pytest.mark.anyio
async def test_urls_are_fetched_before_they_are_opened(
    sources: ImageSources, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def fetch(_: Fetcher, url: str) -> bytes:
        return url.encode()

    monkeypatch.setattr(Fetcher, "fetch", fetch)
    image = UrlImage(kind="url", url="https://a.test/b")
    both = await sources.fetched([image, Base64Image(kind="base64", data="AAEC")])
    with sources.open(*both[0]) as opened:
        assert opened == b"https://a.test/b"
    assert both[1][1] is None
    with pytest.raises(
        CallError, match="image_too_large: the images have more than 100 bytes together"
    ):
        await sources.fetched([image] * 7)
