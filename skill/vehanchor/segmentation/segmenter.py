"""Promptable segmentation: the mask of the object that a box or points name, in pixels of the image.

The model runs on a crop around the prompt: memory does not grow with the image, and small objects
get the model's full resolution. The crop of a box has twice its longer side, at least 256 px.
Points do not show the object's size: they are tried in crops of 128 to 1024 px, or from twice their
extent on. The mask with the best score is refined by its bounding box; masks of other objects are
its alternatives. Points name one object if three masks or more agree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import ImageTooLargeError, ModelContractError
from vehanchor.imagery.raster import Window, outer_sides
from vehanchor.models.files import file_cached, models_sha256, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import metadata_number, open_session
from vehanchor.options import ImageLimits
from vehanchor.segmentation.contracts import recognise_contract
from vehanchor.segmentation.crop import (
    MAX_POINT_CROP_PX,
    crop_side,
    crop_window,
    place_mask,
    read_resized,
)
from vehanchor.segmentation.prompt import MIN_BOX_PX, Box, Prompt
from vehanchor.segmentation.shape import mask_bounds, touches_edge

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Self

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

MIN_MASK_SCORE = 0.7  # default: lower predicted IoUs need a check of the outline
MASK_AREA_LOG_SD = 0.1  # default: standard deviation of log(mask area / true area)
# The same for points whose masks agree, and for all others: research/results/notes.md has the
# trial.
_POINT_AREA_LOG_SD = 0.25
_DOUBTED_POINT_AREA_LOG_SD = 1.3
_LEAST_AGREEING = 3  # masks that show the same object; research/results/notes.md has the trial
# masks that overlap more show the same object; research/results/notes.md has the trial
_SAME_IOU = 0.7
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
        licence: licence of the weights, from the file.
    """

    name: str
    sha256: str
    contract: str
    input_px: int
    min_score: float
    mask_area_log_sd: float
    licence: str | None

    def is_doubtful(self, found: Segmentation) -> bool:
        """Tell whether a mask needs a check of its outline: a low score, no pixels, or several objects."""
        return found.score < self.min_score or not found.mask.any() or not found.is_agreed

    def area_log_sd(self, prompt: Prompt, found: Segmentation) -> float:
        """Return the standard deviation of the log of mask area over true area; points can miss the object's extent.

        Args:
            prompt: of the mask.
            found: the mask.
        """
        if prompt.box is not None:
            return self.mask_area_log_sd
        return _DOUBTED_POINT_AREA_LOG_SD if self.is_doubtful(found) else _POINT_AREA_LOG_SD


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Mask of an object.

    Attributes:
        mask: ``[h, w]`` bool, the pixels of ``window``; nothing outside it belongs to the object.
        window: crop of the image on which the model ran.
        score: IoU of the mask as predicted by the model, 0..1.
        alternatives: other objects that the points may mean, best first; none for a box.
        is_agreed: whether the masks of the points show the same object; true for a box.
    """

    mask: NDArray[np.bool_]
    window: Window
    score: float
    alternatives: tuple[Segmentation, ...] = ()
    is_agreed: bool = True

    @property
    def bounding_box(self) -> Box | None:
        """Smallest box of whole pixels around the mask, in pixels of the image; None for an empty mask."""
        bounds = mask_bounds(self.mask)
        left = self.window.x_px
        top = self.window.y_px
        return bounds and (bounds[0] + left, bounds[1] + top, bounds[2] + left, bounds[3] + top)


class Segmenter(LoadedModel):
    """Promptable segmenter: encoder and decoder, of any contract in ``vehanchor.segmentation.contracts``.

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
        files = read_model(self.encoder_path), read_model(self.decoder_path)
        encoder, decoder = (
            open_session(file.path, content=file.content, runtime=self.runtime) for file in files
        )
        metadata = {
            **encoder.get_modelmeta().custom_metadata_map,
            **decoder.get_modelmeta().custom_metadata_map,
        }
        named_px = metadata_number(metadata, "input_size_px", 0.0)
        try:
            self._contract = recognise_contract(encoder, decoder, int(named_px) or None)
        except ModelContractError as error:
            raise ModelContractError(
                f"{self.encoder_path} and {self.decoder_path}: {error}"
            ) from None
        self.card = SegmenterCard(
            name=metadata.get("vehanchor.name", self.encoder_path.stem),
            sha256=models_sha256(*files),
            contract=self._contract.name,
            input_px=self._contract.input_px,
            min_score=metadata_number(metadata, "min_score", MIN_MASK_SCORE),
            mask_area_log_sd=metadata_number(metadata, "mask_area_log_sd", MASK_AREA_LOG_SD),
            licence=metadata.get("license"),
        )

    def under(self, call: Runtime) -> Self:
        """Bind the segmenter to one call; see ``LoadedModel.under``."""
        bound = super().under(call)
        bound._contract = self._contract.under(call)
        return bound

    def segment(
        self, raster: Raster, prompt: Prompt, *, limits: ImageLimits = _DEFAULT_LIMITS
    ) -> Segmentation:
        """Segment the object that a prompt names.

        Args:
            raster: the image.
            prompt: box or points inside the image, in its pixels.
            limits: ``max_pixels`` bounds the crop.

        Returns:
            The mask with its window.

        Raises:
            PromptError: this model cannot read the prompt.
            ImageTooLargeError: the crop has more pixels than the limits allow.
            ModelContractError: the model violates its contract.
        """
        if prompt.box is None:
            return self._segment_points(raster, prompt, limits)
        return self._segment_crop(raster, prompt, side_px=crop_side(prompt), limits=limits)

    def _segment_points(self, raster: Raster, prompt: Prompt, limits: ImageLimits) -> Segmentation:
        """Choose among the masks of several crops, and refine the chosen one by its bounding box and the points."""
        masks = self._masks_at(raster, prompt, limits)
        chosen, *others = _distinct(masks)
        chosen = replace(
            chosen,
            alternatives=tuple(others),
            is_agreed=len(masks) >= _LEAST_AGREEING and not others,
        )
        box = chosen.bounding_box
        if box is None or min(box[2] - box[0], box[3] - box[1]) < MIN_BOX_PX:
            return chosen
        boxed = Prompt(box, prompt.points)
        refined = self._segment_crop(raster, boxed, side_px=crop_side(boxed), limits=limits)
        best = refined if refined.mask.any() else chosen
        return replace(
            chosen, mask=best.mask, window=best.window, score=min(chosen.score, best.score)
        )

    def _masks_at(self, raster: Raster, prompt: Prompt, limits: ImageLimits) -> list[Segmentation]:
        """Segment points in growing crops; keep masks that end inside, of one crop at least."""
        found: list[Segmentation] = []
        side = crop_side(prompt)
        while True:
            window = crop_window(
                prompt, raster.width_px, image_height_px=raster.height_px, side_px=side
            )
            if found and (side > MAX_POINT_CROP_PX or not _allowed(window, limits)):
                return found
            mask = self._segment_crop(raster, prompt, side_px=side, limits=limits)
            if not _runs_into_inner_side(mask, raster):
                found.append(mask)
            if (window.width_px, window.height_px) == (raster.width_px, raster.height_px):
                return found
            side *= 2

    def _segment_crop(
        self, raster: Raster, prompt: Prompt, side_px: int, limits: ImageLimits
    ) -> Segmentation:
        window = crop_window(
            prompt, raster.width_px, image_height_px=raster.height_px, side_px=side_px
        )
        if not _allowed(window, limits):
            raise ImageTooLargeError(
                f"the object's surroundings are {window.width_px} x {window.height_px} px, the "
                "limit is "
                f"{limits.max_pixels} pixels; give a smaller box, or measure in a reduced copy "
                "of the image"
            )
        size = self._contract.input_size(window.width_px, window.height_px)
        found = self._contract.predict(read_resized(raster, window, size), window, prompt)
        return Segmentation(place_mask(found), window, found.score)


