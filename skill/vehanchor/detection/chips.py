"""Chip network: an auxiliary model that looks at candidates, and says whether each is a car, and how large its body is.

A chip shows 2.7 candidate lengths along the axis and 1.8 across. A candidate's box says where a car
is. The edges say how long and how wide its body is in pixels; the appearance says how long and how
wide it is in metres.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from vehanchor.detection.boxes import box_axes, canonical_boxes
from vehanchor.detection.card import ChipCard
from vehanchor.detection.detections import Appearance, Objects
from vehanchor.detection.verifier import AuxiliaryModel, Weights, surroundings
from vehanchor.imagery.tiles import read_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

CHIP_ROWS = 64
CHIP_COLUMNS = 96
CHIP_LENGTH_PX = 36.0  # the candidate's length on its chip, along the columns
KINDS = ("kei", "small", "compact", "saloon", "suv", "pickup", "van", "lorry", "trailer", "other")
_CUT_ROWS = (CHIP_COLUMNS - CHIP_ROWS) // 2  # of a square chip, above and below
_REACH = 2.1  # candidate lengths from the centre to the farthest pixel that the square needs
_LEAST_LENGTH_PX = 1.5 * CHIP_LENGTH_PX  # of a candidate where it is read; more detail is averaged
_MIRRORS = ((1, 1), (-1, -1), (1, -1), (-1, 1))  # along and across the candidate's axis
_BATCH = 16  # chips per run: bounds the memory
# length and width in candidate lengths: the limits of the training
_LEAST_SIZE = (0.5, 0.15)
_MOST_SIZE = (1.6, 0.9)
_CUT_LOG_SD = 1.0  # of a length or width that the image's border cuts: it tells nothing; a choice


class ChipAnswers(NamedTuple):
    """Answers of the chip network, a row for each candidate; means over mirrored chips.

    Attributes:
        logit: ``[n]`` log odds of a small vehicle in a fitting box, before calibration.
        kinds: ``[n, 10]`` probabilities of ``KINDS``.
        edges: ``[n, 4]`` both ends along and both sides across the body's axis, from the
            candidate's centre, in candidate lengths; without mirrors and shadow.
        edge_sd: ``[n, 4]`` their standard deviations.
        turn: ``[n]`` angle from the candidate's axis to the body's, radians.
        log_metres: ``[n, 2]`` log of the body's length and width in metres that the appearance
            suggests.
        metres_sd: ``[n, 2]`` their standard deviations.
    """

    logit: NDArray[np.float64]
    kinds: NDArray[np.float64]
    edges: NDArray[np.float64]
    edge_sd: NDArray[np.float64]
    turn: NDArray[np.float64]
    log_metres: NDArray[np.float64]
    metres_sd: NDArray[np.float64]

    @property
    def sizes(self) -> NDArray[np.float64]:
        """``[n, 2]`` length and width in candidate lengths."""
        return np.asarray(
            np.clip(self.edges[:, 1::2] - self.edges[:, ::2], _LEAST_SIZE, _MOST_SIZE)
        )

    @property
    def log_size_sd(self) -> NDArray[np.float64]:
        """``[n, 2]`` standard deviations of the logs of length and width."""
        return np.asarray(np.hypot(self.edge_sd[:, ::2], self.edge_sd[:, 1::2]) / self.sizes)


def bodies(boxes: NDArray[np.float64], answers: ChipAnswers) -> NDArray[np.float64]:
    """Boxes of the bodies.

    Args:
        boxes: ``[n, 5]`` candidates ``(x, y, length, width, angle)``, pixels and radians.
        answers: of these candidates.

    Returns:
        ``[n, 5]`` canonical boxes.
    """
    length = boxes[:, 2]
    angle = boxes[:, 4] + answers.turn
    along, across = ((answers.edges[:, k] + answers.edges[:, k + 1]) / 2 * length for k in (0, 2))
    cosine = np.cos(angle)
    sine = np.sin(angle)
    centre = boxes[:, :2] + np.stack(
        [cosine * along - sine * across, sine * along + cosine * across], axis=1
    )
    return canonical_boxes(np.column_stack([centre, answers.sizes * length[:, None], angle]))


def with_appearance(
    network: ChipNetwork, raster: Raster, found: Objects, *, most: int, mirrored: bool
) -> tuple[Objects, Appearance]:
    """Score the best candidates again, and replace their boxes by those of their bodies.

    Args:
        network: looks at their chips.
        raster: the image.
        found: candidates of a search, best first.
        most: number of candidates to look at; the boxes of the others change by the medians of
            these.
        mirrored: whether to look at each in four mirrored views, which are steadier than one.

    Returns:
        The candidates in their order, and the looks of the first ones.
    """
    boxes = found.boxes.copy()
    scores = found.scores.copy()
    seen = boxes[:most]
    answers = network.answers(candidate_chips(raster, seen), views=len(_MIRRORS) if mirrored else 1)
    size_px = raster.width_px, raster.height_px
    apparent = read_appearance(seen, answers, size_px)
    if len(boxes) > most:
        boxes[most:, 2:4] = boxes[most:, 2:3] * np.median(answers.sizes, axis=0)
    boxes[:most] = bodies(seen, answers)
    boxes[:most, :2] = np.clip(boxes[:most, :2], 0, size_px)
    scores[:most] = Weights(*network.card.weights).score(scores[:most], answers.logit)
    return Objects(boxes, scores, found.classes), apparent


def read_appearance(
    boxes: NDArray[np.float64], answers: ChipAnswers, image_px: tuple[int, int]
) -> Appearance:
    """Compare the sizes of bodies in pixels with their metres by appearance.

    Length and width count by the precision of their edges. The image's border cuts a body's length,
    its width or both; what is cut counts as unknown.

    Args:
        boxes: ``[n, 5]`` candidates, pixels and radians.
        answers: of these candidates.
        image_px: width and height of the image.
    """
    variances = answers.log_size_sd**2 + _CUT_LOG_SD**2 * _cut(bodies(boxes, answers), image_px)
    shares = (1 / variances) / (1 / variances).sum(axis=1, keepdims=True)
    sizes_px = answers.sizes * boxes[:, 2:3]
    log_gsd = (shares * (answers.log_metres - np.log(sizes_px))).sum(axis=1)
    edge_variance = 1 / (1 / variances).sum(axis=1)
    log_sds = np.sqrt(answers.metres_sd.mean(axis=1) ** 2 + edge_variance)
    return Appearance(log_gsd + np.log(sizes_px[:, 0]), log_sds, answers.logit)


def _cut(boxes: NDArray[np.float64], image_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Tell whether the image's border cuts length and width ``[n, 2]``: whether an end, or a side, lies beyond it."""
    ends = np.array(box_axes(boxes))  # [axis, end, n, x and y]
    beyond = (ends < 1) | (ends > np.array(image_px) - 1)
    return np.asarray(beyond.any(axis=(1, 3)).T)


