"""Tiles of a size in metres for SAHI and supervision, and the areas of supervision's masks.

Run python tiles_in_metres.py IMAGE METRES, such as 40. Prints one JSON object.
"""

import json
import sys

try:
    import numpy as np
    import supervision as sv
    from sahi.slicing import get_slice_bboxes

    import vehanchor
except ModuleNotFoundError as missing:
    sys.exit(
        f"this example needs the package {missing.name!r}: "
        "pip install -r tiles_in_metres.requirements.txt, and pip install . in a clone"
    )


def main(image: str, tile_m: float) -> None:
    """Cut the image into tiles of so many metres a side."""
    estimate = vehanchor.estimate_gsd(image)
    if estimate.status != "ok":
        sys.exit(f"{image}: the scale is not usable ({estimate.reason})")
    tile_px = round(tile_m * estimate.pixels_per_meter)
    width_px = estimate.image_width_px
    height_px = estimate.image_height_px
    # SAHI: get_sliced_prediction takes the same slice_height and slice_width.
    slices = get_slice_bboxes(
        image_height=height_px,
        image_width=width_px,
        slice_height=tile_px,
        slice_width=tile_px,
        overlap_height_ratio=0,
        overlap_width_ratio=0,
    )

    # supervision: the model of the callback sees tiles of that size. This one finds everything.
    def callback(tile: np.ndarray) -> sv.Detections:
        height, width = tile.shape[:2]
        box = np.array([[0, 0, width, height]], dtype=float)
        return sv.Detections(xyxy=box, mask=np.ones((1, height, width), dtype=bool))

    slicer = sv.InferenceSlicer(
        callback=callback,
        slice_wh=(tile_px, tile_px),
        overlap_wh=(0, 0),
        overlap_filter=sv.OverlapFilter.NONE,
    )
    pixels = np.zeros((height_px, width_px, 3), dtype=np.uint8)
    detections = slicer(pixels)
    records = vehanchor.measure_areas(image, detections, scale=estimate.scale)
    answer = {
        "tile_px": tile_px,
        "sahi_slices": len(slices),
        "supervision_tiles": len(detections),
        "areas_m2": [record.area_m2 for record in records],
    }
    print(json.dumps(answer))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
