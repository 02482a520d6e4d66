"""A photograph of a model: what its rulers measure, in pixels of its centre and in model units.

The plane below a shot comes from the model, so that neither tilt nor lens changes a length. Cars
that several photographs show count once, with the mean of their lengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.analysis.pipeline import conclude, search_raster
from vehanchor.detection.boxes import box_axes
from vehanchor.detection.detections import Detections
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.rulers.active import active_rulers
from vehanchor.rulers.camera_tilt import NADIR_TOLERANCE_DEG, CameraTilt, length_off_nadir
from vehanchor.rulers.ruler import View
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.rulers.witnesses import measure_all
from vehanchor.scale.plane import LEAST_DESCENT
from vehanchor_flight.photograph import Photograph, StoredPhotograph
from vehanchor_flight.reconstruction.ground import local_heights, plane_below

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector
    from vehanchor.options import KnownLength, ScaleOptions
    from vehanchor.scale.posterior import Witness
    from vehanchor_flight.reconstruction.ground import Plane
    from vehanchor_flight.reconstruction.model import Shot

_DESCENTS = 3  # a ray meets the ground around its foot
_MOST_RELIEF = 0.3  # of the camera's height
_SAME_PLACE = 0.5  # of a car's length: closer boxes show one car


class Sight(NamedTuple):
    """Shot above its ground.

    Attributes:
        shot: with the lens of the photograph's size.
        plane: the ground below.
        height: of the camera above it, model units.
        tilt: of the camera against the plane.
    """

    shot: Shot
    plane: Plane
    height: float
    tilt: CameraTilt

    @classmethod
    def of(
        cls, shot: Shot, points: NDArray[np.float64], whole: Plane, size: tuple[int, int]
    ) -> Sight:
        """Fit the plane below a shot.

        Args:
            shot: as in the model.
            points: ``[n, 3]`` points of the model.
            whole: plane of the model.
            size: width and height of the photograph, pixels.

        Raises:
            ReconstructionError: the photograph is not that of the shot, or the camera is not above
                the ground.
        """
        shot = replace(shot, lens=shot.lens.of_size(*size))
        plane = plane_below(shot, points, whole)
        down = -shot.rotation @ plane.normal
        tilt = math.degrees(math.acos(min(1.0, max(-1.0, float(down[2])))))
        roll = math.degrees(math.atan2(-down[0], down[1])) % 360
        height = float(plane.heights(shot.centre[None])[0])
        return cls(
            shot,
            plane,
            height,
            CameraTilt(tilt, roll, focal_length_px=shot.lens.focal_px, source="the reconstruction"),
        )

    @property
    def tilted(self) -> bool:
        """Whether the photograph counts as oblique."""
        return self.tilt.tilt_deg > NADIR_TOLERANCE_DEG

    @property
    def gsd(self) -> float:
        """Model units per pixel at the centre of the ideal photograph."""
        cosine = max(math.cos(math.radians(self.tilt.tilt_deg)), LEAST_DESCENT)
        return float(self.height / self.shot.lens.focal_px / cosine**1.5)

    def on_ground(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Project pixels ``[n, 2]`` to the plane.

        Returns:
            ``[n, 3]`` points, model units, and which rays descend steeply enough.
        """
        rays = self.shot.rays(points)
        descents = -rays @ self.plane.normal
        steep = descents >= LEAST_DESCENT * np.linalg.norm(rays, axis=1)
        reach = self.height / np.where(steep, descents, 1.0)
        return self.shot.centre + reach[:, None] * rays, steep


@dataclass(frozen=True, eq=False)
class SeenPhotograph:
    """Search result of a photograph of a model.

    Attributes:
        name: of its shot.
        view: input of the rulers, without pixels. Its boxes have lengths and widths on the ground,
            in pixels of the photograph's centre.
        others: evidence of the rulers beside vehicles, at the photograph's centre.
        sight: the shot above its ground.
        places: ``[n, 3]`` positions of the boxes, model units.
    """

    name: str
    view: View
    others: tuple[Witness, ...]
    sight: Sight
    places: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        kept: StoredPhotograph,
        shot: Shot,
        points: NDArray[np.float64],
        whole: Plane,
        card: DetectorCard,
        options: ScaleOptions,
    ) -> SeenPhotograph:
        """Project a search result to the ground; arguments as in ``search_photograph``.

        Raises:
            ReconstructionError: the photograph is not that of the shot, or the camera is not above
                the ground.
        """
        sight = Sight.of(shot, points, whole, (kept.image.width_px, kept.image.height_px))
        detections, places = _on_ground(kept.detections, sight, points)
        view = View(
            kept.image,
            detections,
            card=card,
            options=options,
            measure_detail_share=lambda _centres, _scale: kept.detail_share,
            prior=kept.prior,
        )
        return cls(shot.name, view, kept.others or (), sight, places)

    def alone(self) -> Photograph:
        """Analyse the photograph by itself."""
        return self.photograph(
            np.ones(len(self.places), dtype=bool), self.view.detections.boxes[:, 2]
        )

    def photograph(self, kept: NDArray[np.bool_], lengths: NDArray[np.float64]) -> Photograph:
        """Analyse a choice of the boxes.

        Args:
            kept: ``[n]`` the choice.
            lengths: ``[n]`` lengths to take in place of the own ones, pixels of the centre.
        """
        view = replace(self.view, detections=_taken(self.view.detections, kept, lengths))
        return Photograph(self.name, view, conclude(view, measure_all(view, self.others)))


