"""The promptable segmenters that users have as ONNX files, each told by the names of its inputs and outputs.

=============  =============================================  =========================================================
contract       encoder                                        decoder
=============  =============================================  =========================================================
sam            ``input_image`` ``[h, w, 3]`` RGB 0..255, or   ``image_embeddings, point_coords, point_labels,
               ``[1, 3, s, s]`` normalised; long side s,      mask_input, has_mask_input, orig_im_size`` ->
               padded right and below                         ``masks, iou_predictions, low_res_masks``
sam2           ``image`` ``[1, 3, s, s]``, normalised,        ``image_embed, high_res_feats_0, high_res_feats_1`` + as
               stretched to the square                        above -> ``masks, iou_predictions``
transformers   ``pixel_values`` ``[b, 3, s, s]``, as sam2;    ``image_embeddings.0 .1 .2, input_points, input_labels,
               SAM 3 (stride 14) with mean and sd 0.5         input_boxes`` -> ``pred_masks, iou_scores``
efficient_sam  ``batched_images`` ``[b, 3, h, w]`` 0..1       ``image_embeddings, batched_point_coords,
                                                              batched_point_labels, orig_im_size`` ->
                                                              ``output_masks, iou_predictions``
=============  =============================================  =========================================================

Coordinates. Here a crop's first pixel spans 0 to 1. All these graphs add half a pixel of the model's input to the
coordinates they are given (SAM speaks of pixel indices), so each contract takes that half off.

Which of several masks. A box, or two points and more, say what is meant: then a decoder that has a single-mask output
(four masks, the first is it) gives that one, as SAM's own predictor does. One point alone may mean a part or the whole:
then, and for decoders without that output (three masks), the mask that the model itself scores highest. SAM's padding
point is always added, which makes decoders exported with ``--return-single-mask`` choose by the same rule.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from vehanchor.errors import ModelContractError, PromptError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import onnxruntime
    from numpy.typing import NDArray

__all__ = ["MaskLogits", "Prompt", "SamContract", "recognise_contract", "resized_side"]

_MEAN_RGB = np.array([123.675, 116.28, 103.53], dtype=np.float32)  # SAM's and ImageNet's, in 0..255
_SD_RGB = np.array([58.395, 57.12, 57.375], dtype=np.float32)
_SAM3_LEVEL = np.float32(127.5)  # SAM 3: mean and sd 0.5 of 0..1
_SAM_STRIDE_PX, _SAM3_STRIDE_PX = 16, 14  # of the embedding
_SAM3_INPUT_PX = 1008
_MASK_PER_EMBEDDING = 4  # SAM's mask prompt is four times finer than its embedding
_TOP_LEFT, _BOTTOM_RIGHT, _PADDING = 2, 3, -1  # labels beside 1, inside, and 0, outside
_SINGLE_AND_MULTI = 4  # masks of a decoder that puts out the single mask and the three of an ambiguous prompt
_EFFICIENT_SAM_POINTS = 6  # more are dropped without a word in its graph
_EFFICIENT_SAM_INPUT_PX = 1024
_DTYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8,
}


@dataclass(frozen=True)
class Prompt:
    """What to segment: a box or points, in pixels; the first pixel spans 0 to 1.

    Attributes:
        box: x1, y1, x2, y2.
        points: x, y, and whether the point is on the object.
    """

    box: tuple[float, float, float, float] | None = None
    points: tuple[tuple[float, float, bool], ...] = ()

    @property
    def unambiguous(self) -> bool:
        """Whether it tells a whole from its parts: a box, or more than one point."""
        return self.box is not None or len(self.points) > 1

    def moved(self, dx: float, dy: float) -> Prompt:
        """The same prompt seen from another origin."""
        box = self.box and (self.box[0] + dx, self.box[1] + dy, self.box[2] + dx, self.box[3] + dy)
        return Prompt(box, tuple((x + dx, y + dy, include) for x, y, include in self.points))


@dataclass(frozen=True, eq=False)
class MaskLogits:
    """The chosen mask as logits on a grid of its own.

    Attributes:
        logits: ``[gh, gw]`` float32, the object where > 0.
        score: the model's own estimate of its IoU, 0..1.
        cells_per_px: columns and rows of the grid per pixel of the crop, from the common top left corner.
    """

    logits: NDArray[np.float32]
    score: float
    cells_per_px: tuple[float, float]


def resized_side(side_px: int, scale: float) -> int:
    """A side after scaling, rounded half up as SAM does, at least one pixel."""
    return max(1, int(side_px * scale + 0.5))


class SamContract(ABC):
    """One kind of encoder and decoder; the subclasses know what it is fed and what comes back.

    Args:
        encoder: session of the image encoder.
        decoder: session of the prompt encoder and mask decoder.
        input_px: the model's input size where its metadata names one.

    Raises:
        ModelContractError: the size of the model's input cannot be found out, or cannot be used.
    """

    name: ClassVar[str]
    encoder_inputs: ClassVar[frozenset[str]]
    encoder_outputs: ClassVar[frozenset[str]]
    decoder_inputs: ClassVar[frozenset[str]]
    decoder_outputs: ClassVar[frozenset[str]]

    def __init__(
        self, encoder: onnxruntime.InferenceSession, decoder: onnxruntime.InferenceSession, input_px: int | None
    ) -> None:
        self._encoder, self._decoder = encoder, decoder
        self._image = encoder.get_inputs()[0]
        self.input_px = input_px or self._found_input_px()
        self._check_image_shape()

    def _found_input_px(self) -> int:
        """The side of the model's square input, from the shapes of its graphs."""
        shape = self._image.shape
        sides = [side for side in shape[-2:] if isinstance(side, int)] if len(shape) == 4 else []
        if len(shape) == 3:
            sides = [side for side in shape[:2] if isinstance(side, int)]
        if sides:
            return int(max(sides))
        embedding, prior = self._embedding_side(), _fixed_side(self._decoder.get_inputs(), "mask_input")
        if embedding is not None and prior in (None, embedding * _MASK_PER_EMBEDDING):
            return embedding * _SAM_STRIDE_PX
        if embedding is None and prior is not None:
            return prior * _SAM_STRIDE_PX // _MASK_PER_EMBEDDING
        raise ModelContractError(
            f"the encoder's input {self._image.name!r} has shape {shape}, its embedding side {embedding} and the mask "
            f"prompt side {prior}: the input's size cannot be told. Export with fixed shapes, or write the metadata "
            "vehanchor.input_size_px"
        )

    def _embedding_side(self) -> int | None:
        """Side of the coarsest embedding, from the encoder's or the decoder's declaration."""
        name = "image_embeddings"
        return _fixed_side(self._encoder.get_outputs(), name) or _fixed_side(self._decoder.get_inputs(), name)

    def _check_image_shape(self) -> None:
        shape = self._image.shape
        fixed = [side for side in shape[-2:] if isinstance(side, int)]
        if len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != 3):
            raise ModelContractError(f"the encoder's input {self._image.name!r} has shape {shape}: not [b, 3, h, w]")
        if any(side != self.input_px for side in fixed):
            raise ModelContractError(
                f"the encoder's input {self._image.name!r} has shape {shape}, but the input size is {self.input_px} "
                "px: only square inputs can be used"
            )

    @abstractmethod
    def input_size(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Width and height that a crop of this size is resized to before ``segment``."""

    @abstractmethod
    def segment(
        self,
        image: NDArray[np.uint8],
        prompt: Prompt,
        crop_size: tuple[int, int],
        run_options: onnxruntime.RunOptions | None = None,
    ) -> MaskLogits:
        """Encode an image and decode one prompt.

        Args:
            image: ``[h, w, 3]`` uint8 RGB, the crop resized to ``input_size``.
            prompt: in pixels of the crop.
            crop_size: width and height of the crop, pixels.
            run_options: ONNX Runtime's.

        Returns:
            The mask.

        Raises:
            PromptError: a prompt that this model cannot read.
            ModelContractError: the model runs, but what it puts out is no mask.
        """

    def _run(
        self,
        session: onnxruntime.InferenceSession,
        feeds: Mapping[str, NDArray[Any]],
        run_options: onnxruntime.RunOptions | None,
    ) -> dict[str, NDArray[Any]]:
        """Run with what the graph asks for, in its types; outputs by name."""
        asked = {item.name: feeds[item.name].astype(_DTYPES[item.type]) for item in session.get_inputs()}
        names = [output.name for output in session.get_outputs()]
        try:
            results = session.run(names, asked, run_options)
        except Exception as error:  # ONNX Runtime's own exception types are private
            if run_options is not None and run_options.terminate:
                raise
            shapes = ", ".join(f"{name} {list(value.shape)}" for name, value in asked.items())
            raise ModelContractError(f"the {self.name} segmenter fails on {shapes}: {error}") from None
        return dict(zip(names, (np.asarray(result) for result in results), strict=True))

    def _no_mask_prompt(self) -> dict[str, NDArray[Any]]:
        """The inputs of a mask prompt, saying that there is none."""
        shapes = {item.name: item.shape for item in self._decoder.get_inputs()}
        fallback = self.input_px * _MASK_PER_EMBEDDING // _SAM_STRIDE_PX
        sides = [side if isinstance(side, int) else fallback for side in shapes.get("mask_input", [])[2:]]
        return {
            "mask_input": np.zeros((1, 1, *(sides or [fallback] * 2)), np.float32),
            "has_mask_input": np.zeros(1, np.float32),
        }

    def _chosen(self, masks: NDArray[Any], scores: NDArray[Any], prompt: Prompt) -> tuple[NDArray[np.float32], float]:
        """One of ``[m, gh, gw]`` masks by the rule at the top of this module, and its score."""
        grids = masks.reshape(-1, *masks.shape[-2:])
        flat = np.nan_to_num(scores.reshape(-1).astype(np.float64), nan=0.0)
        if len(grids) != len(flat) or len(grids) == 0 or min(grids.shape[1:]) < 1:
            raise ModelContractError(
                f"the decoder put out masks of shape {list(masks.shape)} and scores of shape {list(scores.shape)}: "
                "expected one score a mask"
            )
        index = int(np.argmax(flat))
        if len(flat) == _SINGLE_AND_MULTI:
            index = 0 if prompt.unambiguous else 1 + int(np.argmax(flat[1:]))
        return grids[index].astype(np.float32), float(np.clip(flat[index], 0.0, 1.0))


class _Sam(SamContract):
    """SAM and MobileSAM: Meta's decoder export, samexporter's encoder; and the bundled model."""

    name = "sam"
    encoder_inputs = frozenset({"input_image"})
    encoder_outputs = frozenset({"image_embeddings"})
    decoder_inputs = frozenset({"image_embeddings", "point_coords", "point_labels"})
    decoder_outputs = frozenset({"masks", "iou_predictions"})

    def _check_image_shape(self) -> None:
        shape = self._image.shape
        if len(shape) == 3 and (shape[2] == 3 or not isinstance(shape[2], int)):
            return
        super()._check_image_shape()

    def input_size(self, width_px: int, height_px: int) -> tuple[int, int]:
        scale = self.input_px / max(width_px, height_px)
        return resized_side(width_px, scale), resized_side(height_px, scale)

    def segment(
        self,
        image: NDArray[np.uint8],
        prompt: Prompt,
        crop_size: tuple[int, int],
        run_options: onnxruntime.RunOptions | None = None,
    ) -> MaskLogits:
        height, width = image.shape[:2]
        scale = width / crop_size[0], height / crop_size[1]
        coords, labels = _corner_prompt(prompt, scale, shift=0.5)
        coords, labels = [*coords, (0.0, 0.0)], [*labels, _PADDING]
        encoded = self._run(self._encoder, {"input_image": self._prepared(image)}, run_options)
        outputs = self._run(
            self._decoder,
            {
                "image_embeddings": encoded["image_embeddings"],
                "point_coords": np.array([coords], np.float32),
                "point_labels": np.array([labels], np.float32),
                "orig_im_size": np.array([height, width], np.float32),
                **self._no_mask_prompt(),
            },
            run_options,
        )
        masks, covered = outputs["masks"], (width, height)
        coarse = outputs.get("low_res_masks")
        if coarse is not None and coarse.ndim == 4:  # exports with extra metrics give other things that name
            # Exact, small, and free of the landscape shape that some traced exports freeze into "masks".
            masks, covered = coarse, (self.input_px, self.input_px)
        grid, score = self._chosen(masks, outputs["iou_predictions"], prompt)
        return MaskLogits(grid, score, _cells_per_px(grid, covered, scale))

    def _prepared(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """What the encoder is fed: the picture alone where it pads by itself, else padded with what it takes as 0."""
        height, width = image.shape[:2]
        pixels = image.astype(np.float32)
        below, right = self.input_px - height, self.input_px - width
        if len(self._image.shape) == 3:
            sides = self._image.shape[:2]
            pads = [extra if isinstance(side, int) else 0 for side, extra in zip(sides, (below, right), strict=True)]
            padded = np.empty((height + pads[0], width + pads[1], 3), np.float32)
            padded[:] = _MEAN_RGB
            padded[:height, :width] = pixels
            return padded
        normal = np.zeros((1, 3, self.input_px, self.input_px), np.float32)
        normal[0, :, :height, :width] = ((pixels - _MEAN_RGB) / _SD_RGB).transpose(2, 0, 1)
        return normal


class _Stretched(SamContract):
    """Models whose square input the crop is stretched to."""

    def input_size(self, width_px: int, height_px: int) -> tuple[int, int]:
        del width_px, height_px  # whatever the shape
        return self.input_px, self.input_px

    def _scale(self, crop_size: tuple[int, int]) -> tuple[float, float]:
        return self.input_px / crop_size[0], self.input_px / crop_size[1]

    def _covering(self, grid: NDArray[np.float32], score: float, crop_size: tuple[int, int]) -> MaskLogits:
        square = self.input_px, self.input_px
        return MaskLogits(grid, score, _cells_per_px(grid, square, self._scale(crop_size)))


class _Sam2(_Stretched):
    """SAM 2 and 2.1 as samexporter writes them."""

    name = "sam2"
    encoder_inputs = frozenset({"image"})
    encoder_outputs = frozenset({"image_embed", "high_res_feats_0", "high_res_feats_1"})
    decoder_inputs = frozenset({"image_embed", "high_res_feats_0", "high_res_feats_1", "point_coords", "point_labels"})
    decoder_outputs = frozenset({"masks", "iou_predictions"})

    def _embedding_side(self) -> int | None:
        name = "image_embed"
        return _fixed_side(self._encoder.get_outputs(), name) or _fixed_side(self._decoder.get_inputs(), name)

    def segment(
        self,
        image: NDArray[np.uint8],
        prompt: Prompt,
        crop_size: tuple[int, int],
        run_options: onnxruntime.RunOptions | None = None,
    ) -> MaskLogits:
        coords, labels = _corner_prompt(prompt, self._scale(crop_size), shift=0.5)  # this graph pads by itself
        pixels = ((image.astype(np.float32) - _MEAN_RGB) / _SD_RGB).transpose(2, 0, 1)[None]
        encoded = self._run(self._encoder, {"image": pixels}, run_options)
        outputs = self._run(
            self._decoder,
            {
                **encoded,
                "point_coords": np.array([coords], np.float32),
                "point_labels": np.array([labels], np.float32),
                "orig_im_size": np.array([self.input_px, self.input_px], np.float32),
                **self._no_mask_prompt(),
            },
            run_options,
        )
        return self._covering(*self._chosen(outputs["masks"], outputs["iou_predictions"], prompt), crop_size)


class _Transformers(_Stretched):
    """SAM 2 and the SAM 3 tracker in the layout of transformers.js (onnx-community)."""

    name = "transformers"
    encoder_inputs = frozenset({"pixel_values"})
    encoder_outputs = frozenset({f"image_embeddings.{level}" for level in range(3)})
    decoder_inputs = encoder_outputs | {"input_points", "input_labels", "input_boxes"}
    decoder_outputs = frozenset({"pred_masks", "iou_scores"})

    def _embedding_side(self) -> int | None:
        name = "image_embeddings.2"
        return _fixed_side(self._encoder.get_outputs(), name) or _fixed_side(self._decoder.get_inputs(), name)

    def _found_input_px(self) -> int:
        if self._embedding_side() == _SAM3_INPUT_PX // _SAM3_STRIDE_PX:
            return _SAM3_INPUT_PX
        return super()._found_input_px()

    def _is_sam3(self) -> bool:
        side = self._embedding_side()
        return self.input_px == (_SAM3_INPUT_PX if side is None else side * _SAM3_STRIDE_PX)

    def segment(
        self,
        image: NDArray[np.uint8],
        prompt: Prompt,
        crop_size: tuple[int, int],
        run_options: onnxruntime.RunOptions | None = None,
    ) -> MaskLogits:
        scale = self._scale(crop_size)
        coords, labels = _corner_prompt(Prompt(points=prompt.points), scale, shift=0.5)
        corners, _ = _corner_prompt(Prompt(box=prompt.box), scale, shift=0.5)
        mean, sd = (_SAM3_LEVEL, _SAM3_LEVEL) if self._is_sam3() else (_MEAN_RGB, _SD_RGB)
        pixels = ((image.astype(np.float32) - mean) / sd).transpose(2, 0, 1)[None]
        encoded = self._run(self._encoder, {"pixel_values": pixels}, run_options)
        outputs = self._run(
            self._decoder,
            {
                **encoded,
                "input_points": np.array(coords, np.float32).reshape(1, 1, -1, 2),
                "input_labels": np.array(labels, np.int64).reshape(1, 1, -1),
                "input_boxes": np.array(corners, np.float32).reshape(1, -1, 4),
            },
            run_options,
        )
        return self._covering(*self._chosen(outputs["pred_masks"], outputs["iou_scores"], prompt), crop_size)


class _EfficientSam(SamContract):
    """EfficientSAM's own export: it resizes in its graph, from any size."""

    name = "efficient_sam"
    encoder_inputs = frozenset({"batched_images"})
    encoder_outputs = frozenset({"image_embeddings"})
    decoder_inputs = frozenset({"image_embeddings", "batched_point_coords", "batched_point_labels", "orig_im_size"})
    decoder_outputs = frozenset({"output_masks", "iou_predictions"})

    def _found_input_px(self) -> int:
        side = self._embedding_side()
        return _EFFICIENT_SAM_INPUT_PX if side is None else side * _SAM_STRIDE_PX

    def _check_image_shape(self) -> None:
        if len(self._image.shape) != 4:
            raise ModelContractError(
                f"the encoder's input {self._image.name!r} has shape {self._image.shape}: not [b, 3, h, w]"
            )

    def input_size(self, width_px: int, height_px: int) -> tuple[int, int]:
        height, width = self._image.shape[2:]
        if isinstance(height, int) and isinstance(width, int):
            return width, height
        scale = min(1.0, self.input_px / max(width_px, height_px))  # enlarging is left to its graph
        return resized_side(width_px, scale), resized_side(height_px, scale)

    def segment(
        self,
        image: NDArray[np.uint8],
        prompt: Prompt,
        crop_size: tuple[int, int],
        run_options: onnxruntime.RunOptions | None = None,
    ) -> MaskLogits:
        if not all(include for _, _, include in prompt.points):
            raise PromptError("EfficientSAM knows no points outside the object: leave them out, or use another model")
        if len(prompt.points) > _EFFICIENT_SAM_POINTS:
            raise PromptError(f"EfficientSAM reads {_EFFICIENT_SAM_POINTS} points at most, got {len(prompt.points)}")
        height, width = image.shape[:2]
        scale = width / crop_size[0], height / crop_size[1]
        # Its half pixel is one of its own input, added after it has scaled the coordinates to it.
        half = 0.5 / self.input_px
        coords, labels = _corner_prompt(prompt, scale, shift=(half * width, half * height))
        encoded = self._run(
            self._encoder, {"batched_images": image.astype(np.float32).transpose(2, 0, 1)[None] / 255.0}, run_options
        )
        outputs = self._run(
            self._decoder,
            {
                "image_embeddings": encoded["image_embeddings"],
                "batched_point_coords": np.array(coords, np.float32).reshape(1, 1, -1, 2),
                "batched_point_labels": np.array(labels, np.float32).reshape(1, 1, -1),
                "orig_im_size": np.array([height, width], np.int64),
            },
            run_options,
        )
        grid, score = self._chosen(outputs["output_masks"], outputs["iou_predictions"], prompt)
        return MaskLogits(grid, score, _cells_per_px(grid, (width, height), scale))


_CONTRACTS: tuple[type[SamContract], ...] = (_Sam, _Sam2, _Transformers, _EfficientSam)


def recognise_contract(
    encoder: onnxruntime.InferenceSession, decoder: onnxruntime.InferenceSession, input_px: int | None = None
) -> SamContract:
    """The contract that an encoder and a decoder keep, told by the names of their inputs and outputs.

    Args:
        encoder: session of the image encoder.
        decoder: session of the mask decoder.
        input_px: side of the model's input where its metadata names one.

    Returns:
        The contract, ready to run.

    Raises:
        ModelContractError: the pair is none of those listed at the top of this module; or its shapes do not fit.
    """
    found = [_names(names()) for names in (encoder.get_inputs, encoder.get_outputs)]
    found += [_names(names()) for names in (decoder.get_inputs, decoder.get_outputs)]
    for kind in _CONTRACTS:
        wanted = kind.encoder_inputs, kind.encoder_outputs, kind.decoder_inputs, kind.decoder_outputs
        # An encoder has its one input and no other; what a decoder asks for beyond must be what we can give.
        if found[0] == wanted[0] and all(names <= have for names, have in zip(wanted[1:], found[1:], strict=True)):
            extra = found[2] - wanted[2] - {"mask_input", "has_mask_input", "orig_im_size"}
            types = {item.type for session in (encoder, decoder) for item in session.get_inputs()}
            if not extra and types <= _DTYPES.keys():
                return kind(encoder, decoder, input_px)
    swapped = " (are encoder and decoder swapped?)" if found[2] in [kind.encoder_inputs for kind in _CONTRACTS] else ""
    listed = "; ".join(
        f"{what} {', '.join(sorted(names)) or 'nothing'}"
        for what, names in zip(("encoder in:", "encoder out:", "decoder in:", "decoder out:"), found, strict=True)
    )
    raise ModelContractError(
        f"not a promptable segmenter of a known kind{swapped}: {listed}. Expected SAM or MobileSAM (Meta's or "
        "samexporter's export), SAM 2 (samexporter's), SAM 2 or SAM 3 tracker (onnx-community's), or EfficientSAM"
    )


def _names(items: Sequence[Any]) -> frozenset[str]:
    return frozenset(item.name for item in items)


def _fixed_side(items: Sequence[Any], name: str) -> int | None:
    """The last side of an input or output, where it is fixed."""
    for item in items:
        if item.name == name and len(item.shape) == 4 and isinstance(item.shape[-1], int):
            return int(item.shape[-1])
    return None


def _cells_per_px(
    grid: NDArray[np.float32], covered: tuple[int, int], scale: tuple[float, float]
) -> tuple[float, float]:
    """Cells of a grid that covers so many input pixels, per pixel of the crop."""
    rows, columns = grid.shape
    return columns / covered[0] * scale[0], rows / covered[1] * scale[1]


def _corner_prompt(
    prompt: Prompt, scale: tuple[float, float], *, shift: float | tuple[float, float]
) -> tuple[list[tuple[float, float]], list[int]]:
    """Points and labels as SAM takes them, in input pixels less ``shift``: a box's corners first, labelled 2 and 3."""
    across, down = shift if isinstance(shift, tuple) else (shift, shift)

    def place(x: float, y: float) -> tuple[float, float]:
        return x * scale[0] - across, y * scale[1] - down

    coords, labels = [], []
    if prompt.box is not None:
        x1, y1, x2, y2 = prompt.box
        coords, labels = [place(x1, y1), place(x2, y2)], [_TOP_LEFT, _BOTTOM_RIGHT]
    coords += [place(x, y) for x, y, _ in prompt.points]
    labels += [int(include) for _, _, include in prompt.points]
    return coords, labels
