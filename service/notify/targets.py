"""Targets of notifications: the TOML file of `gridsec serve --notify`.

    external_url = "https://gridsec.example"

    [[webhook]]
    name = "dispatch"
    url = "https://hooks.example/gridsec"
    secret = "whsec_..."                      # or secret_file = "/run/credentials/dispatch"
    severities = ["critical", "major"]        # these filters are optional
    kinds = ["manipulation"]
    feeders = ["village"]
    changes = ["opened", "cleared"]           # default: begin and end, escalation, end of a suppression

    [[alertmanager]]
    name = "control-room"
    url = "http://127.0.0.1:9093"
    private_addresses = true
    labels = { site = "north" }

All problems of the file are reported at once.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from gridsec.errors import InputInvalid, Problem
from service.alarms.incidents import IncidentChange, IncidentKind
from service.alarms.state_machine import Severity
from service.notify.notices import MAIN_CHANGES, Notice
from service.notify.post import Endpoint
from service.notify.webhook import secret_bytes

TARGETS_MOST: Final = 16
"""Largest number of targets: each has a thread."""
_NAME: Final = re.compile(r"^[A-Za-z0-9_-]{1,64}$")
_LABEL: Final = re.compile(r"^[a-zA-Z_][a-zA-Z0-9_]*$")
_FEEDER = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
_Positive = Annotated[float, Field(gt=0.0, le=86_400.0, allow_inf_nan=False)]


class Target(BaseModel):
    """Target of notifications: address, limits and filters."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    url: str
    private_addresses: bool = False
    ca_file: Path | None = None
    timeout_s: Annotated[float, Field(ge=0.1, le=60.0, allow_inf_nan=False)] = 10.0
    give_up_s: _Positive = 3600.0
    severities: tuple[Severity, ...] = ()
    kinds: tuple[IncidentKind, ...] = ()
    feeders: tuple[_FEEDER, ...] = ()

    @field_validator("name")
    @classmethod
    def _named(cls, value: str) -> str:
        if not _NAME.match(value):
            raise InputInvalid([Problem("wrong-name", f"{value!r}: 1 to 64 of A-Z a-z 0-9 _ -")])
        return value

    @field_validator("ca_file")
    @classmethod
    def _file(cls, value: Path | None) -> Path | None:
        if value is not None and not value.is_file():
            raise InputInvalid([Problem("no-file", f"{value} is not a file")])
        return value

    @model_validator(mode="after")
    def _address(self) -> Self:
        parts = urlsplit(self.url)
        port = _port(self.url)
        if parts.scheme not in {"http", "https"} or not parts.hostname or port is None or parts.username:
            text = f"url is {self.url!r}; expected https://host/path without a user"
            raise InputInvalid([Problem("wrong-address", text)])
        if parts.scheme == "http" and not self.private_addresses:
            text = f"url is {self.url!r}: plain HTTP needs `private_addresses = true`; expected https://"
            raise InputInvalid([Problem("plaintext-network", text)])
        return self

    @property
    def kind(self) -> str:
        """Table of the file that the target is in."""
        return type(self).__name__.lower()

    @property
    def host(self) -> str:
        """Host of the address."""
        return urlsplit(self.url).hostname or ""

    def endpoint(self, path: str = "") -> Endpoint:
        """Address for requests. `path` is appended to that of the url."""
        ca_file = None if self.ca_file is None else str(self.ca_file)
        url = self.url.rstrip("/") + path if path else self.url
        return Endpoint(url, self.private_addresses, self.timeout_s, ca_file)

    def selects(self, notice: Notice) -> bool:
        """True if a notice is sent to this target. An empty filter selects everything."""
        chosen = (
            (self.severities, notice.severity),
            (self.kinds, notice.kind),
            (self.feeders, notice.feeder),
        )
        return all(not allowed or value in allowed for allowed, value in chosen)


class Webhook(Target):
    """Target that receives messages of Standard Webhooks."""

    type: Literal["webhook"] = Field(default="webhook", exclude=True)
    secret: str | None = Field(default=None, repr=False)
    secret_file: Path | None = None
    changes: Annotated[tuple[IncidentChange, ...], Field(min_length=1)] = MAIN_CHANGES

    def selects(self, notice: Notice) -> bool:
        """True if a notice is sent: of the chosen changes, those that are not suppressed."""
        return notice.notify and notice.change in self.changes and super().selects(notice)

    @model_validator(mode="after")
    def _signed(self) -> Self:
        if (self.secret is None) == (self.secret_file is None):
            raise InputInvalid([Problem("missing", "expected secret or secret_file, one of them")])
        self.key()
        return self

    def key(self) -> bytes:
        """Return the bytes of the secret. Raises InputInvalid without a valid one."""
        text = self.secret
        if self.secret_file is not None:
            try:
                text = self.secret_file.read_text("utf-8").strip()
            except (OSError, UnicodeDecodeError) as error:
                problem = f"secret_file {self.secret_file}: {getattr(error, 'strerror', None) or error}"
                raise InputInvalid([Problem("no-file", problem)]) from error
        found = secret_bytes(text or "")
        if found is None:
            what = "the secret must be whsec_ and 24 to 64 bytes in base64; `gridsec notify secret` makes one"
            raise InputInvalid([Problem("wrong-secret", what)])
        return found


