from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from research.paper import isaid
from research.paper.isaid import InstanceMask
from research.scenes import Scene, render_scene
from tests.research.paper.isaid_data import write_dota_image, write_isaid_pictures
from vehanchor.errors import ImageError, InvalidParameterError
from vehanchor_evaluation.dota import survey_dota

CATEGORIES = {"swimming-pool": "swimming-pool", "sports-court": "tennis-court", "field": "soccer-ball-field"}
Objects = list[tuple[str, NDArray[np.bool_]]]


@pytest.fixture(scope="module")
def scene() -> Scene:
    return render_scene(gsd_m_per_px=0.25, width_px=512, height_px=448, seed=4)


@pytest.fixture(scope="module")
def objects(scene: Scene) -> Objects:
    """What the scene is known to hold, under iSAID's names."""
    found = [
        (CATEGORIES[item.category], scene.masks[item.category] == item.instance)
        for item in scene.objects
        if item.category in CATEGORIES
    ]
    assert len({category for category, _ in found}) >= 2
    return found


def full(mask: InstanceMask, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    whole = np.zeros(shape[:2], bool)
    height, width = mask.mask.shape
    whole[mask.top_px : mask.top_px + height, mask.left_px : mask.left_px + width] = mask.mask
    return whole


@pytest.mark.parametrize("apart", [False, True], ids=["beside the image", "as downloaded"])
def test_pictures_give_every_object_its_mask_and_category(
    tmp_path: Path, scene: Scene, objects: Objects, apart: bool
) -> None:
    ids, colours = ("Instance_masks/images", "Semantic_masks/images") if apart else ("images", "images")
    size = scene.image.shape[0], scene.image.shape[1]
    write_dota_image(tmp_path / "dota", "P0003", scene.image, 0.25)
    write_isaid_pictures(tmp_path / "isaid" / ids, tmp_path / "isaid" / colours, "P0003", size, objects, first=70_000)
    (image,), issues = isaid.find_annotated_images(tmp_path / "isaid", survey_dota(tmp_path / "dota"))
    assert (image.name, image.gsd_m_per_px, image.path.name) == ("P0003", 0.25, "P0003.png")
    assert issues == []
    found = image.read_masks()
    assert [(mask.category, mask.instance) for mask in found] == [
        (category, 70_000 + 3001 * index) for index, (category, _) in enumerate(objects)
    ]
    for mask, (_, truth) in zip(found, objects, strict=True):
        assert np.array_equal(full(mask, truth.shape), truth)


def test_an_image_that_lacks_something_is_reported_and_the_others_are_read(tmp_path: Path) -> None:
    blank = np.full((40, 60, 3), 90, np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[10:30, 10:30] = True
    dota, masks = tmp_path / "dota", tmp_path / "isaid" / "images"
    for name, gsd in (("P1", 0.2), ("P2", None), ("P3", 0.3), ("P4", 0.3)):
        write_dota_image(dota, name, blank, gsd)
    for name in ("P1", "P2", "P4", "P5"):
        write_isaid_pictures(masks, masks, name, (40, 60), [("swimming-pool", mask)])
    write_isaid_pictures(masks / "again", masks / "again", "P1", (40, 60), [("swimming-pool", mask)])
    (masks / "P4_instance_color_RGB.png").write_bytes(b"no picture")
    images, issues = isaid.find_annotated_images(tmp_path / "isaid", survey_dota(dota))
    assert [image.name for image in images] == ["P1", "P4"]
    assert sorted((issue.reason, issue.file.stem) for issue in issues) == [
        ("duplicate_name", "P1_instance_id_RGB"),
        ("no_gsd", "P2"),
        ("no_masks", "P3"),
    ]
    assert len(images[0].read_masks()) == 1
    with pytest.raises(ImageError, match=r"P4_instance_color_RGB\.png"):
        images[1].read_masks()


def test_an_object_in_no_categorys_colour_is_unlabelled(tmp_path: Path) -> None:
    mask = np.zeros((40, 60), bool)
    mask[10:30, 10:30] = True
    write_isaid_pictures(tmp_path, tmp_path, "P1", (40, 60), [("unheard of", mask)])
    (found,) = isaid.read_instances(tmp_path / "P1_instance_id_RGB.png", tmp_path / "P1_instance_color_RGB.png")
    assert found.category == "unlabelled"
    assert found.box == (10, 10, 30, 30)


def test_pictures_of_two_sizes_are_refused(tmp_path: Path) -> None:
    mask = np.ones((40, 60), bool)
    write_isaid_pictures(tmp_path, tmp_path / "other", "P1", (40, 60), [("swimming-pool", mask)])
    write_isaid_pictures(tmp_path / "other", tmp_path, "P1", (30, 60), [("swimming-pool", mask[:30])])
    with pytest.raises(ValueError, match=r"60 x 40 px.*60 x 30 px"):
        isaid.read_instances(tmp_path / "P1_instance_id_RGB.png", tmp_path / "P1_instance_color_RGB.png")


def test_a_folder_without_annotations_is_refused(tmp_path: Path) -> None:
    write_dota_image(tmp_path / "dota", "P1", np.zeros((20, 20, 3), np.uint8), 0.2)
    (tmp_path / "isaid").mkdir()
    with pytest.raises(InvalidParameterError, match="no iSAID annotations"):
        isaid.find_annotated_images(tmp_path / "isaid", survey_dota(tmp_path / "dota"))
