"""Settings of the operator: image sources, models, limits and access.

Callers cannot change settings. Each field is declared once, with its default and help text. The option of
``vehanchor serve`` and the ``VEHANCHOR_*`` variable follow from its name.
"""

from __future__ import annotations

import json
import math
import os
import typing
from dataclasses import dataclass, field, fields
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from urllib.parse import urlsplit

from vehanchor.errors import InvalidParameterError
from vehanchor.options import DECODED_BYTES_PER_PIXEL, ImageLimits, Search, declared_options, models
from vehanchor.options.option import Option

if TYPE_CHECKING:
    from collections.abc import Mapping

_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_EVERYWHERE = ("0.0.0.0", "::")
_TRUE, _FALSE = ("1", "true", "yes", "on"), ("0", "false", "no", "off")
_MIB, _MEGAPIXEL = 1 << 20, 1_000_000
_SOURCES, _WORK, _HTTP = "Image sources", "Models and limits", "HTTP"


class SettingsError(ValueError):
    """A setting is invalid, or two settings contradict each other; the message has the remedy."""


def _words(help_text: str, *, panel: str, metavar: str = "", flag: str = "", if_unset: str = "") -> dict[str, Any]:
    """Build the metadata of a field.

    Args:
        help_text: one sentence for ``--help``.
        panel: heading in ``--help``.
        metavar: placeholder of the value.
        flag: name of the option; empty for the field's own.
        if_unset: meaning of a default of None.
    """
    return {"option": Option(help_text, metavar=metavar, flag=flag), "panel": panel, "if_unset": if_unset}


def _declared(declared: str | Option, *, panel: str) -> dict[str, Any]:
    """Metadata of a field that is an option of the library: its help and limits are the option's.

    Args:
        declared: the option, or its keyword.
        panel: heading in ``--help``.
    """
    found = declared_options()[declared] if isinstance(declared, str) else None
    option = declared if isinstance(declared, Option) else declared_options()[declared].option
    return {"option": option, "declared": found, "panel": panel, "if_unset": ""}