def middle(squares: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Cut the middle rows of square chips ``[n, 96, 96, 3]``."""
    return squares[:, _CUT_ROWS : _CUT_ROWS + CHIP_ROWS]


def candidate_chips(raster: Raster, boxes: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Cut the chips of candidates from an image, each at the finest useful resolution.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` in image pixels.

    Returns:
        ``[n, 64, 96, 3]`` uint8 RGB.
    """
    chips = [np.zeros((0, CHIP_ROWS, CHIP_COLUMNS, 3), np.uint8)]
    shorter = min(raster.width_px, raster.height_px)
    for box in boxes:
        factor = 2 ** max(0, math.floor(math.log2(min(box[2] / _LEAST_LENGTH_PX, shorter))))
        pixels, inside = read_around(raster, box, factor=factor, reach=_REACH)
        chips.append(
            middle(surroundings(pixels, inside, side_px=CHIP_COLUMNS, length_px=CHIP_LENGTH_PX))
        )
    return np.concatenate(chips)


class ChipNetwork(AuxiliaryModel[ChipCard]):
    """Network from chips ``[n, 3, 64, 96]``, RGB in 0..1, to what ``ChipAnswers`` means."""

    named = "chip network"
    trained_by = "research/training/chips"
    chip_shape = (3, CHIP_ROWS, CHIP_COLUMNS)
    outputs: ClassVar = {
        "logit": (), "kinds": (len(KINDS),), "edges": (4,), "edge_log_sd": (4,), "turn": (), "log_metres": (2,),
        "metres_log_sd": (2,),
    }  # fmt: skip
    card_type = ChipCard

    def answers(self, chips: NDArray[np.uint8], *, views: int = len(_MIRRORS)) -> ChipAnswers:
        """Answer for candidates.

        Args:
            chips: ``[n, 64, 96, 3]`` uint8 RGB.
            views: mirrored chips of each, 1 to 4; one is cheap, four are steadier.

        Raises:
            ModelContractError: the network fails or does not answer in finite numbers.
        """
        total = [np.zeros((len(chips), *shape)) for shape in self.outputs.values()]
        for start in range(0, len(chips), _BATCH):
            part = slice(start, start + _BATCH)
            for along, across in _MIRRORS[:views]:
                for sum_, answer in zip(total, self._seen(chips[part], along, across), strict=True):
                    sum_[part] += answer / views
        return ChipAnswers(*total)

    def _seen(self, chips: NDArray[np.uint8], along: int, across: int) -> list[NDArray[np.float64]]:
        """Answers for mirrored chips: each end, or each side, is seen on the other side."""
        seen = self.predict(chips[:, ::across, ::along])
        logit, kinds, edges, edge_log_sd, turn, log_metres, metres_log_sd = seen
        odds = np.exp(kinds - kinds.max(axis=1, keepdims=True))
        order = [*((0, 1) if along > 0 else (1, 0)), *((2, 3) if across > 0 else (3, 2))]
        return [
            logit, odds / odds.sum(axis=1, keepdims=True), (edges * (along, along, across, across))[:, order],
            np.exp(edge_log_sd)[:, order], turn * along * across, log_metres, np.exp(metres_log_sd),
        ]  # fmt: skip
