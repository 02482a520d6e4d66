"""Compute what the chip network's encoder sees: ``python -m research.training.letters.features``.

``DRAWN`` is a folder of ``research.training.letters.mine``, and ``OUT`` a file named
``features_NAME.npz``. Each stored chip is seen in several views.

The encoder is frozen: its features are computed once, by the bundled file, and a head is trained on
them within minutes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import onnx
import onnxruntime
from numpy.random import Generator
from numpy.typing import NDArray

from vehanchor.detection.chips import CHIP_COLUMNS, CHIP_ROWS

Chips: TypeAlias = NDArray[np.uint8]
"""Chips ``[n, h, w, 3]`` RGB."""

Features: TypeAlias = NDArray[np.float16]
"""Features ``[n, f]`` of chips."""

# Largest changes of a view: its scale, its turn in degrees, its shift in pixels, its tones, blur
# and noise.
_LOG_SCALE = 0.14
_TURN_DEG = 7.0
_SHIFT_PX = 3.0
_GAIN = 0.22
_OFFSET = 22.0
_TINT_SD = 0.05
_SATURATION = 1.15
_BLUR_PX = (0.3, 1.5)
_NOISE = 9.0
_BATCH = 64


class StoredChips(NamedTuple):
    """Chips that are larger than the network takes them, and whether they show drawn things."""

    chips: Chips
    drawn: NDArray[np.int8]
    layouts: NDArray[np.str_]


def read_drawn(folder: Path) -> StoredChips:
    """Read the files of ``research.training.letters.mine``; doubtful candidates are left out."""
    chips: list[Chips] = []
    drawn: list[int] = []
    layouts: list[str] = []
    for path in sorted(folder.glob("letters_*.npz")):
        with np.load(path) as table:
            files = table["files"]
            starts = [0, *table["ends"][:-1]]
            for k, (start, end) in enumerate(zip(starts, table["ends"], strict=True)):
                if table["drawn"][k] < 0:
                    continue
                chip = cv2.imdecode(files[start:end], cv2.IMREAD_COLOR)
                chips.append(np.asarray(chip, np.uint8))
                drawn.append(int(table["drawn"][k]))
                layouts.append(str(table["layout"][k]))
    return StoredChips(np.stack(chips), np.array(drawn, np.int8), np.array(layouts))


class Encoder:
    """The encoder of a chip network: from chips to the input of its heads.

    Args:
        path: the ONNX file of the chip network.
    """

    def __init__(self, path: Path) -> None:
        model = onnx.load(path)
        name = features_name(model)
        model.graph.output.append(onnx.ValueInfoProto(name=name))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self._name = name
        self._session = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )

    def __call__(self, chips: Chips) -> Features:
        """Compute the features ``[n, f]`` of chips ``[n, 64, 96, 3]``."""
        parts = []
        for start in range(0, len(chips), _BATCH):
            planes = chips[start : start + _BATCH].transpose(0, 3, 1, 2)
            batch = np.ascontiguousarray(planes).astype(np.float32) / np.float32(255)
            (features,) = self._session.run([self._name], {"chips": batch})
            parts.append(features.astype(np.float16))
        return np.concatenate(parts)


def features_name(model: onnx.ModelProto) -> str:
    """Find the tensor that both heads read: the input of the first dense layer."""
    dense = next(node for node in model.graph.node if node.op_type == "Gemm")
    return str(dense.input[0])


def view(chip: Chips, rng: Generator | None) -> Chips:
    """Cut a view ``[64, 96, 3]`` from a stored chip; without a generator, the chip as it is."""
    scale, turn, shift = 1.0, 0.0, np.zeros(2)
    if rng is not None:
        scale = float(np.exp(rng.uniform(-_LOG_SCALE, _LOG_SCALE)))
        turn = float(rng.uniform(-_TURN_DEG, _TURN_DEG))
        shift = rng.uniform(-_SHIFT_PX, _SHIFT_PX, 2)
    side = chip.shape[0]
    matrix = cv2.getRotationMatrix2D((side / 2 - 0.5, side / 2 - 0.5), turn, scale)
    matrix[:, 2] += (CHIP_COLUMNS - side) / 2 + shift[0], (CHIP_ROWS - side) / 2 + shift[1]
    cut = cv2.warpAffine(chip, matrix, (CHIP_COLUMNS, CHIP_ROWS), flags=cv2.INTER_LINEAR)
    if rng is None:
        return np.asarray(cut, np.uint8)
    pixels = cut.astype(np.float64)
    if rng.random() < 0.5:
        pixels = np.asarray(cv2.GaussianBlur(pixels, (0, 0), rng.uniform(*_BLUR_PX)), np.float64)
    gains = np.exp(rng.uniform(-_GAIN, _GAIN) + rng.normal(0, _TINT_SD, 3))
    pixels = pixels * gains + rng.uniform(-_OFFSET, _OFFSET)
    grey = pixels.mean(axis=2, keepdims=True)
    pixels = grey + (pixels - grey) * rng.uniform(0, _SATURATION)
    if rng.random() < 0.6:
        pixels += rng.normal(0, rng.uniform(0, _NOISE), pixels.shape)
    mirrored = pixels[:: rng.choice([-1, 1]), :: rng.choice([-1, 1])]
    return np.clip(np.rint(mirrored), 0, 255).astype(np.uint8)


def features_of(chips: Chips, encoder: Encoder, n_views: int) -> Features:
    """Compute the features ``[n, v, f]`` of stored chips: as they are, then of random views."""
    rng = np.random.default_rng(0)
    views = [encoder(np.stack([view(chip, None) for chip in chips]))]
    for _ in range(n_views - 1):
        views.append(encoder(np.stack([view(chip, rng) for chip in chips])))
    return np.stack(views, axis=1)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("drawn", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=4)
    options = parser.parse_args()
    stored = read_drawn(options.drawn)
    views = features_of(stored.chips, Encoder(options.network), options.views)
    pairs = zip(stored.layouts, stored.drawn, strict=True)
    groups = np.array([f"{layout} {drawn}" for layout, drawn in pairs])
    options.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez(options.out, views=views, drawn=stored.drawn, groups=groups)


if __name__ == "__main__":
    main()
