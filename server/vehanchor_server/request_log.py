"""One line of JSON on stderr for every tool call, and for everything else that is logged."""

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
    """Log a call: tool, how it ended, milliseconds and megapixels; nothing of what the image shows.

    Args:
        tool: its name.
        status: the record's status, or the error's code.
        seconds: how long it took.
        record: the structured result, None if there is none.
    """
    fields: dict[str, Any] = {"tool": tool, "status": status, "ms": round(1000 * seconds, 1)}
    if record is not None:
        fields["status"] = record.get("status", status)
        width, height = record.get("image_width_px"), record.get("image_height_px")
        if width and height:
            fields["megapixels"] = round(width * height / 1e6, 3)
    _logger.info("call", extra={"fields": fields})


class RepeatLimit(logging.Filter):
    """Passes a few lines of one place in the code in a while, and then says how many more there were.

    Lines of calls always pass: there is one a call.

    Args:
        n_lines: that pass in a period.
        period_s: seconds.
    """

    def __init__(self, n_lines: int = 20, period_s: float = 10.0) -> None:
        super().__init__()
        self._n_lines = n_lines
        self._period_s = period_s
        self._seen: dict[tuple[str, str, int], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the line passes; the first of a new period tells how many of the last one did not."""
        if record.name == _logger.name:
            return True
        place = record.name, record.pathname, record.lineno
        began, n = self._seen.get(place, (-math.inf, 0))
        if record.created - began >= self._period_s:
            if n > self._n_lines:
                record.__dict__["fields"] = {**getattr(record, "fields", {}), "not_shown_before": n - self._n_lines}
            began, n = record.created, 0
        self._seen[place] = began, n + 1  # as many as there are places in the code that log
        return n < self._n_lines


class JsonFormatter(logging.Formatter):
    """A log record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
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
    """Send everything to stderr as JSON: stdout belongs to the protocol. Before the SDK sets up its own."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter())
    handler.addFilter(RepeatLimit())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    for chatty in ("httpx2", "httpcore2", "sse_starlette", "mcp", "uvicorn.access"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
