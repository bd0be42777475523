"""Alerts of Alertmanager's API v2: https://github.com/prometheus/alertmanager/blob/main/api/v2/openapi.yaml.

Grouping, routing, e-mail, silences and inhibition are Alertmanager's task. An open incident is sent at its
changes and again every `resend_s`, with an end that lies `HOLD` intervals ahead: if the service ends, the
alert resolves by itself. A cleared, shelved or planned incident is sent once with its end.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Final

from service.alarms.incidents import IncidentChange
from service.alarms.state_machine import Severity
from service.notify.notices import Notice
from service.times import rfc3339

PATH: Final = "/api/v2/alerts"
HOLD: Final = 4.0
"""Life of an active alert without a further request, in intervals of `resend_s`; as of Prometheus."""
ALERTS_AT_ONCE: Final = 64
"""Largest number of notices in one request."""
METERS_SHOWN: Final = 50
"""Largest number of meters in an annotation."""
_SEVERITIES: Final = tuple(str(each) for each in Severity)


def alerts(
    notice: Notice, labels: Mapping[str, str], external_url: str, now: float, resend_s: float
) -> list[dict[str, Any]]:
    """Return the alert of a notice, and at an escalation the end of the alerts of lower severities.

    notice: the newest event of the subject.
    labels: further labels of the target.
    external_url: address of the service for links; empty for none.
    now: Unix time, s.
    resend_s: interval of repetitions, s.
    """
    end = now + HOLD * resend_s if notice.active else (notice.ended or notice.t)
    url = f"{external_url.rstrip('/')}/#{notice.feeder}" if external_url else ""
    own = {
        **labels,
        "alertname": "".join(part.capitalize() for part in notice.kind.split("-")),
        "kind": notice.kind,
        "feeder": notice.feeder,
        "id": notice.subject,
    }

    annotations = {"summary": notice.summary}
    if notice.meters:
        annotations["meters"] = ", ".join(notice.meters[:METERS_SHOWN])

    def made(severity: str, end: float) -> dict[str, Any]:
        return {
            "labels": {**own, "severity": severity},
            "annotations": annotations,
            "startsAt": rfc3339(notice.began),
            # Alertmanager refuses an alert that ends before its start.
            "endsAt": rfc3339(max(end, notice.began)),
            **({"generatorURL": url} if url else {}),
        }

    found = [made(notice.severity, end)]
    if notice.change == IncidentChange.ESCALATED:
        lower = _SEVERITIES[_SEVERITIES.index(notice.severity) + 1 :]
        # The severity is a label: without its end the earlier alert would stay until its time limit.
        found += [made(severity, notice.t) for severity in lower]
    return found


def newest(notices: Iterable[Notice]) -> list[Notice]:
    """Return the newest notice of each subject, in the order of their first notices."""
    return list({notice.subject: notice for notice in notices}.values())


def body_of(alerts: Iterable[Mapping[str, Any]]) -> str:
    """Return the body of a request."""
    return json.dumps(list(alerts), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
