"""Write the detector in eight bits.

``python -m research.training.detector.quantise MODEL.onnx OUT.onnx``.

Static quantisation after training: every convolution but the last ones of the two heads, weights a
scale a channel, activations by what crops of train images (never of the held-out tenth, never of
val) make of them. The weights have seven bits, so that every processor's sums are exact: x86
without dot products of bytes adds two products in 16 bits.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import onnx

from research.training.detector.data import is_dev
from research.training.eight_bits import write_eight_bits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_CROP_PX = 256
_QUANTISED = ("Conv", "Add", "Relu", "Resize")
_HEADS = ("heat_head", "shape_head")


def crops(vehicles: Path, count: int, seed: int = 0) -> Iterator[NDArray[np.float32]]:
    """Draw crops ``[1, 3, 256, 256]`` in 0..1; sets by the root of their size, scales 1 to 1/4."""
    with (vehicles / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == "train"]
    rows = [row for row in rows if not is_dev(row["file"], row["set"])]
    sets = sorted({row["set"] for row in rows})
    by_set = {name: [row["file"] for row in rows if row["set"] == name] for name in sets}
    share = np.sqrt([len(by_set[name]) for name in sets])
    rng = np.random.default_rng(seed)
    for _ in range(count):
        files = by_set[sets[rng.choice(len(sets), p=share / share.sum())]]
        file = vehicles / files[rng.integers(len(files))]
        image = np.asarray(cv2.imread(str(file)), np.uint8)
        drawn_factor = float(np.exp(rng.uniform(0, np.log(4))))
        factor = min(drawn_factor, min(image.shape[:2]) / _CROP_PX)
        if factor > 1:
            image = np.asarray(
                cv2.resize(image, None, fx=1 / factor, fy=1 / factor, interpolation=cv2.INTER_AREA)
            )
        down, right = (max(0, _CROP_PX - side) for side in image.shape[:2])
        image = np.pad(image, [(0, down), (0, right), (0, 0)], "symmetric")
        top, left = (int(rng.integers(side - _CROP_PX + 1)) for side in image.shape[:2])
        pixels = image[top : top + _CROP_PX, left : left + _CROP_PX, ::-1]
        yield np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], np.float32) / np.float32(255)


def quantised_nodes(model: onnx.ModelProto) -> list[str]:
    """List the nodes that get 8 bits: all but the last convolutions of the network's heads."""
    nodes = [
        node
        for node in model.graph.node
        if node.name.startswith("/network/") and node.op_type in _QUANTISED
    ]
    last = {
        max(k for k, node in enumerate(nodes) if head in node.name and node.op_type == "Conv")
        for head in _HEADS
    }
    return [node.name for k, node in enumerate(nodes) if k not in last]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--crops", type=int, default=96)
    arguments = parser.parse_args()
    batches = list(crops(arguments.data / "vehicles", arguments.crops))
    write_eight_bits(
        arguments.model, arguments.out, batches=batches, nodes=quantised_nodes, metadata={}
    )
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
