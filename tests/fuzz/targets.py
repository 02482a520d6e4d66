"""Targets of the fuzzer: functions that take bytes of strangers.

A target returns nothing. It may raise errors of VehAnchor or of the server; all others are bugs.
``CORPUS`` makes the bytes to begin with, by our own generators.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import logging
import math
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import rasterio
from mcp.server.mcpserver import Context
from mcp.types import CallToolResult
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.transform import Affine

from research.scenes import render_scene
from tests import bombs
from tests.skill.cut_off import CALIBRATION
from tests.skill.imagery import files as blocks
from tests.skill.imagery.heic_files import Item, grid, heic, identity, overlay
from tests.skill.imagery.samples import SAMPLES
from vehanchor import estimate_gsd, measure_areas
from vehanchor.detection.card import ChipCard, VerifierCard, read_card, read_detector_card
from vehanchor.errors import VehAnchorError
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.formats.ifd import in_memory
from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES
from vehanchor.imagery.metadata.camera import read_camera
from vehanchor.imagery.metadata.exif import read_exif
from vehanchor.imagery.metadata.xmp import read_xmp
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.measure.shape_file import read_shape_file
from vehanchor.models.files import external_locations
from vehanchor.options import ImageLimits, Reading
from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
from vehanchor.rulers.known_length_table import lines_in
from vehanchor.scale.calibration import load_calibration
from vehanchor_flight.subtitles import read_film_facts
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
"""Limits so small that no input may be slow; one that is slow is a bug."""

_SIDE_PX = 48
_MAX_MESSAGE_CHARS = 4000
_EXIF_PREFIX = b"Exif\0\0"
_EXIF = _EXIF_PREFIX + b"II*\0\x08\0\0\0\1\0\x12\1\3\0\1\0\0\0\6\0\0\0\0\0\0\0"
"""EXIF block of orientation 6."""


_PHOTOGRAPH = SAMPLES["PNG"]
_WORLD_FILE = b"0.25\n0\n0\n-0.25\n500000\n5000000\n"
_WKT = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)


def header(data: bytes) -> None:
    """Read the header of an image."""
    with contextlib.suppress(VehAnchorError):
        read_header(in_memory(data))


def image(data: bytes) -> None:
    """Open an image and read a window and the whole of it."""
    reading = Reading(limits=FUZZ_LIMITS)
    with (
        contextlib.suppress(VehAnchorError),
        warnings.catch_warnings(),
        open_raster(data, reading) as raster,
    ):
        warnings.simplefilter("ignore")
        width = min(16, raster.width_px)
        height = min(16, raster.height_px)
        raster.read(Window(0, 0, width_px=width, height_px=height))
        if raster.width_px * raster.height_px <= FUZZ_LIMITS.max_pixels:
            raster.read()


def calibration(data: bytes) -> None:
    """Load a calibration file."""
    try:
        with TemporaryDirectory(dir=_memory()) as folder:
            path = Path(folder, "c.json")
            path.write_bytes(data)
            loaded = load_calibration(path)
    except VehAnchorError:
        return
    assert 2 <= loaded.reference_length_m <= 20
    assert (
        loaded.reference_length_ci95_low_m
        <= loaded.reference_length_m
        <= loaded.reference_length_ci95_high_m
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
    """Read the camera metadata of a file, and the bytes as an EXIF block and as an XMP packet."""
    read_at = in_memory(data)
    after_prefix = in_memory(data[len(_EXIF_PREFIX) :])
    for tags in (read_exif(read_at), read_exif(after_prefix)):
        assert all(isinstance(value, str | float | bytes) for value in tags.values())
    properties, _ = read_xmp(data, ("RelativeAltitude", "CalibratedFocalLength/X"))
    for texts in properties.values():
        assert all(len(text) <= MAX_XMP_BYTES for text in texts)
    camera = None
    with contextlib.suppress(VehAnchorError):
        camera = read_camera(read_at, read_header(read_at))
    if camera is not None:
        numbers = [value for value in vars(camera).values() if isinstance(value, int | float)]
        assert all(math.isfinite(number) for number in numbers), camera


def sidecar(data: bytes) -> None:
    """Read a file beside an image or a film, or one that a user gives with it.

    The first byte selects the kind of the file.
    """
    kinds = list(_SIDECARS)
    name = kinds[data[0] % len(kinds)] if data else kinds[0]
    with TemporaryDirectory(dir=_memory()) as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        photograph = Path(folder, "photo.png")
        photograph.write_bytes(_PHOTOGRAPH)
        Path(folder, "photo.pgw").write_bytes(_WORLD_FILE)
        path = Path(folder, name)
        path.write_bytes(data[1:])
        with contextlib.suppress(VehAnchorError):
            _SIDECARS[name](path, photograph)


def _open_beside(_: Path, photograph: Path) -> None:
    with open_raster(photograph, Reading(limits=FUZZ_LIMITS)) as raster:
        raster.read()


def _measure_shapes(path: Path, photograph: Path) -> None:
    shapes = read_shape_file(path, str(photograph), limits=FUZZ_LIMITS)
    must_fit = {"length_m": 1.0, "width_m": 0.5}
    measure_areas(photograph, shapes, gsd_m_per_px=0.1, must_fit=must_fit, limits=FUZZ_LIMITS)


def _read_lines(path: Path, photograph: Path) -> None:
    lines_in(path, [photograph])


def _read_subtitles(path: Path, _: Path) -> None:
    read_film_facts(str(path.with_suffix(".mp4")))


_SIDECARS: dict[str, Callable[[Path, Path], None]] = {
    "photo.pgw": _open_beside,
    "photo.prj": _open_beside,
    "photo.png.aux.xml": _open_beside,
    "photo.png.msk": _open_beside,
    "shapes.json": _measure_shapes,
    "shapes.geojson": _measure_shapes,
    "ids.png": _measure_shapes,
    "lines.csv": _read_lines,
    "film.SRT": _read_subtitles,
}
"""Readers of files by their names."""


class _Silent(Context[Any, Any]):
    """Context of a call without a listener."""

    @property
    def client_capabilities(self) -> None:
        """State no capabilities."""

    async def report_progress(
        self, progress: float, total: float | None = None, message: str | None = None
    ) -> None:
        """Ignore progress."""


@cache
def _tools() -> tuple[asyncio.AbstractEventLoop, dict[str, StrictTool]]:
    settings = Settings(detector="/nowhere.onnx", isolation="in-process", max_megapixels=1)
    tools = create_tools(create_services(settings))
    return asyncio.new_event_loop(), {tool.name: tool for tool in tools}


def arguments(data: bytes) -> None:
    """Call a tool as a model would; a call that needs a detector ends there."""
    try:
        call = json.loads(data)
    except (ValueError, RecursionError):
        return
    if not isinstance(call, dict):
        return
    loop, tools = _tools()
    name = str(call.pop("tool", ""))
    tool = tools.get(name, tools["estimate_gsd"])
    logging.disable()  # one line for each call
    try:
        context = _Silent()  # type: ignore[call-arg] # private fields have defaults
        result = loop.run_until_complete(tool.run(call, context, convert_result=True))
    except CallError as error:  # an UnexpectedToolError is not one
        if len(str(error)) > _MAX_MESSAGE_CHARS:
            raise
    else:
        assert isinstance(result, CallToolResult), type(result)
    finally:
        logging.disable(logging.NOTSET)


def graph(data: bytes) -> None:
    """Find the files in which an ONNX graph keeps its weights."""
    external_locations(b"\x6a\x00\x0a\x08location\x12" + data)


def _memory() -> str | None:
    """Find a folder in memory; None without one."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


