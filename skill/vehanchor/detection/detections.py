"""Result of a search: vehicles, objects of other classes, and the caller's corrections."""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vehanchor.detection.boxes import oriented_iou
from vehanchor.errors import InvalidParameterError
from vehanchor.odds import chances_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.options.reading import CoordinateFrame
    from vehanchor.options.rulers import ByHand
    from vehanchor.scale.defaults import Stopped

    Boxes: TypeAlias = NDArray[np.float64]
    """``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians."""

    PerVehicle: TypeAlias = NDArray[np.float64]
    """``[n]`` one number for each vehicle."""

    Tones: TypeAlias = NDArray[np.float64]
    """``[n, 3]`` colours in CIELAB."""

    EndTones: TypeAlias = NDArray[np.float64]
    """``[n, 2, 3]`` colours of both ends in CIELAB."""

    Selection: TypeAlias = NDArray[np.bool_] | NDArray[np.intp]
    """Mask ``[n]``, or indices in the order of the result."""

# Score of a vehicle that the caller added; the caller can be wrong, too.
_STATED_SCORE = 0.99
# Standard deviation of an end that the caller pointed at, in pixels of the caller's copy: our
# assumption.
_POINTED_SD_PX = 2.0
# IoU from which two added vehicles are one.
_SAME_VEHICLE_IOU = 0.5
# Chance of a drawn or another thing below which it does not count. Of 14,927 vehicles that the
# search keeps in 1,905 photographs 4 of 100 have more. A choice.
_NEGLIGIBLE_CHANCE = 0.05


@dataclass(frozen=True, eq=False)
class Objects:
    """Oriented boxes with scores and classes.

    Attributes:
        boxes: ``[n, 5]`` float64 rows ``(x, y, length, width, angle)``, pixels and radians.
        scores: ``[n]`` float64 in [0, 1].
        classes: ``[n]`` int, indices into the model's classes (see ``DetectorCard.class_names``).
    """

    boxes: Boxes
    scores: PerVehicle
    classes: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.boxes)

    def take(self, which: Selection) -> Objects:
        """Select objects by a mask, or by indices in their order."""
        boxes = self.boxes[which]
        scores = self.scores[which]
        return Objects(boxes, scores, self.classes[which])

    @classmethod
    def joined(cls, parts: Sequence[Objects] = ()) -> Objects:
        """Concatenate the objects of all parts; without parts the result is empty."""
        nothing = cls(np.zeros((0, 5)), np.zeros(0), np.zeros(0, np.intp))
        all_parts = (nothing, *parts)
        return cls(
            np.concatenate([part.boxes for part in all_parts]),
            np.concatenate([part.scores for part in all_parts]),
            np.concatenate([part.classes for part in all_parts]),
        )


class Appearance(NamedTuple):
    """Sizes of vehicles by their appearance.

    Attributes:
        log_lengths: ``[n]`` float64, log of each body's length in metres.
        log_sds: ``[n]`` float64, their standard deviations as the network states them (see
            ``appearance_error``).
        logits: ``[n]`` float64, log odds of a small vehicle in a fitting box, before calibration.
        tones: ``[n, 3]`` float64, mean colours of the bodies in CIELAB, scaled to 0..255; None in
            journals of earlier versions.
        work_chances: ``[n]`` float64, chances, 0..1, of a van, a lorry or another work vehicle;
            None in journals of earlier versions.
        end_tones: ``[n, 2, 3]`` float64, median colours of the bodies near both ends, as ``tones``:
            first of the end that a box's angle points away from; None in journals of earlier
            versions.
        thing_log_odds: ``[n]`` float64, log odds of a drawn or another thing that is no car; None
            in journals of earlier versions.
    """

    log_lengths: PerVehicle
    log_sds: PerVehicle
    logits: PerVehicle
    tones: Tones | None = None
    work_chances: PerVehicle | None = None
    end_tones: EndTones | None = None
    thing_log_odds: PerVehicle | None = None

    def __len__(self) -> int:
        return len(self.log_lengths)

    def take(self, which: Selection) -> Appearance:
        """Select vehicles by a mask ``[n]``, or by indices in their order."""
        return Appearance(
            self.log_lengths[which],
            self.log_sds[which],
            logits=self.logits[which],
            tones=_taken_if_known(self.tones, which),
            work_chances=_taken_if_known(self.work_chances, which),
            end_tones=_taken_if_known(self.end_tones, which),
            thing_log_odds=_taken_if_known(self.thing_log_odds, which),
        )

    @classmethod
    def joined(cls, parts: Sequence[Appearance]) -> Appearance:
        """Concatenate the vehicles of at least one part."""
        return cls(
            np.concatenate([part.log_lengths for part in parts]),
            np.concatenate([part.log_sds for part in parts]),
            logits=np.concatenate([part.logits for part in parts]),
            tones=_joined_if_known([part.tones for part in parts]),
            work_chances=_joined_if_known([part.work_chances for part in parts]),
            end_tones=_joined_if_known([part.end_tones for part in parts]),
            thing_log_odds=_joined_if_known([part.thing_log_odds for part in parts]),
        )


