"""What is fuzzed: a door for strangers' bytes, and what may come out of it: an answer, or an error of ours.

A target takes bytes and returns nothing. ``CORPUS`` makes the bytes to begin with, by our own
generators.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import io
import json
import logging
import math
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import rasterio
from mcp.server.mcpserver import Context
from mcp.types import CallToolResult
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from research.scenes import render_scene
from tests import bombs
from tests.skill.cut_off import CALIBRATION
from tests.skill.imagery import files as blocks
from vehanchor import estimate_gsd
from vehanchor.detection.card import ChipCard, VerifierCard, read_card, read_detector_card
from vehanchor.errors import VehAnchorError
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES
from vehanchor.imagery.metadata.camera import read_camera
from vehanchor.imagery.metadata.exif import read_exif
from vehanchor.imagery.metadata.xmp import read_xmp
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.files import external_locations
from vehanchor.options import ImageLimits, Reading
from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
from vehanchor.scale.calibration import load_calibration
from vehanchor_server.calls.messages import (
    DRAWING,
    HEADER,
    MAX_PICTURE_BYTES,
    MAX_RECORDS,
    RECORD,
    Loaded,
    MessageError,
    Progressed,
    Refused,
    Replied,
    receive,
    receive_reply,
)
from vehanchor_server.errors import CallError
from vehanchor_server.sandbox.confinement import Confinement
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings
from vehanchor_server.tools.registry import create_tools
from vehanchor_server.tools.strict_tool import StrictTool
from vehanchor_server.tools.view_image import ViewedImage

FUZZ_LIMITS = ImageLimits(
    max_bytes=1 << 20, max_pixels=1 << 20, max_windowed_pixels=1 << 22, max_decoded_bytes=64 << 20
)
"""Small enough that no input is slow, so that what is slow is a bug."""

_SIDE_PX = 48
_MAX_COMPLAINT_CHARS = 4000
_EXIF = b"Exif\0\0II*\0\x08\0\0\0\1\0\x12\1\3\0\1\0\0\0\6\0\0\0\0\0\0\0"


def header(data: bytes) -> None:
    """Read what an image says of itself."""
    with contextlib.suppress(VehAnchorError):
        read_header(lambda offset, count: data[offset : offset + count])


def image(data: bytes) -> None:
    """Open an image and read a window and the whole of it."""
    try:
        with warnings.catch_warnings(), open_raster(data, Reading(limits=FUZZ_LIMITS)) as raster:
            warnings.simplefilter("ignore")
            raster.read(
                Window(0, 0, width_px=min(16, raster.width_px), height_px=min(16, raster.height_px))
            )
            if raster.width_px * raster.height_px <= FUZZ_LIMITS.max_pixels:
                raster.read()
    except VehAnchorError:
        pass


def calibration(data: bytes) -> None:
    """Load a calibration file."""
    try:
        with TemporaryDirectory(dir=_memory()) as folder:
            path = Path(folder, "c.json")
            path.write_bytes(data)
            found = load_calibration(path)
    except VehAnchorError:
        return
    assert 2 <= found.reference_length_m <= 20
    assert (
        found.reference_length_ci95_low_m
        <= found.reference_length_m
        <= found.reference_length_ci95_high_m
    )


def card(data: bytes) -> None:
    """Read the cards of a detector and of its networks from their metadata."""
    try:
        stated = json.loads(data)
    except (ValueError, RecursionError):
        return
    if not isinstance(stated, dict):
        return
    metadata = {
        key: value if isinstance(value, str) else json.dumps(value) for key, value in stated.items()
    }
    file = Path("fuzzed.onnx"), "0" * 64
    with contextlib.suppress(VehAnchorError):
        read_detector_card(*file, metadata)
    for kind in (ChipCard, VerifierCard):
        with contextlib.suppress(VehAnchorError):
            read_card(kind, *file, metadata)


def metadata(data: bytes) -> None:
    """Read what a file says of its camera, or what its EXIF block or XMP packet alone does."""

    def read_at(offset: int, count: int) -> bytes:
        return data[offset : offset + count]

    for tags in (read_exif(read_at), read_exif(lambda at, count: data[6 + at : 6 + at + count])):
        assert all(isinstance(value, str | float | bytes) for value in tags.values())
    for texts in read_xmp(data, ("RelativeAltitude", "CalibratedFocalLength/X"))[0].values():
        assert all(len(text) <= MAX_XMP_BYTES for text in texts)
    found = None
    with contextlib.suppress(VehAnchorError):
        found = read_camera(read_at, read_header(read_at))
    if found is not None:
        numbers = [value for value in vars(found).values() if isinstance(value, int | float)]
        assert all(math.isfinite(number) for number in numbers), found


class _Silent(Context[Any, Any]):
    """A call that nobody follows."""

    @property
    def client_capabilities(self) -> None:
        """None are known."""

    async def report_progress(
        self, progress: float, total: float | None = None, message: str | None = None
    ) -> None:
        """Tell nobody."""


@cache
def _tools() -> tuple[asyncio.AbstractEventLoop, dict[str, StrictTool]]:
    settings = Settings(detector="/nowhere.onnx", isolation="in-process", max_megapixels=1)
    return asyncio.new_event_loop(), {
        tool.name: tool for tool in create_tools(create_services(settings))
    }


def arguments(data: bytes) -> None:
    """Call a tool as a model would; what needs a detector ends there."""
    try:
        given = json.loads(data)
    except (ValueError, RecursionError):
        return
    if not isinstance(given, dict):
        return
    loop, tools = _tools()
    tool = tools.get(str(given.pop("tool", "")), tools["estimate_gsd"])
    logging.disable()  # a line a call
    try:
        context = _Silent()  # type: ignore[call-arg] # private fields of the SDK's, which have defaults
        result = loop.run_until_complete(tool.run(given, context, convert_result=True))
    except CallError as error:  # UnexpectedToolError is none
        if len(str(error)) > _MAX_COMPLAINT_CHARS:
            raise
    else:
        assert isinstance(result, CallToolResult), type(result)
    finally:
        logging.disable(logging.NOTSET)


def graph(data: bytes) -> None:
    """Find the files in which an ONNX graph keeps its weights."""
    external_locations(b"\x6a\x00\x0a\x08location\x12" + data)


def _memory() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def _images() -> list[bytes]:
    x = np.linspace(0, 255, _SIDE_PX).astype(np.uint8)
    rgb = np.dstack(
        [
            np.tile(x, (_SIDE_PX, 1)),
            np.tile(x[:, None], (1, _SIDE_PX)),
            np.full((_SIDE_PX,) * 2, 90, np.uint8),
        ]
    )
    found: list[bytes] = []
    for suffix, parameters in (
        (".jpg", []),
        (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".png", []),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 60]),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
        (".avif", [cv2.IMWRITE_AVIF_QUALITY, 60]),
        (".bmp", []),
        (".tif", []),
    ):
        found.append(cv2.imencode(suffix, rgb, parameters)[1].tobytes())
    found.append(
        found[0][:2] + b"\xff\xe1" + (len(_EXIF) + 2).to_bytes(2, "big") + _EXIF + found[0][2:]
    )
    found.append(cv2.imencode(".png", rgb.astype(np.uint16) * 200)[1].tobytes())
    found += [
        bombs.zero_tiff(_SIDE_PX, dtype, bands=bands, rows=16)
        for dtype, bands in (("float64", 4), ("uint16", 3), ("uint8", 1))
    ]
    found += [make(200) for make in bombs.HEADER_BOMBS.values()]
    found += [bombs.tiff_with_two_sizes(), *_geotiffs(rgb)]
    rgba = np.dstack([rgb, np.where(rgb[..., 0] < 99, 0, 255)]).astype(np.uint8)
    found += [cv2.imencode(suffix, rgba)[1].tobytes() for suffix in (".png", ".webp", ".tif")]
    found.append(
        cv2.imencode(".tif", np.where(rgb < 40, -9999, rgb).astype(np.float32))[1].tobytes()
    )
    raw = [
        (254, 4, 1, 1),
        (256, 4, 1, 24),
        (257, 4, 1, 24),
        (262, 3, 1, 2),
        (330, 13, 1, 80),
        (50706, 1, 4, 1025),
    ]
    found += [bombs.tiff_of_directory(raw[:n], after=bytes(200)) for n in (5, 6)]
    return found


def _geotiffs(rgb: Any) -> list[bytes]:
    found = []
    for options in (
        {},
        {"tiled": True, "blockxsize": 16, "blockysize": 16},
        {"compress": "jpeg"},
        {"nodata": 0},
    ):
        buffer = io.BytesIO()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.MemoryFile() as memory:
                with memory.open(
                    driver="GTiff",
                    width=_SIDE_PX,
                    height=_SIDE_PX,
                    count=3,
                    dtype="uint8",
                    crs="EPSG:32631",
                    transform=Affine(0.25, 0, 500_000, 0, -0.25, 5_000_000),
                    **options,
                ) as dataset:
                    dataset.write(np.moveaxis(rgb, -1, 0))
                buffer.write(memory.read())
        found.append(buffer.getvalue())
    return found


def _calibrations() -> list[bytes]:
    made = CALIBRATION.model_copy(update={"detector": "vehicles", "detector_sha256": "0" * 64})
    return [made.model_dump_json().encode(), made.model_dump_json(indent=1).encode()]


def _cards() -> list[bytes]:
    detector = {
        "names": "{0: 'small vehicle', 1: 'ship'}",
        "stride": "32",
        "vehanchor.name": "mine",
        "vehanchor.reference_length_m": "4.8",
        "vehanchor.reference_length_sd_m": "0.2",
        "vehanchor.region_lengths_m": '{"europe": 4.4}',
        "vehanchor.length_range_px": "9,120",
        "vehanchor.min_length_px": "12",
        "vehanchor.min_score": "0.3",
        "vehanchor.search_scales": "1",
        "vehanchor.aggregation": "weighted_kde",
        "license": "Apache-2.0",
    }
    chips = {
        "vehanchor.detector": "mine",
        "vehanchor.weights": "1,1,0",
        "vehanchor.least_score": "0.15",
        "vehanchor.bodies": json.dumps(
            {
                "reference_length_m": 4.3,
                "reference_length_sd_m": 0.3,
                "region_lengths_m": {"europe": 4.1},
            }
        ),
    }
    # of a pair
    half = dict.fromkeys(("names", "vehanchor.region_lengths_m", "vehanchor.bodies"), '{"�": 4.1}')
    return [json.dumps(each).encode() for each in (detector, chips, detector | chips, chips | half)]


def _metadata() -> list[bytes]:
    camera: dict[str, Any] = {
        "Make": "DJI",
        "Model": "FC6310",
        "FocalLength": (88, 10),
        "PixelXDimension": 5472,
        "PixelYDimension": 3648,
        "FocalPlaneXResolution": (4000, 10),
        "FocalPlaneResolutionUnit": 3,
        "DigitalZoomRatio": (1, 1),
        "FocalLengthIn35mmFilm": 24,
        "GPSLatitudeRef": "N",
        "GPSLatitude": (52, 1, 30, 1, 1234, 100),
        "GPSLongitudeRef": "E",
        "GPSLongitude": (13, 1, 20, 1, 999, 100),
    }
    packets = [
        blocks.xmp(
            {"drone-dji": "http://www.dji.com/drone-dji/1.0/"},
            'drone-dji:RelativeAltitude="+50.20" drone-dji:GimbalPitchDegree="-90.00" '
            'drone-dji:GimbalRollDegree="+0.00" drone-dji:CalibratedFocalLength="3666.666504"',
        ),
        blocks.xmp(
            {"Camera": "http://pix4d.com/camera/1.0"},
            "<Camera:Pitch>2.1</Camera:Pitch><Camera:Roll>1/2</Camera:Roll>",
        ),
    ]
    skydio = {"s": "https://www.skydio.com/drone-skydio/1.0/"}
    packets.append(
        blocks.xmp(
            skydio,
            "<s:CalibratedFocalLength "
            'rdf:parseType="Resource"><s:X>1</s:X></s:CalibratedFocalLength>',
        )
    )
    exifs = [blocks.exif(camera, order) for order in "<>"] + [blocks.exif(camera, pointer_kind=13)]
    damaged = [each.replace(b"Meta Data", b"A & B") for each in packets]
    further = b"http://ns.adobe.com/xmp/extension/\0" + b"0" * 32 + bytes(8) + packets[0]
    return [
        *packets,
        *damaged,
        packets[0].decode().encode("utf-16-le"),
        blocks.jpeg(
            xmp=packets[0],
            more=blocks.segment(blocks.XMP_PREFIX + damaged[1]) + blocks.segment(further),
        ),
        *exifs,
        *[_EXIF[:6] + each for each in exifs],
        blocks.jpeg(exif=exifs[0], xmp=packets[0]),
        blocks.png_with_xmp(packets[1], exifs[1]),
        blocks.webp_with_exif(exifs[0], packets[0]),
    ]


class _Lost:
    """A connection on which a worker that was taken over has sent parts."""

    def __init__(self, parts: list[bytes]) -> None:
        self._parts = parts

    def recv_bytes(self, most: int) -> bytes:
        if not self._parts:
            raise EOFError
        part = self._parts.pop(0)
        if len(part) > most:
            raise OSError("bad message length")  # as the connection does
        return part


def messages(data: bytes) -> None:
    """Take a worker's message; its parts end at zero bytes."""
    for record in (GsdEstimate, AreaMeasurement, DistanceMeasurement, ViewedImage):
        lost: Any = _Lost(data.split(b"\0"))
        with contextlib.suppress(MessageError, OSError, EOFError):
            message = receive(lost)
            if not isinstance(message, Replied):
                assert len(message.model_dump_json()) <= HEADER.n_bytes
                return
            reply = receive_reply(lost, message, record)
            most = 8 * (MAX_RECORDS * RECORD.n_bytes + DRAWING.n_bytes + MAX_PICTURE_BYTES)
            assert len(reply.to_result("found").model_dump_json()) <= most


