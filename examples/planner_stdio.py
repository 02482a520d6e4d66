"""Plan a landing: launch the VehAnchor server, measure candidate zones, and decide by the record.

    python examples/planner_stdio.py examples/scenes/safe.jpg --zone 255 160 535 470

The planner works without a language model, so that its rules are explicit. Planners with a model
need the same rules:

1. Never decide on a scale whose ``status`` is not ``ok``. Try the next ruler; without one, hold
   altitude.
2. A zone fits only if the craft with its margin fits with a high probability: ``must_fit`` and
   ``fit_probability``, never an estimated size.
3. Log the reason of every decision on stderr; print the decision as one JSON object on stdout.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

try:
    from mcp import Client, StdioServerParameters
    from mcp.client.stdio import stdio_client
except ModuleNotFoundError as missing:
    sys.exit(f"this example needs the package {missing.name!r}: pip install .")

# What the craft can do, by the record's reason against its scale.
REMEDIES = {
    "too_coarse": "fly lower",
    "too_few": "climb, or fly to a street, and take another image",
    "no_photograph": "take a photograph from above",
    "oblique": "look straight down, and take another image",
    "not_cars": "use another ruler",
    "disagree": "use another ruler",
    "imprecise": "give the region or a known length",
    "assumed": "give a measured length or height",
}

# As often as a usable scale is right: 9 of 10.
MIN_PROBABILITY = 0.9

log = logging.getLogger("planner")


class Action(StrEnum):
    """Next action of the craft."""

    LAND = "land"
    NEXT_ZONE = "next_zone"
    HOLD_ALTITUDE = "hold_altitude"


@dataclass(frozen=True)
class Craft:
    """The craft that lands."""

    diameter_m: float
    margin_m: float
    min_probability: float = MIN_PROBABILITY

    @property
    def needed_m(self) -> float:
        """Diameter of the free circle: the craft and the margin on both sides."""
        return self.diameter_m + 2 * self.margin_m


@dataclass(frozen=True)
class Zone:
    """Candidate zone of the perception stack: a box in image pixels."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float


