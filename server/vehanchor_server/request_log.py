"""JSON log on stderr: one line per tool call, and all other messages."""

from __future__ import annotations

import json
import logging
import math
import sys
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

_logger = logging.getLogger("vehanchor_server.calls")


def log_call(tool: str, status: str, seconds: float, record: Mapping[str, Any] | None) -> None:
    """Log a call: tool, status, milliseconds and megapixels, but no image content.

    Args:
        tool: name of the tool.
        status: status of the record, or code of the error.
        seconds: duration.
        record: structured result, or None.
    """
    fields: dict[str, Any] = {"tool": tool, "status": status, "ms": round(1000 * seconds, 1)}
    if record is not None:
        fields["status"] = record.get("status", status)
        width = record.get("image_width_px")
        height = record.get("image_height_px")
        if width and height:
            fields["megapixels"] = round(width * height / 1e6, 3)
    _logger.info("call", extra={"fields": fields})


class RepeatLimit(logging.Filter):
    """Rate limit for log lines from the same place in the code; it counts the dropped lines.

    Lines of calls always pass.

    Args:
        n_lines: lines that pass per period.
        period_s: length of a period, seconds.
    """

    def __init__(self, n_lines: int = 20, period_s: float = 10.0) -> None:
        super().__init__()
        self._n_lines = n_lines
        self._period_s = period_s
        # By place in the code: begin of its period, and number of lines in it. The number of
        # places bounds the memory.
        self._periods: dict[tuple[str, str, int], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether the line passes.

        The first line of a period has the number of lines that the previous one dropped.
        """
        if record.name == _logger.name:
            return True
        place = (record.name, record.pathname, record.lineno)
        began, n_lines = self._periods.get(place, (-math.inf, 0))
        if record.created - began >= self._period_s:
            n_dropped = n_lines - self._n_lines
            if n_dropped > 0:
                fields = getattr(record, "fields", {})
                record.__dict__["fields"] = {**fields, "not_shown_before": n_dropped}
            began = record.created
            n_lines = 0
        self._periods[place] = (began, n_lines + 1)
        return n_lines < self._n_lines


class JsonFormatter(logging.Formatter):
    """Formatter of log records as JSON lines."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record as one line of JSON."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "fields", {}),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False, default=str)


def configure_logging() -> None:
    """Log everything to stderr as JSON, because stdout belongs to the protocol.

    Call it before the SDK starts.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    handler.addFilter(RepeatLimit())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    for chatty in ("httpx2", "httpcore2", "sse_starlette", "mcp", "uvicorn.access"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
