"""Promptable segmentation: the mask of the object that a box or points name, in image pixels.

The model runs on a crop around the prompt, so memory does not grow with the image, and small
objects get the model's full resolution. The crop of a box has twice its longer side, at least
256 px. Points do not show the object's size, so several crops are tried: 128 to 1024 px a side, or
from twice the points' extent on.

The mask with the best score is refined by its bounding box. Masks of other objects are its
alternatives. Points name one object if three masks or more agree.

The sides of a box are never exact. The mask of a small object is therefore drawn three times, with
the box as it is, grown and shrunk, from one run of the encoder (``segmentation.box_error``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import ImageTooLargeError, InvalidParameterError, ModelContractError
from vehanchor.imagery.raster import Window, outer_sides
from vehanchor.models.files import file_cached, models_sha256, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import metadata_number, open_session
from vehanchor.models.zoo import resolve_segmenter
from vehanchor.options import ImageLimits
from vehanchor.segmentation.box_error import (
    BOX_ERROR_PX,
    MAX_BOX_LOG_SD,
    SMALL_MASK_PX,
    box_log_sd,
    resized_boxes,
)
from vehanchor.segmentation.contracts import recognise_contract
from vehanchor.segmentation.crop import (
    MAX_POINT_CROP_PX,
    crop_side,
    crop_window,
    place_mask,
    read_resized,
)
from vehanchor.segmentation.object_mask import ObjectMask
from vehanchor.segmentation.prompt import MIN_BOX_PX, Prompt
from vehanchor.segmentation.shape import touches_edge

if TYPE_CHECKING:
    import os
    from collections.abc import Sequence
    from typing import Self, TypeAlias

    from vehanchor.imagery.raster import Raster
    from vehanchor.segmentation.contracts import EncodedCrop
    from vehanchor.segmentation.shape import Mask

    SegmenterSource: TypeAlias = "Segmenter | tuple[str | os.PathLike[str], str | os.PathLike[str]]"
    """Paths of encoder and decoder, or a loaded segmenter."""

# Default: masks with a lower predicted IoU need a check of the outline.
MIN_MASK_SCORE = 0.7
# Default: standard deviation of log(mask area / true area).
MASK_AREA_LOG_SD = 0.1
# Default: standard deviation of the log of what fits into a mask over what fits in truth. A dent or
# a bump changes it more than the area shows (research/results/notes.md).
MASK_WIDTH_LOG_SD = 0.12
# research/results/notes.md has the trial behind the numbers for points.
# Standard deviation of log(mask area / true area) where all masks of the points agree.
_POINT_AREA_LOG_SD = 0.25
# The same for all other points.
_DOUBTED_POINT_AREA_LOG_SD = 1.3
# Points name one object if at least so many masks show it.
_MIN_AGREEING_MASKS = 3
# Masks that overlap at least as much show the same object.
_SAME_OBJECT_IOU = 0.7
_MAX_OBJECTS = 3
_DEFAULT_LIMITS = ImageLimits()


@dataclass(frozen=True)
class SegmenterCard:
    """Model card of a segmenter.

    Attributes:
        name: the model's name.
        sha256: checksum of the encoder's file followed by the decoder's (``cat ENCODER DECODER |
            sha256sum``); external weights follow their file.
        contract: layout of inputs and outputs: ``sam``, ``sam2``, ``transformers`` or
            ``efficient_sam``.
        input_px: side of the input, pixels.
        min_score: masks with a lower score need a check of the outline.
        mask_area_log_sd: standard deviation of the log of mask area over true area, for boxes.
        mask_width_log_sd: least standard deviation of the log of the largest circle or rectangle
            inside a mask over the true one.
        licence: licence of the weights, from the file.
    """

    name: str
    sha256: str
    contract: str
    input_px: int
    min_score: float
    mask_area_log_sd: float
    mask_width_log_sd: float
    licence: str | None

    def is_doubtful(self, segmentation: Segmentation) -> bool:
        """Test whether a mask needs a check.

        Its score is low, it is empty, points disagree, or it depends on the box too much.
        """
        if segmentation.score < self.min_score or segmentation.depends_on_box:
            return True
        return not segmentation.mask.any() or not segmentation.is_agreed

    def area_log_sd(self, prompt: Prompt, segmentation: Segmentation) -> float:
        """Return the standard deviation of the log of mask area over true area.

        It is larger for points, because they do not show the object's extent, and for small
        objects, whose masks follow the error of the box.

        Args:
            prompt: prompt of the mask.
            segmentation: the mask.
        """
        if prompt.box is not None:
            return math.hypot(self.mask_area_log_sd, segmentation.box_log_sd)
        if self.is_doubtful(segmentation):
            return _DOUBTED_POINT_AREA_LOG_SD
        return _POINT_AREA_LOG_SD


@dataclass(frozen=True, eq=False)
class Segmentation(ObjectMask):
    """Mask of an object by a model, which ran on the mask's window.

    Attributes:
        score: IoU of the mask as predicted by the model, 0..1.
        alternatives: other objects that the points may mean, best first; none for a box.
        is_agreed: whether the masks of the points show the same object; true for a box.
        box_log_sd: standard deviation of the log of its area, from the error of the box alone; 0
            for points and large masks.
        box_error_px: error of the box's sides behind that number, pixels of the image.
    """

    score: float
    alternatives: tuple[Segmentation, ...] = ()
    is_agreed: bool = True
    box_log_sd: float = 0.0
    box_error_px: float = 0.0

    @property
    def depends_on_box(self) -> bool:
        """Whether the error of the box alone makes the area useless."""
        return self.box_log_sd > MAX_BOX_LOG_SD


class Segmenter(LoadedModel):
    """Promptable segmenter of any contract in ``vehanchor.segmentation.contracts``.

    Args:
        encoder_path: the image encoder's ONNX file.
        decoder_path: the mask decoder's ONNX file.
        runtime: how to open them; None for the defaults.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the files are not a promptable segmenter of a known kind; the message
            lists their inputs and outputs.
        ProviderUnavailableError: an execution provider is not installed.
    """

    def __init__(
        self,
        encoder_path: str | Path,
        decoder_path: str | Path,
        *,
        runtime: Runtime | None = None,
    ) -> None:
        self.runtime = runtime or Runtime()
        self.encoder_path = Path(encoder_path)
        self.decoder_path = Path(decoder_path)
        encoder_file = read_model(self.encoder_path)
        decoder_file = read_model(self.decoder_path)
        encoder = open_session(
            encoder_file.path, content=encoder_file.content, runtime=self.runtime
        )
        decoder = open_session(
            decoder_file.path, content=decoder_file.content, runtime=self.runtime
        )
        metadata = {
            **encoder.get_modelmeta().custom_metadata_map,
            **decoder.get_modelmeta().custom_metadata_map,
        }
        # 0 stands for metadata without a size.
        input_px = int(metadata_number(metadata, "input_size_px", 0.0))
        try:
            self._contract = recognise_contract(encoder, decoder, input_px or None)
        except ModelContractError as error:
            raise ModelContractError(
                f"{self.encoder_path} and {self.decoder_path}: {error}"
            ) from None
        self.card = SegmenterCard(
            name=metadata.get("vehanchor.name", self.encoder_path.stem),
            sha256=models_sha256(encoder_file, decoder_file),
            contract=self._contract.name,
            input_px=self._contract.input_px,
            min_score=metadata_number(metadata, "min_score", MIN_MASK_SCORE),
            mask_area_log_sd=metadata_number(metadata, "mask_area_log_sd", MASK_AREA_LOG_SD),
            mask_width_log_sd=metadata_number(metadata, "mask_width_log_sd", MASK_WIDTH_LOG_SD),
            licence=metadata.get("license"),
        )

    def under(self, call: Runtime) -> Self:
        """Bind the segmenter to one call; see ``LoadedModel.under``."""
        bound = super().under(call)
        bound._contract = self._contract.under(call)
        return bound

    def segment(
        self,
        raster: Raster,
        prompt: Prompt,
        *,
        limits: ImageLimits = _DEFAULT_LIMITS,
        copy_px: float = 1.0,
    ) -> Segmentation:
        """Segment the object that a prompt names.

        Args:
            raster: the image.
            prompt: box or points inside the image, in its pixels.
            limits: ``max_pixels`` bounds the crop.
            copy_px: side of a pixel of the copy in which the box was drawn, pixels of the image; 0
                for an exact box, such as one of a label.

        Returns:
            The mask with its window.

        Raises:
            PromptError: this model cannot read the prompt.
            ImageTooLargeError: the crop has more pixels than the limits allow.
            ModelContractError: the model violates its contract.
        """
        if prompt.box is None:
            return self._segment_points(raster, prompt, limits)
        crop = self._encode_crop(raster, prompt, side_px=crop_side(prompt), limits=limits)
        segmentation = self._decode(crop, prompt)
        n_mask_px = int(segmentation.mask.sum())
        if not 0 < n_mask_px < SMALL_MASK_PX * copy_px**2:
            return segmentation
        error_px = BOX_ERROR_PX * copy_px
        areas_px = [n_mask_px]
        for box in resized_boxes(prompt.box, crop.window, error_px):
            other = self._decode(crop, replace(prompt, box=box))
            areas_px.append(int(other.mask.sum()))
        return replace(segmentation, box_log_sd=box_log_sd(areas_px), box_error_px=error_px)

    def _segment_points(self, raster: Raster, prompt: Prompt, limits: ImageLimits) -> Segmentation:
        """Choose among the masks of several crops, and refine the best one.

        The points and the mask's bounding box are the prompt of the refinement.
        """
        masks = self._segment_growing_crops(raster, prompt, limits)
        best, *others = _choose_objects(masks)
        best = replace(
            best,
            alternatives=tuple(others),
            is_agreed=len(masks) >= _MIN_AGREEING_MASKS and not others,
        )
        box = best.bounding_box
        if box is None:
            return best
        x1, y1, x2, y2 = box
        if min(x2 - x1, y2 - y1) < MIN_BOX_PX:
            return best
        boxed = Prompt(box, prompt.points)
        side_px = crop_side(boxed)
        refined = self._segment_crop(raster, boxed, side_px=side_px, limits=limits)
        if not refined.mask.any():
            return best
        score = min(best.score, refined.score)
        return replace(best, mask=refined.mask, window=refined.window, score=score)

    def _segment_growing_crops(
        self, raster: Raster, prompt: Prompt, limits: ImageLimits
    ) -> list[Segmentation]:
        """Segment points in growing crops; keep masks that end inside their crop.

        Growth ends with the whole image. Once a mask is kept, it also ends at the largest side of
        crops and at the limits.
        """
        masks: list[Segmentation] = []
        side = crop_side(prompt)
        while True:
            window = crop_window(
                prompt, raster.width_px, image_height_px=raster.height_px, side_px=side
            )
            is_largest = side > MAX_POINT_CROP_PX
            if masks and (is_largest or not _is_within_limits(window, limits)):
                return masks
            mask = self._segment_crop(raster, prompt, side_px=side, limits=limits)
            if not _is_cut_by_window(mask, raster):
                masks.append(mask)
            has_all_columns = window.width_px == raster.width_px
            has_all_rows = window.height_px == raster.height_px
            if has_all_columns and has_all_rows:
                return masks
            side *= 2

    def _segment_crop(
        self, raster: Raster, prompt: Prompt, side_px: int, limits: ImageLimits
    ) -> Segmentation:
        crop = self._encode_crop(raster, prompt, side_px=side_px, limits=limits)
        return self._decode(crop, prompt)

    def _encode_crop(
        self, raster: Raster, prompt: Prompt, side_px: int, limits: ImageLimits
    ) -> EncodedCrop:
        window = crop_window(
            prompt, raster.width_px, image_height_px=raster.height_px, side_px=side_px
        )
        if not _is_within_limits(window, limits):
            raise ImageTooLargeError(
                f"the crop around the object is {window.width_px} x {window.height_px} px, the "
                f"limit is {limits.max_pixels} pixels: give a smaller box, or measure in a reduced "
                "copy of the image"
            )
        size = self._contract.input_size(window.width_px, window.height_px)
        picture = read_resized(raster, window, size)
        return self._contract.encode(picture, window)

    def _decode(self, crop: EncodedCrop, prompt: Prompt) -> Segmentation:
        logits = self._contract.decode(crop, prompt)
        mask = place_mask(logits)
        return Segmentation(mask, crop.window, logits.score)


_opened = file_cached(max_models=2)(Segmenter)


def load_segmenter(
    encoder_path: Path, decoder_path: Path, runtime: Runtime | None = None
) -> Segmenter:
    """Open a segmenter, or return the open one while its files are unchanged; see ``Segmenter``."""
    call = runtime or Runtime()
    segmenter = _opened(encoder_path, decoder_path, runtime=call.idle)
    return segmenter.under(call)


def open_segmenter(source: SegmenterSource | None, runtime: Runtime) -> Segmenter:
    """Open a segmenter.

    Raises:
        ModelError: it cannot be used.
        InvalidParameterError: the source is neither a ``Segmenter`` nor two paths.
    """
    if isinstance(source, Segmenter):
        return source
    files = None
    if source is not None:
        if isinstance(source, str) or len(source) != 2:
            raise InvalidParameterError(
                f"segmenter is {source!r}: give two paths, of its encoder and its decoder"
            )
        encoder, decoder = source
        files = (Path(encoder), Path(decoder))
    encoder_path, decoder_path = resolve_segmenter(files)
    return load_segmenter(encoder_path, decoder_path, runtime)


def _is_within_limits(window: Window, limits: ImageLimits) -> bool:
    return window.width_px * window.height_px <= limits.max_pixels


def _is_cut_by_window(segmentation: Segmentation, raster: Raster) -> bool:
    """Test whether the mask touches a side of its window that is not an edge of the image."""
    window = segmentation.window
    left, top, right, bottom = outer_sides(window, raster.width_px, raster.height_px)
    inner_sides = (not left, not top, not right, not bottom)
    return touches_edge(segmentation.mask, inner_sides)


def _choose_objects(masks: Sequence[Segmentation]) -> list[Segmentation]:
    """Choose the masks of different objects, at most three.

    Args:
        masks: masks in windows of one image, one at least.

    Returns:
        The mask with the best score, the first of equal ones, then those of other objects by
        falling score. An empty mask comes back only if all are empty.
    """
    best_first = sorted(masks, key=_rank, reverse=True)
    objects = best_first[:1]
    for mask in best_first[1:]:
        if not mask.mask.any():
            continue
        is_new = all(_mask_iou(mask, other) < _SAME_OBJECT_IOU for other in objects)
        if is_new:
            objects.append(mask)
    return objects[:_MAX_OBJECTS]


def _rank(segmentation: Segmentation) -> tuple[bool, float]:
    """Return the sort key of a mask: empty masks come last, then the score counts."""
    return bool(segmentation.mask.any()), segmentation.score


def _mask_iou(one: Segmentation, other: Segmentation) -> float:
    """Compute the intersection over union of two masks that are not empty."""
    # The part of the image that both windows cover; nothing outside it is common.
    first = one.window
    second = other.window
    left = max(first.x_px, second.x_px)
    top = max(first.y_px, second.y_px)
    right = min(first.x_px + first.width_px, second.x_px + second.width_px)
    bottom = min(first.y_px + first.height_px, second.y_px + second.height_px)
    if left >= right or top >= bottom:
        return 0.0
    common_part = Window(left, top, width_px=right - left, height_px=bottom - top)
    in_both = _cut_out(one, common_part) & _cut_out(other, common_part)
    intersection = int(in_both.sum())
    area = int(one.mask.sum())
    other_area = int(other.mask.sum())
    return intersection / (area + other_area - intersection)


def _cut_out(segmentation: Segmentation, part: Window) -> Mask:
    """Return the mask in a part of its window."""
    left = part.x_px - segmentation.window.x_px
    top = part.y_px - segmentation.window.y_px
    rows = slice(top, top + part.height_px)
    columns = slice(left, left + part.width_px)
    return segmentation.mask[rows, columns]
