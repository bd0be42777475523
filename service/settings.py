"""Settings of the service: by command line, by environment (`GRIDSEC_...`), or by default.

All problems are reported at once, in terms of the options.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

from feeders.format.columns import ESTIMATORS
from gridsec.errors import GridsecError, InputInvalid, Problem
from service.access.signing import MeterKeys, read_meter_keys
from service.errors import prefixed
from service.ingest.align import Clock

ENV_PREFIX = "GRIDSEC_"
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
_ENDPOINT = re.compile(r"^(tcp|udp|tls|quic|ws|unixsock-stream|unixpipe|vsock|serial)/\S+$")
_HOST = re.compile(r"^[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*$")
_PREFIX = re.compile(r"^[A-Za-z0-9_.-]+(/[A-Za-z0-9_.-]+)*$")


_CODES = {
    "enum": "unknown-name",
    "extra_forbidden": "unknown-name",
    "finite_number": "not-finite",
    "greater_than": "out-of-range",
    "greater_than_equal": "out-of-range",
    "less_than_equal": "out-of-range",
    "literal_error": "unknown-name",
}
"""Code by pydantic's type of the error; `wrong-type` for all others."""


class SettingsInvalid(GridsecError):
    """The settings are wrong; `problems` lists all of them.

    problems: one sentence each.
    """

    code = "wrong-settings"

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n  - ".join(["the settings are wrong:", *self.problems]))

    @property
    def codes(self) -> tuple[str, ...]:
        """Code of each problem."""
        return tuple(problem.code for problem in self.problems)


Listed = Annotated[tuple[str, ...], NoDecode]


