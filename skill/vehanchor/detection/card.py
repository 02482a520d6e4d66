"""The card of a model: what its file says of itself, checked at the door; foreign detectors get the paper's values."""

from __future__ import annotations

import ast
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from vehanchor.detection.appearance import FleetLengths
from vehanchor.errors import ModelContractError
from vehanchor.scale.defaults import LARGEST_VEHICLE_M, LEAST_VEHICLE_M, Aggregation
from vehanchor.scale.fusion import Votes

MIN_SCORE = 0.1  # paper, section III-B
REFERENCE_LENGTH_M = 5.045  # paper, section III-F: KDE mode of the DOTA v1.5 training labels
REFERENCE_LENGTH_SD_M = 0.25  # half of the paper's +-0.5 m sweep, taken as two standard deviations between regions
LENGTH_RANGE_PX = (9.0, 120.0)  # what a DOTA-trained model at 1024 px has seen of small vehicles
_REGION_RATIOS = {"europe": 4.5 / 5.045, "north_america": 5.5 / 5.045}  # paper, section IV-D
_STRIDE_PX = 32  # of every YOLO's coarsest layer
_MAX_LENGTH_PX = 1024.0  # a tile
_MAX_TEXT = 1 << 20  # characters of one entry; a thousand class names take a fiftieth
_MAX_STRIDE_PX = 1024  # a tile: input sides are padded to whole strides

_VehicleLength = Annotated[float, Field(ge=LEAST_VEHICLE_M, le=LARGEST_VEHICLE_M)]
_VehicleSpread = Annotated[float, Field(ge=0, le=LARGEST_VEHICLE_M)]
_LengthPx = Annotated[float, Field(gt=0, le=_MAX_LENGTH_PX)]
_NotNegative = Annotated[float, Field(ge=0)]
_LeastLengthPx = Annotated[float, Field(ge=0, le=_MAX_LENGTH_PX)]
_Share = Annotated[float, Field(ge=0, le=1)]
_Weight = Annotated[float, Field(ge=0, le=1000)]
_ClassIndex = Annotated[int, Field(ge=0)]


class _Card(BaseModel):
    """A frozen record of finite numbers, nothing converted on the way in."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


_CardT = TypeVar("_CardT", bound=_Card)


class DetectorCard(_Card):
    """What a detector's file says of itself.

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
        stride_px: the sides of its input are multiples of it.
        fleet_lengths: how the look of the vehicles moves the reference length; None where no network beside the
            detector can tell fleets apart.
        fleet_sha256: of the file of that network.
        verifier_sha256: of the file of the network beside the detector that judges its candidates once more, whose
            ``min_score`` and ``clear_score`` then stand here; None without one.
        votes: what its boxes tell of the scale together; None where that was never fitted, as for foreign models.
        quantised_from: name of the detector that this one is in fewer bits: the networks beside that one serve it, too.
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
    clear_score: _Share = 0.0
    aggregation: Aggregation = "kde"
    stride_px: Annotated[int, Field(ge=1, le=_MAX_STRIDE_PX)] = _STRIDE_PX
    fleet_lengths: FleetLengths | None = None
    fleet_sha256: str | None = None
    verifier_sha256: str | None = None
    votes: Votes | None = None
    quantised_from: str | None = None

    @field_validator("votes")
    @classmethod
    def _votes_in_range(cls, value: Votes | None) -> Votes | None:
        if value is not None and not (
            min(value.log_sd, value.clutter_density, value.sharpness) > 0
            and 0 < value.trust <= 1
            and 0 < value.chance_wrong < 1
        ):
            raise ValueError("expected log_sd, clutter_density and certainty > 0, trust and chance_wrong in 0..1")
        return value

    @field_validator("length_range_px")
    @classmethod
    def _rising(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] >= value[1]:
            raise ValueError("expected the shortest length before the longest")
        return value


class AuxiliaryCard(_Card):
    """What the file of a network beside a detector says of itself.

    Attributes:
        sha256: of the file.
        detector: name of the detector for which its numbers were measured: they hold for no other.
    """

    sha256: str
    detector: str


_CompanionT = TypeVar("_CompanionT", bound=AuxiliaryCard)


class FleetCard(AuxiliaryCard):
    """What the file of a network that tells fleets apart says of itself.

    Attributes:
        lengths: how what it says of vehicles becomes a reference length.
    """

    lengths: FleetLengths

    @field_validator("lengths")
    @classmethod
    def _in_order(cls, value: FleetLengths) -> FleetLengths:
        short, long = value.log_lengths
        if not (short < long and value.neutral_vehicles > 0 and value.sd_m >= 0):
            raise ValueError("expected rising log_lengths, length_m and neutral_vehicles > 0, and sd_m >= 0")
        if not (LEAST_VEHICLE_M <= min(value.length_m) <= max(value.length_m) <= LARGEST_VEHICLE_M >= value.sd_m):
            raise ValueError(f"expected length_m, {LEAST_VEHICLE_M:g} to {LARGEST_VEHICLE_M:g} m, and sd_m no longer")
        return value


