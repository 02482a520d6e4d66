"""JSON server on a loopback port, as a stand-in for the services of language models."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Answered = tuple[int, dict[str, Any], dict[str, str]]


@contextmanager
def json_server(
    answer: Callable[[str, dict[str, str], dict[str, Any]], Answered | None],
) -> Iterator[str]:
    """Listen, and give the address.

    Args:
        answer: to a path, headers (lower case) and a body: status, body and further headers, or
            None to hang up.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["content-length"])))
            answered = answer(
                self.path, {name.lower(): value for name, value in self.headers.items()}, body
            )
            if answered is None:
                self.close_connection = True
                return
            status, reply, headers = answered
            content = json.dumps(reply).encode()
            self.send_response(status)
            for name, value in {"content-type": "application/json", **headers}.items():
                self.send_header(name, value)
            self.send_header("content-length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