_opened = file_cached(max_models=2)(Segmenter)


def load_segmenter(
    encoder_path: Path, decoder_path: Path, runtime: Runtime | None = None
) -> Segmenter:
    """Open a segmenter, or return the open one while its files are unchanged; see ``Segmenter``."""
    chosen = runtime or Runtime()
    return _opened(encoder_path, decoder_path, runtime=chosen.idle).under(chosen)


def _allowed(window: Window, limits: ImageLimits) -> bool:
    return window.width_px * window.height_px <= limits.max_pixels


def _runs_into_inner_side(found: Segmentation, raster: Raster) -> bool:
    """Test whether the mask touches a side of its window that is not an edge of the image."""
    outer = outer_sides(found.window, raster.width_px, raster.height_px)
    return touches_edge(found.mask, (not outer[0], not outer[1], not outer[2], not outer[3]))


def _distinct(found: Sequence[Segmentation]) -> list[Segmentation]:
    """Choose the masks of different objects, at most three.

    Args:
        found: masks in windows of one image, one at least.

    Returns:
        The mask with the best score, the first of equal ones, then those of other objects by
        falling score; empty masks only if there is nothing else.
    """
    kept: list[Segmentation] = []
    for each in sorted(found, key=lambda each: (bool(each.mask.any()), each.score), reverse=True):
        if not kept or (
            each.mask.any() and all(_overlap(each, other) < _SAME_IOU for other in kept)
        ):
            kept.append(each)
    return kept[:_MAX_OBJECTS]


def _overlap(one: Segmentation, other: Segmentation) -> float:
    """Compute the intersection over union of two masks that are not empty."""
    first = one.window
    second = other.window
    left = max(first.x_px, second.x_px)
    top = max(first.y_px, second.y_px)
    right = min(first.x_px + first.width_px, second.x_px + second.width_px)
    bottom = min(first.y_px + first.height_px, second.y_px + second.height_px)
    if left >= right or top >= bottom:
        return 0.0
    parts = [
        mask[top - at.y_px : bottom - at.y_px, left - at.x_px : right - at.x_px]
        for mask, at in ((one.mask, first), (other.mask, second))
    ]
    common = int((parts[0] & parts[1]).sum())
    return common / (int(one.mask.sum()) + int(other.mask.sum()) - common)
