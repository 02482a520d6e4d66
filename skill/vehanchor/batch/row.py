"""One image's row: its estimate, or why there is none; and the columns that a table has for it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict

from vehanchor.records import ConfidenceTerms, GsdEstimate, SceneScaleEstimate
from vehanchor.rulers.registry import ruler_kinds

if TYPE_CHECKING:
    from vehanchor.errors import VehAnchorError

# The only fields of an estimate that are no single value.
_NESTED = ("confidence_terms", "frame", "rulers", "scale", "scene_scale", "tilt", "warnings")
_OF_TILT = ("tilt_deg", "gsd_least_m_per_px", "gsd_largest_m_per_px")


class BatchRow(BaseModel):
    """The outcome for one image.

    Attributes:
        file: the image, as the caller named it.
        estimate: null where the image could not be read.
        error_code: stable code of the error; null where there is an estimate.
        error: what was wrong and what to do.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    file: str
    estimate: GsdEstimate | None = None
    error_code: str | None = None
    error: str | None = None

    @classmethod
    def failed(cls, file: str, error: VehAnchorError) -> BatchRow:
        """The row of an image that could not be read."""
        return cls(file=file, error_code=error.code, error=str(error))

    def flat(self) -> dict[str, Any]:
        """The row's values by column; all those of the estimate are null where there is none."""
        values: dict[str, Any] = dict.fromkeys(COLUMNS)
        if self.estimate is not None:
            values.update(self.estimate.model_dump(exclude=set(_NESTED)))
            for name, term in self.estimate.confidence_terms.model_dump().items():
                values[f"confidence_{name}"] = term
            if self.estimate.scene_scale is not None:
                for name, value in self.estimate.scene_scale.model_dump().items():
                    values[f"scene_{name}"] = value
            if self.estimate.tilt is not None:
                values.update(self.estimate.tilt.model_dump(include=set(_OF_TILT)))
            for ruler in self.estimate.rulers:
                values[f"ruler_{ruler.kind}_gsd_m_per_px"] = ruler.gsd_m_per_px
                values[f"ruler_{ruler.kind}_agrees"] = ruler.agrees
            values["warning_codes"] = " ".join(notice.code for notice in self.estimate.warnings)
        return {**values, "file": self.file, "error_code": self.error_code, "error": self.error}


def _columns() -> dict[str, type]:
    """Columns and their types: an estimate's fields under their own names, those of its parts under prefixed ones."""
    estimate = {
        name: _kind(field.annotation) for name, field in GsdEstimate.model_fields.items() if name not in _NESTED
    }
    terms: dict[str, type] = dict.fromkeys((f"confidence_{name}" for name in ConfidenceTerms.model_fields), float)
    scene: dict[str, type] = dict.fromkeys((f"scene_{name}" for name in SceneScaleEstimate.model_fields), float)
    tilt: dict[str, type] = dict.fromkeys(_OF_TILT, float)
    rulers: dict[str, type] = {}
    for kind in ruler_kinds():
        rulers |= {f"ruler_{kind}_gsd_m_per_px": float, f"ruler_{kind}_agrees": bool}
    return {
        "file": str,
        **estimate,
        **terms,
        **scene,
        **tilt,
        **rulers,
        "warning_codes": str,
        "error_code": str,
        "error": str,
    }


def _kind(annotation: Any) -> type:
    """The type that a field has where it is not null."""
    if get_origin(annotation) is Literal:
        return str
    if isinstance(annotation, type):
        return annotation
    (kind,) = (option for option in get_args(annotation) if option is not type(None))
    return _kind(kind)


COLUMNS = _columns()
