"""Search of one tile: the detector's proposals, scored again by the verifier."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from vehanchor.detection.merging import objects_in_image
from vehanchor.detection.scheduler import position_sample

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from vehanchor.detection.detections import Objects
    from vehanchor.detection.detector import Detector, PreparedTile, TileDetections
    from vehanchor.detection.levels import SearchLevel
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.detection.verifier import Verifier
    from vehanchor.imagery.raster import Window


class Tile(NamedTuple):
    """Tile of one level; its window is in pixels of the level's image."""

    level: SearchLevel
    window: Window


class MinScores(NamedTuple):
    """Lowest scores for each stage; a weak score can pass, because the next network may raise it.

    Attributes:
        proposal: lowest score of the detector; lower ones do not reach the verifier.
        candidate: lowest score of the verifier; lower ones do not reach the chip network.
        vehicle: lowest score of a vehicle.
    """

    proposal: float
    candidate: float
    vehicle: float


class TileSearch:
    """Detection in one tile: the detector's proposals, scored again by the verifier.

    Args:
        detector: the detector.
        verifier: the verifier; None without one.
        prior: scene-scale prior; None without one.
        min_scores: lowest scores.
        overlap_px: overlap of neighbouring tiles.

    Attributes:
        n_skipped: number of candidates that were left out before the verifier.
    """

    def __init__(
        self,
        detector: Detector,
        verifier: Verifier | None,
        prior: SceneScalePrior | None,
        min_scores: MinScores,
        overlap_px: int,
    ) -> None:
        self._detector = detector
        self._verifier = verifier
        self._prior = prior
        self._min_scores = min_scores
        self._overlap_px = overlap_px
        self.n_skipped = 0

    def detect(
        self, prepared: PreparedTile, tile: Tile, max_verified: int | None
    ) -> TileDetections:
        """Detect vehicles and other objects in a tile.

        Args:
            prepared: the tile as the detector takes it.
            tile: its level and window.
            max_verified: number of candidates at which the verifier scores a sample; None for all.

        Returns:
            Objects in pixels of the image, which overlap the objects of other tiles.
        """
        level, window = tile
        detections = self._detector.detect_tile(prepared, self._min_scores.proposal)
        others = detections.others
        others = others.take(others.scores >= self._min_scores.vehicle)
        # The range of lengths applies to vehicles only.
        vehicles = detections.vehicles
        lengths_px = vehicles.boxes[:, 2]
        vehicles = vehicles.take(level.accepts(lengths_px))
        if self._verifier:
            if max_verified is not None:
                vehicles = self._sample(vehicles, max_verified)
            size_odds = self._size_odds(vehicles, level)
            vehicles = self._verifier.scored(prepared.pixels, vehicles, size_odds=size_odds)
        vehicles = vehicles.take(vehicles.scores >= self._min_scores.candidate)
        return detections._replace(
            vehicles=objects_in_image(vehicles, window, level, self._overlap_px),
            others=objects_in_image(others, window, level, self._overlap_px),
        )

    def _sample(self, vehicles: Objects, max_verified: int) -> Objects:
        """Select the candidates that the verifier scores, and count the others."""
        sample = vehicles.take(position_sample(vehicles.boxes, max_verified))
        self.n_skipped += len(vehicles) - len(sample)
        return sample

    def _size_odds(self, vehicles: Objects, level: SearchLevel) -> ArrayLike:
        """Compute how well the lengths of candidates fit cars; 0 without a prior."""
        if self._prior is None:
            return 0.0
        lengths_px = vehicles.boxes[:, 2] * level.factor
        return self._prior.size_odds(lengths_px)
