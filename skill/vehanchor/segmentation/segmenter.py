"""Promptable segmentation: a box or points in, the object's mask out, in pixels of the image.

The image is cropped around the prompt before the model sees it, so that memory does not grow with the image and small
objects get all of the model's resolution: twice the box, at least 256 px. Points say nothing about size: their crop is
512 px or twice what they span, and doubles while the mask runs into a side of it that is not the image's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import ImageTooLargeError, ModelContractError
from vehanchor.imagery.raster import Window
from vehanchor.models.cache import file_cached
from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.session import DEFAULT_PROVIDERS, metadata_number, open_session
from vehanchor.options import ImageLimits
from vehanchor.segmentation.contracts import MaskLogits, Prompt, recognise_contract

if TYPE_CHECKING:
    from collections.abc import Sequence

    import onnxruntime
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

__all__ = ["Prompt", "Segmentation", "Segmenter", "SegmenterCard", "crop_window", "load_segmenter", "place_mask"]

MIN_MASK_SCORE = 0.7  # for foreign models: predicted IoU below which a mask is not to be trusted by itself
MASK_AREA_LOG_SD = 0.1  # for foreign models: sd of log(mask area / true area)
_BOX_CONTEXT = 2.0  # side of the crop over the box's longer side
_MIN_CROP_PX = 256
_POINT_CROP_PX = 512  # where points alone say nothing about the object's size
_ROWS_A_STRIP = 1024


@dataclass(frozen=True)
class SegmenterCard:
    """What a segmenter's files say of themselves.

    Attributes:
        name: the model's name.
        sha256: of the encoder's file followed by the decoder's (``cat ENCODER DECODER | sha256sum``); weights kept
            beside a file follow it.
        contract: how it is fed and read: ``sam``, ``sam2``, ``transformers`` or ``efficient_sam``.
        input_px: side of its input, pixels.
        min_score: masks that it scores below are not to be trusted by themselves.
        mask_area_log_sd: standard deviation of the log of mask area over true area.
        licence: of the weights, as the file states it.
    """

    name: str
    sha256: str
    contract: str
    input_px: int
    min_score: float
    mask_area_log_sd: float
    licence: str | None


@dataclass(frozen=True, eq=False)
class Segmentation:
    """An object's mask.

    Attributes:
        mask: ``[h, w]`` bool, the pixels of ``window``; nothing outside it belongs to the object.
        window: the part of the image that the model saw.
        score: the model's own estimate of the mask's IoU, 0..1.
    """

    mask: NDArray[np.bool_]
    window: Window
    score: float


class Segmenter:
    """A promptable segmenter: encoder and decoder, of any contract that ``vehanchor.segmentation.contracts`` lists.

    Args:
        encoder_path: the image encoder's ONNX file.
        decoder_path: the mask decoder's ONNX file.
        threads: CPU threads of the sessions; None leaves it to ONNX Runtime.
        providers: ONNX Runtime execution providers in order of preference.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the files are not a promptable segmenter of a known kind; the message lists what was found.
        ProviderUnavailableError: an execution provider is not installed.
        InvalidParameterError: bad ``threads``.
    """

    def __init__(
        self,
        encoder_path: str | Path,
        decoder_path: str | Path,
        *,
        threads: int | None = None,
        providers: Sequence[str] = DEFAULT_PROVIDERS,
    ) -> None:
        self.encoder_path, self.decoder_path = Path(encoder_path), Path(decoder_path)
        files = read_model(self.encoder_path), read_model(self.decoder_path)
        encoder, decoder = (
            open_session(file.path, content=file.content, threads=threads, providers=providers) for file in files
        )
        metadata = {
            **encoder.get_modelmeta().custom_metadata_map,
            **decoder.get_modelmeta().custom_metadata_map,
        }
        named_px = metadata_number(metadata, "input_size_px", 0.0)
        try:
            self._contract = recognise_contract(encoder, decoder, int(named_px) or None)
        except ModelContractError as error:
            raise ModelContractError(f"{self.encoder_path} and {self.decoder_path}: {error}") from None
        self.card = SegmenterCard(
            name=metadata.get("vehanchor.name", self.encoder_path.stem),
            sha256=models_sha256(*files),
            contract=self._contract.name,
            input_px=self._contract.input_px,
            min_score=metadata_number(metadata, "min_score", MIN_MASK_SCORE),
            mask_area_log_sd=metadata_number(metadata, "mask_area_log_sd", MASK_AREA_LOG_SD),
            licence=metadata.get("license"),
        )

    def segment(
        self,
        raster: Raster,
        prompt: Prompt,
        *,
        limits: ImageLimits | None = None,
        run_options: onnxruntime.RunOptions | None = None,
    ) -> Segmentation:
        """Find the object that a prompt names.

        Args:
            raster: the image.
            prompt: a box or points inside it, in its pixels.
            limits: ``max_pixels`` bounds the crop; None for the defaults.
            run_options: ONNX Runtime's, for a caller that may have to end a running model (``terminate``).

        Returns:
            The mask with the window it lies in.

        Raises:
            PromptError: a prompt that this model cannot read.
            ImageTooLargeError: the crop has more pixels than the limits allow to hold.
            ModelContractError: the model does not keep its contract.
        """
        side = _crop_side(prompt)
        while True:
            window = crop_window(prompt, raster.width_px, raster.height_px, side)
            _check_window(window, limits or ImageLimits())
            found = self._segment_window(raster, window, prompt, run_options)
            if prompt.box is not None or not _runs_into_inner_side(found, raster):
                return found
            side *= 2

    def _segment_window(
        self, raster: Raster, window: Window, prompt: Prompt, run_options: onnxruntime.RunOptions | None
    ) -> Segmentation:
        image = _read_resized(raster, window, self._contract.input_size(window.width_px, window.height_px))
        local = prompt.moved(-window.x_px, -window.y_px)
        chosen = self._contract.segment(image, local, (window.width_px, window.height_px), run_options)
        return Segmentation(place_mask(chosen, window.width_px, window.height_px), window, chosen.score)


@file_cached(max_models=2)
def load_segmenter(
    encoder_path: Path,
    decoder_path: Path,
    *,
    threads: int | None = None,
    providers: tuple[str, ...] = DEFAULT_PROVIDERS,
) -> Segmenter:
    """Open a segmenter once per pair of files, thread count and providers; see ``Segmenter``."""
    return Segmenter(encoder_path, decoder_path, threads=threads, providers=providers)


def crop_window(prompt: Prompt, image_width_px: int, image_height_px: int, side_px: int) -> Window:
    """The square around a prompt, pushed back into the image where it reaches over, and no larger than it.

    Args:
        prompt: in pixels of the image.
        image_width_px: width of the image.
        image_height_px: its height.
        side_px: of the square.

    Returns:
        A window of the image.
    """
    x1, y1, x2, y2 = _extent(prompt)
    width, height = min(side_px, image_width_px), min(side_px, image_height_px)
    left = math.floor((x1 + x2 - width) / 2 + 0.5)
    top = math.floor((y1 + y2 - height) / 2 + 0.5)
    return Window(min(max(left, 0), image_width_px - width), min(max(top, 0), image_height_px - height), width, height)


def place_mask(found: MaskLogits, width_px: int, height_px: int) -> NDArray[np.bool_]:
    """The mask of a crop: logits between the grid's cells by bilinear interpolation, the object where they are > 0.

    Args:
        found: logits on the model's grid.
        width_px: width of the crop.
        height_px: its height.

    Returns:
        ``[h, w]`` bool.
    """
    grid = found.logits
    left, right, across = _between(width_px, found.cells_per_px[0], grid.shape[1])
    above, below, down = _between(height_px, found.cells_per_px[1], grid.shape[0])
    mask = np.empty((height_px, width_px), dtype=bool)
    for top in range(0, height_px, _ROWS_A_STRIP):  # never the whole crop as floats
        part = slice(top, min(height_px, top + _ROWS_A_STRIP))
        share = down[part, None]
        lines = grid[above[part]] * (1 - share) + grid[below[part]] * share
        mask[part] = lines[:, left] * (1 - across) + lines[:, right] * across > 0
    return mask


def _between(
    side_px: int, cells_per_px: float, n_cells: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """For every pixel's centre the cells whose centres lie before and behind it, and how far it is on the way."""
    at = np.clip((np.arange(side_px) + 0.5) * cells_per_px - 0.5, 0, n_cells - 1)
    before = at.astype(np.intp)
    return before, np.minimum(before + 1, n_cells - 1), (at - before).astype(np.float32)


