"""Chip network: an auxiliary model that measures the bodies of candidates.

A chip is a small picture along a candidate's axis: it shows 2.7 candidate lengths along the axis
and 1.8 across. From it the network predicts

- whether the candidate is a car in a fitting box,
- whether it is drawn, such as a letter or an icon, or a small thing such as a kart or a grave,
- where the edges of its body are: its length and width in pixels,
- how long and wide the car is in metres, by its appearance.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar, NamedTuple, TypeAlias

import cv2
import numpy as np

from vehanchor.detection.boxes import box_axes, canonical_boxes
from vehanchor.detection.card import ChipCard
from vehanchor.detection.detections import Appearance, Objects, thing_chances
from vehanchor.detection.hidden_ends import cut_chances, edge_strengths, hidden_errors
from vehanchor.detection.verifier import AuxiliaryModel, Weights, surroundings
from vehanchor.imagery.tiles import read_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

    Boxes: TypeAlias = NDArray[np.float64]
    """``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians."""

    Chips: TypeAlias = NDArray[np.uint8]
    """``[n, rows, columns, 3]`` RGB."""

    Tones: TypeAlias = NDArray[np.float64]
    """``[n, 3]`` colours in CIELAB, scaled to 0..255."""

    EndTones: TypeAlias = NDArray[np.float64]
    """``[n, 2, 3]`` colours of both ends in CIELAB, scaled to 0..255."""

    Answers: TypeAlias = NDArray[np.float64]
    """Answers of the chip network, a row for each candidate."""

CHIP_ROWS = 64
CHIP_COLUMNS = 96
# The candidate's length on its chip, along the columns.
CHIP_LENGTH_PX = 36.0
KINDS = ("kei", "small", "compact", "saloon", "suv", "pickup", "van", "lorry", "trailer", "other")
# Kinds of vehicles for work: one of ``KINDS`` from here on.
_FIRST_OF_WORK = KINDS.index("van")

# Parts of a body's length near its first end, and of its width in its middle.
_END_PART = (0.06, 0.3)
_MIDDLE_PART = (0.2, 0.8)

# Rows of a chip that a car's body fills.
_BODY_ROWS = 16
# A chip is the middle of a square; these rows are cut off above and below it.
_CUT_ROWS = (CHIP_COLUMNS - CHIP_ROWS) // 2
# Candidate lengths from the centre to the farthest pixel that the square needs.
_REACH = 2.1
# Least length of a candidate at the resolution at which it is read; more detail is averaged.
_MIN_LENGTH_PX = 1.5 * CHIP_LENGTH_PX
# Directions of the mirrored chips: along and across the candidate's axis.
_MIRRORS = ((1, 1), (-1, -1), (1, -1), (-1, 1))
# Chips per run, to bound the memory.
_BATCH = 16
# Length and width of a body in candidate lengths: the limits of the training.
_MIN_SIZE = (0.5, 0.15)
_MAX_SIZE = (1.6, 0.9)
# Standard deviation of the log of a length or width that the image border cuts: a choice, so large
# that it counts nothing.
_CUT_LOG_SD = 1.0


class Examined(NamedTuple):
    """Candidates that the chip network examined.

    Attributes:
        candidates: all candidates, with the boxes of their bodies and new scores.
        appearance: appearance of the first ones.
        drawn_chances: ``[n]`` chances, 0..1, that the first ones are drawn or other things.
    """

    candidates: Objects
    appearance: Appearance
    drawn_chances: Answers


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
        drawn: ``[n]`` log odds of something drawn, such as a letter or an icon, or of another
            thing, such as a kart, a grave or a boat.
    """

    logit: Answers
    kinds: Answers
    edges: Answers
    edge_sd: Answers
    turn: Answers
    log_metres: Answers
    metres_sd: Answers
    drawn: Answers

    @property
    def sizes(self) -> Answers:
        """``[n, 2]`` length and width in candidate lengths."""
        first_edges = self.edges[:, ::2]
        second_edges = self.edges[:, 1::2]
        sizes = second_edges - first_edges
        return np.asarray(np.clip(sizes, _MIN_SIZE, _MAX_SIZE))

    @property
    def log_size_sd(self) -> Answers:
        """``[n, 2]`` standard deviations of the logs of length and width."""
        first_sd = self.edge_sd[:, ::2]
        second_sd = self.edge_sd[:, 1::2]
        size_sd = np.hypot(first_sd, second_sd)
        return np.asarray(size_sd / self.sizes)

    @property
    def work_chances(self) -> Answers:
        """``[n]`` chances, 0..1, of a van, a lorry or another work vehicle."""
        return np.asarray(self.kinds[:, _FIRST_OF_WORK:].sum(axis=1))

    @property
    def drawn_chances(self) -> Answers:
        """``[n]`` chances, 0..1, of a drawn or another thing; negligible ones are 0."""
        return thing_chances(self.drawn)


