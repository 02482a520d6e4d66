"""A photograph of a model: what its rulers measure, in pixels of its centre and in model units.

The plane below a shot comes from the model, so that neither tilt nor lens changes a length. Cars
that several photographs show count once, with the mean of their lengths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

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
from vehanchor.scale.plane import MIN_DESCENT
from vehanchor_flight.photograph import (
    Photograph,
    StoredPhotograph,
    constant_detail_share,
)
from vehanchor_flight.reconstruction.ground import local_heights, plane_below

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector
    from vehanchor.detection.detector_errors import DetectorErrors
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import KnownLength, ScaleOptions
    from vehanchor.scale.posterior import Witness
    from vehanchor_flight.reconstruction.ground import Plane
    from vehanchor_flight.reconstruction.model import Shot

    Points: TypeAlias = NDArray[np.float64]
    """Points ``[n, 3]`` in model units."""

    Pixels: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]`` in pixels."""

    Lengths: TypeAlias = NDArray[np.float64]
    """Lengths ``[n]``, or their natural logs."""

    Shares: TypeAlias = NDArray[np.float64]
    """Scores of boxes, or parts of rays."""

    Flags: TypeAlias = NDArray[np.bool_]
    """Which of the boxes or points have a property."""

_N_DESCENTS = 3  # Steps in which a ray meets the ground around its foot.
_MAX_RELIEF = 0.3  # Of the camera's height.
_SAME_CAR_DISTANCE = 0.5  # Of a car's length: boxes that are closer show one car.
_MIN_WEIGHT = 1e-3  # Of a box in the mean of a car's lengths.


class ShotAboveGround(NamedTuple):
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
        cls,
        shot: Shot,
        points: Points,
        whole_plane: Plane,
        size: tuple[int, int],
    ) -> ShotAboveGround:
        """Fit the plane below a shot.

        Args:
            shot: as in the model.
            points: ``[n, 3]`` points of the model in its picture.
            whole_plane: plane of the whole model.
            size: width and height of the photograph, pixels.

        Raises:
            ReconstructionError: the photograph is not that of the shot, or the camera is not above
                the ground.
        """
        width_px, height_px = size
        lens = shot.lens.of_size(width_px, height_px)
        shot = replace(shot, lens=lens)
        plane = plane_below(shot, points, whole_plane)
        # Straight down, in the camera's frame: z along its axis, y to the lower side of the image.
        straight_down = -shot.rotation @ plane.normal
        right, down, ahead = straight_down.tolist()
        # Rounding can leave the domain of the arc cosine.
        cosine = min(1.0, max(-1.0, ahead))
        tilt_deg = math.degrees(math.acos(cosine))
        direction_deg = math.degrees(math.atan2(-right, down)) % 360
        tilt = CameraTilt(
            tilt_deg,
            direction_deg,
            focal_length_px=lens.focal_px,
            source="the reconstruction",
        )
        height = plane.height(shot.centre)
        return cls(shot, plane, height=height, tilt=tilt)

    @property
    def tilted(self) -> bool:
        """Whether the photograph counts as oblique."""
        return self.tilt.tilt_deg > NADIR_TOLERANCE_DEG

    @property
    def gsd(self) -> float:
        """Model units per pixel at the centre of the ideal photograph."""
        tilt = math.radians(self.tilt.tilt_deg)
        cosine = max(math.cos(tilt), MIN_DESCENT)
        nadir_gsd = self.height / self.shot.lens.focal_px
        return float(nadir_gsd / cosine**1.5)

    def on_ground(self, points: Pixels) -> tuple[Points, Flags]:
        """Project pixels to the plane.

        Args:
            points: ``[n, 2]`` x, y in pixels.

        Returns:
            ``[n, 3]`` points, model units, and ``[n]``, which rays descend steeply enough.
        """
        rays = self.shot.rays(points)
        descents = -rays @ self.plane.normal
        lengths = np.linalg.norm(rays, axis=1)
        is_steep = descents >= MIN_DESCENT * lengths
        # Multiples of the rays that end on the plane; of flat rays they have no meaning.
        reach = self.height / np.where(is_steep, descents, 1.0)
        feet = self.shot.centre + reach[:, None] * rays
        return feet, is_steep


