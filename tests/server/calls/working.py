"""Workers that run works of a test."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from vehanchor_server.base_model import FrozenModel
from vehanchor_server.calls.capacity import Stop
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import Reply
from vehanchor_server.calls.task import Task, Work, work
from vehanchor_server.images.argument import Base64Image
from vehanchor_server.resources import Resources
from vehanchor_server.services import Services

TESTS = Path(__file__).parents[2]
"""A root of the servers here, so that a worker may read the works of tests."""

_READY_S = 60
IMAGE = Base64Image(kind="base64", data="AAAA")
"""The image of all tasks here; their works ignore it."""


def ready(services: Services) -> Services:
    """Wait until a call can start at once."""
    services.preload()
    deadline = time.monotonic() + _READY_S
    while not services.ready and time.monotonic() < deadline:
        time.sleep(0.02)
    assert services.ready
    return services


class Value(FrozenModel):
    """The record of the works here."""

    value: Any


def answered(value: Any) -> Reply[Value]:
    """The reply of a work here."""
    return Reply((Value(value=value),))


def done(
    services: Services, work: Work[Value], question: Any = None, stop: Stop | None = None
) -> Any:
    """The work's value, from a worker."""
    assert services.workers is not None
    task = Task(work, question, ((IMAGE, None),))
    return services.workers.run(task, stop or Stop(), lambda *_: None).record.value


@work(Value)
def number(resources: Resources, job: Job, source: Any, _: None) -> Reply[Value]:
    """A work that answers with the process id."""
    return answered(os.getpid())