def bodies(boxes: Boxes, answers: ChipAnswers) -> Boxes:
    """Compute the boxes of the bodies.

    Args:
        boxes: ``[n, 5]`` candidates ``(x, y, length, width, angle)``, pixels and radians.
        answers: answers for these candidates.

    Returns:
        ``[n, 5]`` canonical boxes.
    """
    lengths = boxes[:, 2]
    angles = boxes[:, 4] + answers.turn
    # A body's centre lies between its ends and between its sides, along and across its own axis.
    back, front, left, right = answers.edges.T
    along = (back + front) / 2 * lengths
    across = (left + right) / 2 * lengths
    cosine = np.cos(angles)
    sine = np.sin(angles)
    x = boxes[:, 0] + (cosine * along - sine * across)
    y = boxes[:, 1] + (sine * along + cosine * across)
    sizes_px = answers.sizes * lengths[:, None]
    rows = np.column_stack([x, y, sizes_px, angles])
    return canonical_boxes(rows)


def with_appearance(
    network: ChipNetwork, raster: Raster, candidates: Objects, *, most: int, mirrored: bool
) -> Examined:
    """Replace the boxes of candidates by those of their bodies, and score them again.

    The length of a short body that ends at a straight edge is less certain: a roof may hide a part
    of it.
    A drawn or another thing is not a car: the chance of that lowers the score.

    Args:
        network: the chip network.
        raster: the image.
        candidates: candidates in image pixels, best first.
        most: number of candidates that the network examines. The others get the median size of the
            examined bodies, relative to their own lengths, and the median chance of being drawn.
        mirrored: whether to examine each in four mirrored views, which are steadier than one.

    Returns:
        The candidates in their order.
    """
    image_px = raster.width_px, raster.height_px
    examined = candidates.boxes[:most]
    n_views = 1
    if mirrored:
        n_views = len(_MIRRORS)
    chips = candidate_chips(raster, examined)
    answers = network.answers(chips, views=n_views)
    appearance = read_appearance(examined, answers, image_px)
    hidden_means, hidden_sds = _hidden_errors(chips, examined, answers, image_px)
    boxes = candidates.boxes.copy()
    boxes[:most] = bodies(examined, answers)
    # The chips lie along the candidates' angles; a body's angle may point the other way.
    is_turned = np.cos(boxes[:most, 4] - examined[:, 4] - answers.turn) < 0
    end_tones = body_end_tones(chips, answers)
    end_tones[is_turned] = end_tones[is_turned, ::-1]
    appearance = Appearance(
        appearance.log_lengths - hidden_means,
        np.hypot(appearance.log_sds, hidden_sds),
        logits=appearance.logits,
        tones=body_tones(chips),
        work_chances=answers.work_chances,
        end_tones=end_tones,
        thing_log_odds=answers.drawn,
    )
    centres = boxes[:most, :2]
    np.clip(centres, 0, image_px, out=centres)
    if len(boxes) > most:
        median_size = np.median(answers.sizes, axis=0)
        lengths = boxes[most:, 2:3]
        boxes[most:, 2:4] = lengths * median_size
    weights = Weights(*network.card.weights)
    scores = candidates.scores.copy()
    photographed = 1.0 - answers.drawn_chances
    scores[:most] = weights.score(scores[:most], answers.logit) * photographed
    if len(boxes) > most:
        scores[most:] *= np.median(photographed)
    scored = Objects(boxes, scores, candidates.classes)
    return Examined(scored, appearance, answers.drawn_chances)


def read_appearance(boxes: Boxes, answers: ChipAnswers, image_px: tuple[int, int]) -> Appearance:
    """Compare the sizes of bodies in pixels with their metres by appearance.

    Length and width count by the precision of their edges. If the image border cuts a body's length
    or width, that one counts as unknown.

    Args:
        boxes: ``[n, 5]`` candidates, pixels and radians.
        answers: answers for these candidates.
        image_px: width and height of the image.
    """
    is_cut = _cut_by_border(bodies(boxes, answers), image_px)
    # Mean of the log GSD by length and by width, weighted by the inverse variances.
    variances = answers.log_size_sd**2 + _CUT_LOG_SD**2 * is_cut
    precisions = 1 / variances
    total_precision = precisions.sum(axis=1, keepdims=True)
    weights = precisions / total_precision
    sizes_px = answers.sizes * boxes[:, 2:3]
    log_gsds = answers.log_metres - np.log(sizes_px)
    mean_log_gsd = (weights * log_gsds).sum(axis=1)
    # The errors of length and width by appearance count as one error, those of the edges do not.
    metres_sds = answers.metres_sd.mean(axis=1)
    edge_variances = 1 / precisions.sum(axis=1)
    log_sds = np.sqrt(metres_sds**2 + edge_variances)
    log_lengths = mean_log_gsd + np.log(sizes_px[:, 0])
    return Appearance(log_lengths, log_sds, answers.logit)