def search_photograph(
    image: Path,
    shot: Shot,
    points: NDArray[np.float64],
    whole: Plane,
    detector: Detector,
    options: ScaleOptions,
) -> StoredPhotograph:
    """Search a photograph; the rulers beside vehicles measure on the model's ground.

    Args:
        image: its file.
        shot: its camera and pose.
        points: ``[n, 3]`` points of the model in its picture.
        whole: ground plane of the model.
        detector: finds the vehicles.
        options: of the method, without metadata.

    Returns:
        The boxes in pixels of the photograph, and evidence at its centre. Neither depends on the
        model's size.

    Raises:
        ImageError: the photograph cannot be read.
        ReconstructionError: it is not that of the shot, or the camera is not above the ground.
        TooObliqueError: the horizon is in the photograph or close to it.
    """
    reading = options.reading
    with open_raster(image, reading) as raster:
        sight = Sight.of(shot, points, whole, (raster.width_px, raster.height_px))
        view = search_raster(raster, detector, options)
        if sight.tilted:
            sight.tilt.plane(view.image).check()
            view = replace(view, tilt=sight.tilt, prior=None)
        others = _measured(view, sight)
        detail_share = Vehicles().measure(view.at_nadir()).detail_share
    return StoredPhotograph(
        view.image, view.detections, detail_share=detail_share, others=others, prior=view.prior
    )


def distinct(seen: Sequence[SeenPhotograph]) -> list[Photograph]:
    """Keep each car in the photograph that shows it best, with the mean of its lengths over all photographs."""
    if not seen:
        return []
    gsds = np.concatenate([np.full(len(each.places), each.sight.gsd) for each in seen])
    boxes = np.concatenate([each.view.detections.boxes for each in seen])
    scores = np.concatenate([each.view.detections.scores for each in seen])
    places = np.concatenate([each.places for each in seen])
    logs = np.log(boxes[:, 2] * gsds)
    kept = np.zeros(len(scores), dtype=bool)
    means = logs.copy()
    left = np.ones(len(scores), dtype=bool)
    for first in np.argsort(-scores, kind="stable"):
        if not left[first]:
            continue
        reach = _SAME_PLACE * math.exp(logs[first])
        same = left & (np.abs(places - places[first]).max(axis=1) <= reach)
        same[same] = np.linalg.norm(places[same] - places[first], axis=1) <= reach
        left[same] = False
        kept[first] = True
        means[first] = np.average(logs[same], weights=np.maximum(scores[same], 1e-3))
    lengths = np.exp(means) / gsds
    ends = np.cumsum([len(each.places) for each in seen])[:-1]
    parts = zip(seen, np.split(kept, ends), np.split(lengths, ends), strict=True)
    return [each.photograph(chosen, own) for each, chosen, own in parts]


def _measured(view: View, sight: Sight) -> tuple[Witness, ...]:
    """Measure with the rulers that use no vehicles; in a tilted view, with those that use the plane."""
    rulers = [
        each
        for each in active_rulers(view.options.rulers)
        if each.pooling_gain is not None and (each.uses_plane or not sight.tilted)
    ]
    lines = tuple(_straight_line(line, sight) for line in view.options.rulers.known_lengths)
    options = replace(view.options, rulers=replace(view.options.rulers, known_lengths=lines))
    level = replace(view, tilt=sight.tilt, options=options)
    return tuple(found for ruler in rulers if (found := ruler.measure(level)) is not None)


def _on_ground(
    detections: Detections, sight: Sight, points: NDArray[np.float64]
) -> tuple[Detections, NDArray[np.float64]]:
    """Project boxes to the ground: lengths and widths in pixels of the centre, and positions in model units."""
    boxes = detections.boxes
    places, steep = sight.on_ground(boxes[:, :2])
    sides = []
    for first, second in box_axes(boxes):
        (one, good) = sight.on_ground(first)
        (other, well) = sight.on_ground(second)
        sides.append(np.linalg.norm(one - other, axis=1))
        steep &= good & well
    steep &= (
        np.isfinite(np.column_stack([places, *sides])).all(axis=1) & (sides[0] > 0) & (sides[1] > 0)
    )
    lengths = sides[0][steep]
    widths = sides[1][steep]
    if sight.tilted:
        lengths = length_off_nadir(lengths, widths, bodies=detections.appearance is not None)
    centre = sight.shot.centre
    nearer = np.ones((len(lengths), 1))
    for _ in range(_DESCENTS):
        heights = local_heights(
            centre + nearer * (places[steep] - centre),
            points,
            plane=sight.plane,
            camera_height=sight.height,
        )
        nearer = np.clip(1 - heights[:, None] / sight.height, 1 - _MOST_RELIEF, 1 + _MOST_RELIEF)
    measured = boxes.copy()
    measured[steep, 2:4] = np.column_stack([lengths, widths]) * nearer / sight.gsd
    kept = _taken(replace(detections, boxes=measured), steep, measured[:, 2])
    return kept, centre + nearer * (places[steep] - centre)


def _taken(
    detections: Detections, kept: NDArray[np.bool_], lengths: NDArray[np.float64]
) -> Detections:
    """Select boxes ``[n]`` and replace their lengths."""
    boxes = detections.boxes.copy()
    appearance = detections.appearance
    boxes[:, 2] = lengths
    return replace(
        detections,
        boxes=boxes[kept],
        scores=detections.scores[kept],
        reductions=None if detections.reductions is None else detections.reductions[kept],
        appearance=None if appearance is None else appearance.take(kept[: len(appearance)]),
        stretch=None,  # width and height have the scales that the model gives them
    )


def _straight_line(line: KnownLength, sight: Sight) -> KnownLength:
    ends = sight.shot.lens.ideal([(line.x1, line.y1), (line.x2, line.y2)])
    (x1, y1), (x2, y2) = ends.tolist()
    return replace(line, x1=x1, y1=y1, x2=x2, y2=y2)