@dataclass(frozen=True, eq=False)
class SearchedPhotograph:
    """Search result of a photograph of a model, on the ground of the model.

    Attributes:
        name: of its shot.
        view: input of the rulers, without pixels. Its boxes have lengths and widths on the ground,
            in pixels of the photograph's centre.
        others: evidence of the rulers beside vehicles, at the photograph's centre.
        above_ground: the shot above its ground.
        places: ``[n, 3]`` positions of the boxes, model units.
    """

    name: str
    view: View
    others: tuple[Witness, ...]
    above_ground: ShotAboveGround
    places: Points

    @property
    def gsd(self) -> float:
        """Model units per pixel at the photograph's centre."""
        return self.above_ground.gsd

    @classmethod
    def of(
        cls,
        stored: StoredPhotograph,
        shot: Shot,
        *,
        points: Points,
        whole_plane: Plane,
        card: DetectorCard,
        options: ScaleOptions,
    ) -> SearchedPhotograph:
        """Project a search result to the ground; arguments as in ``search_photograph``.

        Raises:
            ReconstructionError: the photograph is not that of the shot, or the camera is not above
                the ground.
        """
        size = (stored.image.width_px, stored.image.height_px)
        above_ground = ShotAboveGround.of(shot, points, whole_plane, size)
        detections, places = _project_boxes(
            stored.detections, above_ground, points=points, errors=card.errors
        )
        view = View(
            stored.image,
            detections,
            card=card,
            options=options,
            measure_detail_share=constant_detail_share(stored.detail_share),
            prior=stored.prior,
        )
        others = stored.others or ()
        return cls(shot.name, view, others=others, above_ground=above_ground, places=places)

    def alone(self) -> Photograph:
        """Analyse the photograph by itself."""
        boxes = self.view.detections.boxes
        kept = np.ones(len(boxes), dtype=bool)
        return self.photograph(kept, boxes[:, 2])

    def photograph(self, kept: Flags, lengths: Lengths) -> Photograph:
        """Analyse a choice of the boxes.

        Args:
            kept: ``[n]`` the choice.
            lengths: ``[n]`` lengths to take in place of the own ones, pixels of the centre.
        """
        detections = _select_boxes(self.view.detections, kept, lengths)
        view = replace(self.view, detections=detections)
        witnesses = measure_all(view, self.others)
        analysis = conclude(view, witnesses)
        return Photograph(self.name, view, analysis)


