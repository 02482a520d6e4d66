"""The layouts in which detectors put out oriented boxes, one class each, told by the shapes of their outputs.

=============  ==============================  =========================================================================
contract       output                          exported by
=============  ==============================  =========================================================================
``raw``        ``[1, 4+classes+1, anchors]``   Ultralytics (YOLOv8, YOLO11 OBB), and the bundled detector
``end_to_end`` ``[1, n, 7]``                   Ultralytics with ``nms=True``, or YOLO26 OBB
=============  ==============================  =========================================================================

A new one is a file with a subclass of ``DetectorContract``, and a place in ``CONTRACTS``.
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
    """The contract that a model keeps.

    Args:
        shapes: of its outputs for one image.
        named_classes: indices of the classes that its metadata names; may be none.

    Returns:
        The first of ``CONTRACTS`` that recognises the shapes.

    Raises:
        ModelContractError: none does.
    """
    for kind in CONTRACTS:
        contract = kind.recognise(shapes, named_classes)
        if contract is not None:
            return contract
    raise ModelContractError(
        f"its outputs have shapes {', '.join(str(list(shape)) for shape in shapes)}, with {len(named_classes)} class "
        f"names in the metadata; expected {' or '.join(kind.layout for kind in CONTRACTS)}"
    )
