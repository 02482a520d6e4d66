"""Commands and their options for a language model's service: address, key, limits."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, TypeVar

import typer

from research.paper.vlm_api import Budget, Provider, open_api, reply_journal
from vehanchor.cli.terminal import exit_on_error
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.commands.request import as_command, fields_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from research.paper.vlm_api import ModelApi

Request = TypeVar("Request")

# Exit status of a run that ended early; its results are written or printed.
STOPPED = 3
_LIMITS = "Limits and service"
RecordOption: TypeAlias = Annotated[
    str | None,
    typer.Option(metavar="SUFFIX", help="Write the table into research/results; '' for no suffix."),
]
MODEL_PANEL = "A real model"


def plain_command(
    request: type[Request],
) -> Callable[[Callable[[Request], None]], Callable[..., None]]:
    """Create a command with the fields of a dataclass as options.

    Args:
        request: the dataclass; its fields are annotated for Typer.

    Returns:
        A decorator for a function of the dataclass; the result is for Typer and prints errors to
        stderr.
    """

    def decorate(command: Callable[[Request], None]) -> Callable[..., None]:
        def run(**typed: Any) -> None:
            with exit_on_error():
                command(request(**typed))

        return as_command(run, command, fields_of(request))

    return decorate


@dataclass(frozen=True, kw_only=True)
class ServiceRequest:
    """Options for the service and the limits of a run, one per field."""

    base_url: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Address of the service. Default: the provider's.",
            rich_help_panel=_LIMITS,
        ),
    ] = None
    max_requests: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Maximum number of requests in this run.",
            rich_help_panel=_LIMITS,
        ),
    ] = None
    max_tokens: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Maximum number of input and output tokens in this run.",
            rich_help_panel=_LIMITS,
        ),
    ] = None
    max_output_tokens: Annotated[
        int,
        typer.Option(
            min=16,
            metavar="N",
            help="Maximum number of tokens of one reply.",
            rich_help_panel=_LIMITS,
        ),
    ] = 4096
    timeout: Annotated[
        float,
        typer.Option(
            min=0.1,
            metavar="S",
            help="Time limit of one attempt, seconds.",
            rich_help_panel=_LIMITS,
        ),
    ] = 120.0
    retries: Annotated[
        int,
        typer.Option(min=0, metavar="N", help="Attempts after the first.", rich_help_panel=_LIMITS),
    ] = 6

    def open_api(self, provider: Provider, model: str, out: Path | None) -> ModelApi:
        """Connect to the model with these limits.

        Args:
            provider: API of the model.
            model: name of the model.
            out: folder of stored replies; None stores none.

        Raises:
            MissingExtraError: the provider's client is not installed.
            InvalidParameterError: the environment has no key, or the address of a compatible
                service is missing.
        """
        return open_api(
            provider,
            model,
            reply_journal(out),
            Budget(self.max_requests, self.max_tokens),
            base_url=self.base_url,
            max_output_tokens=self.max_output_tokens,
            timeout_s=self.timeout,
            max_retries=self.retries,
        )


@dataclass(frozen=True, kw_only=True)
class PlannerRequest(ServiceRequest):
    """Options for a real model beside the scripted planner, one per field."""

    provider: Annotated[
        Provider | None,
        typer.Option(
            help="API of the model; openai-compatible: vLLM, DashScope, ...",
            rich_help_panel=MODEL_PANEL,
        ),
    ] = None
    model: Annotated[
        str, typer.Option(metavar="NAME", help="Name of the model.", rich_help_panel=MODEL_PANEL)
    ] = ""
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of stored replies, a transcript: they are never requested again.",
            rich_help_panel=MODEL_PANEL,
        ),
    ] = None
    record: RecordOption = None

    def check_model(self) -> None:
        """Check, before the work, that provider and model are both given or both missing.

        Raises:
            InvalidParameterError: one of them is missing.
        """
        if (self.provider is None) != (not self.model):
            raise InvalidParameterError(
                "a real model needs --provider and --model, and its key in the environment"
            )

    def model_api(self) -> ModelApi | None:
        """Connect to the real model; None without one.

        Raises:
            VehAnchorError: as ``open_api``.
        """
        return None if self.provider is None else self.open_api(self.provider, self.model, self.out)


def exit_if_stopped(stopped: str | None) -> None:
    """End the command with exit status 3 if a limit stopped its run early."""
    if stopped:
        print(f"stopped: {stopped}; with --out the same command resumes", file=sys.stderr)
        raise typer.Exit(STOPPED)