@dataclass(frozen=True)
class Settings:
    """The operator's settings; the metadata of each field has its help text.

    Raises:
        SettingsError: a setting is invalid, or two settings contradict each other.
    """

    roots: tuple[Path, ...] = field(
        default=(),
        metadata=_words("Directory of images that callers may read by path; repeatable.", panel=_SOURCES, flag="root"),
    )
    image_hosts: tuple[str, ...] = field(
        default=(),
        metadata=_words(
            "Host from which images may be fetched (https); repeatable.", panel=_SOURCES, flag="image-host"
        ),
    )
    detector: str | None = field(default=None, metadata=_declared(models.DETECTOR, panel=_WORK))
    precision: str = field(default="float32", metadata=_declared(models.PRECISION, panel=_WORK))
    segmenter: tuple[Path, Path] | None = field(default=None, metadata=_declared(models.SEGMENTER, panel=_WORK))
    calibration: Path | None = field(  # for callers who give neither region nor reference length
        default=None, metadata=_declared(models.CALIBRATION, panel=_WORK)
    )
    threads: int | None = field(default=None, metadata=_declared(models.THREADS, panel=_WORK))
    providers: tuple[str, ...] = field(default=(), metadata=_declared(models.PROVIDERS, panel=_WORK))
    min_score: float | None = field(default=Search.min_score, metadata=_declared("min_score", panel=_WORK))
    effort: str = field(default=Search.effort, metadata=_declared("effort", panel=_WORK))
    max_tiles: int | None = field(default=Search.max_tiles, metadata=_declared("max_tiles", panel=_WORK))
    max_search_s: float | None = field(default=Search.max_seconds, metadata=_declared("max_seconds", panel=_WORK))
    max_image_mb: float = field(
        default=ImageLimits.max_bytes / _MIB, metadata=_words("Largest image file, MiB.", panel=_WORK)
    )
    max_megapixels: float = field(
        default=ImageLimits.max_pixels / _MEGAPIXEL,
        metadata=_words("Largest image decoded at once, megapixels.", panel=_WORK),
    )
    max_decoded_mb: float | None = field(
        default=None,
        metadata=_words(
            "Memory limit for decoding an image, MiB.",
            panel=_WORK,
            if_unset=f"{ImageLimits.max_decoded_bytes / _MIB:g}, or more for the megapixels",
        ),
    )
    max_windowed_megapixels: float = field(
        default=ImageLimits.max_windowed_pixels / _MEGAPIXEL,
        metadata=_words("Largest TIFF read in windows, megapixels.", panel=_WORK),
    )
    never_ask: bool = field(
        default=False,
        metadata=_words(
            "Never ask the user for a region, a height or a known length; for unattended agents.", panel=_WORK
        ),
    )
    max_concurrency: int | None = field(
        default=None, metadata=_words("Concurrent calls per process.", panel=_WORK, if_unset="one per CPU, at least 2")
    )
    in_process: bool = field(  # only for your own images: see SECURITY.md
        default=False,
        metadata=_words(
            "Decode and compute in this process, not in workers that can be killed at the deadline.", panel=_WORK
        ),
    )
    unconfined: bool = field(  # for systems where a worker needs more than Python, the models and the roots
        default=False,
        metadata=_words("Give workers all rights of this user; otherwise they are confined on Linux.", panel=_WORK),
    )
    max_worker_mb: float = field(  # per process; at most one process per concurrent call
        default=2048.0,
        metadata=_words("Memory limit of a worker in addition to its models, MiB.", panel=_WORK),
    )
    deadline_s: float = field(  # common clients give up after 60 s
        default=55.0, metadata=_words("Seconds after which a call ends.", panel=_WORK)
    )
    fetch_timeout_s: float = field(
        default=20.0, metadata=_words("Time limit for fetching an image, seconds.", panel=_SOURCES)
    )
    host: str = field(default="127.0.0.1", metadata=_words("Address to listen on.", panel=_HTTP))
    port: int = field(default=8000, metadata=_words("Port to listen on.", panel=_HTTP))
    workers: int = field(default=1, metadata=_words("Number of processes that share the port.", panel=_HTTP))
    allowed_hosts: tuple[str, ...] = field(  # name, name:port or name:*
        default=(),
        metadata=_words(
            "Accepted Host header besides the loopback names; repeatable.", panel=_HTTP, flag="allowed-host"
        ),
    )
    allowed_origins: tuple[str, ...] = field(
        default=(),
        metadata=_words(
            "Accepted Origin header besides the loopback names; repeatable.", panel=_HTTP, flag="allowed-origin"
        ),
    )
    public_url: str | None = field(default=None, metadata=_words("Public URL of /mcp.", panel=_HTTP))
    token_file: Path | None = field(
        default=None, metadata=_words("File with one accepted bearer token per line.", panel=_HTTP)
    )
    oidc_issuer: str | None = field(default=None, metadata=_words("Issuer of accepted JWTs.", panel=_HTTP))
    oidc_audience: str | None = field(default=None, metadata=_words("Required audience of these JWTs.", panel=_HTTP))
    oidc_max_key_age_s: float = field(
        default=86400.0, metadata=_words("Seconds after which the issuer's keys end if it is unreachable.", panel=_HTTP)
    )
    max_body_mb: float = field(default=32.0, metadata=_words("Largest request, MiB.", panel=_HTTP))
    insecure: bool = field(default=False, metadata=_words("Listen publicly without authentication.", panel=_HTTP))

    def __post_init__(self) -> None:
        self._check_numbers()
        object.__setattr__(self, "_spelled", tuple(Path(os.path.abspath(root)) for root in self.roots))  # noqa: PTH100
        object.__setattr__(self, "roots", tuple(_checked_root(root) for root in self.roots))
        object.__setattr__(self, "image_hosts", tuple(host.strip().lower() for host in self.image_hosts))
        for host in self.image_hosts:
            name, _, port = host.partition(":")
            if not name or set(name) & set("/*@[]") or (":" in host and not port.isdigit()):
                raise SettingsError(f"image host {host!r}: give a plain host name or name:port, without https:// or *")
        if self.segmenter is not None and len(self.segmenter) != 2:
            raise SettingsError("segmenter needs two files: give its encoder and its decoder")
        self._check_authentication()

    def _check_numbers(self) -> None:
        for each in fields(self):
            value, declared = getattr(self, each.name), each.metadata.get("declared")
            if declared is not None and value is not None:
                try:
                    declared.check(each.name, value)
                except InvalidParameterError as error:
                    raise SettingsError(str(error)) from None
                continue
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                continue
            if not (math.isfinite(value) and value > 0):
                raise SettingsError(f"{each.name} is {value}: use a finite number > 0")

    def _check_authentication(self) -> None:
        if (self.oidc_issuer is None) != (self.oidc_audience is None):
            raise SettingsError("oidc_issuer and oidc_audience belong together: give both or neither")
        if self.oidc_issuer is not None and not self.oidc_issuer.startswith("https://"):
            raise SettingsError(f"oidc_issuer is {self.oidc_issuer!r}: an issuer is an https:// URL")
        if self.oidc_issuer is not None and self.token_file is not None:
            raise SettingsError("token_file and oidc_issuer exclude each other: choose one way to authenticate")
        if self.public_url is not None and not _is_web_address(self.public_url):
            raise SettingsError(f"public_url is {self.public_url!r}: write all of it, as in https://example.org/mcp")
        if self.oidc_issuer is not None and self.public_url is None and self.host in _EVERYWHERE:
            raise SettingsError(f"listening on {self.host} with an issuer: give --public-url, the address for callers")

    @property
    def image_kinds(self) -> tuple[str, ...]:
        """Kinds of images that models can name: by path and by URL, if allowed; models cannot write base64."""
        return (*(["path"] if self.roots else []), *(["url"] if self.image_hosts else []))

    @property
    def spelled_roots(self) -> tuple[Path, ...]:
        """The roots as given by the operator: absolute, with unresolved links."""
        spelled: tuple[Path, ...] = self.__dict__["_spelled"]
        return spelled

    @property
    def authenticated(self) -> bool:
        """Whether HTTP callers need a token."""
        return self.token_file is not None or self.oidc_issuer is not None

    @property
    def loopback(self) -> bool:
        """Whether HTTP listens on the loopback interface only."""
        return self.host in _LOOPBACK

    @property
    def image_limits(self) -> ImageLimits:
        """Limits on accepted images."""
        max_pixels = round(self.max_megapixels * _MEGAPIXEL)
        if self.max_decoded_mb is None:
            max_decoded_bytes = max(ImageLimits.max_decoded_bytes, DECODED_BYTES_PER_PIXEL * max_pixels)
        else:
            max_decoded_bytes = round(self.max_decoded_mb * _MIB)
        return ImageLimits(
            max_bytes=round(self.max_image_mb * _MIB),
            max_pixels=max_pixels,
            max_windowed_pixels=round(self.max_windowed_megapixels * _MEGAPIXEL),
            max_decoded_bytes=max_decoded_bytes,
            max_unpacked_bytes=1,  # refuse large JPEGs, so that callers cannot fill the disk
        )

    @property
    def max_worker_bytes(self) -> int:
        """Memory limit of a worker in addition to its models."""
        return round(self.max_worker_mb * _MIB)

    @property
    def max_body_bytes(self) -> int:
        """Largest accepted HTTP request."""
        return round(self.max_body_mb * _MIB)

    def check_exposure(self) -> None:
        """Refuse to listen on a public address without authentication.

        Raises:
            SettingsError: a public address without authentication and without ``insecure``.
        """
        if not (self.loopback or self.authenticated or self.insecure):
            raise SettingsError(
                f"refusing to listen on {self.host} without authentication: everyone could use the server. "
                "Give --token-file or --oidc-issuer with --oidc-audience, listen on 127.0.0.1, or pass --insecure"
            )

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] | None = None, /, **given: Any) -> Settings:
        """Read settings from ``VEHANCHOR_*`` variables; ``given`` values other than None take precedence.

        The system's path separator separates paths, commas separate other lists. An empty variable counts as unset.

        Raises:
            SettingsError: a variable is malformed or invalid.
        """
        environ = os.environ if environ is None else environ
        chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        for name, form in _forms().items():
            text = environ.get(variable_name(name))
            if name not in chosen and text:
                chosen[name] = _from_text(variable_name(name), text, form)
        return cls(**chosen)

    def to_json(self) -> str:
        """Serialise all settings for ``from_json`` in another process, without separators inside values."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return json.dumps({**values, "roots": self.spelled_roots}, default=str)

    @classmethod
    def from_json(cls, text: str) -> Settings:
        """Restore settings from ``to_json``.

        Raises:
            SettingsError: a setting is invalid.
        """
        values: dict[str, Any] = json.loads(text)
        for name, form in _forms().items():
            if form.many and values[name] is not None:
                values[name] = tuple(form.type(value) for value in values[name])
            elif values[name] is not None:
                values[name] = form.type(values[name])
        return cls(**values)


def _is_web_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:  # brackets without an address in them
        return False


def variable_name(name: str) -> str:
    """Return the environment variable of a field."""
    return f"VEHANCHOR_{name.upper()}"


class _Form(NamedTuple):
    """Type of a field's values, and whether it takes several."""

    type: Any
    many: bool