class Alertmanager(Target):
    """Target with the API v2 of Alertmanager."""

    type: Literal["alertmanager"] = Field(default="alertmanager", exclude=True)
    labels: dict[str, str] = Field(default_factory=dict)
    resend_s: Annotated[float, Field(ge=1.0, le=3600.0, allow_inf_nan=False)] = 60.0

    @field_validator("labels")
    @classmethod
    def _labels(cls, value: dict[str, str]) -> dict[str, str]:
        wrong = [name for name in value if not _LABEL.match(name) or name.startswith("__")]
        if wrong:
            text = f"{', '.join(wrong)}: letters, digits and _, not a digit first"
            raise InputInvalid([Problem("wrong-name", text)])
        return value


class Targets(BaseModel):
    """All targets of a file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    external_url: str = ""
    webhook: tuple[Webhook, ...] = ()
    alertmanager: tuple[Alertmanager, ...] = ()

    @property
    def all(self) -> tuple[Webhook | Alertmanager, ...]:
        """All targets."""
        return (*self.webhook, *self.alertmanager)


def read_targets(path: Path) -> Targets:
    """Return the targets of a file.

    Raises InputInvalid with all problems.
    """
    try:
        given = tomllib.loads(path.read_text("utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        text = f"{path}: {getattr(error, 'strerror', None) or error}"
        raise InputInvalid([Problem("no-file", text)]) from error
    except tomllib.TOMLDecodeError as error:
        raise InputInvalid([Problem("not-toml", f"{path}: {error}")]) from error
    try:
        found = Targets.model_validate(given)
    except ValidationError as error:
        problems = [_problem(path, given, one) for one in error.errors(include_url=False)]
        raise InputInvalid(problems) from error
    problems = [Problem("duplicate", f"{path}: {name!r} names several targets") for name in _repeated(found)]
    if len(found.all) > TARGETS_MOST:
        text = f"{path}: {len(found.all)} targets; at most {TARGETS_MOST} are possible"
        problems.append(Problem("out-of-range", text))
    if not found.all:
        problems.append(Problem("missing", f"{path}: expected [[webhook]] or [[alertmanager]]"))
    if problems:
        raise InputInvalid(problems)
    return found


def _repeated(found: Targets) -> list[str]:
    names = [each.name for each in found.all]
    return sorted({name for name in names if names.count(name) > 1})


def _port(url: str) -> int | None:
    """Port of an address; 0 without one, None for a wrong one."""
    try:
        return urlsplit(url).port or 0
    except ValueError:
        return None


_CODES: Final = {
    "enum": "unknown-name",
    "extra_forbidden": "unknown-name",
    "missing": "missing",
    "finite_number": "not-finite",
    "greater_than": "out-of-range",
    "greater_than_equal": "out-of-range",
    "less_than_equal": "out-of-range",
}
"""Code by pydantic's type of the error; `wrong-type` for all others."""


def _problem(path: Path, given: Mapping[str, Any], error: Any) -> Problem:
    place = _place(given, error["loc"])
    start = f"{path}: {place}: " if place else f"{path}: "
    if error["type"] == "value_error":
        cause = error["ctx"]["error"]
        return Problem(cause.codes[0], start + "; ".join(cause.problems))
    text = f"{error['msg']} (is {error['input']!r})" if error["type"] != "missing" else error["msg"]
    return Problem(_CODES.get(error["type"], "wrong-type"), start + text)


def _place(given: Mapping[str, Any], loc: Iterable[str | int]) -> str:
    """Place of a problem: the target by its name or its number, and the field."""
    parts: list[str] = []
    value: Any = given
    for each in loc:
        value = value[each] if _has(value, each) else None
        if isinstance(each, int) and len(parts) == 1:
            named = value.get("name") if isinstance(value, dict) else None
            parts[0] += f" {named!r}" if named else f" {each + 1}"
        elif isinstance(each, int):
            parts.append(f"entry {each + 1}")
        else:
            parts.append(str(each))
    return ", ".join(parts)


def _has(value: Any, key: str | int) -> bool:
    return (isinstance(value, dict) and key in value) or (
        isinstance(value, list) and isinstance(key, int) and key < len(value)
    )
