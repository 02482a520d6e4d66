"""Recover the reference lengths of rendered fleets: ``python -m research.benchmarks.calibration [--detector FILE]``.

Scenes of three fleets, none of them the renderer's default, are written as a split of DOTA. From labels the aim is
1 %; what the detector's own boxes give is shown beside it. Prints Markdown; ``--record`` keeps it.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from research.results.record import add_record_option, header, recording
from research.scenes import render_scene
from vehanchor.detection.detector import Detector
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor_evaluation.dota import survey_dota
from vehanchor_evaluation.fleet_survey import calibrate_found, calibrate_labelled, found_vehicles, labelled_vehicles
from vehanchor_evaluation.search import search_known_scale

if TYPE_CHECKING:
    from vehanchor.scale.calibration import Calibration
    from vehanchor_evaluation.known_scale import KnownScaleSet

FLEETS_M = (3.9, 4.3, 5.4)
MODE_OVER_MEAN = 1.010  # of the renderer's fleets, see render_scene
_SCENES = ((0.12, 0), (0.15, 1), (0.20, 2))  # GSD, seed
_SIDE_PX = 1200


def render_split(folder: Path, mean_length_m: float) -> KnownScaleSet:
    """Write the scenes of one fleet in DOTA's layout and read them back."""
    for name in ("images", "labelTxt-v1.5"):
        (folder / name).mkdir(parents=True)
    for gsd, seed in _SCENES:
        scene = render_scene(
            gsd,
            width_px=_SIDE_PX,
            height_px=_SIDE_PX,
            seed=seed,
            layout="parking",
            mean_vehicle_length_m=mean_length_m,
        )
        cv2.imwrite(str(folder / "images" / f"P{seed:04}.png"), scene.image[:, :, ::-1])
        (folder / "labelTxt-v1.5" / f"P{seed:04}.txt").write_text(f"imagesource:scene\n{scene.dota_text()}")
    return survey_dota(folder)


def from_detections(data: KnownScaleSet, detector: Detector) -> Calibration:
    """The calibration from a detector's boxes."""
    options = ScaleOptions()
    searched = search_known_scale(data, detector, options)
    return calibrate_found(found_vehicles(data, searched, detector.card, options), detector.card)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detector", help="ONNX file or bundled name; default: the bundled one")
    options = add_record_option(parser).parse_args()
    detector = Detector(resolve_model(options.detector))
    with recording("scale", ["calibration"], options.record, model={detector.card.name: detector.card.sha256}):
        columns = ["fleet: mean, mode", "labelled", "from labels", "off by from labels"]
        columns += ["found", "from detections", "off by from detections"]
        print(header(*columns))
        for mean in FLEETS_M:
            mode = MODE_OVER_MEAN * mean
            with tempfile.TemporaryDirectory() as folder:
                data = render_split(Path(folder), mean)
                labelled, found = calibrate_labelled(labelled_vehicles(data)), from_detections(data, detector)
            cells = [f"{mean:g} m, {mode:.3f} m"]
            for record in (labelled, found):
                low, high = record.reference_length_ci95_low_m, record.reference_length_ci95_high_m
                off = record.reference_length_m / mode - 1
                cells += [
                    str(record.n_vehicles),
                    f"{record.reference_length_m:.3f} m ({low:.3f} to {high:.3f})",
                    f"{100 * off:+.2f} %",
                ]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