_OTHER_ENCODINGS: list[tuple[str, list[int]]] = [
    (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
    (".webp", [cv2.IMWRITE_WEBP_QUALITY, 60]),
    (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
]
"""Encodings besides the usual one of each format, by suffix and parameters of OpenCV."""


def _encoded(suffix: str, pixels: NDArray[Any], parameters: Sequence[int] = ()) -> bytes:
    _, data = cv2.imencode(suffix, pixels, parameters)
    return data.tobytes()


def _images() -> list[bytes]:
    """Make honest images of every format, and small bombs."""
    ramp = np.linspace(0, 255, _SIDE_PX).astype(np.uint8)
    red = np.tile(ramp, (_SIDE_PX, 1))
    green = np.tile(ramp[:, None], (1, _SIDE_PX))
    blue = np.full((_SIDE_PX, _SIDE_PX), 90, np.uint8)
    rgb = np.dstack([red, green, blue])
    images = list(SAMPLES.values())
    images += [_encoded(suffix, rgb, parameters) for suffix, parameters in _OTHER_ENCODINGS]
    images.append(blocks.after_start(SAMPLES["JPEG"], blocks.segment(_EXIF)))
    images.append(_encoded(".png", rgb.astype(np.uint16) * 200))
    for dtype, bands in (("float64", 4), ("uint16", 3), ("uint8", 1)):
        images.append(bombs.zero_tiff(_SIDE_PX, dtype, bands=bands, rows=16))
    images += [make(200) for make in bombs.HEADER_BOMBS.values()]
    images.append(bombs.tiff_with_two_sizes())
    images += _geotiffs(rgb)
    images += _images_with_holes(rgb)
    images += _raw_files()
    images += _composed_heics()
    return images


def _composed_heics() -> list[bytes]:
    """Make HEICs with metadata, a thumbnail, and pictures that are made of others."""
    metadata = Item(b"mime", b"<x/>", side_px=0, text=b"\0a/xml\0", refers=(b"cdsc", [1]))
    thumbnail = Item(refers=(b"thmb", [1]))
    return [
        heic([Item(), metadata, thumbnail]),
        heic([grid([2, 3], 2), Item(), Item()]),
        heic([overlay([2, 3]), identity(3), Item()]),
    ]


def _sidecars() -> list[bytes]:
    """Make a file of each kind."""
    corners = [2, 2, 40, 2, 40, 40, 2, 40]
    coco = {
        "images": [{"id": 1, "file_name": "photo.png"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 3, "segmentation": [corners]},
            {"id": 2, "image_id": 1, "segmentation": {"size": [40, 60], "counts": [9, 90, 2301]}},
            {
                "id": 3,
                "image_id": 1,
                "segmentation": {
                    "size": [40, 60],
                    "counts": "e<?i00000000000000000000000000000000000000[U1",
                },
            },
        ],
        "categories": [{"id": 3, "name": "roof"}],
    }
    ring = [[13.0, 52.0], [13.00001, 52.0], [13.00001, 52.00001], [13.0, 52.0]]
    geometry = {"type": "Polygon", "coordinates": [ring]}
    feature = {"type": "Feature", "geometry": geometry, "properties": {"name": "roof"}}
    ids = np.zeros((40, 60), np.uint16)
    ids[4:9, 4:9] = 7
    ids[20:40, 20:40] = 300
    contents = {
        "photo.pgw": _WORLD_FILE,
        "photo.prj": _WKT.encode(),
        "photo.png.aux.xml": (
            f"<PAMDataset><SRS>{_WKT}</SRS><GeoTransform>1, 0.25, 0, 2, 0, -0.25</GeoTransform>"
            "</PAMDataset>"
        ).encode(),
        "photo.png.msk": _encoded(".tif", np.full((40, 60), 255, np.uint8)),
        "shapes.json": json.dumps(coco).encode(),
        "shapes.geojson": json.dumps({"type": "FeatureCollection", "features": [feature]}).encode(),
        "ids.png": _encoded(".png", ids),
        "lines.csv": b"photograph,x1,y1,x2,y2,metres,basis\nphoto.png,1,2,30,40,5,measured\n",
        "film.SRT": (
            b"1\n00:00:00,000 --> 00:00:00,033\n[focal_len: 24.00] [rel_alt: 1.300]\n"
            b"\n2\n00:00:00,033 --> 00:00:00,066\nF/2.8, GPS (-122.1, 37.4, 19), H 6.0m\n"
        ),
    }
    return [bytes([number]) + contents[name] for number, name in enumerate(_SIDECARS)]


def _images_with_holes(rgb: NDArray[np.uint8]) -> list[bytes]:
    """Make images with transparent pixels, and one with values of no data."""
    alpha = np.where(rgb[..., 0] < 99, 0, 255)
    rgba = np.dstack([rgb, alpha]).astype(np.uint8)
    with_no_data = np.where(rgb < 40, -9999, rgb).astype(np.float32)
    images = [_encoded(suffix, rgba) for suffix in (".png", ".webp", ".tif")]
    images.append(_encoded(".tif", with_no_data))
    return images


def _raw_files() -> list[bytes]:
    """Make the directories of cameras' raw files, without and with the version of DNG."""
    entries = [
        (254, 4, 1, 1),
        (256, 4, 1, 24),
        (257, 4, 1, 24),
        (262, 3, 1, 2),
        (330, 13, 1, 80),
        (50706, 1, 4, 1025),
    ]
    return [bombs.tiff_of_directory(entries[:n], after=bytes(200)) for n in (5, 6)]


_GEOTIFF_OPTIONS: list[dict[str, Any]] = [
    {},
    {"tiled": True, "blockxsize": 16, "blockysize": 16},
    {"compress": "jpeg"},
    {"nodata": 0},
]


def _geotiffs(rgb: NDArray[np.uint8]) -> list[bytes]:
    """Make GeoTIFFs of several layouts."""
    images = []
    for options in _GEOTIFF_OPTIONS:
        with warnings.catch_warnings(), rasterio.MemoryFile() as memory:
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
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
            images.append(memory.read())
    return images


def _calibrations() -> list[bytes]:
    changes = {"detector": "vehicles", "detector_sha256": "0" * 64}
    made = CALIBRATION.model_copy(update=changes)
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
    half_of_a_pair = dict.fromkeys(
        ("names", "vehanchor.region_lengths_m", "vehanchor.bodies"), '{"�": 4.1}'
    )
    cards = (detector, chips, detector | chips, chips | half_of_a_pair)
    return [json.dumps(card).encode() for card in cards]


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
        blocks.xmp(
            {"s": "https://www.skydio.com/drone-skydio/1.0/"},
            '<s:CalibratedFocalLength rdf:parseType="Resource"><s:X>1</s:X>'
            "</s:CalibratedFocalLength>",
        ),
    ]
    little_endian = blocks.exif(camera, "<")
    big_endian = blocks.exif(camera, ">")
    with_directories = blocks.exif(camera, pointer_kind=13)
    exifs = [little_endian, big_endian, with_directories]
    damaged = [packet.replace(b"Meta Data", b"A & B") for packet in packets]
    digest_size_offset = b"0" * 32 + bytes(8)
    extended = b"http://ns.adobe.com/xmp/extension/\0" + digest_size_offset + packets[0]
    more = blocks.segment(blocks.XMP_PREFIX + damaged[1]) + blocks.segment(extended)
    return [
        *packets,
        *damaged,
        packets[0].decode().encode("utf-16-le"),
        blocks.jpeg(xmp=packets[0], more=more),
        *exifs,
        *[_EXIF_PREFIX + block for block in exifs],
        blocks.jpeg(exif=little_endian, xmp=packets[0]),
        blocks.png_with_xmp(packets[1], big_endian),
        blocks.webp_with_exif(little_endian, packets[0]),
    ]


class _CompromisedConnection:
    """Connection on which a compromised worker has sent these parts."""

    def __init__(self, parts: list[bytes]) -> None:
        self._parts = parts

    def recv_bytes(self, most: int) -> bytes:
        if not self._parts:
            raise EOFError
        part = self._parts.pop(0)
        if len(part) > most:
            raise OSError("bad message length")  # as a real connection
        return part


def messages(data: bytes) -> None:
    """Receive a worker's message; its parts end at zero bytes."""
    max_reply_bytes = 8 * (MAX_RECORDS * RECORD.n_bytes + DRAWING.n_bytes + MAX_PICTURE_BYTES)
    for record in (GsdEstimate, AreaMeasurement, DistanceMeasurement, ViewedImage):
        connection: Any = _CompromisedConnection(data.split(b"\0"))
        with contextlib.suppress(MessageError, OSError, EOFError):
            message = receive(connection)
            if not isinstance(message, Replied):
                assert len(message.model_dump_json()) <= HEADER.n_bytes
                return
            reply = receive_reply(connection, message, record)
            assert len(reply.to_result("found").model_dump_json()) <= max_reply_bytes


def _messages() -> list[bytes]:
    header = Replied(n_records=1, drawing=False, picture=True).model_dump_json().encode()
    plain = [
        Loaded(failure=None, confinement=Confinement(landlock=6, seccomp=True)),
        Progressed(percent=50, message="searched 1 of 2 tiles"),
        Refused(code="image_too_large", message="smaller"),
        Refused(code="internal_error", message="Traceback"),
    ]
    box = {"x_min": 0, "y_min": 0, "x_max": 20, "y_max": 20}
    view = {"image_width_px": 20, "image_height_px": 20, "part": box, "grid_px": 5}
    estimate = _estimate().model_dump(mode="json")
    records = [json.dumps(record).encode() for record in (view, estimate)]
    picture = b"\xff\xd8\xff"
    return [
        *(message.model_dump_json().encode() for message in plain),
        *(b"\0".join([header, record, picture]) for record in records),
    ]


def _estimate() -> GsdEstimate:
    """Estimate the GSD of a rendered scene, as a worker does."""
    scene = render_scene(0.15, width_px=256, height_px=256, seed=5)
    return estimate_gsd(scene.image)


def _arguments() -> list[bytes]:
    image = {"kind": "base64", "data": base64.b64encode(_images()[2]).decode()}
    path = {"kind": "path", "path": "/images/a.png"}
    scale: dict[str, Any] = {"gsd_m_per_px": 0.15}
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
        ("measure_distance", {"image": image, **scale, "points": points}),
        ("measure_distance", {"image": image, **scale, "points": points, "frame": frame}),
        ("measure_area", {"image": image, **scale, "targets": [{"box": box}]}),
        (
            "measure_area",
            {"image": path, **scale, "targets": [{"points": points}], "coordinates": "per_mille"},
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
    return [json.dumps({"tool": name, **arguments}).encode() for name, arguments in calls]


def _graphs() -> list[bytes]:
    from onnx import TensorProto, helper

    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, [1])
    y = helper.make_tensor_value_info("y", TensorProto.FLOAT, [1])
    weight = helper.make_tensor("w", TensorProto.FLOAT, [1], [1.0])
    external = TensorProto(
        name="e", data_type=TensorProto.FLOAT, dims=[1], data_location=TensorProto.EXTERNAL
    )
    entry = external.external_data.add()
    entry.key = "location"
    entry.value = "weights.bin"
    node = helper.make_node("Add", ["x", "w"], ["y"])
    graph = helper.make_graph([node], "g", [x], [y], initializer=[weight, external])
    return [helper.make_model(graph).SerializeToString()]


TARGETS: dict[str, Callable[[bytes], None]] = {
    "header": header,
    "image": image,
    "calibration": calibration,
    "card": card,
    "graph": graph,
    "metadata": metadata,
    "arguments": arguments,
    "messages": messages,
    "sidecar": sidecar,
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
    "sidecar": _sidecars,
}