@cache
def _forms() -> dict[str, _Form]:
    forms = {}
    for name, kind in typing.get_type_hints(Settings).items():
        options = typing.get_args(kind)
        bare = options[0] if type(None) in options else kind
        many = typing.get_origin(bare) is tuple
        forms[name] = _Form(typing.get_args(bare)[0] if many else bare, many)
    return forms


def _checked_root(root: Path) -> Path:
    """Resolve a root; refuse missing directories and the whole file system."""
    try:
        resolved = Path(root).resolve(strict=True)
    except OSError as error:
        raise SettingsError(f"root {root}: {error.strerror}; give an existing directory") from None
    if not resolved.is_dir():
        raise SettingsError(f"root {root} is not a directory; give the directory of the images")
    if resolved == Path(resolved.anchor):
        raise SettingsError(f"root {root} is the whole file system; give the directory of the images")
    return resolved


def _from_text(variable: str, text: str, form: _Form) -> Any:
    """Convert a variable's text to the field's type."""
    try:
        if form.type is bool:
            if text.lower() not in _TRUE + _FALSE:
                raise ValueError(text)
            return text.lower() in _TRUE
        if form.many:
            parts = _split_paths(variable, text) if form.type is Path else text.split(",")
            return tuple(form.type(part.strip()) for part in parts if part.strip())
        return form.type(text)
    except ValueError as error:
        if isinstance(error, SettingsError):
            raise
        raise SettingsError(f"{variable} is {text!r}: expected {form.type.__name__}") from None


def _split_paths(variable: str, text: str) -> list[str]:
    """Split the paths of a variable; refuse an existing path that contains the separator."""
    parts = text.split(os.pathsep)
    for start, end in combinations(range(len(parts) + 1), 2):
        joined = os.pathsep.join(parts[start:end])
        if end - start > 1 and os.path.exists(joined):  # noqa: PTH110 - no error for a name that no path can have
            raise SettingsError(
                f"{variable} is {text!r}: {joined!r} exists, but {os.pathsep!r} separates paths in a variable. Use "
                "an option of 'vehanchor serve', or rename it"
            )
    return parts
