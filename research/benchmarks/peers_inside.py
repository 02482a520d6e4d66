"""Run one tool inside the peers' own environment, for ``peers.py``.

``python peers_inside.py TOOL MODEL TILES IMAGE``.

IMAGE may be several files. Nothing of this project is imported here, and nothing here by this
project: ultralytics is under the AGPL. Each line printed is JSON of an image: seconds, CPU seconds,
peak memory, boxes, tiles.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

TILE_PX = 1024
OVERLAP_PX = 256
# Least score of the bundled file.
MIN_SCORE = 0.35
NMS_IOU = 0.45

Counts = tuple[int, int]
"""Boxes and tiles."""


def _bare(model: str, image: Any, tiles: list[tuple[int, int]]) -> Callable[[], Counts]:
    import numpy as np
    import onnxruntime

    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    inputs = []
    for x, y in tiles:
        tile = image[y : y + TILE_PX, x : x + TILE_PX, ::-1]
        channels = tile.transpose(2, 0, 1)[None]
        inputs.append(np.ascontiguousarray(channels, np.float32) / 255)
    session.run(None, {"images": inputs[0]})

    def run() -> Counts:
        outputs = [session.run(None, {"images": tile})[0] for tile in inputs]
        n_boxes = sum(int((output[0, 4] >= MIN_SCORE).sum()) for output in outputs)
        return n_boxes, len(inputs)

    return run


def _ultralytics(model: str, image: Any, tiles: list[tuple[int, int]]) -> Callable[[], Counts]:
    predict = _predictor(model)
    predict(image[:TILE_PX, :TILE_PX])

    def run() -> Counts:
        results = [predict(image[y : y + TILE_PX, x : x + TILE_PX]) for x, y in tiles]
        return sum(len(result.obb) for result in results), len(tiles)

    return run


def _predictor(model: str) -> Callable[[Any], Any]:
    from ultralytics import YOLO

    network = YOLO(model, task="obb")

    def predict(tile: Any) -> Any:
        settings = {"imgsz": TILE_PX, "conf": MIN_SCORE, "iou": NMS_IOU, "max_det": 3000}
        return network.predict(tile, device="cpu", verbose=False, **settings)[0]

    return predict


def _sahi(model: str, image: Any, _tiles: Any) -> Callable[[], Counts]:
    from sahi import AutoDetectionModel
    from sahi.predict import get_sliced_prediction
    from sahi.slicing import get_slice_bboxes

    network = AutoDetectionModel.from_pretrained(
        "ultralytics",
        model_path=model,
        confidence_threshold=MIN_SCORE,
        device="cpu",
        image_size=TILE_PX,
    )
    share = OVERLAP_PX / TILE_PX
    height, width = image.shape[:2]
    n_slices = len(get_slice_bboxes(height, width, TILE_PX, TILE_PX, False, share, share))

    def sliced(pixels: Any) -> Any:
        return get_sliced_prediction(
            pixels, network, slice_height=TILE_PX, slice_width=TILE_PX, overlap_height_ratio=share,
            overlap_width_ratio=share, perform_standard_pred=False,
            postprocess_match_threshold=NMS_IOU, verbose=0,
        )  # fmt: skip

    rgb = image[:, :, ::-1].copy()
    sliced(rgb[:TILE_PX, :TILE_PX])

    def run() -> Counts:
        return len(sliced(rgb).object_prediction_list), n_slices

    return run


def _supervision(model: str, image: Any, _tiles: Any) -> Callable[[], Counts]:
    import supervision

    predict = _predictor(model)
    n_tiles = 0

    def callback(tile: Any) -> Any:
        nonlocal n_tiles
        n_tiles += 1
        return supervision.Detections.from_ultralytics(predict(tile))

    slicer = supervision.InferenceSlicer(
        callback,
        slice_wh=(TILE_PX, TILE_PX),
        overlap_wh=(OVERLAP_PX, OVERLAP_PX),
        iou_threshold=NMS_IOU,
    )
    slicer(image[:TILE_PX, :TILE_PX])

    def run() -> Counts:
        nonlocal n_tiles
        n_tiles = 0
        n_boxes = len(slicer(image))
        return n_boxes, n_tiles

    return run


def main() -> None:
    """Command line."""
    tool = sys.argv[1]
    import cv2

    model, tiles, *images = sys.argv[2:]
    makers: dict[str, Callable[..., Callable[[], Counts]]] = {
        "ONNX Runtime alone": _bare,
        "ultralytics, tile by tile, no merge": _ultralytics,
        "SAHI": _sahi,
        "supervision": _supervision,
    }
    for image in images:
        run = makers[tool](model, cv2.imread(image), json.loads(Path(tiles).read_text()))
        wall = time.perf_counter()
        cpu = time.process_time()
        n_boxes, n_tiles = run()
        spent = {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
        status = Path("/proc/self/status").read_text().splitlines()
        peak_kib = next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))
        print(
            json.dumps(
                {**spent, "peak_mib": peak_kib / 1024, "n_boxes": n_boxes, "n_tiles": n_tiles}
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
