"""Output layouts of oriented-box detectors, one class each, recognised by the shapes of the outputs.

=============  ==============================  =========================================================================
contract       output                          exported by
=============  ==============================  =========================================================================
``raw``        ``[1, 4+classes+1, anchors]``   Ultralytics (YOLOv8, YOLO11 OBB), and the bundled detector
``end_to_end`` ``[1, n, 7]``                   Ultralytics with ``nms=True``, or YOLO26 OBB
=============  ==============================  =========================================================================

To add one, write a file with a subclass of ``DetectorContract`` and add the class to ``CONTRACTS``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.detection.contracts.contract import DetectorContract
from vehanchor.detection.contracts.end_to_end import EndToEnd
from vehanchor.detection.contracts.raw import Raw
from vehanchor.errors import ModelContractError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

__all__ = ["CONTRACTS", "DetectorContract", "recognise_contract"]

CONTRACTS: tuple[type[DetectorContract], ...] = (Raw, EndToEnd)


def recognise_contract(shapes: Sequence[tuple[int, ...]], named_classes: Collection[int]) -> DetectorContract:
    """Recognise the contract of a model.

    Args:
        shapes: shapes of its outputs for one image.
        named_classes: indices of the classes that its metadata names; may be empty.

    Returns:
        The first of ``CONTRACTS`` that recognises the shapes.

    Raises:
        ModelContractError: no contract recognises the shapes.
    """
    for kind in CONTRACTS:
        contract = kind.recognise(shapes, named_classes)
        if contract is not None:
            return contract
    raise ModelContractError(
        f"its outputs have shapes {', '.join(str(list(shape)) for shape in shapes)}, with {len(named_classes)} class "
        f"names in the metadata; expected {' or '.join(kind.layout for kind in CONTRACTS)}"
    )
