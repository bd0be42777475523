"""Identities, roles, and the policy of REST.

A role includes all lower ones: viewer < operator < engineer < admin. An identity has one role and, if it is
restricted, a set of feeders. A route that is not in `POLICY` is denied to every identity.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from gridsec.errors import GridsecError


class Role(StrEnum):
    """Role of an identity, in ascending order of permissions."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    ENGINEER = "engineer"
    ADMIN = "admin"

    def includes(self, other: Role) -> bool:
        """True if this role has the permissions of the other one."""
        order = tuple(Role)
        return order.index(self) >= order.index(other)


PUBLIC: Final = None
"""Role of a route that needs no credential."""

POLICY: Final[dict[str, Role | None]] = {
    "GET /healthz": PUBLIC,
    "GET /readyz": PUBLIC,
    "GET /api/v1/session": PUBLIC,
    "POST /api/v1/session": PUBLIC,
    "DELETE /api/v1/session": PUBLIC,
    "GET /metrics": Role.VIEWER,
    "GET /api/v1/feeders": Role.VIEWER,
    "GET /api/v1/feeders/{feeder}": Role.VIEWER,
    "GET /api/v1/feeders/{feeder}/state": Role.VIEWER,
    "GET /api/v1/feeders/{feeder}/meters/{meter}": Role.VIEWER,
    "GET /api/v1/feeders/{feeder}/history": Role.VIEWER,
    "GET /api/v1/feeders/{feeder}/series": Role.VIEWER,
    "GET /api/v1/feeders/{feeder}/commissioning": Role.VIEWER,
    "GET /api/v1/feeders/{feeder}/commissioning/events": Role.VIEWER,
    "GET /api/v1/feeders/{feeder}/stream": Role.VIEWER,
    "GET /api/v1/alarms": Role.VIEWER,
    "GET /api/v1/alarms/stream": Role.VIEWER,
    "GET /api/v1/alarms/{alarm_id}": Role.VIEWER,
    "GET /api/v1/alarms/{alarm_id}/events": Role.VIEWER,
    "GET /api/v1/bad-readings": Role.VIEWER,
    "GET /api/v1/incidents": Role.VIEWER,
    "GET /api/v1/incidents/events": Role.VIEWER,
    "GET /api/v1/incidents/stream": Role.VIEWER,
    "GET /api/v1/incidents/{incident_id}": Role.VIEWER,
    "GET /api/v1/incidents/{incident_id}/events": Role.VIEWER,
    "GET /api/v1/shelves": Role.VIEWER,
    "GET /api/v1/planned-work": Role.VIEWER,
    "GET /api/v1/hand-over": Role.VIEWER,
    "POST /api/v1/alarms/ack": Role.OPERATOR,
    "POST /api/v1/alarms/{alarm_id}/ack": Role.OPERATOR,
    "POST /api/v1/alarms/{alarm_id}/unack": Role.OPERATOR,
    "POST /api/v1/alarms/{alarm_id}/comment": Role.OPERATOR,
    "POST /api/v1/incidents/{incident_id}/ack": Role.OPERATOR,
    "POST /api/v1/incidents/{incident_id}/unack": Role.OPERATOR,
    "POST /api/v1/incidents/{incident_id}/comment": Role.OPERATOR,
    "POST /api/v1/incidents/{incident_id}/assign": Role.OPERATOR,
    "POST /api/v1/shelves": Role.OPERATOR,
    "POST /api/v1/shelves/{shelf_id}/end": Role.OPERATOR,
    "POST /api/v1/planned-work": Role.OPERATOR,
    "POST /api/v1/planned-work/{work_id}/end": Role.OPERATOR,
    "PUT /api/v1/feeders/{feeder}": Role.ENGINEER,
    "DELETE /api/v1/feeders/{feeder}": Role.ENGINEER,
    "POST /api/v1/feeders/{feeder}/commissioning": Role.ENGINEER,
    "GET /api/v1/notifications": Role.OPERATOR,
    "GET /api/v1/notifications/dead-letters": Role.OPERATOR,
    "POST /api/v1/notifications/dead-letters/resend": Role.ENGINEER,
    "POST /api/v1/notifications/dead-letters/discard": Role.ENGINEER,
    "GET /api/v1/audit": Role.ADMIN,
}
"""Least role by method and path. The files of the web page hold no data and are public."""

WHOLE_FLEET: Final = frozenset(
    {
        "GET /metrics",
        "GET /api/v1/bad-readings",
        "GET /api/v1/notifications",
        "GET /api/v1/notifications/dead-letters",
        "POST /api/v1/notifications/dead-letters/resend",
        "POST /api/v1/notifications/dead-letters/discard",
        "GET /api/v1/audit",
    }
)
"""Routes with data of all feeders; identities with restricted feeders have no access."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Authenticated identity of a request."""

    name: str  # name in alarms, comments and the audit log
    role: Role  # its role
    feeders: frozenset[str] | None = None  # feeders it has access to; None for all
    # credential that proved it: `key <id>`, `token <issuer>`, or `open` without authentication
    credential: str = "open"

    def sees(self, feeder: str) -> bool:
        """True if the feeder is in the scope of this identity."""
        return self.feeders is None or feeder in self.feeders

    def seen(self, feeders: Iterable[str]) -> tuple[str, ...]:
        """Feeders in the scope of this identity, in the given order."""
        return tuple(name for name in feeders if self.sees(name))

    def permits(self, route: str) -> str | None:
        """Reason why this identity has no access to a route, or None.

        route: method and path template, a key of `POLICY`.
        """
        if route not in POLICY:
            return "no role has access to this resource"
        least = POLICY[route]
        if least is not None and not self.role.includes(least):
            return f"this needs the role {least}; {self.name} is {self.role}"
        if self.feeders is not None and route in WHOLE_FLEET:
            return f"this shows all feeders; {self.name} has access to {', '.join(sorted(self.feeders))}"
        return None


OPEN: Final = Identity("", Role.ADMIN)
"""Identity of all requests where no authentication is set up. Requests give the operator's name."""


NAME_MOST: Final = 64
"""Largest length of an identity's name, characters."""


def is_name(text: str) -> bool:
    """True for 1 to 64 printable characters without a space at an end."""
    return 0 < len(text) <= NAME_MOST and text.isprintable() and text == text.strip()


class NotAuthenticated(GridsecError):
    """The request has no valid credential."""

    code = "not-authenticated"


class IssuerUnavailable(GridsecError):
    """The keys of the issuer of tokens cannot be read."""

    code = "issuer-unavailable"


class NotPermitted(GridsecError):
    """The identity has no access to the resource."""

    code = "not-permitted"


class TooManyFailures(GridsecError):
    """The client has sent too many invalid credentials."""

    code = "too-many-failures"