class VerifierCard(AuxiliaryCard):
    """What the file of a network that judges a detector's candidates once more says of itself.

    Attributes:
        weights: of the detector's logit, of its own, what is added, and that of how well a candidate's size fits the
            ground (0 where it is not stated): together the logit of the combined score.
        least_score: candidates are what the detector gives at least this score.
        min_score: combined scores below it are dropped.
        clear_score: combined score that the best tenth of the cars of any place reaches; 0 where it is not known.
    """

    weights: tuple[_Weight, _Weight, float] | tuple[_Weight, _Weight, float, _Weight]
    least_score: _Share
    min_score: _Share
    clear_score: _Share = 0.0


def _class_names(text: str) -> dict[int, str]:
    """Names by index, from the repr of a Python dict or list, as Ultralytics writes it."""
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


def _fleet_lengths(text: str) -> FleetLengths:
    stated: dict[str, Any] = dict(json.loads(text).items())
    (low, high), (short, long) = stated.pop("log_lengths"), stated.pop("length_m")
    return FleetLengths((low, high), (short, long), **stated)


def _votes(text: str) -> Votes:
    return Votes(**{name: float(value) for name, value in json.loads(text).items()})


# MemoryError and RecursionError: what Python's parsers say of too many brackets.
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

# Field -> the key of the metadata, how its text is read, and what a text that cannot be read should have been.
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
    "clear_score": ("vehanchor.clear_score", float, "a number from 0 to 1"),
    "aggregation": ("vehanchor.aggregation", str, "a name"),
    "stride_px": ("stride", _whole, "a whole number >= 1"),
    "votes": ("vehanchor.votes", _votes, "a JSON object of the fields of Votes"),
    "quantised_from": ("vehanchor.quantised_from", str, "a detector's name"),
}
_FOR_DETECTOR: dict[str, _Entry] = {"detector": ("vehanchor.detector", str, "a detector's name")}
_SECOND_LOOK_ENTRIES: dict[str, _Entry] = {
    **_FOR_DETECTOR,
    "weights": ("vehanchor.weights", _range, "three or four numbers, 'detector,look,bias,size'"),
    "least_score": ("vehanchor.least_score", float, "a number from 0 to 1"),
    "min_score": ("vehanchor.min_score", float, "a number from 0 to 1"),
    "clear_score": ("vehanchor.clear_score", float, "a number from 0 to 1"),
}
_FLEET_ENTRIES: dict[str, _Entry] = {
    **_FOR_DETECTOR,
    "lengths": (
        "vehanchor.fleet_lengths",
        _fleet_lengths,
        "a JSON object of log_lengths, length_m, sd_m and neutral_vehicles",
    ),
}
_COMPANION_ENTRIES: dict[type[AuxiliaryCard], dict[str, _Entry]] = {
    FleetCard: _FLEET_ENTRIES,
    VerifierCard: _SECOND_LOOK_ENTRIES,
}


def _stated(path: Path, metadata: Mapping[str, str], entries: Mapping[str, _Entry]) -> dict[str, Any]:
    """The values of the fields whose keys the metadata has."""
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


def _checked(
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
    fleet: FleetCard | None = None,
    verifier: VerifierCard | None = None,
) -> DetectorCard:
    """The card of a detector's file.

    Args:
        path: of the file, whose stem names the model where its metadata does not.
        sha256: of the file.
        metadata: of the file.
        fleet: card of the network beside the detector that tells fleets apart.
        verifier: card of the network beside it that judges its candidates once more.

    Returns:
        The card, with the paper's values for what the metadata leaves out.

    Raises:
        ModelContractError: an entry has no meaning; or a network beside was made for another detector.
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
        **_stated(path, metadata, _DETECTOR_ENTRIES),
    }
    lengths = {name: values["reference_length_m"] * ratio for name, ratio in _REGION_RATIOS.items()}
    regions = {name: length for name, length in lengths.items() if LEAST_VEHICLE_M <= length <= LARGEST_VEHICLE_M}
    values["region_lengths_m"] = regions | values.get("region_lengths_m", {})
    for network, kind in ((fleet, "fleet network"), (verifier, "second look")):
        if network is not None and network.detector not in (values["name"], values.get("quantised_from")):
            raise ModelContractError(
                f"the {kind} of {path} was made for the detector {network.detector!r}, and this is "
                f"{values['name']!r}: remove its file, or state this name in its metadata 'vehanchor.detector'"
            )
    if fleet is not None:
        values |= {"fleet_lengths": fleet.lengths, "fleet_sha256": fleet.sha256}
    if verifier is not None:
        values |= {"min_score": verifier.min_score, "clear_score": verifier.clear_score}
        values |= {"verifier_sha256": verifier.sha256}
    return _checked(DetectorCard, path, metadata, _DETECTOR_ENTRIES, {**values, "sha256": sha256})


def read_auxiliary_card(kind: type[_CompanionT], path: Path, sha256: str, metadata: Mapping[str, str]) -> _CompanionT:
    """The card of a network beside a detector.

    Args:
        kind: which network's.
        path: of the file.
        sha256: of the file.
        metadata: of the file.

    Returns:
        The card.

    Raises:
        ModelContractError: an entry is missing, or has no meaning.
    """
    entries = _COMPANION_ENTRIES[kind]
    return _checked(kind, path, metadata, entries, _stated(path, metadata, entries) | {"sha256": sha256})
