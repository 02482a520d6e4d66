"""Sorties: photographs of several flights in one folder, told apart by camera and time."""

from __future__ import annotations

from datetime import datetime, timedelta
from itertools import pairwise
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.imagery.facts import ImageFacts

_PAUSE = timedelta(minutes=20)  # between two photographs of one camera: longer than a change of battery
_EXIF_TIME = "%Y:%m:%d %H:%M:%S"


def number_sorties(images: Sequence[ImageFacts]) -> list[int]:
    """Number the sorties of photographs.

    A sortie has one camera and no pause of more than 20 minutes. Photographs without a time belong to the first sortie
    of their camera.

    Args:
        images: their facts.

    Returns:
        The number of each photograph's sortie, from 0 on, in the order of the photographs.
    """
    places = []
    for place, image in enumerate(images):
        camera = image.camera
        kind = ("", "") if camera is None else (camera.make, camera.model)
        places.append((kind, _taken_at(image) or datetime.min, place))
    places.sort()
    found, sortie = {places[0][2]: 0} if places else {}, 0
    for (kind_before, before, _), (kind, taken, place) in pairwise(places):
        sortie += kind != kind_before or (before > datetime.min and taken - before > _PAUSE)
        found[place] = sortie
    numbers: dict[int, int] = {}
    return [numbers.setdefault(found[place], len(numbers)) for place in range(len(images))]


def _taken_at(image: ImageFacts) -> datetime | None:
    """Read the camera's local time of a photograph; None without a valid one."""
    try:
        return None if image.camera is None else datetime.strptime(image.camera.taken_at, _EXIF_TIME)
    except ValueError:
        return None
