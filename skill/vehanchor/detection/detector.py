"""Vehicle detection: an ONNX oriented-box model, run over the tiles of an image, to boxes in image pixels.

One decoder reads the bundled model and any YOLOv8, YOLO11 or YOLO26 OBB file that a user exports with Ultralytics:

* raw, ``[1, 4 + nc + 1, anchors]``: a column is cx, cy, w, h, nc scores, angle;
* end to end, ``[1, n, 7]``: a row is cx, cy, w, h, score, class, angle, padded with zeros to n (300 in practice).
"""

from __future__ import annotations

import ast
import base64
import functools
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast, get_args

import cv2
import numpy as np

from vehanchor.detection.boxes import box_corners, canonical_boxes, oriented_nms
from vehanchor.detection.look import CHIP_SHAPE, MAX_CHIPS, FleetLengths, vehicle_chips
from vehanchor.errors import InvalidParameterError, ModelContractError
from vehanchor.imagery.tiles import TILE_OVERLAP, TILE_SIZE_PX, read_reduced_window, tile_grid
from vehanchor.models.session import DEFAULT_PROVIDERS, check_model_file, metadata_number, open_session
from vehanchor.options import NMS_IOU, Aggregation

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import onnxruntime
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, Window

__all__ = [
    "Detections",
    "Detector",
    "DetectorCard",
    "SearchLevel",
    "detect_vehicles",
    "load_detector",
    "search_levels",
]

MIN_SCORE = 0.1  # paper, section III-B
REFERENCE_LENGTH_M = 5.045  # paper, section III-F: KDE mode of the DOTA v1.5 training labels
REFERENCE_LENGTH_SD_M = 0.25  # half of the paper's +-0.5 m sweep, taken as two standard deviations between regions
LENGTH_RANGE_PX = (9.0, 120.0)  # what a DOTA-trained model at 1024 px has seen of small vehicles
SEARCH_FACTORS = (1, 2, 4, 8)  # the image is searched at 1/1, 1/2, 1/4 and 1/8: a third more pixels in all
MIN_LEVEL_SIDE_PX = 96  # a reduced image with a shorter side is not searched: it would hold a car or two
LEVEL_OVERLAP = 1.25  # factor by which the length ranges of two levels overlap: a car at their border is seen by both
_REGION_RATIOS = {"europe": 4.5 / 5.045, "north_america": 5.5 / 5.045}  # paper, section IV-D
_VEHICLE_NAMES = ("small vehicle", "car", "vehicle")  # in this order, the first that the model knows
_DOTA_NAMES = (
    "plane", "ship", "storage tank", "baseball diamond", "tennis court", "basketball court", "ground track field",
    "harbor", "bridge", "large vehicle", "small vehicle", "helicopter", "roundabout", "soccer ball field",
    "swimming pool",
)  # fmt: skip
_PADDING_LEVEL = 114  # the grey that Ultralytics pads with
_ANGLE_LIMIT = 1e4  # a finite, sane angle in radians before it is taken modulo pi


@dataclass(frozen=True)
class DetectorCard:
    """What a detector's file says of itself; foreign models get the paper's values.

    Attributes:
        name: the model's name.
        sha256: of the file.
        class_names: class index to name.
        reference_length_m: ``L_ref``, the length that the modal box of this model stands for.
        reference_length_sd_m: its standard deviation between regions.
        region_lengths_m: reference length by region.
        length_range_px: shortest and longest vehicle, in pixels, that the model was trained on.
        min_length_px: shortest length measured without bias; 0 where nothing is known.
        min_score: detections below it are dropped.
        licence: of the weights, as the file states it.
        search_scales: whether the model is meant to be run at reduced resolutions, too.
        clear_score: score that the best tenth of the cars of any place reaches; 0 where it is not known.
        aggregation: how the lengths of its boxes are best made one.
        fleet_lengths: how the look of the vehicles moves the reference length; None where the file cannot tell fleets
            apart.
    """

    name: str
    sha256: str
    class_names: Mapping[int, str]
    reference_length_m: float
    reference_length_sd_m: float
    region_lengths_m: Mapping[str, float]
    length_range_px: tuple[float, float]
    min_length_px: float
    min_score: float
    licence: str | None
    search_scales: bool = False
    clear_score: float = 0.0
    aggregation: Aggregation = "kde"
    fleet_lengths: FleetLengths | None = None