def search_photograph(
    image: Path,
    shot: Shot,
    *,
    points: Points,
    whole_plane: Plane,
    detector: Detector,
    options: ScaleOptions,
) -> StoredPhotograph:
    """Search a photograph; the rulers beside vehicles measure on the model's ground.

    Args:
        image: its file.
        shot: its camera and pose.
        points: ``[n, 3]`` points of the model in its picture.
        whole_plane: ground plane of the whole model.
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
    with open_raster(image, options.reading) as raster:
        options = _read_as_in_model(raster, shot, options)
        size = (raster.width_px, raster.height_px)
        above_ground = ShotAboveGround.of(shot, points, whole_plane, size)
        view = search_raster(raster, detector, options)
        if above_ground.tilted:
            above_ground.tilt.plane(view.image).check()
            # The scene-scale prior holds for nadir images.
            view = replace(view, tilt=above_ground.tilt, prior=None)
        others = _measure_on_ground(view, above_ground)
        vehicles = Vehicles().measure(view.at_nadir())
    return StoredPhotograph(
        view.image,
        view.detections,
        detail_share=vehicles.detail_share,
        others=others,
        prior=view.prior,
    )


def _read_as_in_model(raster: Raster, shot: Shot, options: ScaleOptions) -> ScaleOptions:
    """Read the pixels of a photograph that the camera of the model counts.

    COLMAP and OpenSfM ignore the EXIF orientation: their cameras count stored pixels (checked with
    pycolmap 4.2.1). A camera with the proportions of the upright photograph alone belongs to a copy
    that was turned before.

    Args:
        raster: the photograph; it is switched to stored pixels.
        shot: of the model.
        options: of the method, with lines in the upright photograph.

    Returns:
        The options with lines in the pixels that are read.
    """
    fits_stored_pixels = shot.lens.fits(*raster.stored_size_px())
    if raster.orientation == 1 or not fits_stored_pixels:
        return options
    options = options.in_pixels(raster.grid)
    lines = []
    for line in options.rulers.known_lengths:
        x1, y1 = raster.stored_point(line.x1, line.y1)
        x2, y2 = raster.stored_point(line.x2, line.y2)
        lines.append(replace(line, x1=x1, y1=y1, x2=x2, y2=y2))
    raster.use_stored_pixels()
    rulers = replace(options.rulers, known_lengths=tuple(lines))
    # The lines are in pixels now, whatever they were before.
    frame = replace(options.frame, coordinates="pixels")
    return replace(options, rulers=rulers, frame=frame)


def merge_cars(photographs: Sequence[SearchedPhotograph]) -> list[Photograph]:
    """Analyse the photographs so that a car in several of them counts once.

    A car stays in the photograph that shows it best, with the mean of its lengths in all
    photographs.
    """
    if not photographs:
        return []
    detections = [photograph.view.detections for photograph in photographs]
    n_boxes = [len(photograph.places) for photograph in photographs]
    photograph_gsds = [photograph.gsd for photograph in photographs]
    gsds = np.repeat(photograph_gsds, n_boxes)
    part_lengths = [part.boxes[:, 2] for part in detections]
    lengths = np.concatenate(part_lengths)
    scores = np.concatenate([part.scores for part in detections])
    places = np.concatenate([photograph.places for photograph in photographs])
    log_lengths = np.log(lengths * gsds)
    kept, mean_log_lengths = _distinct_cars(places, log_lengths, scores)
    mean_lengths = np.exp(mean_log_lengths) / gsds
    ends = np.cumsum(n_boxes)[:-1]
    kept_parts = np.split(kept, ends)
    length_parts = np.split(mean_lengths, ends)
    parts = zip(photographs, kept_parts, length_parts, strict=True)
    return [
        photograph.photograph(own_kept, own_lengths) for photograph, own_kept, own_lengths in parts
    ]


def _distinct_cars(
    places: Points,
    log_lengths: Lengths,
    scores: Shares,
) -> tuple[Flags, Lengths]:
    """Find the boxes that show one car: those around its box with the best score.

    Args:
        places: ``[n, 3]`` positions of the boxes of all photographs, model units.
        log_lengths: ``[n]`` logs of their lengths, model units.
        scores: ``[n]``.

    Returns:
        ``[n]`` bool, the best box of each car, and ``[n]`` log lengths, of the best boxes the means
        over their cars.
    """
    kept = np.zeros(len(scores), dtype=bool)
    means = log_lengths.copy()
    # Greedy, as in non-maximum suppression: the best box takes all boxes around it.
    is_left = np.ones(len(scores), dtype=bool)
    for best in np.argsort(-scores, kind="stable"):
        if not is_left[best]:
            continue
        reach = _SAME_CAR_DISTANCE * math.exp(log_lengths[best])
        # Boxes in a cube first, which is faster than distances to all.
        place = places[best]
        offsets = np.abs(places - place)
        is_in_cube = offsets.max(axis=1) <= reach
        is_same = is_left & is_in_cube
        steps = places[is_same] - place
        distances = np.linalg.norm(steps, axis=1)
        is_same[is_same] = distances <= reach
        is_left[is_same] = False
        kept[best] = True
        weights = np.maximum(scores[is_same], _MIN_WEIGHT)
        means[best] = np.average(log_lengths[is_same], weights=weights)
    return kept, means


def _measure_on_ground(view: View, above_ground: ShotAboveGround) -> tuple[Witness, ...]:
    """Measure with the rulers that use no vehicles; in a tilted view, only with the plane."""
    ruler_options = view.options.rulers
    lines = [_undistorted_line(line, above_ground) for line in ruler_options.known_lengths]
    ground_rulers = replace(ruler_options, known_lengths=tuple(lines))
    options = replace(view.options, rulers=ground_rulers)
    ground_view = replace(view, tilt=above_ground.tilt, options=options)
    witnesses = []
    for ruler in active_rulers(ruler_options):
        measures_alone = ruler.pooling_gain is not None
        if measures_alone and (ruler.uses_plane or not above_ground.tilted):
            witness = ruler.measure(ground_view)
            if witness is not None:
                witnesses.append(witness)
    return tuple(witnesses)


def _project_boxes(
    detections: Detections,
    above_ground: ShotAboveGround,
    *,
    points: Points,
    errors: DetectorErrors,
) -> tuple[Detections, Points]:
    """Project boxes to the ground; boxes whose rays are too flat are left out.

    Args:
        detections: in pixels of the photograph.
        above_ground: the shot above its ground.
        points: ``[n, 3]`` points of the model in its picture.
        errors: errors of the detector, with the proportions of its boxes.

    Returns:
        Boxes with lengths and widths in pixels of the centre, and ``[m, 3]`` positions in model
        units.
    """
    boxes = detections.boxes
    places, kept = above_ground.on_ground(boxes[:, :2])
    sides = []
    for first_ends, second_ends in box_axes(boxes):
        first, is_first_steep = above_ground.on_ground(first_ends)
        second, is_second_steep = above_ground.on_ground(second_ends)
        side_lengths = np.linalg.norm(first - second, axis=1)
        sides.append(side_lengths)
        kept &= is_first_steep & is_second_steep
    lengths, widths = sides
    positions_and_sizes = np.column_stack([places, lengths, widths])
    is_finite = np.isfinite(positions_and_sizes).all(axis=1)
    kept &= is_finite & (lengths > 0) & (widths > 0)
    lengths = lengths[kept]
    widths = widths[kept]
    if above_ground.tilted:
        has_bodies = detections.appearance is not None
        proportions = errors.length_over_width(of_bodies=has_bodies)
        lengths = length_off_nadir(lengths, widths, length_over_width=proportions)
    rays = places[kept] - above_ground.shot.centre
    nearness = _nearness(rays, above_ground, points)
    sizes = np.column_stack([lengths, widths])
    measured = boxes.copy()
    measured[kept, 2:4] = sizes * nearness / above_ground.gsd
    measured_detections = replace(detections, boxes=measured)
    selected = _select_boxes(measured_detections, kept, measured[:, 2])
    return selected, above_ground.shot.centre + nearness * rays


def _nearness(rays: Points, above_ground: ShotAboveGround, points: Points) -> Shares:
    """Compute the parts of rays down to the plane at which these meet the real ground.

    Ground above the plane is nearer to the camera, so that things on it look larger.

    Args:
        rays: ``[n, 3]`` from the camera to the plane, model units.
        above_ground: the shot above its ground.
        points: ``[m, 3]`` points of the model in its picture.

    Returns:
        ``[n, 1]``, 1 on the plane.
    """
    nearness = np.ones((len(rays), 1))
    # The height of the ground depends on the place, and the place on the height: iterate.
    for _ in range(_N_DESCENTS):
        heights = local_heights(
            above_ground.shot.centre + nearness * rays,
            points,
            plane=above_ground.plane,
            camera_height=above_ground.height,
        )
        nearness = 1 - heights[:, None] / above_ground.height
        nearness = np.clip(nearness, 1 - _MAX_RELIEF, 1 + _MAX_RELIEF)
    return nearness


def _select_boxes(detections: Detections, kept: Flags, lengths: Lengths) -> Detections:
    """Select boxes ``[n]`` and replace their lengths."""
    boxes = detections.boxes.copy()
    boxes[:, 2] = lengths
    # Width and height have the scales that the model gives them.
    rescaled = replace(detections, boxes=boxes, stretch=None, stretch_log_odds=None)
    return rescaled.take(kept)


def _undistorted_line(line: KnownLength, above_ground: ShotAboveGround) -> KnownLength:
    """Convert a line to pixels of a pinhole camera, which the ground plane assumes."""
    start = (line.x1, line.y1)
    end = (line.x2, line.y2)
    ideal_ends = above_ground.shot.lens.ideal([start, end])
    (x1, y1), (x2, y2) = ideal_ends.tolist()
    return replace(line, x1=x1, y1=y1, x2=x2, y2=y2)
