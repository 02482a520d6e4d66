"""The option group ``Reference``: source of the reference length."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, ClassVar

from vehanchor.errors import InvalidParameterError
from vehanchor.options.models import CALIBRATION
from vehanchor.options.option import Limits, Text, check_fields, metadata_of, option, set_frozen
from vehanchor.scale.defaults import LARGEST_VEHICLE_M, LEAST_VEHICLE_M, REGIONS

if TYPE_CHECKING:
    from vehanchor.scale.calibration import Calibration


@dataclass(frozen=True)
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

    reference_length_m: float | None = field(
        default=None,
        metadata=option(
            "Known length of local cars, metres; not with a region. Default: the model's.",
            Limits(LEAST_VEHICLE_M, LARGEST_VEHICLE_M),
            metavar="M",
        ),
    )
    region: str | None = field(
        default=None,
        metadata=option(
            f"Country (ISO code, as FR) or region, if known: {', '.join(REGIONS)}.",
            Text(),
            metavar="NAME",
            first=True,
        ),
    )
    calibration: Calibration | None = field(default=None, metadata=metadata_of(CALIBRATION))

    def __post_init__(self) -> None:
        given = [each.name for each in fields(self) if getattr(self, each.name) is not None]
        if len(given) > 1:
            raise InvalidParameterError(f"give {' or '.join(given)}, not both: each sets the reference length")
        check_fields(self)
        if self.calibration is not None:
            from vehanchor.scale.calibration import as_calibration

            set_frozen(self, "calibration", as_calibration(self.calibration))