def thing_chances(log_odds: PerVehicle) -> PerVehicle:
    """Compute the chances ``[n]``, 0..1, of things from their log odds; negligible ones are 0."""
    excess = (chances_of(log_odds) - _NEGLIGIBLE_CHANCE) / (1.0 - _NEGLIGIBLE_CHANCE)
    return np.asarray(np.maximum(excess, 0.0))


def _taken_if_known(
    values: NDArray[np.float64] | None, which: Selection
) -> NDArray[np.float64] | None:
    """Select measurements of vehicles; None if they are not known."""
    if values is None:
        return None
    return values[which]


def _joined_if_known(
    parts: Sequence[NDArray[np.float64] | None],
) -> NDArray[np.float64] | None:
    """Concatenate measurements of vehicles; None if those of a part are not known."""
    known = [part for part in parts if part is not None]
    if len(known) < len(parts):
        return None
    return np.concatenate(known)


class Corrections(NamedTuple):
    """Vehicles of a search after the caller's corrections.

    Attributes:
        numbers: ``[n]`` int, numbers of the vehicles in pictures; added ones follow the last
            detection.
        pointed_log_sds: ``[n]`` float64, standard deviation of the log of each length by pointing;
            0 for detections.
        n_dropped: number of dropped vehicles.
        n_added: number of added vehicles.
    """

    numbers: NDArray[np.intp]
    pointed_log_sds: PerVehicle
    n_dropped: int
    n_added: int


@dataclass(frozen=True, eq=False)
class Detections:
    """Vehicles in an image, and objects of the detector's other classes.

    Attributes:
        boxes: ``[n, 5]`` float64 rows ``(x, y, length, width, angle)`` of the vehicles, in image
            pixels and radians, those with an appearance first, then best score first, then vehicles
            that the caller added.
        scores: ``[n]`` float64 in [0, 1].
        n_tiles: number of tiles that were searched.
        n_capped_tiles: number of tiles in which an end-to-end model filled all its rows, so that
            vehicles may be missing.
        reductions: ``[n]`` float64, reduction of the image in which each was found: 1, 0.5, 0.25 or
            None for a search at full resolution only.
        appearance: sizes of the first m = min(n, 64) vehicles by their appearance; None without a
            chip network.
        others: objects of the model's other classes, in image pixels, best score first; overlapping
            boxes are merged within a class, not between classes.
        n_tiles_total: number of tiles of the image at all resolutions; None for boxes that no
            search found, such as labels.
        stopped_because: reason for the end of the search; None before, and without a search.
        stretch: above 1 if the vehicles say that the image is too wide, below -1 if it is too high,
            see ``vehanchor.detection.proportions``; None for a single vehicle, without a verifier,
            or before the end of the search.
        stretch_log_odds: log odds of the vehicles' look in a stretched image over that in a true
            one; None if it was not measured.
        corrections: by the caller; None without any.
        n_skipped: number of candidates in crowded tiles that were left out before the verifier.
        n_copies: number of vehicles that were left out because their pixels repeat another one's.
        with_copies: the vehicles before similar copies were left out, because things that repeat
            each other may not be cars; None if none was.
    """

    boxes: Boxes
    scores: PerVehicle
    n_tiles: int = 1
    n_capped_tiles: int = 0
    reductions: PerVehicle | None = None
    appearance: Appearance | None = None
    others: Objects = field(default_factory=Objects.joined)
    n_tiles_total: int | None = None
    stopped_because: Stopped | None = None
    stretch: float | None = None
    stretch_log_odds: float | None = None
    corrections: Corrections | None = None
    n_skipped: int = 0
    n_copies: int = 0
    with_copies: Detections | None = None

    @property
    def were_searched(self) -> bool:
        """Whether a search found these boxes, or is finding them."""
        return self.n_tiles_total is not None

    @property
    def numbers(self) -> NDArray[np.intp]:
        """``[n]`` int, numbers of the vehicles in pictures and options."""
        if self.corrections is not None:
            return self.corrections.numbers
        return np.arange(1, len(self.boxes) + 1)

    @property
    def stated(self) -> NDArray[np.bool_]:
        """``[n]`` bool, vehicles that the caller added: the last ones."""
        n_added = 0
        if self.corrections is not None:
            n_added = self.corrections.n_added
        n_vehicles = len(self.boxes)
        return np.arange(n_vehicles) >= n_vehicles - n_added

    def moved(self, origin_px: tuple[int, int]) -> Detections:
        """Move the objects of a part of an image to their places in the image.

        Args:
            origin_px: column and row of the part's first pixel.
        """
        if origin_px == (0, 0):
            return self
        offset = np.array([*origin_px, 0.0, 0.0, 0.0])
        others = replace(self.others, boxes=self.others.boxes + offset)
        with_copies = self.with_copies
        if with_copies is not None:
            with_copies = with_copies.moved(origin_px)
        return replace(self, boxes=self.boxes + offset, others=others, with_copies=with_copies)

    def take(self, kept: NDArray[np.bool_]) -> Detections:
        """Select vehicles by a mask ``[n]``; corrections by hand come after it.

        Args:
            kept: which vehicles to keep.
        """
        reductions = self.reductions
        if reductions is not None:
            reductions = reductions[kept]
        appearance = self.appearance
        if appearance is not None:
            # Only the first detections have an appearance.
            appearance = appearance.take(kept[: len(appearance)])
        return replace(
            self,
            boxes=self.boxes[kept],
            scores=self.scores[kept],
            reductions=reductions,
            appearance=appearance,
        )


