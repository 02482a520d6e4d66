"""A scale that is given back is this server's, or counts as assumed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcp import Client

from tests.server.conversation import by_path
from vehanchor.records import KnownScale
from vehanchor_server.app import create_server
from vehanchor_server.calls.compact import scale_from_text
from vehanchor_server.services import Services, _worker_services, create_services
from vehanchor_server.settings import Settings, SettingsError
from vehanchor_server.tools.scale_seal import ScaleSeal, assumed_confidence, read_key

KEY = bytes(range(32))
SCALE = KnownScale(
    gsd_m_per_px=0.1,
    gsd_ci95_low_m_per_px=0.09,
    gsd_ci95_high_m_per_px=0.11,
    confidence=0.97,
    image_id="0123456789abcdef",
    model_id="0" * 12,
)
LINES = [{"points": [{"x": 10, "y": 20}, {"x": 300, "y": 120}]}]


def _record(result: Any) -> dict[str, Any]:
    assert not result.is_error, result
    found: dict[str, Any] = result.structured_content
    return found


def _sealed(seal: ScaleSeal) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(seal.sealed({"scale": SCALE.model_dump(mode="json")})["scale"]))
    return found


def test_a_signed_scale_comes_back_as_it_was() -> None:
    seal = ScaleSeal(KEY)
    given = KnownScale.model_validate(_sealed(seal))
    assert given.image_id.startswith("0123456789abcdef.")
    assert seal.opened(given) == SCALE


@pytest.mark.parametrize(
    "changed",
    [
        {"confidence": 0.99},
        {"gsd_m_per_px": 0.105},
        {"gsd_ci95_low_m_per_px": 0.0999},
        {"image_id": "f123456789abcdef"},
        {"model_id": "1" * 12},
        {"plane": {"tilt_deg": 20.0, "roll_deg": 0.0, "focal_length_px": 900.0}},
    ],
)
def test_a_changed_scale_counts_as_assumed(changed: dict[str, Any]) -> None:
    seal, given = ScaleSeal(KEY), _sealed(ScaleSeal(KEY))
    if "image_id" in changed:
        changed = {"image_id": changed["image_id"] + given["image_id"][16:]}
    opened = seal.opened(KnownScale.model_validate({**given, **changed}))
    assert opened is not None
    assert opened.confidence == pytest.approx(assumed_confidence(opened))
    assert 0.5 < opened.confidence <= 0.85


@pytest.mark.parametrize("key", [None, bytes(32)])
def test_without_the_key_no_confidence_is_raised(key: bytes | None) -> None:
    given = KnownScale.model_validate(_sealed(ScaleSeal(KEY)))
    wide = given.model_copy(update={"gsd_ci95_low_m_per_px": 0.05, "gsd_ci95_high_m_per_px": 0.2, "confidence": 1.0})
    for each, most in ((given, 0.85), (wide, 0.4), (given.model_copy(update={"confidence": 0.2}), 0.2)):
        opened = ScaleSeal(key).opened(each)
        assert opened is not None
        assert opened.confidence <= most
        assert opened.image_id == SCALE.image_id


def test_a_key_that_protects_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="cannot be read"):
        read_key(tmp_path / "none")
    (tmp_path / "short").write_bytes(b"x" * 31 + b"\n")
    with pytest.raises(SettingsError, match="at least 32 bytes"):
        read_key(tmp_path / "short")


def test_workers_have_no_key(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.write_bytes(KEY.hex().encode())
    settings = Settings(scale_key_file=path, in_process=True)
    assert create_services(settings).seal.key is not None
    assert _worker_services(settings).seal.key is None


@pytest.mark.anyio
@pytest.mark.parametrize("detail", ["short", "full"])
async def test_a_scale_is_given_back_over_mcp(services: Services, images: Path, detail: str) -> None:
    server = create_server(replace(services, seal=ScaleSeal(KEY)))
    image = by_path(images / "cars.png")
    async with Client(server) as client:
        first = _record(await client.call_tool("estimate_gsd", {**image, "detail": detail}))
        arguments = {**image, "lines": LINES, "detail": "full"}
        honest = _record(await client.call_tool("measure_distance", {**arguments, "scale": first["scale"]}))
        scale = KnownScale.model_validate(scale_from_text(first["scale"]))
        raised = {**scale.model_dump(mode="json"), "confidence": 1.0}
        forged = _record(await client.call_tool("measure_distance", {**arguments, "scale": raised}))
    assert honest["confidence"] == scale.confidence
    assert forged["confidence"] <= 0.85
    assert (honest["distance_m"], honest["scale_source"]) == (forged["distance_m"], "reused")
