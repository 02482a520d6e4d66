from __future__ import annotations

from pathlib import Path

import pytest

from tests.known_scale_data import REFERENCE_M, cars, dota_lines, paint, write_geotiff
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.dota import survey_dota
from vehanchor_evaluation.geotiff import survey_geotiffs
from vehanchor_evaluation.survey import survey_known_scale
from vehanchor_evaluation.table import survey_table


def test_a_split_of_dota_is_read_as_downloaded(dota: Path) -> None:
    data = survey_dota(dota)
    assert [image.path.name for image in data.images] == [
        "P0000.png", "P0001.png", "P0002.png", "P0003.png", "P0007.png"
    ]  # fmt: skip
    assert data.images[0].gsd_m_per_px == REFERENCE_M / 20  # neither version 1.0's nor the upright boxes' header
    assert [image.labelled_vehicles for image in data.images] == [12, 12, 12, 0, 0]
    issues = {(issue.file.name, issue.reason, issue.skipped) for issue in data.issues}
    assert issues == {
        ("P0004.png", "no_gsd", True),
        ("P0005.png", "no_gsd", True),
        ("P0006.png", "no_label", True),
        ("P0000.png", "duplicate_name", True),
        ("P0001.txt", "malformed_labels", False),
        ("P0008.txt", "no_image", True),
        ("P0009.txt", "unreadable_labels", True),
    }
    malformed = next(issue for issue in data.issues if issue.reason == "malformed_labels")
    assert "line 15" in malformed.message
    assert "1 2 3 car" in malformed.message


def test_version_2_keeps_the_scale_in_its_meta_folder(dota: Path) -> None:
    (dota / "labelTxt-v2.0").mkdir()
    (dota / "meta").mkdir()
    (dota / "labelTxt-v2.0" / "P0000.txt").write_text(dota_lines(cars(22)))
    (dota / "meta" / "P0000.txt").write_text("acquisition dates:2014\nimagesource:GoogleEarth\ngsd:0.31\n")
    data = survey_dota(dota)
    assert [(image.path.name, image.gsd_m_per_px) for image in data.images] == [("P0000.png", 0.31)]
    assert len(survey_dota(dota, dota / "labelTxt-v1.5").images) == 5
    (dota / "meta" / "P0000.txt").write_text("imagesource:GoogleEarth\n")
    assert survey_dota(dota).images == ()


def test_a_folder_that_is_no_split_says_what_to_name(dota: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="name one of its splits: val"):
        survey_dota(tmp_path)
    (tmp_path / "bare" / "images").mkdir(parents=True)
    with pytest.raises(InvalidParameterError, match="--labels"):
        survey_dota(tmp_path / "bare")
    with pytest.raises(InvalidParameterError, match="no label folder"):
        survey_dota(dota, tmp_path / "nowhere")


def test_a_table_reports_bad_lines_and_finds_labels_beside_its_images(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        paint(tmp_path / "images" / f"{name}.png", cars(20))
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.txt").write_text("")
    (tmp_path / "images" / "b.txt").write_text("")
    table = tmp_path / "table.csv"
    table.write_text(
        "file,gsd_m_per_px,set\nimages/a.png,0.2,x\nimages/b.png,wide,x\nimages/b.png,0.3,y\nimages/a.png,0.2,x\n"
        "images/none.png,0.2,x\n,0.2,x\nimages/c.png,0.2,y\n"
    )
    data = survey_table(table)
    assert [(image.path.stem, image.labels and image.labels.parent.name) for image in data.images] == [
        ("a", "labels"),
        ("b", "images"),
        ("c", None),
    ]
    assert sorted(issue.reason for issue in data.issues) == [
        "duplicate_name", "malformed_row", "malformed_row", "no_image"
    ]  # fmt: skip
    assert [image.path.stem for image in data.chosen(set_name="y").images] == ["b", "c"]
    assert [image.path.stem for image in data.chosen(limit=1).images] == ["a"]
    table.write_text("name,gsd\na,0.1\n")
    with pytest.raises(InvalidParameterError, match=r"no line of the table can be used.*line 2"):
        survey_table(table)
    with pytest.raises(InvalidParameterError, match="cannot read table"):
        survey_table(tmp_path / "none.csv")


def test_the_true_scale_of_a_geotiff_is_corrected_for_its_latitude(tmp_path: Path) -> None:
    latitude_60_m = 8399737.89  # northing of 60 degrees in Web Mercator
    files = [
        write_geotiff(tmp_path / "metres.tif", "EPSG:25832", 0.25, 500000, 5500000),
        write_geotiff(tmp_path / "mercator.tif", "EPSG:3857", 0.5, 1000000, latitude_60_m),
        write_geotiff(tmp_path / "degrees.tif", "EPSG:4326", 2e-6, 10, 0),
    ]
    paint(tmp_path / "plain.png", cars(20))
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    data = survey_geotiffs([*files, tmp_path / "plain.png", tmp_path / "broken.tif", files[0]])
    # on the ellipsoid Web Mercator's metre is at 60 degrees half of sqrt(M N) / a = 1.00168 long
    assert [image.gsd_m_per_px for image in data.images] == pytest.approx([0.25, 0.25042, 0.2219], rel=1e-4)
    assert [(issue.file.name, issue.reason) for issue in data.issues] == [
        ("plain.png", "no_georeference"),
        ("broken.tif", "image_undecodable"),
    ]
    assert len(survey_geotiffs([tmp_path]).images) == 3
    with pytest.raises(InvalidParameterError, match="no file or folder"):
        survey_geotiffs([tmp_path / "none"])


def test_a_source_is_named_one_way_and_its_images_may_be_chosen(dota: Path, tmp_path: Path) -> None:
    paint(tmp_path / "plain.png", cars(20))
    assert survey_known_scale(geotiff=[tmp_path / "plain.png"]).images == ()
    assert len(survey_known_scale(dota=dota, limit=2).images) == 2
    with pytest.raises(InvalidParameterError, match="give the images with one of"):
        survey_known_scale()
    with pytest.raises(InvalidParameterError, match="give the images with one of"):
        survey_known_scale(dota=dota, table=tmp_path / "t.csv")
    with pytest.raises(InvalidParameterError, match="no image of set 'asia'"):
        survey_known_scale(dota=dota, set_name="asia")
