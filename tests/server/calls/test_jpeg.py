from __future__ import annotations

import cv2
import numpy as np

from vehanchor_server.calls.jpeg import MAX_PAGE_BYTES, MAX_PICTURE_BYTES, small_jpeg


def test_noise_is_squeezed_until_no_host_cuts_the_result() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (800, 1600, 3), dtype=np.uint8)
    for most, side_px in (
        (MAX_PICTURE_BYTES, 1568),
        (MAX_PAGE_BYTES, 1568),
        (MAX_PICTURE_BYTES, 300),
    ):
        jpeg = small_jpeg(noise, most, side_px)
        decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        assert len(jpeg) <= most
        assert max(decoded.shape) <= side_px
