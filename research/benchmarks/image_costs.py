"""Measure what hostile images cost against their size.

``python -m research.benchmarks.image_costs``. Prints Markdown; ``--record`` keeps it.

Each image is opened and a window of it read in a process of its own, at a size and at four times that size. Time and
memory may grow in proportion to what was sent, or to what the limits allow to be decoded, never faster.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from research.results.record import add_record_option, recording
from tests.image_costs import FAMILIES, Cost, cost, grows_too_fast

__all__ = ["main"]

_MIB = 1 << 20


def measure(families: list[str], folder: Path) -> list[str]:
    """Print what each family costs; return those that grow too fast."""
    print("| image | size | file, MiB | s | MiB | answer |\n|---|---|---|---|---|---|")
    failed = []
    for name in families:
        family = FAMILIES[name]
        costs: list[Cost] = []
        for size in (family.size, 4 * family.size):
            data = family.make(size)
            costs.append(cost(data, folder))
            shown = f"{costs[-1].seconds:.2f} | {costs[-1].mebibytes:.0f} | {costs[-1].answer}"
            print(f"| {name} | {size} {family.unit} | {len(data) / _MIB:.2f} | {shown} |", flush=True)
        if grows_too_fast(costs[0], costs[1]):
            failed.append(name)
    return failed


def main() -> int:
    """Measure all families, or those named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("families", nargs="*", default=list(FAMILIES))
    parser.add_argument("--folder", type=Path, default=Path())
    asked = add_record_option(parser).parse_args()
    with recording("server", ["image_costs"], asked.record):
        failed = measure(asked.families, asked.folder)
    if failed:
        print(f"grows faster than its size: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
