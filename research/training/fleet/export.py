"""Export the network that estimates the lengths of fleets.

``python -m research.training.fleet.export RUN OUT.onnx --detector vehicles``.

What its answers mean was measured with one detector's boxes: the file states which, and that detector alone takes it.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path

from research.training.onnx_file import LICENCE, write_metadata


def export_fleet(run: Path, out: Path, detector: str) -> None:
    """Write a calibrated run as one ONNX file, to lie beside the detector's as ``<stem>.fleet.onnx``.

    Args:
        run: of ``train.py``, with the ``fleet_lengths.json`` of ``calibrate.py``.
        out: the file.
        detector: name of the detector with which the run was calibrated.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(run / "fleet.onnx", out)
    metadata = {
        "description": "VehAnchor network that estimates the length of a fleet of cars from their appearance",
        "author": "VehAnchor",
        "license": LICENCE,
        "vehanchor.detector": detector,
        "vehanchor.fleet_lengths": json.dumps(json.loads((run / "fleet_lengths.json").read_text())),
    }
    write_metadata(out, metadata)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--detector", required=True, help="name of the detector with which the run was calibrated")
    options = parser.parse_args()
    export_fleet(options.run, options.out, options.detector)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
