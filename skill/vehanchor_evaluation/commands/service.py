"""Options by which commands are given a language model's service: its address, its key, and how much of it to use."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor_evaluation.vlm_api import ModelApi

STOPPED = 3  # exit status of a run that ended early, results so far written or printed
_LIMITS = "Ceilings and the service"


class ProviderName(StrEnum):
    """Whose API."""

    anthropic = "anthropic"
    openai = "openai"
    openai_compatible = "openai-compatible"


@dataclass(frozen=True, kw_only=True)
class ServiceRequest:
    """Where the model is, and the ceilings of a run: each field is an option."""

    base_url: Annotated[
        str | None,
        typer.Option(metavar="URL", help="Address of the service. Default: the provider's.", rich_help_panel=_LIMITS),
    ] = None
    key_variable: Annotated[
        str | None,
        typer.Option(
            "--api-key-env",
            metavar="NAME",
            help="Environment variable with the key. Default: ANTHROPIC_API_KEY or OPENAI_API_KEY.",
            rich_help_panel=_LIMITS,
        ),
    ] = None
    max_requests: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Requests of this run.", rich_help_panel=_LIMITS)
    ] = None
    max_tokens: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Input and output tokens of this run.", rich_help_panel=_LIMITS),
    ] = None
    requests_per_minute: Annotated[
        float | None, typer.Option(min=0.001, metavar="N", help="At most so fast.", rich_help_panel=_LIMITS)
    ] = None
    max_output_tokens: Annotated[
        int, typer.Option(min=16, metavar="N", help="Of one reply.", rich_help_panel=_LIMITS)
    ] = 4096
    timeout: Annotated[
        float, typer.Option(min=0.1, metavar="S", help="Of one attempt, seconds.", rich_help_panel=_LIMITS)
    ] = 120.0
    retries: Annotated[
        int, typer.Option(min=0, metavar="N", help="Attempts after the first.", rich_help_panel=_LIMITS)
    ] = 6

    def open_api(self, provider: ProviderName, model: str, out: Path | None) -> ModelApi:
        """Connect to the model, with the ceilings that were chosen.

        Args:
            provider: whose API.
            model: its name there.
            out: folder where replies are kept; None to keep none.

        Raises:
            MissingExtraError: the provider's client is not installed.
            InvalidParameterError: there is no key in the environment, or no address for a compatible service.
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
