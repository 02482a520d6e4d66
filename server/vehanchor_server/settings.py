"""The operator's decisions: where images may come from, which model, how much work, who may call.

Nothing here can be changed by a caller. A field is declared once, with its default and its words: it is an option of
``vehanchor serve`` and a ``VEHANCHOR_*`` variable of the field's name without being named anywhere else.
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
from vehanchor.options import DECODED_BYTES_PER_PIXEL, ImageLimits, Search, declared_option, models
from vehanchor.options.option import Option, metadata_of, option, option_of

if TYPE_CHECKING:
    from collections.abc import Mapping

_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_EVERYWHERE = ("0.0.0.0", "::")
_TRUE, _FALSE = ("1", "true", "yes", "on"), ("0", "false", "no", "off")
_MIB, _MEGAPIXEL = 1 << 20, 1_000_000
_SOURCES, _WORK, _HTTP = "Where images may come from", "Models and limits", "HTTP"


class SettingsError(ValueError):
    """An option has no meaning, or two options contradict each other; the message says which and what to do."""


def _words(help_text: str, *, panel: str, metavar: str = "", flag: str = "", if_unset: str = "") -> dict[str, Any]:
    """Metadata of a field: all that is said about it.

    Args:
        help_text: one sentence for ``--help``.
        panel: heading in ``--help``.
        metavar: what stands for the value.
        flag: the option's name; empty for the field's own.
        if_unset: what a default of None means, in words.
    """
    return {**option(help_text, metavar=metavar, flag=flag), "panel": panel, "if_unset": if_unset}


def _declared(declared: str | Option, *, panel: str) -> dict[str, Any]:
    """Metadata of a field that is an option of the library: its help and limits are the option's.

    Args:
        declared: the option, or its keyword.
        panel: heading in ``--help``.
    """
    found = declared_option(declared) if isinstance(declared, str) else declared
    return {
        **metadata_of(found),
        "panel": panel,
        "if_unset": "",
    }


@dataclass(frozen=True)
class Settings:
    """The operator's options; each is explained where it is declared.

    Raises:
        SettingsError: an option has no meaning, or two of them contradict each other.
    """

    roots: tuple[Path, ...] = field(
        default=(),
        metadata=_words("Directory below which images may be read by path; repeatable.", panel=_SOURCES, flag="root"),
    )
    image_hosts: tuple[str, ...] = field(
        default=(),
        metadata=_words("Host that images may be fetched from (https); repeatable.", panel=_SOURCES, flag="image-host"),
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
        metadata=_words("Largest image decoded whole, megapixels.", panel=_WORK),
    )
    max_decoded_mb: float | None = field(
        default=None,
        metadata=_words(
            "Memory that decoding an image may take, MiB.",
            panel=_WORK,
            if_unset=f"{ImageLimits.max_decoded_bytes / _MIB:g}, and what the megapixels need",
        ),
    )
    max_windowed_megapixels: float = field(
        default=ImageLimits.max_windowed_pixels / _MEGAPIXEL,
        metadata=_words("Largest TIFF read by windows, megapixels.", panel=_WORK),
    )
    never_ask: bool = field(
        default=False,
        metadata=_words(
            "Never ask the person at a client for a region, a height or a known length at low confidence.", panel=_WORK
        ),
    )
    max_concurrency: int | None = field(
        default=None, metadata=_words("Calls at once in a process.", panel=_WORK, if_unset="one a CPU, at least 2")
    )
    in_process: bool = field(  # for a host on one's own machine: see SECURITY.md
        default=False,
        metadata=_words("Decode and compute here, not in processes that can be killed at the deadline.", panel=_WORK),
    )
    unconfined: bool = field(  # for systems on which a worker needs more than Python, the models and the roots
        default=False,
        metadata=_words(
            "Let worker processes read, write and start what this user may; on Linux they cannot.", panel=_WORK
        ),
    )
    max_worker_mb: float = field(  # of one process, of which there are at most as many as calls at once
        default=2048.0,
        metadata=_words("Data of a worker process beside its models, MiB; it ends beyond.", panel=_WORK),
    )
    deadline_s: float = field(  # below the 60 s at which common clients give up
        default=55.0, metadata=_words("Seconds after which a call ends.", panel=_WORK)
    )
    fetch_timeout_s: float = field(
        default=20.0, metadata=_words("Seconds that fetching an image may take.", panel=_SOURCES)
    )
    host: str = field(default="127.0.0.1", metadata=_words("Address to listen on.", panel=_HTTP))
    port: int = field(default=8000, metadata=_words("Port to listen on.", panel=_HTTP))
    workers: int = field(default=1, metadata=_words("Processes that share the port.", panel=_HTTP))
    allowed_hosts: tuple[str, ...] = field(  # name, name:port or name:*
        default=(),
        metadata=_words(
            "Host header to accept beside the loopback ones; repeatable.", panel=_HTTP, flag="allowed-host"
        ),
    )
    allowed_origins: tuple[str, ...] = field(
        default=(),
        metadata=_words(
            "Origin header to accept beside the loopback ones; repeatable.", panel=_HTTP, flag="allowed-origin"
        ),
    )
    public_url: str | None = field(default=None, metadata=_words("URL under which callers reach /mcp.", panel=_HTTP))
    token_file: Path | None = field(
        default=None, metadata=_words("File with one accepted bearer token a line.", panel=_HTTP)
    )
    oidc_issuer: str | None = field(default=None, metadata=_words("Issuer whose JWTs are accepted.", panel=_HTTP))
    oidc_audience: str | None = field(
        default=None, metadata=_words("Audience that those JWTs must carry.", panel=_HTTP)
    )
    max_body_mb: float = field(default=32.0, metadata=_words("Largest request, MiB.", panel=_HTTP))
    body_timeout_s: float = field(default=60.0, metadata=_words("Seconds a request may take to arrive.", panel=_HTTP))
    max_connections: int = field(
        default=512, metadata=_words("Connections at once in a process; the next are closed.", panel=_HTTP)
    )
    max_connections_per_address: int = field(  # a proxy is one address
        default=256, metadata=_words("Connections at once from one address.", panel=_HTTP)
    )
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
            value, declared = getattr(self, each.name), option_of(each)
            if declared is not None and declared.takes is not None and value is not None:
                _check(declared, each.name, value)
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
    def spelled_roots(self) -> tuple[Path, ...]:
        """The roots as the operator wrote them, absolute, links in them unresolved."""
        spelled: tuple[Path, ...] = self.__dict__["_spelled"]
        return spelled

    @property
    def authenticated(self) -> bool:
        """Whether HTTP callers must show a token."""
        return self.token_file is not None or self.oidc_issuer is not None

    @property
    def loopback(self) -> bool:
        """Whether HTTP listens where only this machine reaches it."""
        return self.host in _LOOPBACK

    @property
    def image_limits(self) -> ImageLimits:
        """The cost of an image that is accepted here."""
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
            max_unpacked_bytes=1,  # no caller fills the disk: a large JPEG is refused
        )

    @property
    def max_worker_bytes(self) -> int:
        """Data that a worker process may take beside its models."""
        return round(self.max_worker_mb * _MIB)

    @property
    def max_body_bytes(self) -> int:
        """Size of an HTTP request that is accepted."""
        return round(self.max_body_mb * _MIB)

    def check_exposure(self) -> None:
        """Refuse to listen where others reach the server and none has to show a token.

        Raises:
            SettingsError: a public address, no authentication, and not ``insecure``.
        """
        if not (self.loopback or self.authenticated or self.insecure):
            raise SettingsError(
                f"refusing to listen on {self.host} without authentication: everyone could use the server. "
                "Give --token-file or --oidc-issuer with --oidc-audience, listen on 127.0.0.1, or pass --insecure"
            )

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] | None = None, /, **given: Any) -> Settings:
        """Options from ``VEHANCHOR_*`` variables, those ``given`` (and not None) first.

        Paths are separated by the system's path separator, other lists by commas. An empty variable is none.

        Raises:
            SettingsError: a variable cannot be read, or what it says has no meaning.
        """
        environ = os.environ if environ is None else environ
        chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        for name, form in _forms().items():
            text = environ.get(variable_name(name))
            if name not in chosen and text:
                chosen[name] = _from_text(variable_name(name), text, form)
        return cls(**chosen)

    def to_json(self) -> str:
        """All options, for ``from_json`` in another process; unlike variables, with nothing that separates values."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return json.dumps({**values, "roots": self.spelled_roots}, default=str)

    @classmethod
    def from_json(cls, text: str) -> Settings:
        """The options that ``to_json`` gave.

        Raises:
            SettingsError: one of them has no meaning here.
        """
        values: dict[str, Any] = json.loads(text)
        for name, form in _forms().items():
            if form.many and values[name] is not None:
                values[name] = tuple(form.type(value) for value in values[name])
            elif values[name] is not None:
                values[name] = form.type(values[name])
        return cls(**values)


