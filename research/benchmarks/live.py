"""Measure ``vehanchor live`` on rendered flights of exactly known scale.

``python -m research.benchmarks.live [--flights N] [--fleets] [--loopback RATE] [--precision P] [--out FLIGHTS.jsonl]
[--record]``.

A flight crosses one rendered place at five frames a second, 1280 x 720. It climbs, turns and shifts. For a second no
frame arrives, and for another the frames are grey. The last table has the errors of all frames with a scale, the share
of the intervals that hold the truth, the longest time of ``ok`` with an error above a fifth, and the processor seconds
of a frame. With ``--fleets``, the cars of each flight have the modal length of a region that the detector knows, in
turn: the error of the reference length is common to a flight, and one fleet for all flights would not show it. With
``--loopback``, so many frames a second arrive in a folder, the command reads them, and a MAVLink parser listens on the
loopback interface.
"""

from __future__ import annotations

import argparse
import json
import math
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, get_args

import cv2
import numpy as np

from research.results.record import add_record_option, recording, values_table
from vehanchor.engine import Engine
from vehanchor.flight.live.estimator import LiveEstimator
from vehanchor.flight.live.frames import Frame
from vehanchor.models.runtime import Runtime
from vehanchor.options import ScaleOptions
from vehanchor.scale.lengths import Z95
from vehanchor_scenes import render_scene
from vehanchor_scenes.truth import Layout

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from vehanchor.records import LiveScale

_WORLD_GSD, _WORLD_PX = 0.05, 3600
_WIDTH_PX, _HEIGHT_PX, _FRAMES, _STEP_S = 1280, 720, 40, 0.2
_LOST, _GREY = range(14, 19), range(27, 32)  # frames that do not arrive, frames that show nothing
_WRONG = 0.2
_MOST_HELD = 0.9  # share of a flight's frames
_MODE_OVER_MEAN = 1.01  # of a rendered fleet's lengths
_AIMS: dict[str, float | str] = {
    "median_error": 0.06,
    "holds": "0.93 to 0.97",
    "longest_wrong_s": 1,
    "median_latency_s": 0.2,
}


def frames_of(seed: int, mean_length_m: float = 4.6) -> Iterator[tuple[Frame, float]]:
    """Render the frames of one flight over cars of this mean length, each with its metres per pixel."""
    rng = np.random.default_rng(seed)
    layouts = [each for each in get_args(Layout) if each != "sports"]
    layout = layouts[seed % len(layouts)]
    world = render_scene(
        _WORLD_GSD,
        width_px=_WORLD_PX,
        height_px=_WORLD_PX,
        seed=seed,
        mean_vehicle_length_m=mean_length_m,
        layout=layout,
    ).image
    low, climb, heading = rng.uniform(0.055, 0.08), rng.uniform(0.0, 0.35), rng.uniform(0, 2 * math.pi)
    sway, turning = rng.uniform(0.1, 0.3), rng.uniform(-40, 40)
    for number in range(_FRAMES):
        at_s = number * _STEP_S
        part = number / (_FRAMES - 1)
        gsd = low * math.exp(climb * part + 0.1 * math.sin(2 * math.pi * part))
        along = (part - 0.5) * 700
        x = _WORLD_PX / 2 + along * math.cos(heading)
        y = _WORLD_PX / 2 + along * math.sin(heading) + 100 * math.sin(sway * at_s * 5)
        if number in _LOST:
            continue
        image = _view(world, x, y, gsd / _WORLD_GSD, turning * part, rng)
        if number in _GREY:
            image = np.full_like(image, 110)
        yield Frame(f"{layout} {seed} at {at_s:.1f} s", image, at_s, time.monotonic(), 0), gsd


