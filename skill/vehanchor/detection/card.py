"""Model cards: validated metadata of model files; for other detectors the paper's values are the defaults."""

from __future__ import annotations

import ast
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from vehanchor.errors import ModelContractError
from vehanchor.scale.defaults import LARGEST_VEHICLE_M, LEAST_VEHICLE_M, Aggregation
from vehanchor.scale.votes import Votes

MIN_SCORE = 0.1  # paper, section III-B
REFERENCE_LENGTH_M = 5.045  # paper, section III-F: KDE mode of the DOTA v1.5 training labels
REFERENCE_LENGTH_SD_M = 0.25  # the paper's +-0.5 m sweep taken as two standard deviations between regions
LENGTH_RANGE_PX = (9.0, 120.0)  # small vehicles in DOTA's training tiles of 1024 px
_REGION_RATIOS = {"europe": 4.5 / 5.045, "north_america": 5.5 / 5.045}  # paper, section IV-D
_STRIDE_PX = 32  # of every YOLO's coarsest layer
_MAX_LENGTH_PX = 1024.0  # side of a tile
_MAX_TEXT = 1 << 20  # characters of one entry; a thousand class names take a fiftieth
_MAX_STRIDE_PX = 1024  # side of a tile; input sides are padded to whole strides

_VehicleLength = Annotated[float, Field(ge=LEAST_VEHICLE_M, le=LARGEST_VEHICLE_M)]
_VehicleSpread = Annotated[float, Field(ge=0, le=LARGEST_VEHICLE_M)]
_LengthPx = Annotated[float, Field(gt=0, le=_MAX_LENGTH_PX)]
_NotNegative = Annotated[float, Field(ge=0)]
_LeastLengthPx = Annotated[float, Field(ge=0, le=_MAX_LENGTH_PX)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Weight = Annotated[float, Field(ge=0, le=1000)]
_ClassIndex = Annotated[int, Field(ge=0)]


class _Card(BaseModel):
    """Frozen record of finite numbers, validated without conversion."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


_CardT = TypeVar("_CardT", bound=_Card)


class BodyLengths(_Card):
    """Lengths of cars' bodies, bumper to bumper.

    Attributes:
        reference_length_m: usual modal length, metres.
        reference_length_sd_m: standard deviation between regions, metres.
        region_lengths_m: modal length by region, metres.
    """

    reference_length_m: _VehicleLength
    reference_length_sd_m: _VehicleSpread
    region_lengths_m: dict[str, _VehicleLength]


class DetectorCard(_Card):
    """Model card of a detector.

    Attributes:
        name: the model's name.
        sha256: checksum of the file.
        class_names: class index to name.
        reference_length_m: ``L_ref``, length in metres that corresponds to the model's modal box.
        reference_length_sd_m: standard deviation of the reference length between regions.
        region_lengths_m: reference length by region.
        length_range_px: shortest and longest vehicle in the training data, pixels.
        min_length_px: shortest length measured without bias; 0 if unknown.
        min_score: detections with a lower score are dropped.
        licence: licence of the weights, from the file.
        search_scales: whether the model should also run at reduced resolutions.
        aggregation: default rule for the modal length.
        stride_px: the sides of the input are multiples of it.
        bodies: lengths of cars' bodies; None without a chip network, when the lengths are those of boxes.
        verifier_sha256: checksum of the verifier's file; None without one. With a verifier, ``min_score`` is the
            verifier's.
        chips_sha256: checksum of the chip network's file; None without one.
        votes: calibration of the boxes' votes; None if it was never fitted, as for other people's models.
    """

    name: str
    sha256: str
    class_names: dict[_ClassIndex, str]
    reference_length_m: _VehicleLength
    reference_length_sd_m: _VehicleSpread
    region_lengths_m: dict[str, _VehicleLength]
    length_range_px: tuple[_LengthPx, _LengthPx]
    min_length_px: _LeastLengthPx
    min_score: _Share
    licence: str | None
    search_scales: bool = False
    aggregation: Aggregation = "kde"
    stride_px: Annotated[int, Field(ge=1, le=_MAX_STRIDE_PX)] = _STRIDE_PX
    bodies: BodyLengths | None = None
    verifier_sha256: str | None = None
    chips_sha256: str | None = None
    votes: Votes | None = None

    @field_validator("length_range_px")
    @classmethod
    def _rising(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] >= value[1]:
            raise ValueError("expected the shortest length before the longest")
        return value


class AuxiliaryCard(_Card):
    """Model card of an auxiliary model.

    Attributes:
        sha256: checksum of the file.
        detector: name of the only detector for which the model is calibrated.
    """

    sha256: str
    detector: str


_AuxiliaryCardT = TypeVar("_AuxiliaryCardT", bound=AuxiliaryCard)


class VerifierCard(AuxiliaryCard):
    """Model card of a verifier.

    Attributes:
        weights: terms of the combined score's logit: weight of the detector's logit, weight of the verifier's logit,
            bias, and weight of the size odds (0 if it is missing).
        least_score: detections with at least this detector score are candidates.
        min_score: candidates with a lower combined score are dropped.
    """

    weights: tuple[_Weight, _Weight, float] | tuple[_Weight, _Weight, float, _Weight]
    least_score: _Share
    min_score: _Share


class ChipCard(AuxiliaryCard):
    """Model card of a chip network.

    Attributes:
        weights: terms of the combined score's logit: weight of the search's logit, weight of the chip network's logit,
            and bias. The search's logit includes the size odds.
        least_score: detections with at least this score of the search are candidates.
        bodies: lengths of cars' bodies.
    """

    weights: tuple[_Weight, _Weight, float]
    least_score: _Share
    bodies: BodyLengths


def _class_names(text: str) -> dict[int, str]:
    """Read names by index from the repr of a Python dict or list, as Ultralytics writes it."""
    value = ast.literal_eval(text) if text else {}
    if not isinstance(value, (dict, list, tuple)):
        raise TypeError(f"a {type(value).__name__}")
    return {int(index): str(name) for index, name in (value.items() if isinstance(value, dict) else enumerate(value))}


def _switch(text: str) -> bool:
    return {0.0: False, 1.0: True}[float(text)]


def _whole(text: str) -> int:
    number = float(text)
    if number != int(number):
        raise ValueError("not whole")
    return int(number)


def _range(text: str) -> tuple[float, ...]:
    return tuple(map(float, text.split(",")))


def _region_lengths(text: str) -> dict[str, Any]:
    return dict(json.loads(text).items())


def _bodies(text: str) -> BodyLengths:
    return BodyLengths(**json.loads(text))


def _votes(text: str) -> Votes:
    stated = json.loads(text)
    return Votes(float(stated["share_at_zero"]), float(stated["share_slope"]))


# Python's parsers raise MemoryError or RecursionError for too many brackets.
_UNREADABLE = (
    ValueError,
    SyntaxError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RecursionError,
    MemoryError,
)

# Field -> key of the metadata, function that reads its text, and description of the expected text.
_Entry = tuple[str, Callable[[str], Any], str]
_DETECTOR_ENTRIES: dict[str, _Entry] = {
    "name": ("vehanchor.name", str, "a name"),
    "class_names": ("names", _class_names, "a Python dict of class names"),
    "reference_length_m": ("vehanchor.reference_length_m", float, "a number > 0"),
    "reference_length_sd_m": ("vehanchor.reference_length_sd_m", float, "a number >= 0"),
    "region_lengths_m": ("vehanchor.region_lengths_m", _region_lengths, "a JSON object of lengths"),
    "length_range_px": ("vehanchor.length_range_px", _range, "two numbers, 'shortest,longest'"),
    "min_length_px": ("vehanchor.min_length_px", float, "a number >= 0"),
    "min_score": ("vehanchor.min_score", float, "a number from 0 to 1"),
    "licence": ("license", str, "a name"),
    "search_scales": ("vehanchor.search_scales", _switch, "0 or 1"),
    "aggregation": ("vehanchor.aggregation", str, "a name"),
    "stride_px": ("stride", _whole, "a whole number >= 1"),
    "votes": ("vehanchor.votes", _votes, "a JSON object of the fields of Votes"),
}
_FOR_DETECTOR: dict[str, _Entry] = {"detector": ("vehanchor.detector", str, "a detector's name")}
_VERIFIER_ENTRIES: dict[str, _Entry] = {
    **_FOR_DETECTOR,
    "weights": ("vehanchor.weights", _range, "three or four numbers, 'detector,verifier,bias,size'"),
    "least_score": ("vehanchor.least_score", float, "a number from 0 to 1"),
    "min_score": ("vehanchor.min_score", float, "a number from 0 to 1"),
}
_CHIP_ENTRIES: dict[str, _Entry] = {
    **_FOR_DETECTOR,
    "weights": ("vehanchor.weights", _range, "three numbers, 'search,chips,bias'"),
    "least_score": ("vehanchor.least_score", float, "a number from 0 to 1"),
    "bodies": (
        "vehanchor.bodies",
        _bodies,
        f"a JSON object of {', '.join(BodyLengths.model_fields)}: lengths of {LEAST_VEHICLE_M:g} to "
        f"{LARGEST_VEHICLE_M:g} m",
    ),
}
_AUXILIARY_ENTRIES: dict[type[AuxiliaryCard], dict[str, _Entry]] = {
    VerifierCard: _VERIFIER_ENTRIES,
    ChipCard: _CHIP_ENTRIES,
}


def _read_entries(path: Path, metadata: Mapping[str, str], entries: Mapping[str, _Entry]) -> dict[str, Any]:
    """Read the fields whose keys are in the metadata."""
    values = {}
    for field, (key, read, expected) in entries.items():
        if key in metadata:
            try:
                if len(metadata[key]) > _MAX_TEXT:
                    raise ValueError("too long")
                values[field] = read(metadata[key])
            except _UNREADABLE:
                raise ModelContractError(
                    f"{path}: metadata {key!r} is {metadata[key][:80]!r}: expected {expected}"
                ) from None
    return values


def _validated(
    kind: type[_CardT],
    path: Path,
    metadata: Mapping[str, str],
    entries: Mapping[str, _Entry],
    values: Mapping[str, Any],
) -> _CardT:
    try:
        return kind(**values)
    except ValidationError as error:
        first = error.errors()[0]
        key, _, expected = entries[str(first["loc"][0])]
        if key not in metadata:
            raise ModelContractError(f"{path} has no metadata {key!r}: expected {expected}") from None
        raise ModelContractError(f"{path}: metadata {key!r} is {metadata[key][:80]!r}: {first['msg']}") from None


def read_detector_card(
    path: Path,
    sha256: str,
    metadata: Mapping[str, str],
    verifier: VerifierCard | None = None,
    chips: ChipCard | None = None,
) -> DetectorCard:
    """Read the model card of a detector.

    Args:
        path: path of the file; its stem is the name of a model whose metadata have none.
        sha256: checksum of the file.
        metadata: metadata of the file.
        verifier: card of the verifier; None without one.
        chips: card of the chip network; None without one.

    Returns:
        The card, with the paper's values for missing entries.

    Raises:
        ModelContractError: an entry is invalid, or an auxiliary model belongs to another detector.
    """
    values: dict[str, Any] = {
        "name": path.stem,
        "class_names": {},
        "reference_length_m": REFERENCE_LENGTH_M,
        "reference_length_sd_m": REFERENCE_LENGTH_SD_M,
        "length_range_px": LENGTH_RANGE_PX,
        "min_length_px": 0.0,
        "min_score": MIN_SCORE,
        "licence": None,
        **_read_entries(path, metadata, _DETECTOR_ENTRIES),
    }
    lengths = {name: values["reference_length_m"] * ratio for name, ratio in _REGION_RATIOS.items()}
    regions = {name: length for name, length in lengths.items() if LEAST_VEHICLE_M <= length <= LARGEST_VEHICLE_M}
    values["region_lengths_m"] = regions | values.get("region_lengths_m", {})
    for network, kind in ((verifier, "verifier"), (chips, "chip network")):
        if network is not None and network.detector != values["name"]:
            raise ModelContractError(
                f"the {kind} of {path} was made for the detector {network.detector!r}, and this is "
                f"{values['name']!r}: remove its file, or state this name in its metadata 'vehanchor.detector'"
            )
    if verifier is not None:
        values |= {"min_score": verifier.min_score, "verifier_sha256": verifier.sha256}
    if chips is not None:
        values |= {"bodies": chips.bodies, "chips_sha256": chips.sha256}
    return _validated(DetectorCard, path, metadata, _DETECTOR_ENTRIES, {**values, "sha256": sha256})


def read_auxiliary_card(
    kind: type[_AuxiliaryCardT], path: Path, sha256: str, metadata: Mapping[str, str]
) -> _AuxiliaryCardT:
    """Read the model card of an auxiliary model.

    Args:
        kind: type of the card.
        path: path of the file.
        sha256: checksum of the file.
        metadata: metadata of the file.

    Returns:
        The card.

    Raises:
        ModelContractError: an entry is missing or invalid.
    """
    entries = _AUXILIARY_ENTRIES[kind]
    return _validated(kind, path, metadata, entries, _read_entries(path, metadata, entries) | {"sha256": sha256})