def _check(declared: Option, name: str, value: Any) -> None:
    """Check a value as the library does.

    Raises:
        SettingsError: the option takes no such value.
    """
    assert declared.takes is not None
    try:
        declared.takes.check(name, value)
    except InvalidParameterError as error:
        raise SettingsError(str(error)) from None


def _is_web_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:  # brackets without an address in them
        return False


def variable_name(name: str) -> str:
    """The environment variable of a field."""
    return f"VEHANCHOR_{name.upper()}"


class _Form(NamedTuple):
    """How a field's values are written: one or many of a type."""

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
    """The directory, resolved; a root that is missing or is everything is a mistake to tell at once."""
    try:
        resolved = Path(root).resolve(strict=True)
    except OSError as error:
        raise SettingsError(f"root {root}: {error.strerror}; give an existing directory") from None
    if not resolved.is_dir():
        raise SettingsError(f"root {root} is not a directory; give the directory that holds the images")
    if resolved == Path(resolved.anchor):
        raise SettingsError(f"root {root} is the whole file system; give the directory that holds the images")
    return resolved


def _from_text(variable: str, text: str, form: _Form) -> Any:
    """A variable's text as the field's type."""
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
    """The paths of a variable; refuses a name with the separator in it, which would be read as other directories."""
    parts = text.split(os.pathsep)
    for start, end in combinations(range(len(parts) + 1), 2):
        joined = os.pathsep.join(parts[start:end])
        if end - start > 1 and os.path.exists(joined):  # noqa: PTH110 - no error for a name that no path can have
            raise SettingsError(
                f"{variable} is {text!r}: {joined!r} exists, but {os.pathsep!r} separates paths in a variable. Name it "
                "by an option of 'vehanchor serve', or rename it"
            )
    return parts