def _messages() -> list[bytes]:
    header = Replied(n_records=1, drawing=False, picture=True).model_dump_json().encode()
    plain = [
        Loaded(failure=None, confinement=Confinement(landlock=6, seccomp=True)),
        Progressed(percent=50, message="searched 1 of 2 tiles"),
        Refused(code="image_too_large", message="smaller"),
        Refused(code="internal_error", message="Traceback"),
    ]
    box = {"x_min": 0, "y_min": 0, "x_max": 20, "y_max": 20}
    seen = {"image_width_px": 20, "image_height_px": 20, "part": box, "grid_px": 5}
    records = [
        json.dumps(record).encode() for record in (seen, _estimate().model_dump(mode="json"))
    ]
    return [
        *(each.model_dump_json().encode() for each in plain),
        *(header + b"\0" + record + b"\0\xff\xd8\xff" for record in records),
    ]


def _estimate() -> GsdEstimate:
    """Measure a rendered scene, as a worker does."""
    return estimate_gsd(render_scene(0.15, width_px=256, height_px=256, seed=5).image)


def _arguments() -> list[bytes]:
    image = {"kind": "base64", "data": base64.b64encode(_images()[2]).decode()}
    path = {"kind": "path", "path": "/images/a.png"}
    known: dict[str, Any] = {"gsd_m_per_px": 0.15}
    points = [{"x": 1, "y": 2}, {"x": 40.5, "y": 30}]
    frame = {"width_px": 24, "height_px": 24}
    box = {"x_min": 1, "y_min": 2, "x_max": 30, "y_max": 40}
    calls: list[tuple[str, dict[str, Any]]] = [
        ("estimate_gsd", {"image": path, "region": "europe", "metadata": False, "detail": "full"}),
        (
            "estimate_gsd",
            {"image": image, "height_m": 60, "focal_35mm": 24, "reference_length_m": 4.6},
        ),
        ("estimate_gsd", {"image": {"kind": "url", "url": "https://a.test/b.png"}}),
        ("measure_distance", {"image": image, **known, "points": points}),
        ("measure_distance", {"image": image, **known, "points": points, "frame": frame}),
        ("measure_area", {"image": image, **known, "targets": [{"box": box}]}),
        (
            "measure_area",
            {"image": path, **known, "targets": [{"points": points}], "coordinates": "per_mille"},
        ),
        ("view_image", {"image": image, "width_px": 32}),
        ("view_image", {"image": image, "region": box}),
        (
            "view_image",
            {
                "of": {
                    "tool": "measure_area",
                    "arguments": {"image": image, "targets": [{"box": box}]},
                }
            },
        ),
    ]
    return [json.dumps({"tool": name, **given}).encode() for name, given in calls]


def _graphs() -> list[bytes]:
    import onnx
    from onnx import TensorProto, helper

    value = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    weight = helper.make_tensor("w", TensorProto.FLOAT, [1], [1.0])
    external = onnx.TensorProto(name="e", data_type=1, dims=[1], data_location="EXTERNAL")
    entry = external.external_data.add()
    entry.key = "location"
    entry.value = "weights.bin"
    node = helper.make_node("Add", ["x", "w"], ["y"])
    made = helper.make_model(
        helper.make_graph(
            [node], "g", [value], [helper.make_tensor_value_info("y", 1, [1])], [weight, external]
        )
    )
    return [made.SerializeToString()]


TARGETS: dict[str, Callable[[bytes], None]] = {
    "header": header,
    "image": image,
    "calibration": calibration,
    "card": card,
    "graph": graph,
    "metadata": metadata,
    "arguments": arguments,
    "messages": messages,
}

CORPUS: dict[str, Callable[[], list[bytes]]] = {
    "header": _images,
    "image": _images,
    "calibration": _calibrations,
    "card": _cards,
    "graph": _graphs,
    "metadata": _metadata,
    "arguments": _arguments,
    "messages": _messages,
}
