"""``vehanchor serve`` and ``vehanchor schemas``, for the command line to mount."""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Annotated, Any

import typer

from vehanchor_server.settings import Settings, SettingsError

__all__ = ["schemas", "serve"]

_SOURCES, _WORK, _HTTP = "Where images may come from", "Models and limits", "HTTP"


def serve(
    http: Annotated[bool, typer.Option("--http", help="Listen for HTTP instead of serving stdin and stdout.")] = False,
    root: Annotated[
        list[Path] | None,
        typer.Option(help="Directory below which images may be read by path; repeatable.", rich_help_panel=_SOURCES),
    ] = None,
    image_host: Annotated[
        list[str] | None,
        typer.Option(help="Host that images may be fetched from (https); repeatable.", rich_help_panel=_SOURCES),
    ] = None,
    detector: Annotated[
        str | None, typer.Option(help="Bundled name or path of the detector.", rich_help_panel=_WORK)
    ] = None,
    segmenter: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            metavar="ENCODER DECODER", help="ONNX files of the segmenter [the bundled one].", rich_help_panel=_WORK
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Reference length that 'vehanchor calibrate' measured.", rich_help_panel=_WORK
        ),
    ] = None,
    threads: Annotated[int | None, typer.Option(help="CPU threads of a model.", rich_help_panel=_WORK)] = None,
    min_score: Annotated[float | None, typer.Option(help="Lowest detection score.", rich_help_panel=_WORK)] = None,
    max_image_mb: Annotated[
        float | None, typer.Option(help="Largest image file, MiB [512].", rich_help_panel=_WORK)
    ] = None,
    max_megapixels: Annotated[
        float | None, typer.Option(help="Largest image decoded whole, megapixels [100].", rich_help_panel=_WORK)
    ] = None,
    max_windowed_megapixels: Annotated[
        float | None, typer.Option(help="Largest TIFF read by windows, megapixels [10000].", rich_help_panel=_WORK)
    ] = None,
    max_concurrency: Annotated[
        int | None, typer.Option(help="Calls at once in a process [one a CPU, at least 2].", rich_help_panel=_WORK)
    ] = None,
    deadline_s: Annotated[
        float | None, typer.Option(help="Seconds after which a call ends [55].", rich_help_panel=_WORK)
    ] = None,
    fetch_timeout_s: Annotated[
        float | None, typer.Option(help="Seconds that fetching an image may take [20].", rich_help_panel=_SOURCES)
    ] = None,
    host: Annotated[str | None, typer.Option(help="Address to listen on [127.0.0.1].", rich_help_panel=_HTTP)] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on [8000].", rich_help_panel=_HTTP)] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes that share the port.", rich_help_panel=_HTTP)] = 1,
    allowed_host: Annotated[
        list[str] | None,
        typer.Option(help="Host header to accept beside the loopback ones; repeatable.", rich_help_panel=_HTTP),
    ] = None,
    allowed_origin: Annotated[
        list[str] | None,
        typer.Option(help="Origin header to accept beside the loopback ones; repeatable.", rich_help_panel=_HTTP),
    ] = None,
    public_url: Annotated[
        str | None, typer.Option(help="URL under which callers reach /mcp.", rich_help_panel=_HTTP)
    ] = None,
    token_file: Annotated[
        Path | None, typer.Option(help="File with one accepted bearer token a line.", rich_help_panel=_HTTP)
    ] = None,
    oidc_issuer: Annotated[
        str | None, typer.Option(help="Issuer whose JWTs are accepted.", rich_help_panel=_HTTP)
    ] = None,
    oidc_audience: Annotated[
        str | None, typer.Option(help="Audience that those JWTs must carry.", rich_help_panel=_HTTP)
    ] = None,
    max_body_mb: Annotated[float | None, typer.Option(help="Largest request, MiB [32].", rich_help_panel=_HTTP)] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Listen publicly without authentication.", rich_help_panel=_HTTP)
    ] = False,
) -> None:
    """Serve the tools to agents over MCP: on stdin and stdout, or over HTTP at /mcp.

    Every option is also a variable: --max-image-mb is VEHANCHOR_MAX_IMAGE_MB, --root is VEHANCHOR_ROOTS. Several paths
    in one variable are separated by the system's path separator.
    """
    given: dict[str, Any] = {
        "roots": tuple(root) if root else None,
        "image_hosts": tuple(image_host) if image_host else None,
        "detector": detector,
        "segmenter": segmenter,
        "calibration": calibration,
        "threads": threads,
        "min_score": min_score,
        "max_image_mb": max_image_mb,
        "max_megapixels": max_megapixels,
        "max_windowed_megapixels": max_windowed_megapixels,
        "max_concurrency": max_concurrency,
        "deadline_s": deadline_s,
        "fetch_timeout_s": fetch_timeout_s,
        "host": host,
        "port": port,
        "allowed_hosts": tuple(allowed_host) if allowed_host else None,
        "allowed_origins": tuple(allowed_origin) if allowed_origin else None,
        "public_url": public_url,
        "token_file": token_file,
        "oidc_issuer": oidc_issuer,
        "oidc_audience": oidc_audience,
        "max_body_mb": max_body_mb,
        "insecure": insecure or None,
    }
    try:
        settings = Settings.from_environment(**given)
        if http:
            from vehanchor_server.transport.http import serve_http

            serve_http(settings, workers=workers)
        else:
            gc.disable()  # importing the SDK makes thousands of classes: looking for garbage among them is slow
            try:
                from vehanchor_server.transport.stdio import serve_stdio
            finally:
                gc.enable()
            serve_stdio(settings)
    except SettingsError as error:
        typer.echo(f"error[invalid_settings]: {error}", err=True)
        raise typer.Exit(2) from None


def schemas(
    directory: Annotated[Path, typer.Argument(help="Directory to write to.")] = Path("schemas"),
) -> None:
    """Write the tools' JSON Schemas, and the same tools as Anthropic and OpenAI definitions."""
    from vehanchor_server.schemas import write_schemas

    for path in write_schemas(directory):
        typer.echo(path)
