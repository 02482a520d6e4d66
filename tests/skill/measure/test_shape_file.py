from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from affine import Affine
from numpy.typing import NDArray

from tests.bombs import png_of_text
from tests.skill.imagery.files import after_head, encoded, exif, geotiff, png_chunk
from tests.skill.imagery.samples import SAMPLES
from vehanchor import analyse_areas, measure_areas
from vehanchor.errors import PromptError
from vehanchor.export.geojson import write_shapes
from vehanchor.measure.shape_file import read_shape_file
from vehanchor.options import ImageLimits

IMAGE = np.full((120, 200, 3), 90, np.uint8)
FLAT = [20, 30, 80, 30, 80, 70, 20, 70]
COCO: dict[str, Any] = {
    "images": [
        {"id": 1, "file_name": "other.png", "width": 200, "height": 120},
        {"id": 2, "file_name": "photo.png", "width": 200, "height": 120},
    ],
    "annotations": [
        {"id": 11, "image_id": 1, "category_id": 5, "segmentation": [FLAT]},
        {"id": 12, "image_id": 2, "category_id": 5, "segmentation": [FLAT]},
        {"id": 13, "image_id": 2, "segmentation": {"size": [120, 200], "counts": [0, 24000]}},
    ],
    "categories": [{"id": 5, "name": "roof"}],
}


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), IMAGE)
    return path


def _json(folder: Path, content: Any, name: str = "shapes.json") -> Path:
    path = folder / name
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def _areas(file: Path, photo: Path) -> list[float | None]:
    shapes = read_shape_file(file, str(photo))
    return [record.area_m2 for record in measure_areas(photo, shapes, gsd_m_per_px=0.1)]


def test_a_polygon_of_coco_drawn_in_a_larger_copy_is_refused(photo: Path, tmp_path: Path) -> None:
    larger = {**COCO, "images": [{**COCO["images"][1], "width": 400, "height": 240}]}
    with pytest.raises(PromptError, match="picture of the polygon has 400 x 240 px, the image 200"):
        _areas(_json(tmp_path, larger), photo)


def test_a_polygon_of_coco_drawn_in_stored_pixels_is_turned(tmp_path: Path) -> None:
    turned = tmp_path / "photo.png"
    stored = png_chunk(b"eXIf", exif({"Orientation": 6}))
    turned.write_bytes(after_head(encoded(".png", IMAGE), stored))
    (shape, _) = read_shape_file(_json(tmp_path, COCO), str(turned))
    (analysis,) = analyse_areas(turned, [shape], gsd_m_per_px=0.1)
    window = analysis.segmentation.window
    # The stored rows 30 to 70 of 120 become columns 50 to 90.
    assert (window.x_px, window.y_px) == (50, 20)
    assert (window.width_px, window.height_px) == (40, 60)


def test_coco_names_the_image_by_its_file_name(photo: Path, tmp_path: Path) -> None:
    file = _json(tmp_path, COCO)
    assert _areas(file, photo) == pytest.approx([24.0, 240.0])
    names = [shape.name for shape in read_shape_file(file, str(photo))]
    assert names == ["roof 12", "13"]


