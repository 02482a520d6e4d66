"""Options for a language model's service: address, key, limits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor_evaluation.vlm_api import ModelApi

STOPPED = 3  # exit status of a run that ended early; its results are written or printed
_LIMITS = "Limits and service"


class ProviderName(StrEnum):
    """API of the model."""

    anthropic = "anthropic"
    openai = "openai"
    openai_compatible = "openai-compatible"


@dataclass(frozen=True, kw_only=True)
class ServiceRequest:
    """Options for the service and the limits of a run, one per field."""

    base_url: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Address of the service. Default: the provider's.", rich_help_panel=_LIMITS),
    ] = None
    key_variable: Annotated[
        str | None,
        typer.Option(
            "--api-key-env",
            metavar="NAME",
            help="Environment variable of the key. Default: ANTHROPIC_API_KEY or OPENAI_API_KEY.",
            rich_help_panel=_LIMITS,
        ),
    ] = None
    max_requests: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Maximum number of requests in this run.", rich_help_panel=_LIMITS),
    ] = None
    max_tokens: Annotated[
        int | None,
        typer.Option(
            min=1, metavar="N", help="Maximum number of input and output tokens in this run.", rich_help_panel=_LIMITS
        ),
    ] = None
    requests_per_minute: Annotated[
        float | None,
        typer.Option(min=0.001, metavar="N", help="Maximum number of requests per minute.", rich_help_panel=_LIMITS),
    ] = None
    max_output_tokens: Annotated[
        int, typer.Option(min=16, metavar="N", help="Maximum number of tokens of one reply.", rich_help_panel=_LIMITS)
    ] = 4096
    timeout: Annotated[
        float, typer.Option(min=0.1, metavar="S", help="Time limit of one attempt, seconds.", rich_help_panel=_LIMITS)
    ] = 120.0
    retries: Annotated[
        int, typer.Option(min=0, metavar="N", help="Attempts after the first.", rich_help_panel=_LIMITS)
    ] = 6

    def open_api(self, provider: ProviderName, model: str, out: Path | None) -> ModelApi:
        """Connect to the model with these limits.

        Args:
            provider: API of the model.
            model: name of the model.
            out: folder of stored replies; None stores none.

        Raises:
            MissingExtraError: the provider's client is not installed.
            InvalidParameterError: the environment has no key, or the address of a compatible service is missing.
        """
        from vehanchor_evaluation.vlm_api import Budget, open_api, reply_journal

        return open_api(
            provider.value,
            model,
            reply_journal(out),
            Budget(self.max_requests, self.max_tokens, self.requests_per_minute),
            base_url=self.base_url,
            key_variable=self.key_variable,
            max_output_tokens=self.max_output_tokens,
            timeout_s=self.timeout,
            max_retries=self.retries,
        )
