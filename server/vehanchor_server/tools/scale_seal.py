"""Seal of the scales that callers give back.

A caller can raise the confidence of a scale before giving it back. With a deployment key the server signs each scale:
the signature follows the image's id after a dot. A scale without a valid one counts as an assumed fact.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from vehanchor.records import KnownScale
from vehanchor_server.settings import SettingsError

if TYPE_CHECKING:
    from pathlib import Path

MIN_KEY_BYTES = 32
_DIGITS = 32  # of the signature, hexadecimal
_ASSUMED_RELIABILITY = 0.85  # an assumed length is taken to be wrong with a chance of 0.15
_TOLERANCE = 1.2  # of the confidence: the chance of an error within 20 %
_Z95 = 1.959964
_FIELDS = {"gsd_m_per_px", "confidence", "image_id", "model_id"}


def read_key(path: Path) -> bytes:
    """Read a deployment key.

    Raises:
        SettingsError: the file is unreadable or the key is short.
    """
    try:
        key = path.read_bytes().strip()
    except OSError as error:
        raise SettingsError(f"scale key file {path} cannot be read: {error.strerror}") from None
    if len(key) < MIN_KEY_BYTES:
        raise SettingsError(
            f"scale key file {path}: give at least {MIN_KEY_BYTES} bytes: openssl rand -hex 32 > {path}"
        )
    return key


@dataclass(frozen=True)
class ScaleSeal:
    """Signer and verifier of scales.

    Attributes:
        key: the deployment's key; None signs nothing.
    """

    key: bytes | None = None

    def sealed(self, value: Any) -> Any:
        """Sign every scale in a JSON value."""
        if self.key is None:
            return value
        if isinstance(value, list):
            return [self.sealed(each) for each in value]
        if not isinstance(value, dict):
            return value
        inner = {name: self.sealed(each) for name, each in value.items()}
        if inner.keys() >= _FIELDS:
            inner["image_id"] = f"{inner['image_id']}.{self._signature(inner)}"
        return inner

    def opened(self, scale: KnownScale | None) -> KnownScale | None:
        """Return a scale without its signature; without a valid one, with the confidence of an assumed fact."""
        if scale is None:
            return None
        image_id, _, signature = scale.image_id.partition(".")
        plain = scale.model_copy(update={"image_id": image_id})
        if self.key is not None and hmac.compare_digest(
            signature.encode("utf-8", "surrogatepass"), self._signature(plain.model_dump(mode="json")).encode()
        ):
            return plain
        return plain.model_copy(update={"confidence": min(plain.confidence, assumed_confidence(plain))})

    def _signature(self, scale: dict[str, Any]) -> str:
        try:
            values = KnownScale.model_validate(scale).model_dump(mode="json")
        except ValidationError:  # a compromised worker sent it
            return ""
        assert self.key is not None
        text = json.dumps(values, sort_keys=True, separators=(",", ":")).encode()
        return hmac.new(self.key, text, hashlib.sha256).hexdigest()[:_DIGITS]


def assumed_confidence(scale: KnownScale) -> float:
    """Compute the chance of an error within 20 % by the interval alone, for a scale that nobody vouches for."""
    low, high = scale.gsd_ci95_low_m_per_px, scale.gsd_ci95_high_m_per_px
    if not 0 < low < high:
        return _ASSUMED_RELIABILITY
    log_sd = math.log(high / low) / (2 * _Z95)
    return _ASSUMED_RELIABILITY * math.erf(math.log(_TOLERANCE) / (log_sd * math.sqrt(2)))