@pytest.mark.promise("sidecars")
def test_a_file_of_very_many_empty_lists_is_refused(
    photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vehanchor.measure.shape_file._MAX_CONTAINERS", 100)
    file = _json(tmp_path, {**COCO, "licenses": [[]] * 100})
    with pytest.raises(PromptError, match="more than 100 lists and objects"):
        read_shape_file(file, str(photo))


def test_shapes_may_have_another_encoding(photo: Path, tmp_path: Path) -> None:
    file = tmp_path / "shapes.json"
    file.write_text(json.dumps(COCO), encoding="utf-16")
    assert len(_areas(file, photo)) == 2


def test_of_equal_names_in_folders_the_path_decides(photo: Path, tmp_path: Path) -> None:
    own_name = f"{tmp_path.name}/photo.png"
    images = [
        {"id": 1, "file_name": "elsewhere/photo.png"},
        {"id": 2, "file_name": own_name},
    ]
    assert len(_areas(_json(tmp_path, {**COCO, "images": images}), photo)) == 2


def test_a_png_has_an_object_for_each_number(photo: Path, tmp_path: Path) -> None:
    ids = np.zeros((120, 200), np.uint16)
    ids[10:20, 10:20] = 7
    ids[40:60, 40:60] = 300
    file = tmp_path / "ids.png"
    cv2.imwrite(str(file), ids)
    assert _areas(file, photo) == pytest.approx([1.0, 4.0])
    assert [shape.name for shape in read_shape_file(file, str(photo))] == ["7", "300"]


def test_a_png_of_one_object_can_be_white_on_black(photo: Path, tmp_path: Path) -> None:
    mask = np.zeros((120, 200, 3), np.uint8)
    mask[10:20, 10:20] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    assert _areas(tmp_path / "mask.png", photo) == pytest.approx([1.0])


def test_geojson_in_pixels_is_read_as_it_is_written(photo: Path, tmp_path: Path) -> None:
    (analysis,) = analyse_areas(photo, [FLAT], gsd_m_per_px=0.1)
    write_shapes(tmp_path / "roof.geojson", analysis)
    assert _areas(tmp_path / "roof.geojson", photo) == pytest.approx([24.0])


@pytest.fixture
def ortho(tmp_path: Path) -> Path:
    """A photograph of 0.1 m per pixel in UTM."""
    transform = Affine(0.1, 0, 500_000, 0, -0.1, 5_000_000)
    return geotiff(tmp_path / "photo.tif", IMAGE, transform=transform)


def test_geojson_in_degrees_is_read_as_it_is_written(ortho: Path, tmp_path: Path) -> None:
    (analysis,) = analyse_areas(ortho, [FLAT], gsd_m_per_px=0.1)
    file = tmp_path / "roof.geojson"
    write_shapes(file, analysis)
    longitude, latitude = json.loads(file.read_text())["features"][0]["geometry"]["coordinates"][0][
        0
    ][0]
    assert (longitude, latitude) == pytest.approx((3, 45.15), abs=0.01)
    assert _areas(file, ortho) == pytest.approx([24.0], rel=1e-4)


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        ([[3.1, 45], [3.2, 45], [3.2, 45.1]], "degrees of WGS 84, is not inside"),
        ([[20, 30], [80, 300], [80, 70]], "longitude first"),
        ([[1e20, 30], [80, 3], [80, 70]], "outside any image"),
    ],
)
def test_degrees_elsewhere_are_refused(
    ortho: Path, tmp_path: Path, corners: Any, message: str
) -> None:
    geometry = {"type": "Polygon", "coordinates": [corners]}
    file = _json(tmp_path, geometry, "place.geojson")
    with pytest.raises(PromptError, match=message):
        _areas(file, ortho)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "neither COCO JSON"),
        ({**COCO, "images": []}, "no image with the file_name 'photo.png'"),
        ({**COCO, "images": 3}, "no list of images"),
        ({**COCO, "annotations": []}, "no annotation of 'photo.png'"),
        (
            {**COCO, "annotations": [{"id": 4, "image_id": 2, "bbox": [1, 2, 3, 4]}]},
            "annotation 4: it has no segmentation",
        ),
        (
            {**COCO, "annotations": [{"id": 4, "image_id": 2, "segmentation": [[1, 2]]}]},
            "annotation 4: the polygon has fewer than 3 different corners",
        ),
        ({"features": []}, "it has features"),
        ({**COCO, "categories": [3]}, "no list of categories"),
        ({"type": "FeatureCollection", "features": [3]}, "feature 1: it is 3"),
        ({"type": "Feature", "geometry": 3, "properties": 4}, "the geometry is None"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_bad_json_is_refused(photo: Path, tmp_path: Path, content: Any, message: str) -> None:
    with pytest.raises(PromptError, match=rf"shapes.json'.*{message}"):
        _areas(_json(tmp_path, content), photo)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("shapes.json", b"{", "cannot be read"),
        ("deep.json", b"[" * 100_000, "cannot be read"),
        ("shapes.shp", b"", "use .json, .geojson, .png"),
        ("ids.png", b"no picture", "cannot be read"),
    ],
)
def test_a_bad_file_is_refused(
    photo: Path, tmp_path: Path, name: str, content: bytes, message: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PromptError, match=message):
        _areas(tmp_path / name, photo)


def test_a_missing_file_is_refused(photo: Path) -> None:
    with pytest.raises(PromptError, match="cannot be read"):
        _areas(photo.with_name("none.json"), photo)


@pytest.mark.promise("sidecars")
def test_zipped_texts_in_an_image_of_ids_are_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[bytes] = []

    def decode(data: NDArray[np.uint8], _: int) -> NDArray[np.uint8]:
        decoded.append(bytes(data))
        return np.ones((64, 64), np.uint8)

    monkeypatch.setattr("vehanchor.imagery.formats.decoding.cv2.imdecode", decode)
    (tmp_path / "ids.png").write_bytes(png_of_text(3))
    read_shape_file(tmp_path / "ids.png", "photo.png")
    assert b"zTXt" not in decoded[0]


def test_an_image_of_ids_is_a_png(tmp_path: Path) -> None:
    (tmp_path / "ids.png").write_bytes(SAMPLES["BMP"])
    with pytest.raises(PromptError, match="it is a BMP"):
        read_shape_file(tmp_path / "ids.png", "photo.png")


def test_ids_whose_boxes_are_far_larger_than_the_image_are_refused(tmp_path: Path) -> None:
    """Each number in two opposite corners has the whole image as its box."""
    ids = np.zeros((200, 400), np.uint16)
    numbers = np.arange(1, 101)
    ids[0, :100] = numbers
    ids[-1, -100:] = numbers
    cv2.imwrite(str(tmp_path / "ids.png"), ids)
    limits = ImageLimits(max_decoded_bytes=1 << 20)
    with pytest.raises(PromptError, match="measure fewer at a time"):
        read_shape_file(tmp_path / "ids.png", "photo.png", limits=limits)


def test_a_picture_is_not_an_image_of_ids(photo: Path, tmp_path: Path) -> None:
    noise = np.random.default_rng(1).integers(0, 65535, (120, 200)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    with pytest.raises(PromptError, match="is it a picture"):
        _areas(tmp_path / "noise.png", photo)
    cv2.imwrite(str(tmp_path / "empty.png"), np.zeros((120, 200), np.uint8))
    with pytest.raises(PromptError, match="all its pixels are 0"):
        _areas(tmp_path / "empty.png", photo)
