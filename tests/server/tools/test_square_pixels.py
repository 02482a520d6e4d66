"""An image whose file has oblong pixels, over MCP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from mcp.server import MCPServer

from tests.oblong import ASPECT, in_degrees
from tests.server.conftest import paint_scene
from tests.server.conversation import called, record_of, text_of
from tests.server.tools.test_view_image import asked, facts_in

pytestmark = pytest.mark.anyio


@pytest.fixture
def oblong(images: Path) -> Iterator[Path]:
    """A picture of 640 x 512 square pixels in a file of fewer rows."""
    path = in_degrees(images / "oblong.tif", paint_scene(640, 512), 0.1)
    yield path
    path.unlink()


async def test_lines_in_both_directions_have_their_lengths(
    server: MCPServer[object], oblong: Path
) -> None:
    east = {"points": [{"x": 100, "y": 100}, {"x": 500, "y": 100}]}
    south = {"points": [{"x": 100, "y": 50}, {"x": 100, "y": 50 + 200 / ASPECT}]}
    for line, metres in ((east, 40.0), (south, 20.0)):
        result = await called(
            server,
            "measure_distance",
            oblong,
            lines=[line],
            gsd_m_per_px=0.1,
            gsd_basis="measured",
        )
        assert record_of(result)["distance_m"] == pytest.approx(metres, rel=0.01)


async def test_a_scale_names_both_sides_of_a_pixel(server: MCPServer[object], oblong: Path) -> None:
    south = {"x1": 100, "y1": 50, "x2": 100, "y2": 50 + 200 / ASPECT, "metres": 20.0}
    line = {**south, "basis": "measured"}
    result = await called(server, "estimate_gsd", oblong, known_lengths=[line])
    assert "not square: 0.100 m across, 0.145 m down" in text_of(result)


async def test_a_view_is_square_and_counts_the_files_pixels(
    server: MCPServer[object], oblong: Path
) -> None:
    part = {"x_min": 100, "y_min": 100, "x_max": 300, "y_max": 200}
    viewed = facts_in(await asked(server, oblong, part=part))
    assert (viewed["image_width_px"], viewed["image_height_px"]) == (640, 353)
    assert viewed["part"] == {"x_min": 100, "y_min": 100, "x_max": 300, "y_max": 200}
    ratio = viewed["picture_width_px"] / viewed["picture_height_px"]
    assert ratio == pytest.approx(200 / (100 * ASPECT), rel=0.01)
