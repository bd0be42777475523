"""A small service and whoever asks it over HTTP."""

from __future__ import annotations

from typing import Any

import httpx
from pydantic import TypeAdapter

from service.api import models
from service.store import AlarmEvent

T0 = 1_795_212_000.0
LIE = {"H3": 9.0}


class Setup:
    def __init__(self, service: Any, server: Any) -> None:
        self.service, self.server = service, server
        self.village = next(iter(service.villages.values()))
        self.http = httpx.Client(base_url=server.url, timeout=20)

    def attack(self, t: float = T0, ticks: int = 4, **changes: Any) -> None:
        for k in range(ticks):
            self.service.tick(self.village.report(t + k, **({"lies": LIE} | changes)))

    def calm(self, t: float, ticks: int = 8) -> None:
        self.attack(t, ticks, lies={})

    def get(self, path: str, **arguments: Any) -> httpx.Response:
        return self.http.get(f"/api/v1{path}", **arguments)

    def one(self) -> dict[str, Any]:
        (alarm,) = self.get("/alarms").json()["alarms"]
        return alarm


def is_problem(response: httpx.Response, status: int) -> dict[str, Any]:
    assert response.status_code == status, (response.request.url, response.text)
    assert response.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = response.json()
    assert models.Problem.model_validate(body).status == status
    assert body["instance"] == response.request.url.path
    assert body["detail"]
    return body


class Stream:
    """A client of server-sent events that parses what the standard says."""

    def __init__(self, setup: Setup, path: str, **headers: str) -> None:
        self.context = setup.http.stream("GET", f"/api/v1{path}", headers=headers)
        self.response = self.context.__enter__()
        self.lines = self.response.iter_lines()

    def next(self) -> dict[str, str]:
        event: dict[str, str] = {}
        for line in self.lines:
            if line.startswith(":"):
                event["comment"] = line[1:].strip()
            elif line:
                name, _, value = line.partition(": ")
                event[name] = value
            elif event:
                return event
        return {"end": "true"}

    def alarms(self, count: int) -> list[tuple[int, str]]:
        found = []
        while len(found) < count:
            event = self.next()
            if "data" in event:
                data = TypeAdapter(AlarmEvent).validate_json(event["data"])
                assert event["event"] == "alarm"
                assert int(event["id"]) == data.seq
                found.append((data.seq, str(data.change)))
        return found

    def close(self) -> None:
        self.context.__exit__(None, None, None)
