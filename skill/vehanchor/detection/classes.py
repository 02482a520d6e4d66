"""Classes of a detector that count as vehicles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import InvalidParameterError, ModelContractError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

_VEHICLE_NAMES = ("small vehicle", "car", "vehicle")  # the first that the model has is used
_DOTA_NAMES = (
    "plane", "ship", "storage tank", "baseball diamond", "tennis court", "basketball court", "ground track field",
    "harbor", "bridge", "large vehicle", "small vehicle", "helicopter", "roundabout", "soccer ball field",
    "swimming pool",
)  # fmt: skip


def vehicle_classes(
    class_names: Mapping[int, str], n_classes: int | None, wanted: Sequence[str | int] | None = None
) -> NDArray[np.intp]:
    """Find the indices of the classes that count as vehicles.

    Args:
        class_names: class index to name, from the model's file; fifteen classes without names are taken as DOTA's.
        n_classes: number of classes of the model; None if its outputs do not show it.
        wanted: names (in either spelling) or indices; None takes "small vehicle", else "car" or "vehicle", else the
            only class under any name.

    Returns:
        ``[n]`` int, n >= 1, rising.

    Raises:
        InvalidParameterError: the model lacks a wanted class, or ``wanted`` is empty.
        ModelContractError: ``wanted`` is None, and no class of the model is a vehicle.
    """
    names = {index: _canonical_name(name) for index, name in class_names.items()}
    if not names and n_classes == len(_DOTA_NAMES):
        names = dict(enumerate(_DOTA_NAMES))
    if wanted is not None:
        if not wanted:
            raise InvalidParameterError("classes is empty: name at least one, or leave it out")
        return np.unique(np.array([i for each in wanted for i in _indices_of(each, names, n_classes)], dtype=np.intp))
    for name in _VEHICLE_NAMES:
        matching = [index for index, known in names.items() if known == name]
        if matching:
            return np.unique(np.array(matching, dtype=np.intp))
    if len(names) == 1 or n_classes == 1:
        return np.array([next(iter(names), 0)], dtype=np.intp)
    listed = ", ".join(class_names.values()) or "no names"
    raise ModelContractError(
        f"no class is a small vehicle (it has {listed}); name the classes to use with classes=[...]"
    )


def _canonical_name(name: str) -> str:
    return name.lower().replace("-", " ").replace("_", " ").strip()


def _indices_of(wanted: str | int, names: Mapping[int, str], n_classes: int | None) -> list[int]:
    if isinstance(wanted, int):
        known = wanted in names if names else wanted >= 0 and (n_classes is None or wanted < n_classes)
        found = [wanted] if known else []
    else:
        found = [index for index, name in names.items() if name == _canonical_name(wanted)]
    if not found:
        raise InvalidParameterError(
            f"class {wanted!r} is not in the model; it has {dict(names) or f'{n_classes or 0} without names'}"
        )
    return found