def _view(
    world: NDArray[np.uint8], x: float, y: float, scale: float, turn_deg: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Resample the world around a point: ``scale`` of its pixels a pixel."""
    reach = math.ceil(math.hypot(_WIDTH_PX, _HEIGHT_PX) / 2 * scale) + 8
    left, top = max(0, int(x) - reach), max(0, int(y) - reach)
    part = world[top : int(y) + reach, left : int(x) + reach]
    move = np.asarray(cv2.getRotationMatrix2D((x - left, y - top), turn_deg, 1 / scale), np.float64)
    move[:, 2] += np.array([_WIDTH_PX / 2 - (x - left), _HEIGHT_PX / 2 - (y - top)])
    soft = cv2.GaussianBlur(part, (0, 0), 0.4 * scale)
    seen = cv2.warpAffine(soft, move, (_WIDTH_PX, _HEIGHT_PX), flags=cv2.INTER_LINEAR)
    noise = rng.integers(-3, 4, seen.shape, dtype=np.int16)
    return np.asarray(np.clip(seen.astype(np.int16) + noise, 0, 255), np.uint8)


def fly(seed: int, engine: Engine, mean_length_m: float = 4.6) -> list[dict[str, Any]]:
    """Estimate the scales of one flight over cars of this mean length."""
    estimator = LiveEstimator(engine.detector, ScaleOptions())
    rows = []
    for frame, gsd in frames_of(seed, mean_length_m):
        before = time.process_time()
        record = estimator.estimate(frame._replace(arrived_s=time.monotonic()))
        rows.append(_row(record, gsd, time.process_time() - before))
    return rows


def _row(record: LiveScale, gsd: float, cpu_s: float) -> dict[str, Any]:
    low, high = record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px
    return {
        "frame": record.frame,
        "truth": gsd,
        "error": None if record.gsd_m_per_px is None else record.gsd_m_per_px / gsd - 1,
        "holds": None if low is None or high is None else low <= gsd <= high,
        "width": None if low is None or high is None else high / low,
        "status": record.status,
        "confidence": record.confidence,
        "n_vehicles": record.n_vehicles,
        "linked": record.linked,
        "cpu_s": cpu_s,
        "latency_s": record.latency_s,
    }


def summary(flights: list[list[dict[str, Any]]]) -> dict[str, Any]:
    """Summarise all flights."""
    rows = [row for flight in flights for row in flight]
    scaled = [row for row in rows if row["error"] is not None]
    ok = [row for row in rows if row["status"] == "ok"]
    return {
        "flights": len(flights),
        "frames": len(rows),
        "with_scale": len(scaled),
        "ok": len(ok),
        "median_error": float(np.median([abs(row["error"]) for row in scaled])) if scaled else None,
        "median_error_ok": float(np.median([abs(row["error"]) for row in ok])) if ok else None,
        "holds": float(np.mean([row["holds"] for row in scaled])) if scaled else None,
        "flights_that_hold_nine_in_ten": sum(_share_held(flight) >= _MOST_HELD for flight in flights),
        "rms_error_over_log_sd": float(np.sqrt(np.mean([_deviation(row) ** 2 for row in scaled]))) if scaled else None,
        "holds_ok": float(np.mean([row["holds"] for row in ok])) if ok else None,
        "longest_wrong_s": max((_longest_wrong(flight) for flight in flights), default=0.0),
        "median_cpu_s": float(np.median([row["cpu_s"] for row in rows])),
        "p90_cpu_s": float(np.quantile([row["cpu_s"] for row in rows], 0.9)),
        "median_latency_s": float(np.median([row["latency_s"] for row in rows])),
    }


def _share_held(flight: list[dict[str, Any]]) -> float:
    held = [row["holds"] for row in flight if row["holds"] is not None]
    return float(np.mean(held)) if held else 1.0


def _deviation(row: dict[str, Any]) -> float:
    """Compute the error of a frame over the standard deviation that its interval states."""
    return math.log1p(row["error"]) * 2 * Z95 / math.log(row["width"])


def _longest_wrong(flight: list[dict[str, Any]]) -> float:
    longest = run = 0
    for row in flight:
        run = run + 1 if row["status"] == "ok" and abs(row["error"]) > _WRONG else 0
        longest = max(longest, run)
    return longest * _STEP_S


def loopback(flights: int, rate: float, precision: str) -> dict[str, Any]:
    """Run ``vehanchor live`` over a folder that fills, and parse its MAVLink messages on the other side."""
    from pymavlink.dialects.v20 import common as mavlink

    with TemporaryDirectory() as work, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        folder, written = Path(work, "folder"), []
        folder.mkdir()
        for number, (frame, _) in enumerate(row for seed in range(flights) for row in frames_of(seed)):
            written.append(Path(work, f"{number:04}.jpg"))
            cv2.imwrite(str(written[-1]), frame.image[:, :, ::-1])
        station.bind(("127.0.0.1", 0))
        station.setblocking(False)
        address = f"127.0.0.1:{station.getsockname()[1]}"
        options = ["--idle", "3", "--mavlink", address, "--precision", precision]
        command = [sys.executable, "-m", "vehanchor", "live", str(folder), *options]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as live:
            assert live.stdout is not None
            written[0].rename(folder / written[0].name)
            live.stdout.readline()  # the models are loaded
            begun = time.monotonic()
            for number, path in enumerate(written[1:]):
                time.sleep(max(0.0, begun + number / rate - time.monotonic()))
                path.rename(folder / path.name)
            lasted = time.monotonic() - begun
            rows = [json.loads(line) for line in live.stdout]
        parser, messages = mavlink.MAVLink(None), 0
        with suppress(BlockingIOError):
            while True:
                messages += len(parser.parse_buffer(station.recv(4096)) or [])
    latencies = np.array([row["latency_s"] for row in rows])
    halves = np.array_split(latencies, 2)
    return {
        "frames": len(written) - 1,
        "frames_a_second": rate,
        "lines": len(rows),
        "lines_a_second": len(rows) / lasted,
        "most_skipped_at_once": max(row["n_skipped"] for row in rows),
        "median_latency_s": float(np.median(latencies)),
        "largest_latency_s": float(latencies.max()),
        "median_latency_of_the_halves_s": ", ".join(f"{np.median(half):.3f}" for half in halves),
        "lines_with_a_scale": sum(row["status"] != "no_scale" for row in rows),
        "mavlink_messages": messages,
    }


def main() -> None:
    """Run the measurement."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=16)
    parser.add_argument("--fleets", action="store_true", help="fleets of the regions that the detector knows, in turn")
    parser.add_argument("--loopback", type=float, metavar="RATE", help="frames a second into a folder; MAVLink out")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--precision", choices=("float32", "int8", "auto"), default="auto")
    parser.add_argument("--out", type=Path)
    chosen = add_record_option(parser).parse_args()
    key = "live_loopback" if chosen.loopback else "live_fleets" if chosen.fleets else "live"
    with recording("flights", [key], chosen.record):
        if chosen.loopback:
            print("\n".join(values_table(loopback(chosen.flights, chosen.loopback, chosen.precision), _AIMS)))
        else:
            _measure(chosen)


def _measure(chosen: argparse.Namespace) -> None:
    engine = Engine(runtime=Runtime(threads=2, precision=chosen.precision))
    engine.load()
    regions = list(engine.detector.card.region_lengths_m.values()) if chosen.fleets else [4.6 * _MODE_OVER_MEAN]
    flights = []
    for seed in range(chosen.first, chosen.first + chosen.flights):
        flights.append(fly(seed, engine, regions[seed % len(regions)] / _MODE_OVER_MEAN))
        print(json.dumps({"seed": seed, **summary(flights[-1:])}), flush=True)
        if chosen.out is not None:
            with chosen.out.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(row) + "\n" for row in flights[-1])
    print("\n".join(values_table(summary(flights), _AIMS)))


if __name__ == "__main__":
    main()