class Settings(BaseSettings):
    """All settings of `gridsec serve`. Lists in the environment are separated by commas."""

    model_config = SettingsConfigDict(env_prefix=ENV_PREFIX, extra="forbid", frozen=True)

    feeders: Listed = ()
    estimator: str | None = None
    zenoh_listen: Listed = ()
    zenoh_connect: Listed = ()
    zenoh_mode: Literal["router", "peer", "client"] | None = None
    zenoh_config: Path | None = None
    prefix: str = "gridsec"
    http: str = "127.0.0.1:8000"
    http_hosts: Listed = ()
    database: str = "sqlite:///gridsec.db"
    clock: Clock = Clock.WALL
    max_skew_s: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    grace_s: float | None = Field(default=None, ge=0.0, allow_inf_nan=False)
    max_payload: int = Field(default=256 * 1024, ge=1024, le=16 << 20)
    queue: int = Field(default=20_000, ge=100)
    max_feeders: int = Field(default=100, ge=0)
    max_shelve_h: float = Field(default=24.0, gt=0.0, le=8760.0, allow_inf_nan=False)
    oidc_issuer: str = ""
    oidc_audience: str = "gridsec"
    oidc_jwks: str = ""
    oidc_role_claim: str = "gridsec_role"
    open_to_network_without_authentication: bool = False
    meter_keys: Path | None = None
    unsigned: Literal["refuse", "accept"] = "refuse"
    plaintext_network: bool = False
    notify: Path | None = None
    workers: int | None = Field(default=None, ge=0, le=256)
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    log_format: Literal["console", "json"] = "console"

    @property
    def listen(self) -> tuple[str, ...]:
        """Endpoints to listen on; none by default for clients and with a zenoh configuration file."""
        if self.zenoh_listen or self.zenoh_config is not None or self.zenoh_mode == "client":
            return self.zenoh_listen
        return (DEFAULT_ENDPOINT,)

    def read_meter_keys(self) -> MeterKeys | None:
        """Return the keys of meters; None without `meter_keys`.

        Raises
        ------
        SettingsInvalid
            If the file cannot be read, or has a wrong row.
        """
        if self.meter_keys is None:
            return None
        try:
            return read_meter_keys(self.meter_keys, accepts_unlisted=self.unsigned == "accept")
        except InputInvalid as error:
            start = f"--meter-keys or {ENV_PREFIX}METER_KEYS: "
            raise SettingsInvalid(prefixed(start, one) for one in error.problems) from error

    @field_validator("feeders", "zenoh_listen", "zenoh_connect", "http_hosts", mode="before")
    @classmethod
    def _split(cls, value: object) -> object:
        if isinstance(value, str):
            return tuple(part.strip() for part in value.split(",") if part.strip())
        return value

    @field_validator("zenoh_listen", "zenoh_connect")
    @classmethod
    def _endpoints(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        wrong = [end for end in value if not _ENDPOINT.match(end)]
        if wrong:
            text = f"{', '.join(wrong)}: an endpoint looks like tcp/127.0.0.1:7447"
            raise InputInvalid([Problem("wrong-endpoint", text)])
        return value

    @field_validator("http_hosts")
    @classmethod
    def _names(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        wrong = [name for name in value if not _HOST.match(name)]
        if wrong:
            text = f"{', '.join(wrong)}: a host name looks like grid.example, without a port"
            raise InputInvalid([Problem("wrong-host", text)])
        return value

    @field_validator("estimator")
    @classmethod
    def _known(cls, value: str | None) -> str | None:
        if value is not None and value not in ESTIMATORS:
            text = f"{value!r} is not an estimator; expected one of {', '.join(ESTIMATORS)}"
            raise InputInvalid([Problem("unknown-name", text)])
        return value

    @field_validator("zenoh_config", "notify")
    @classmethod
    def _file(cls, value: Path | None) -> Path | None:
        if value is not None and not value.is_file():
            raise InputInvalid([Problem("no-file", f"{value} is not a file")])
        return value

    @field_validator("prefix")
    @classmethod
    def _chunks(cls, value: str) -> str:
        if not _PREFIX.match(value):
            text = f"{value!r}: letters, digits and _ . - in chunks separated by slashes"
            raise InputInvalid([Problem("wrong-prefix", text)])
        return value

    @field_validator("http")
    @classmethod
    def _address(cls, value: str) -> str:
        split_address(value)
        return value


def is_loopback(host: str) -> bool:
    """True if a host name or address is of this machine only."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def split_address(address: str) -> tuple[str, int]:
    """Return host and port of `host:port` or `[v6]:port`.

    Raises InputInvalid if the text is not an address.
    """
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isascii() or not port.isdigit() or int(port) > 65535:
        text = f"{address!r}: an address looks like 127.0.0.1:8000, with a port up to 65535"
        raise InputInvalid([Problem("wrong-address", text)])
    return host, int(port)


def settings(given: Mapping[str, Any]) -> Settings:
    """Return the settings: given values, then the environment, then the defaults.

    Raises SettingsInvalid with every problem.
    """
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        raise SettingsInvalid(_problem(one) for one in error.errors()) from error


def strangers(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that look like settings, each with the closest setting or "".

    They do not prevent the start: links between containers add variables of such names.
    """
    ours = [ENV_PREFIX + name.upper() for name in Settings.model_fields]
    strange = (
        name for name in environment if name.upper().startswith(ENV_PREFIX) and name.upper() not in ours
    )
    closest = {name: get_close_matches(name.upper(), ours, 1) for name in strange if name not in _OTHERS}
    return {name: found[0] if found else "" for name, found in sorted(closest.items())}


# Read elsewhere: folder of cached designs, and the switch that forbids tests to skip.
_OTHERS = ("GRIDSEC_CACHE_DIR", "GRIDSEC_TESTS_REQUIRE_ALL")


def exposed(endpoints: Iterable[str]) -> tuple[str, ...]:
    """Return the endpoints of zenoh that use a network beyond loopback without TLS."""
    return tuple(end.partition("#")[0] for end in endpoints if not _protected(end))


def _protected(endpoint: str) -> bool:
    protocol, _, rest = endpoint.partition("/")
    if protocol not in ("tcp", "udp", "ws"):
        return True
    address = re.split("[?#]", rest, maxsplit=1)[0]
    host = address.rpartition(":")[0].removeprefix("[").removesuffix("]")
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def refuse_exposed(endpoints: Iterable[str]) -> None:
    """Refuse endpoints of zenoh that use a network beyond loopback without TLS.

    Raises
    ------
    SettingsInvalid
        With one problem for all of them.
    """
    found = exposed(endpoints)
    if found:
        text = (
            f"zenoh uses a network without TLS: {', '.join(found)}; expected an endpoint on loopback, or "
            "--zenoh-config with a file made by `gridsec zenoh-config`, or --plaintext-network "
            f"({ENV_PREFIX}PLAINTEXT_NETWORK) where any machine of the network may publish readings"
        )
        raise SettingsInvalid([Problem("plaintext-network", text)])


def _problem(error: Any) -> Problem:
    name = str(error["loc"][0]) if error["loc"] else "settings"
    option, variable = "--" + name.replace("_", "-").removesuffix("-s"), ENV_PREFIX + name.upper()
    option = {"--max-shelve-h": "--max-shelve", "--feeders": "--feeder", "--http-hosts": "--http-host"}.get(
        option, option
    )
    message = str(error["msg"]).removeprefix("Value error, ")
    kind = error["type"]
    if kind == "value_error":
        (code,) = error["ctx"]["error"].codes
        return Problem(code, f"{option} or {variable}: {message}")
    return Problem(
        _CODES.get(kind, "wrong-type"), f"{option} or {variable}: {message} (is {error['input']!r})"
    )