def _extent(prompt: Prompt) -> tuple[float, float, float, float]:
    if prompt.box is not None:
        return prompt.box
    xs, ys = [x for x, _, _ in prompt.points], [y for _, y, _ in prompt.points]
    return min(xs), min(ys), max(xs), max(ys)


def _crop_side(prompt: Prompt) -> int:
    x1, y1, x2, y2 = _extent(prompt)
    least = _POINT_CROP_PX if prompt.box is None else _MIN_CROP_PX
    return max(least, math.ceil(_BOX_CONTEXT * max(x2 - x1, y2 - y1)))


def _check_window(window: Window, limits: ImageLimits) -> None:
    n_pixels = window.width_px * window.height_px
    if n_pixels > limits.max_pixels:
        raise ImageTooLargeError(
            f"the object's surroundings are {window.width_px} x {window.height_px} px, the limit is "
            f"{limits.max_pixels} pixels; give a smaller box, or measure in a reduced copy of the image"
        )


def _runs_into_inner_side(found: Segmentation, raster: Raster) -> bool:
    """Whether the mask touches a side of its window beyond which the image goes on."""
    mask, window = found.mask, found.window
    return bool(
        (window.x_px > 0 and mask[:, 0].any())
        or (window.y_px > 0 and mask[0].any())
        or (window.x_px + window.width_px < raster.width_px and mask[:, -1].any())
        or (window.y_px + window.height_px < raster.height_px and mask[-1].any())
    )


def _read_resized(raster: Raster, window: Window, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Read a window at another size, in strips: each side averaged where it shrinks, interpolated where it grows."""
    width, height = size
    if window.height_px <= _ROWS_A_STRIP:
        narrow = _resized(raster.read(window), width, window.height_px)
    else:
        narrow = np.empty((window.height_px, width, 3), np.uint8)
        for top in range(0, window.height_px, _ROWS_A_STRIP):
            rows = min(_ROWS_A_STRIP, window.height_px - top)
            strip = raster.read(Window(window.x_px, window.y_px + top, window.width_px, rows))
            narrow[top : top + rows] = _resized(strip, width, rows)
    return _resized(narrow, width, height)


def _resized(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    if (height, width) == image.shape[:2]:
        return image
    shrinks = width < image.shape[1] or height < image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method).astype(np.uint8, copy=False)