@dataclass(frozen=True, eq=False)
class Detections:
    """Vehicles found in an image.

    Attributes:
        boxes: ``[n, 5]`` float64 rows ``(x, y, length, width, angle)`` in image pixels and radians, best score first.
        scores: ``[n]`` float64 in [0, 1].
        n_tiles: tiles that were searched.
        n_capped_tiles: tiles in which an end-to-end model had no row left, so that vehicles may be missing.
        scales: ``[n]`` float64, the scale of the image in which each was found: 1, 0.5, 0.25 or 0.125; None stands
            for a search at full resolution alone.
        fleet_log_odds: ``[m]`` float64 of the first m = min(n, 100) vehicles, see ``vehanchor.detection.look``; None
            where the model cannot tell.
    """

    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]
    n_tiles: int = 1
    n_capped_tiles: int = 0
    scales: NDArray[np.float64] | None = None
    fleet_log_odds: NDArray[np.float64] | None = None


class SearchLevel(NamedTuple):
    """One resolution at which an image is searched, and the lengths that count there.

    Attributes:
        factor: the image is reduced by it.
        width_px: columns of the reduced image.
        height_px: its rows.
        shortest_px: shortest vehicle that counts here, in pixels of the reduced image.
        longest_px: longest one.
    """

    factor: int
    width_px: int
    height_px: int
    shortest_px: float
    longest_px: float


def _class_names(metadata: Mapping[str, str]) -> dict[int, str]:
    """``names`` is the repr of a Python dict (or list) in Ultralytics' exports."""
    text = metadata.get("names")
    if not text:
        return {}
    try:
        value = ast.literal_eval(text)
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        return {int(index): str(name) for index, name in pairs}
    except (ValueError, SyntaxError, TypeError):
        raise ModelContractError(f"metadata 'names' is {text[:80]!r}: expected a Python dict of class names") from None


def _canonical_name(name: str) -> str:
    return name.lower().replace("-", " ").replace("_", " ").strip()


def _fleet_lengths(metadata: Mapping[str, str]) -> FleetLengths | None:
    if "vehanchor.fleet" not in metadata:
        return None
    stated = json.loads(metadata["vehanchor.fleet_lengths"])
    (few, many), (short, long) = stated["log_odds"], stated["length_m"]
    lengths = FleetLengths(
        (float(few), float(many)), (float(short), float(long)), float(stated["sd_m"]), float(stated["neutral_vehicles"])
    )
    if not (few < many and min(short, long, lengths.neutral_vehicles) > 0 and lengths.sd_m >= 0):
        raise ValueError(f"fleet_lengths {stated} are in no order")
    return lengths


def _read_card(path: Path, sha256: str, metadata: Mapping[str, str]) -> DetectorCard:
    reference = metadata_number(metadata, "reference_length_m", REFERENCE_LENGTH_M)
    regions = {name: reference * ratio for name, ratio in _REGION_RATIOS.items()}
    range_text = metadata.get("vehanchor.length_range_px")
    try:
        if "vehanchor.region_lengths_m" in metadata:
            regions |= {str(k): float(v) for k, v in json.loads(metadata["vehanchor.region_lengths_m"]).items()}
        shortest, longest = map(float, range_text.split(",")) if range_text else LENGTH_RANGE_PX
        fleet_lengths = _fleet_lengths(metadata)
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ModelContractError(f"{path}: the vehanchor.* metadata cannot be read: {error}") from None
    aggregation = metadata.get("vehanchor.aggregation", "kde")
    if aggregation not in get_args(Aggregation):
        raise ModelContractError(
            f"{path}: metadata 'vehanchor.aggregation' is {aggregation[:80]!r}: expected one of "
            f"{', '.join(get_args(Aggregation))}"
        )
    return DetectorCard(
        name=metadata.get("vehanchor.name", path.stem),
        sha256=sha256,
        class_names=_class_names(metadata),
        reference_length_m=reference,
        reference_length_sd_m=metadata_number(metadata, "reference_length_sd_m", REFERENCE_LENGTH_SD_M),
        region_lengths_m=regions,
        length_range_px=(shortest, longest),
        min_length_px=metadata_number(metadata, "min_length_px", 0.0),
        min_score=metadata_number(metadata, "min_score", MIN_SCORE),
        licence=metadata.get("license"),
        search_scales=metadata_number(metadata, "search_scales", 0.0) > 0,
        clear_score=metadata_number(metadata, "clear_score", 0.0),
        aggregation=cast("Aggregation", aggregation),
        fleet_lengths=fleet_lengths,
    )


