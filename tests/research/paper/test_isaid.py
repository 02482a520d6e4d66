from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from research.paper import isaid
from tests.research.paper.isaid_data import write_dota_image, write_isaid_pictures
from vehanchor.errors import ImageError, InvalidParameterError
from vehanchor_evaluation.dota import survey_dota


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


def test_a_folder_without_annotations_is_refused(tmp_path: Path) -> None:
    write_dota_image(tmp_path / "dota", "P1", np.zeros((20, 20, 3), np.uint8), 0.2)
    (tmp_path / "isaid").mkdir()
    with pytest.raises(InvalidParameterError, match="no iSAID annotations"):
        isaid.find_annotated_images(tmp_path / "isaid", survey_dota(tmp_path / "dota"))