@dataclass(frozen=True)
class Ruler:
    """Source of a scale: the vehicles in the image, or a measured scale, used as +- 10 %."""

    name: str
    gsd_m_per_px: float | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of ``measure_area`` for a measured scale; none for the vehicles."""
        if self.gsd_m_per_px is None:
            return {}
        return {"gsd_m_per_px": self.gsd_m_per_px, "gsd_basis": "measured"}


@dataclass(frozen=True)
class Decision:
    """Action with its reason and the measurements behind it."""

    action: Action
    reason: str
    ruler: str | None = None
    zone: Zone | None = None
    needed_m: float | None = None
    fit_probability: float | None = None
    center_x_px: float | None = None
    center_y_px: float | None = None


def decide_zone(record: dict[str, Any], ruler: Ruler, zone: Zone, craft: Craft) -> Decision:
    """Decide on one zone by a record of ``measure_area``.

    The decision is HOLD_ALTITUDE if the ruler is not usable.
    """
    if record["status"] == "no_scale":
        reason = f"no scale from {ruler.name}"
        return Decision(Action.HOLD_ALTITUDE, reason, ruler=ruler.name, zone=zone)
    # Only an unusable scale has a reason.
    if "reason" in record:
        reason = (
            f"the scale from {ruler.name} is not ok (confidence "
            f"{record['scale_confidence']:.2f}): {record['reason']}; {REMEDIES[record['reason']]}"
        )
        return Decision(Action.HOLD_ALTITUDE, reason, ruler=ruler.name, zone=zone)
    if record["status"] != "ok":
        reason = "the zone's outline is uncertain"
        return Decision(Action.NEXT_ZONE, reason, ruler=ruler.name, zone=zone)
    fit = record["fit"]
    fits = (
        f"a circle of {craft.needed_m:.1f} m fits by {ruler.name} with probability "
        f"{fit['fit_probability']:.2f}, {craft.min_probability:.2f} needed"
    )
    if fit["fit_probability"] < craft.min_probability:
        action = Action.NEXT_ZONE
        reason = f"too small: {fits}"
    else:
        action = Action.LAND
        reason = fits
    # A zone without room for any circle has no centre.
    center = fit.get("center", {})
    return Decision(
        action,
        reason,
        ruler=ruler.name,
        zone=zone,
        needed_m=craft.needed_m,
        fit_probability=fit["fit_probability"],
        center_x_px=center.get("x_px"),
        center_y_px=center.get("y_px"),
    )


async def decide(
    client: Client,
    image: Path,
    *,
    zones: Sequence[Zone],
    rulers: Sequence[Ruler],
    craft: Craft,
    region: str | None = None,
) -> Decision:
    """Try the zones with each ruler until one allows a landing."""
    decision = Decision(Action.HOLD_ALTITUDE, "no zone was given")
    for number, ruler in enumerate(rulers):
        if number > 0:
            log.info("trying the next ruler: %s", ruler.name)
        for zone in zones:
            arguments = measure_arguments(image, zone, ruler, craft=craft, region=region)
            result = await client.call_tool("measure_area", arguments)
            if result.is_error:
                # The text of an error is "code: problem. remedy".
                message = " ".join(getattr(part, "text", "") for part in result.content)
                reason = f"the measurement failed: {message}"
                return Decision(Action.HOLD_ALTITUDE, reason, ruler=ruler.name, zone=zone)
            decision = decide_zone(result.structured_content or {}, ruler, zone, craft)
            log.info("%s: %s", decision.action, decision.reason)
            if decision.action is Action.LAND:
                return decision
            if decision.action is Action.HOLD_ALTITUDE:
                # The ruler is not usable for any zone.
                break
        else:
            # The ruler is usable, but no zone fits.
            return decision
    return decision


def measure_arguments(
    image: Path, zone: Zone, ruler: Ruler, *, craft: Craft, region: str | None
) -> dict[str, Any]:
    """Build the arguments of ``measure_area``; the region concerns only the vehicles."""
    arguments: dict[str, Any] = {
        "image": {"kind": "path", "path": str(image.resolve())},
        "targets": [{"box": asdict(zone)}],
        "must_fit": {"diameter_m": craft.needed_m},
        **ruler.arguments,
    }
    if region is not None and ruler.gsd_m_per_px is None:
        arguments["region"] = region
    return arguments


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Decide a landing with VehAnchor's measurements.")
    parser.add_argument("image", type=Path)
    parser.add_argument(
        "--zone", type=float, nargs=4, action="append", metavar=("X1", "Y1", "X2", "Y2"), default=[]
    )
    parser.add_argument(
        "--diameter", type=float, default=4.0, help="diameter of the craft with rotors, metres"
    )
    parser.add_argument(
        "--margin", type=float, default=2.0, help="free margin on each side, metres"
    )
    parser.add_argument(
        "--probability",
        type=float,
        default=MIN_PROBABILITY,
        help="least probability that the craft with its margin fits",
    )
    parser.add_argument(
        "--region",
        help="region of the cars, such as europe; needed where cars are small, as in south_asia",
    )
    parser.add_argument(
        "--altitude", type=float, help="next ruler: the barometer's height above ground, metres"
    )
    parser.add_argument("--focal", type=float, help="focal length in pixels, for --altitude")
    return parser.parse_args()


async def main() -> None:
    """Launch the server, decide, print the decision."""
    options = _arguments()
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", stream=sys.stderr)
    log.setLevel(logging.INFO)
    rulers = [Ruler("vehicles in the image")]
    if options.altitude is not None and options.focal is not None:
        rulers.append(Ruler("barometer", options.altitude / options.focal))
    zones = [Zone(*corners) for corners in options.zone]
    craft = Craft(options.diameter, options.margin, options.probability)
    server = StdioServerParameters(
        command=sys.executable,
        args=["-m", "vehanchor", "serve", "--root", str(options.image.resolve().parent)],
    )
    # The server's log does not belong on the planner's stderr.
    with Path(os.devnull).open("w") as nowhere:
        async with Client(stdio_client(server, errlog=nowhere)) as client:
            decision = await decide(
                client,
                options.image,
                zones=zones,
                rulers=rulers,
                craft=craft,
                region=options.region,
            )
    log.info("decision: %s, because %s", decision.action, decision.reason)
    known = {name: value for name, value in asdict(decision).items() if value is not None}
    print(json.dumps(known))


if __name__ == "__main__":
    asyncio.run(main())
