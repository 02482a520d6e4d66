"""Why a call failed, as the model that made it reads it: ``code: what is wrong. what to do``.

The library's own codes (``vehanchor.errors``) pass through unchanged. The server adds:

* CallError (ToolError)
  x ``invalid_arguments``   an argument is missing, unknown, or of the wrong form
  x ``unknown_tool``        there is no tool of that name
  x ``source_disabled``     this server does not take images of that ``kind``
  x ``path_not_allowed``    the path is not below an allowed root, or its form cannot be trusted
  x ``base64_invalid``      the data is not base64
  x ``url_not_allowed``     not https, a host that is not listed, or an address that is not public
  x ``fetch_failed``        the host did not deliver the image
  x ``busy``                every place is taken: try again
  x ``deadline_exceeded``   the call took longer than the server allows
  x ``worker_killed``       the process that worked on the image ended: too much memory or time, or a crash; try again
  x ``worker_unavailable``  no process for work on images can start here; no fault of the image
  x ``server_stopping``     the server is shutting down
  x ``model_unavailable``   the operator's model cannot be loaded
  x ``invalid_answer``      what the person at the client answered to a question has no meaning
  x ``internal_error``      a bug; the details are in the server's log only
"""

from __future__ import annotations

from mcp.server.mcpserver.exceptions import ToolError

_SHOWN_CHARS = 80


def shortened(name: str) -> str:
    """A name from a request, short enough to be repeated to its caller: the end of a long one."""
    return name if len(name) <= _SHOWN_CHARS else f"...{name[-_SHOWN_CHARS:]}"


class CallError(ToolError):
    """A call failed for a reason that its caller can act on; ``code`` is stable.

    Args:
        code: the stable identifier.
        message: what is wrong, with its value, and what to do.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code

    @property
    def explanation(self) -> str:
        """The message without the code."""
        return str(self).removeprefix(f"{self.code}: ")

    def __reduce__(self) -> tuple[type[CallError], tuple[str, str]]:
        """How it comes from a worker process."""
        return type(self), (self.code, self.explanation)
