"""Images of known scale without oriented boxes, with labels by size and by eye.

The table has cars to learn, places to ignore, and clutter to look at more often; all other ground
is background. It was made once, by three judges in this order: people's boxes and what we made of
candidates on contact sheets (``looked_at.csv``); size in metres; a detector, by the mean score over
eight symmetries.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from research.training.detector.data import TrainImage, corrected, read_corrections
from research.training.detector.places import is_held_out, places
from vehanchor_evaluation.dota import read_labels

SCENERY = Path(__file__).with_name("scenery.csv")
CAR_M = 4.5


def load_scenery(data: Path, table: Path = SCENERY, *, held_out: bool = False) -> list[TrainImage]:
    """Load the places that train, with the labels of ``scenery.csv``; lorries are ignored."""
    corrections_by_file = read_corrections(table)
    out = []
    for place in places(data):
        if is_held_out(place) != held_out:
            continue
        image = cv2.imread(str(place.path), cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(place.path)
        lorries = np.zeros((0, 4, 2))
        if place.labels:
            lorries = read_labels(place.labels).of_class("large-vehicle")
        bare = TrainImage(
            place.kind if place.kind == "harbor" else place.set,
            np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8),
            boxes=np.zeros((0, 5)),
            ignore=lorries,
            clutter=np.zeros((0, 2)),
            car_px=CAR_M / place.gsd_m_per_px,
        )
        out.append(corrected(bare, corrections_by_file.get(place.path.name, [])))
    return out
