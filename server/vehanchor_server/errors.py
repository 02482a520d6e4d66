"""Errors of calls, in the form ``code: problem. remedy``.

The library's codes (``vehanchor.errors``) pass through unchanged. The server adds:

* CallError (Exception)
  x ``invalid_arguments``   an argument is missing, unknown or malformed
  x ``unknown_tool``        there is no tool of that name
  x ``source_disabled``     the server accepts no images of that ``kind``
  x ``path_not_allowed``    the path is not below an allowed root, or is malformed
  x ``base64_invalid``      the data is not base64
  x ``url_not_allowed``     not https, not a listed host, or not a public address
  x ``fetch_failed``        the host did not deliver the image
  x ``busy``                all slots are taken; try again
  x ``deadline_exceeded``   the call exceeded the server's deadline
  x ``worker_killed``       the worker process ended: memory, time or a crash; try again
  x ``worker_unavailable``  no worker process can start; not caused by the image
  x ``server_stopping``     the server is shutting down
  x ``model_unavailable``   the operator's model cannot be loaded
  x ``invalid_answer``      the user's answer to a form is invalid
  x ``internal_error``      a bug; only the server's log has the details
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records.escaping import on_one_line

if TYPE_CHECKING:
    from vehanchor.errors import VehAnchorError

WORKER_KILLED = "worker_killed"
_SHOWN_CHARS = 80


def shortened(name: str) -> str:
    """Shorten a name from a request to its end, on one line, for use in a message."""
    name = on_one_line(name)
    if len(name) > _SHOWN_CHARS:
        return f"...{name[-_SHOWN_CHARS:]}"
    return name


class CallError(Exception):
    """Failure of a call with a remedy for the caller.

    Args:
        code: stable identifier.
        message: the problem with its value, and the remedy.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code

    @property
    def explanation(self) -> str:
        """The message without the code."""
        return str(self).removeprefix(f"{self.code}: ")

    @classmethod
    def of(cls, error: VehAnchorError, message: str = "") -> CallError:
        """Convert an error of the library: its code, and its message as one line.

        Args:
            error: the error.
            message: replaces its message; empty for its own.
        """
        text = on_one_line(message or str(error))
        if not text.endswith("."):
            text += "."
        return cls(error.code, text)
