"""Checksum of all networks that stand behind a result."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from vehanchor.models.files import models_sha256, read_model
from vehanchor.models.zoo import COURTS, SCENE_SCALE

if TYPE_CHECKING:
    from vehanchor.detection.card import DetectorCard


def networks_sha256(card: DetectorCard) -> str:
    """SHA-256 of the detector and of its auxiliary, scene-scale and court networks.

    A result is stale once one of them has changed.
    """
    digest = hashlib.sha256()
    for checksum in (card.sha256, card.verifier_sha256, card.chips_sha256):
        digest.update(f"{checksum}\n".encode())
    for path in (SCENE_SCALE, COURTS):
        digest.update(models_sha256(read_model(path)).encode())
    return digest.hexdigest()
