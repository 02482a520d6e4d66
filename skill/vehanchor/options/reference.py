"""The option group ``Reference``: source of the reference length."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field

from vehanchor.errors import InvalidParameterError
from vehanchor.options.models import CALIBRATION
from vehanchor.options.option import Limits, Option, group
from vehanchor.scale.defaults import LARGEST_VEHICLE_M, LEAST_VEHICLE_M, REGIONS

if TYPE_CHECKING:
    from vehanchor.scale.calibration import Calibration
else:
    Calibration = Any  # imported on first use


def _read(calibration: Any) -> Any:
    """Read a calibration from its file."""
    if calibration is None:
        return None
    from vehanchor.scale.calibration import as_calibration

    return as_calibration(calibration)


@group(frozen=True)
class Reference:
    """Source of the reference length ``L_ref``: one of these or, by default, the appearance of the vehicles.

    Attributes:
        reference_length_m: the fleet's modal vehicle length, 2 to 20 metres.
        region: use the model's reference length for a region (bundled: ``vehanchor.scale.defaults.REGIONS``), or that
            of a country by its ISO 3166-1 alpha-2 code (``vehanchor.scale.countries``).
        calibration: use the reference length measured for this fleet and detector (see ``load_calibration``); a path
            is read at once.

    Raises:
        InvalidParameterError: two are given, or the length is not a number from 2 to 20.
        CalibrationFileError: the calibration cannot be read.
    """

    panel: ClassVar[str] = "Reference length"

    reference_length_m: Annotated[
        Annotated[float, Limits(LEAST_VEHICLE_M, LARGEST_VEHICLE_M, unit="m")] | None,
        Option(
            "Known length of local cars, metres; not with a region. Default: the model's.",
            metavar="M",
            tools="all",
            listed=False,
        ),
    ] = None
    region: Annotated[
        Annotated[str, Field(max_length=64)] | None,
        Option(
            f"Country (ISO code, as FR) or region, if known: {', '.join(REGIONS)}.",
            metavar="NAME",
            first=True,
            tools="all",
        ),
    ] = None
    calibration: Annotated[Calibration | None, BeforeValidator(_read), CALIBRATION] = None

    def __post_init__(self) -> None:
        given = [each.name for each in fields(self) if getattr(self, each.name) is not None]
        if len(given) > 1:
            raise InvalidParameterError(f"give {' or '.join(given)}, not both: each sets the reference length")