def _hidden_errors(
    chips: Chips, boxes: Boxes, answers: ChipAnswers, image_px: tuple[int, int]
) -> tuple[Answers, Answers]:
    """Compute means and standard deviations ``[n]`` of the log of what roofs hide of bodies.

    Args:
        chips: ``[n, 64, 96, 3]`` uint8 RGB.
        boxes: ``[n, 5]`` candidates, pixels and radians.
        answers: answers for these candidates.
        image_px: width and height of the image.
    """
    ends = CHIP_COLUMNS / 2 + answers.edges[:, :2] * CHIP_LENGTH_PX
    strengths = edge_strengths(chips, ends)
    proportions = answers.sizes[:, 0] / answers.sizes[:, 1]
    # What the image border cuts has its own error.
    is_cut_by_border = _cut_by_border(bodies(boxes, answers), image_px)[:, 0]
    chances = np.where(is_cut_by_border, 0.0, cut_chances(strengths, proportions))
    return hidden_errors(strengths, chances)


def _cut_by_border(boxes: Boxes, image_px: tuple[int, int]) -> NDArray[np.bool_]:
    """Test whether the image border cuts length and width ``[n, 2]`` of bodies.

    It cuts the length if an end lies beyond it, and the width if a side does.
    """
    ends = np.array(box_axes(boxes))  # [axis, end, n, x and y]
    last_pixel = np.array(image_px) - 1
    beyond = (ends < 1) | (ends > last_pixel)
    is_cut = beyond.any(axis=(1, 3))
    return np.asarray(is_cut.T)


def prepare_colours() -> None:
    """Convert a pixel to CIELAB: at the first conversion OpenCV makes tables, for some 0.05 s."""
    pixel = np.zeros((1, 1, 3), np.uint8)
    cv2.cvtColor(pixel, cv2.COLOR_RGB2LAB)


def body_tones(chips: Chips) -> Tones:
    """Measure the mean colours ``[n, 3]`` of candidates on their chips, in CIELAB."""
    first_row = (CHIP_ROWS - _BODY_ROWS) // 2
    first_column = (CHIP_COLUMNS - round(CHIP_LENGTH_PX)) // 2
    inside = chips[:, first_row:-first_row, first_column:-first_column]
    tones = np.zeros((len(chips), 3))
    for tone, body in zip(tones, inside, strict=True):
        lab = cv2.cvtColor(np.ascontiguousarray(body), cv2.COLOR_RGB2LAB)
        tone[:] = lab.mean(axis=(0, 1))
    return tones


def body_end_tones(chips: Chips, answers: ChipAnswers) -> EndTones:
    """Measure the median colours ``[n, 2, 3]`` of bodies near both ends, in CIELAB.

    Args:
        chips: ``[n, 64, 96, 3]`` uint8 RGB.
        answers: answers for these candidates, with the edges of their bodies.
    """
    tones = np.zeros((len(chips), 2, 3))
    nearest, farthest = _END_PART
    edges_px = answers.edges * CHIP_LENGTH_PX
    for tone, chip, edges in zip(tones, chips, edges_px, strict=True):
        back, front, left, right = edges
        rows = _pixels(CHIP_ROWS, left, right, part=_MIDDLE_PART)
        body = cv2.cvtColor(np.ascontiguousarray(chip[rows]), cv2.COLOR_RGB2LAB)
        first = _pixels(CHIP_COLUMNS, back, front, part=(nearest, farthest))
        last = _pixels(CHIP_COLUMNS, back, front, part=(1 - farthest, 1 - nearest))
        tone[0] = np.median(body[:, first], axis=(0, 1))
        tone[1] = np.median(body[:, last], axis=(0, 1))
    return tones