NOT_SEARCHED = Detections(
    boxes=np.zeros((0, 5)),
    scores=np.zeros(0),
    n_tiles=0,
    n_tiles_total=0,
)
"""Result for an image that was not searched."""


def corrected(
    detections: Detections,
    by_hand: ByHand,
    coordinates: CoordinateFrame,
    *,
    nms_iou: float,
    length_over_width: float,
) -> Detections:
    """Drop and add vehicles after a search.

    An added vehicle replaces the detections that it overlaps.

    Args:
        detections: result of the search, in pixels of the image.
        by_hand: the caller's corrections, in pixels of the frame, or of the file without a frame.
        coordinates: the caller's coordinates.
        nms_iou: IoU above which two boxes are one vehicle.
        length_over_width: proportions of the detector's boxes, for added vehicles.

    Returns:
        The detections with ``Detections.corrections``; the same ones without corrections.

    Raises:
        InvalidParameterError: a number does not exist, or two added vehicles are one.
    """
    if by_hand.given is None:
        return detections
    n_detected = len(detections.boxes)
    _check_numbers(by_hand.drop, n_detected)
    added, pointed_log_sds = _added_boxes(by_hand, coordinates, length_over_width=length_over_width)
    n_added = len(added)

    numbers = np.arange(1, n_detected + 1)
    is_dropped = np.isin(numbers, by_hand.drop)
    overlaps = oriented_iou(detections.boxes, added)
    is_replaced = overlaps.max(axis=1, initial=0.0) > nms_iou
    kept = ~is_dropped & ~is_replaced
    n_kept = int(kept.sum())

    remaining = detections.take(kept)
    reductions = remaining.reductions
    if reductions is not None:
        reductions = np.concatenate([reductions, np.ones(n_added)])
    added_numbers = n_detected + 1 + np.arange(n_added)
    added_scores = np.full(n_added, _STATED_SCORE)
    corrections = Corrections(
        numbers=np.concatenate([numbers[kept], added_numbers]),
        pointed_log_sds=np.concatenate([np.zeros(n_kept), pointed_log_sds]),
        n_dropped=len(by_hand.drop),
        n_added=n_added,
    )
    return replace(
        remaining,
        boxes=np.concatenate([remaining.boxes, added]),
        scores=np.concatenate([remaining.scores, added_scores]),
        reductions=reductions,
        corrections=corrections,
    )


def _check_numbers(drop: Sequence[int], n_detected: int) -> None:
    """Check that all vehicles to drop exist.

    Raises:
        InvalidParameterError: a number does not exist.
    """
    missing = [number for number in drop if number > n_detected]
    if not missing:
        return
    existing = "no vehicle was found"
    if n_detected:
        existing = f"its vehicles are 1 to {n_detected}"
    raise InvalidParameterError(
        f"drop has number {missing[0]}, which is not a vehicle of this image: {existing}"
    )


def _added_boxes(
    by_hand: ByHand, frame: CoordinateFrame, *, length_over_width: float
) -> tuple[Boxes, PerVehicle]:
    """Convert the axes of added vehicles to boxes in pixels of the image.

    Returns:
        Boxes ``[k, 5]``, and the standard deviations of their log lengths ``[k]``.

    Raises:
        InvalidParameterError: two of them are one vehicle.
    """
    coordinates = [astuple(vehicle) for vehicle in by_hand.add]
    axes = np.array(coordinates, dtype=np.float64)
    # Square pixels of the image per pixel of the caller's copy.
    unit = np.array(frame.unit_of_copy_px)
    ends = axes.reshape(-1, 2, 2) * unit
    centres = ends.mean(axis=1)
    dx, dy = (ends[:, 1] - ends[:, 0]).T
    lengths = np.hypot(dx, dy)
    widths = lengths / length_over_width
    angles = np.arctan2(dy, dx) % np.pi
    boxes = np.column_stack([centres, lengths, widths, angles])
    is_same = oriented_iou(boxes, boxes) > _SAME_VEHICLE_IOU
    same_pairs = np.argwhere(np.triu(is_same, 1))
    if len(same_pairs):
        first, second = same_pairs[0] + 1
        raise InvalidParameterError(
            f"add {first} and add {second} are one vehicle: give each vehicle once"
        )
    # A length is the difference of two ends with independent errors.
    pointed_sd_px = np.sqrt(2) * _POINTED_SD_PX * unit.mean()
    return boxes, pointed_sd_px / lengths