class Detector:
    """An oriented-box vehicle detector: an ONNX Runtime session and what its file says of itself.

    Args:
        path: the ONNX file.
        classes: class names (either spelling) or indices that count as vehicles; default "small vehicle", else "car" or
            "vehicle", else a single class whatever its name.
        threads: CPU threads of the session; None leaves it to ONNX Runtime.
        providers: ONNX Runtime execution providers in order of preference.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file is not an oriented-box detector of a known layout.
        ProviderUnavailableError: an execution provider is not installed.
        InvalidParameterError: bad ``threads`` or ``classes``.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        classes: Sequence[str | int] | None = None,
        threads: int | None = None,
        providers: Sequence[str] = DEFAULT_PROVIDERS,
    ) -> None:
        self.path = Path(path)
        check_model_file(self.path)
        content = self.path.read_bytes()
        self._session = open_session(self.path, content=content, threads=threads, providers=providers)
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.card = _read_card(self.path, hashlib.sha256(content).hexdigest(), metadata)
        self._fleet = self._fleet_session(metadata, threads, providers)
        self._input = self._checked_input()
        self._dtype = np.float16 if self._input.type == "tensor(float16)" else np.float32
        batch, _, height, width = (side if isinstance(side, int) else None for side in self._input.shape)
        if batch not in (None, 1):
            raise ModelContractError(
                f"{self.path}: batch size is fixed at {batch}; export with batch=1 or dynamic=True"
            )
        self.fixed_size: tuple[int, int] | None = (height, width) if height and width else None
        self._stride = self._model_stride(metadata)
        self._rows, self._n_classes = self._layout()
        self._classes = self._vehicle_classes(classes)

    def _refuse(self, found: str) -> ModelContractError:
        return ModelContractError(
            f"{self.path} is not an oriented-box detector: {found}. Expected one float input [1, 3, h, w] and an "
            "output [1, 4+classes+1, anchors] or [1, n, 7], as 'yolo export model=yolo11l-obb.pt format=onnx' writes it"
        )

    def _fleet_session(
        self, metadata: Mapping[str, str], threads: int | None, providers: Sequence[str]
    ) -> onnxruntime.InferenceSession | None:
        if "vehanchor.fleet" not in metadata:
            return None
        try:
            content = base64.b64decode(metadata["vehanchor.fleet"], validate=True)
        except ValueError:
            raise ModelContractError(f"{self.path}: metadata 'vehanchor.fleet' is not base64 of an ONNX file") from None
        session = open_session(self.path, content=content, threads=threads, providers=providers)
        names = [each.name for each in (*session.get_inputs(), *session.get_outputs())]
        if names != ["chips", "log_odds"] or session.get_inputs()[0].shape[1:] != [1, *CHIP_SHAPE]:
            raise ModelContractError(
                f"{self.path}: the network in metadata 'vehanchor.fleet' has {', '.join(names)}: expected chips "
                f"[n, 1, {CHIP_SHAPE[0]}, {CHIP_SHAPE[1]}] and log_odds [n]"
            )
        return session

    def _checked_input(self) -> Any:
        inputs = self._session.get_inputs()
        if len(inputs) != 1:
            raise self._refuse(f"it has {len(inputs)} inputs ({', '.join(i.name for i in inputs)})")
        first = inputs[0]
        if first.type not in ("tensor(float)", "tensor(float16)"):
            raise self._refuse(f"input {first.name!r} is {first.type}")
        if len(first.shape) != 4 or (first.shape[1] not in (3, None) and not isinstance(first.shape[1], str)):
            raise self._refuse(f"input {first.name!r} has shape {first.shape}")
        return first

    def _model_stride(self, metadata: Mapping[str, str]) -> int:
        try:
            return max(1, int(float(metadata.get("stride", "32"))))
        except ValueError:
            raise self._refuse(f"metadata 'stride' is {metadata['stride']!r}") from None

    def _layout(self) -> tuple[bool, int]:
        """Whether the output is end-to-end rows, and the number of classes; a blank probe where shapes are symbolic."""
        shape = list(self._session.get_outputs()[0].shape)
        known = len(self.card.class_names)
        if len(shape) != 3 or not all(isinstance(side, int) for side in shape[1:]):
            height, width = self.fixed_size or (self._stride * 4, self._stride * 4)
            try:
                shape = list(self._run(np.zeros((1, 3, height, width), dtype=self._dtype)).shape)
            except Exception as error:  # whatever ONNX Runtime raises: the graph does not take an image
                raise self._refuse(f"it fails on a blank {width} x {height} image ({error})") from None
        if len(shape) != 3:
            raise self._refuse(f"its output has shape {shape}")
        if shape[1] == known + 5 and known:
            return False, known
        if shape[2] == 7:
            return True, known
        if not known and 6 <= shape[1] < shape[2]:
            return False, shape[1] - 5
        raise self._refuse(f"its output has shape {shape}, with {known} class names in the metadata")

    def _vehicle_classes(self, wanted: Sequence[str | int] | None) -> NDArray[np.intp]:
        names = {index: _canonical_name(name) for index, name in self.card.class_names.items()}
        if not names and self._n_classes == len(_DOTA_NAMES):
            names = dict(enumerate(_DOTA_NAMES))
        if wanted is not None:
            chosen = [i for w in wanted for i in self._indices_of(w, names)]
            return np.unique(np.array(chosen, dtype=np.intp))
        for name in _VEHICLE_NAMES:
            matching = [index for index, known in names.items() if known == name]
            if matching:
                return np.array(matching, dtype=np.intp)
        if len(names) == 1 or self._n_classes == 1:
            return np.array([next(iter(names), 0)], dtype=np.intp)
        listed = ", ".join(self.card.class_names.values()) or "no names"
        raise ModelContractError(
            f"{self.path}: no class is a small vehicle (it has {listed}); name the classes to use with classes=[...]"
        )

    def _indices_of(self, wanted: str | int, names: Mapping[int, str]) -> list[int]:
        if isinstance(wanted, int):
            known = wanted in names if names else wanted >= 0 and (wanted < self._n_classes or self._rows)
            found = [wanted] if known else []
        else:
            found = [index for index, name in names.items() if name == _canonical_name(wanted)]
        if not found:
            raise InvalidParameterError(
                f"class {wanted!r} is not in the model; it has {dict(names) or self._n_classes}"
            )
        return found

    def _run(self, batch: NDArray[Any], run_options: onnxruntime.RunOptions | None = None) -> NDArray[Any]:
        return np.asarray(self._session.run(None, {self._input.name: batch}, run_options)[0])

    def _prepared(self, tile: NDArray[np.uint8]) -> NDArray[Any]:
        """``[h, w, 3]`` uint8 to the model's ``[1, 3, H, W]`` in 0..1, padded right and below."""
        height, width = tile.shape[:2]
        if self.fixed_size:
            full_h, full_w = self.fixed_size
        else:
            full_h, full_w = (-(-side // self._stride) * self._stride for side in (height, width))
        if (full_h, full_w) != (height, width):
            padded = np.full((full_h, full_w, 3), _PADDING_LEVEL, dtype=np.uint8)
            padded[:height, :width] = tile
            tile = padded
        batch = np.empty((1, 3, full_h, full_w), dtype=self._dtype)
        for plane, channel in zip(batch[0], cv2.split(tile), strict=True):
            np.multiply(channel, np.float32(1 / 255), out=plane, casting="unsafe")
        return batch

    def detect_tile(
        self, tile: NDArray[np.uint8], min_score: float, run_options: onnxruntime.RunOptions | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], bool]:
        """Detect vehicles in one tile, before non-maximum suppression.

        Args:
            tile: ``[h, w, 3]`` uint8 RGB, no larger than the model's input where that is fixed.
            min_score: detections below it are dropped.
            run_options: of ONNX Runtime; setting their ``terminate`` from another thread ends a run within a layer.

        Returns:
            ``[n, 5]`` canonical boxes in tile pixels, ``[n]`` scores, and whether the model's rows ran out.
        """
        output = self._run(self._prepared(tile), run_options)[0]
        capped = False
        if self._rows:
            table = output.astype(np.float64)
            wanted = (table[:, 4] >= max(min_score, 1e-9)) & np.isin(table[:, 5].astype(np.intp), self._classes)
            capped = bool(len(table) and (table[:, 4] > 0).all())
            boxes, scores = table[wanted][:, [0, 1, 2, 3, 6]], table[wanted, 4]
        else:
            class_scores = output[4 + self._classes]
            best = class_scores[0] if len(class_scores) == 1 else class_scores.max(axis=0)
            wanted = np.flatnonzero(best >= min_score)
            boxes = output[:, wanted][[0, 1, 2, 3, -1]].T.astype(np.float64)
            scores = best[wanted].astype(np.float64)
        sane = np.isfinite(boxes).all(axis=1) & (boxes[:, 2:4] > 0).all(axis=1) & (np.abs(boxes[:, 4]) < _ANGLE_LIMIT)
        height, width = tile.shape[:2]
        sane &= (boxes[:, 0] >= 0) & (boxes[:, 0] <= width) & (boxes[:, 1] >= 0) & (boxes[:, 1] <= height)
        return canonical_boxes(boxes[sane]), np.clip(scores[sane], 0.0, 1.0), capped

    def fleet_log_odds(self, raster: Raster, boxes: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Log odds that vehicles are of North America's fleet, from their look alone.

        Args:
            raster: the image.
            boxes: ``[n, 5]`` in image pixels, best first.

        Returns:
            ``[m]`` of the first m = min(n, 100); None where the model's file cannot tell.
        """
        if self._fleet is None:
            return None
        if len(boxes) == 0:
            return np.zeros(0)
        chips = vehicle_chips(raster, boxes[:MAX_CHIPS])
        return np.asarray(self._fleet.run(["log_odds"], {"chips": chips})[0], dtype=np.float64)


@functools.lru_cache(maxsize=4)
def load_detector(
    path: Path, *, threads: int | None = None, providers: tuple[str, ...] = DEFAULT_PROVIDERS
) -> Detector:
    """Open a detector once per path, thread count and providers; see ``Detector``."""
    return Detector(path, threads=threads, providers=providers)


def search_levels(
    width_px: int, height_px: int, length_range_px: tuple[float, float], *, search_scales: bool
) -> list[SearchLevel]:
    """The resolutions at which an image is searched, finest first.

    A vehicle is measured at the finest level at which it is not longer than what the model was trained on: there it has
    the most pixels. So each coarser level counts the lengths from half of that limit up, less an overlap: a fleet at
    the border of two levels is cut off by neither, and boxes of one vehicle found twice are merged by the non-maximum
    suppression. The finest level has no lower and the coarsest no upper limit.

    Args:
        width_px: of the image.
        height_px: of the image.
        length_range_px: shortest and longest vehicle that the model was trained on.
        search_scales: False gives full resolution alone.

    Returns:
        Levels whose shorter side has at least 96 px; always full resolution.
    """
    longest = length_range_px[1]
    shortest = longest / 2 / LEVEL_OVERLAP
    factors = [
        factor
        for factor in SEARCH_FACTORS
        if factor == 1 or (search_scales and min(width_px, height_px) // factor >= MIN_LEVEL_SIDE_PX)
    ]
    return [
        SearchLevel(
            factor,
            width_px // factor,
            height_px // factor,
            0.0 if factor == 1 else shortest,
            np.inf if factor == factors[-1] else longest,
        )
        for factor in factors
    ]


def _cut_by_tile(boxes: NDArray[np.float64], tile: Window, level: SearchLevel, overlap_px: int) -> NDArray[np.bool_]:
    """Boxes cut by a tile's inner edge, which the next tile sees whole: their length is not the vehicle's."""
    corners = box_corners(boxes)
    low, high = corners.min(axis=1), corners.max(axis=1)
    over = np.zeros(len(boxes), dtype=bool)
    if tile.x_px > 0:
        over |= low[:, 0] < 1
    if tile.y_px > 0:
        over |= low[:, 1] < 1
    if tile.x_px + tile.width_px < level.width_px:
        over |= high[:, 0] > tile.width_px - 1
    if tile.y_px + tile.height_px < level.height_px:
        over |= high[:, 1] > tile.height_px - 1
    return over & (boxes[:, 2] < overlap_px)


def detect_vehicles(
    raster: Raster,
    detector: Detector,
    *,
    min_score: float | None = None,
    tile_px: int | None = None,
    stride_px: int | None = None,
    nms_iou: float = NMS_IOU,
    search_scales: bool | None = None,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> Detections:
    """Search an image tile by tile, at one or more resolutions, and merge the results (paper, section III-B).

    Args:
        raster: the image; only one tile of it is held at a time.
        detector: the model.
        min_score: lowest detection score; default the model's own, 0.1 for foreign models.
        tile_px: side of the tiles; default 1024, or the model's input where that is fixed.
        stride_px: step between tiles; default three quarters of ``tile_px``.
        nms_iou: IoU above which the lower-scored of two boxes is dropped.
        search_scales: whether to search reduced copies of the image, too (see ``search_levels``); default the model's
            own, False for foreign models.
        progress: called with (tiles done, tiles in all); an exception it raises ends the search.
        run_options: see ``Detector.detect_tile``.

    Returns:
        Boxes in image pixels after oriented non-maximum suppression.

    Raises:
        InvalidParameterError: a tile larger than the model's fixed input, a stride beyond the tile.
    """
    if tile_px is None:
        tile_px = min(detector.fixed_size) if detector.fixed_size else TILE_SIZE_PX
    if detector.fixed_size and tile_px > min(detector.fixed_size):
        raise InvalidParameterError(f"tile_px is {tile_px}, but the model's input is fixed at {detector.fixed_size}")
    stride = round(tile_px * (1 - TILE_OVERLAP)) if stride_px is None else stride_px
    if tile_px < 32 or not 1 <= stride <= tile_px:
        raise InvalidParameterError(f"tile_px {tile_px}, stride_px {stride}: use a tile >= 32 and a stride within it")
    card = detector.card
    threshold = card.min_score if min_score is None else min_score
    wide = card.search_scales if search_scales is None else search_scales
    levels = search_levels(raster.width_px, raster.height_px, card.length_range_px, search_scales=wide)
    visits = [
        (level, tile)
        for level in levels
        for tile in tile_grid(level.width_px, level.height_px, tile_px=tile_px, stride_px=stride)
    ]
    boxes, scores, scales, n_capped = [np.zeros((0, 5))], [np.zeros(0)], [np.zeros(0)], 0
    for done, (level, tile) in enumerate(visits):
        if progress:
            progress(done, len(visits))
        pixels = read_reduced_window(raster, tile, level.factor)
        local, score, capped = detector.detect_tile(pixels, threshold, run_options)
        n_capped += capped
        counted = (local[:, 2] >= level.shortest_px) & (local[:, 2] <= level.longest_px)
        counted &= ~_cut_by_tile(local, tile, level, tile_px - stride)
        local[:, :2] += tile.x_px, tile.y_px
        local[:, :4] *= level.factor
        boxes.append(local[counted])
        scores.append(score[counted])
        scales.append(np.full(np.count_nonzero(counted), 1 / level.factor))
    if progress:
        progress(len(visits), len(visits))
    found, found_scores, found_scales = np.concatenate(boxes), np.concatenate(scores), np.concatenate(scales)
    kept = oriented_nms(found, found_scores, iou_threshold=nms_iou)
    found = found[kept]
    return Detections(
        found,
        found_scores[kept],
        len(visits),
        n_capped,
        found_scales[kept] if wide else None,
        detector.fleet_log_odds(raster, found),
    )