def _pixels(side: int, low: float, high: float, *, part: tuple[float, float]) -> slice:
    """Select the pixels of a part of a body: at least one.

    Args:
        side: rows or columns of the chip.
        low: first edge of the body, pixels from the chip's centre.
        high: its other edge.
        part: shares of the size at which the part begins and ends.
    """
    start = side / 2 + low
    size = high - low
    begin, end = part
    first = round(start + begin * size)
    first = min(max(0, first), side - 1)
    last = round(start + end * size)
    return slice(first, max(first + 1, last))


def middle(squares: Chips) -> Chips:
    """Cut the middle rows of square chips ``[n, 96, 96, 3]``."""
    return squares[:, _CUT_ROWS : _CUT_ROWS + CHIP_ROWS]


def candidate_chips(raster: Raster, boxes: Boxes) -> Chips:
    """Cut the chips of candidates from an image, each at the finest useful resolution.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` in image pixels.

    Returns:
        ``[n, 64, 96, 3]`` uint8 RGB.
    """
    chips = [np.zeros((0, CHIP_ROWS, CHIP_COLUMNS, 3), np.uint8)]
    shorter_px = min(raster.width_px, raster.height_px)
    for box in boxes:
        # The coarsest power of two that leaves the candidate enough pixels.
        largest_factor = min(box[2] / _MIN_LENGTH_PX, shorter_px)
        octaves = math.floor(math.log2(largest_factor))
        factor = 2 ** max(0, octaves)
        pixels, box_there = read_around(raster, box, factor=factor, reach=_REACH)
        squares = surroundings(
            pixels,
            box_there,
            side_px=CHIP_COLUMNS,
            length_px=CHIP_LENGTH_PX,
        )
        chips.append(middle(squares))
    return np.concatenate(chips)


class ChipNetwork(AuxiliaryModel[ChipCard]):
    """Network from chips ``[n, 3, 64, 96]``, RGB in 0..1, to the values of ``ChipAnswers``.

    The outputs are logits of the kinds, and logs of the standard deviations.
    """

    named = "chip network"
    trained_by = "research/training/chips"
    chip_shape = (3, CHIP_ROWS, CHIP_COLUMNS)
    outputs: ClassVar = {
        "logit": (),
        "kinds": (len(KINDS),),
        "edges": (4,),
        "edge_log_sd": (4,),
        "turn": (),
        "log_metres": (2,),
        "metres_log_sd": (2,),
        "drawn": (),
    }
    card_type = ChipCard

    def answers(self, chips: Chips, *, views: int = len(_MIRRORS)) -> ChipAnswers:
        """Answer for candidates: means over mirrored chips.

        Args:
            chips: ``[n, 64, 96, 3]`` uint8 RGB.
            views: mirrored chips of each, 1 to 4; one is cheap, four are steadier.

        Raises:
            ModelContractError: the network fails or does not answer in finite numbers.
        """
        n_chips = len(chips)
        zeros = [np.zeros((n_chips, *shape)) for shape in self.outputs.values()]
        means = ChipAnswers(*zeros)
        for start in range(0, n_chips, _BATCH):
            batch = slice(start, start + _BATCH)
            for along, across in _MIRRORS[:views]:
                answers = self._mirrored_answers(chips[batch], along, across)
                for mean, answer in zip(means, answers, strict=True):
                    mean[batch] += answer / views
        return means

    def _mirrored_answers(self, chips: Chips, along: int, across: int) -> ChipAnswers:
        """Run the network on mirrored chips, and convert its answers to the chips as they are.

        Args:
            chips: ``[n, 64, 96, 3]`` uint8 RGB.
            along: -1 to mirror along the candidate's axis, else 1.
            across: -1 to mirror across it, else 1.
        """
        mirrored = chips[:, ::across, ::along]
        outputs = self.predict(mirrored)
        logit, kinds, edges, edge_log_sd, turn, log_metres, metres_log_sd, drawn = outputs
        highest = kinds.max(axis=1, keepdims=True)
        odds = np.exp(kinds - highest)
        total = odds.sum(axis=1, keepdims=True)
        # A mirror exchanges both ends, or both sides, and changes their signs.
        ends = (0, 1)
        sides = (2, 3)
        if along < 0:
            ends = (1, 0)
        if across < 0:
            sides = (3, 2)
        order = [*ends, *sides]
        signs = (along, along, across, across)
        signed_edges = edges * signs
        edge_sd = np.exp(edge_log_sd)
        return ChipAnswers(
            logit=logit,
            kinds=odds / total,
            edges=signed_edges[:, order],
            edge_sd=edge_sd[:, order],
            turn=turn * along * across,
            log_metres=log_metres,
            metres_sd=np.exp(metres_log_sd),
            drawn=drawn,
        )
