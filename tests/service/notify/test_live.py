"""Notifications of a running service: readings over zenoh, messages over HTTP, REST and command line."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from feeders.model.site import load
from feeders.simulation.scenario import Scenario, random_attacks
from service.cli.simulate import Pace, play
from service.notify.webhook import secret_bytes, signature
from service.settings import SettingsInvalid, settings
from service.store.deliveries import DeadLetter, DeliveryStore
from tests.codes import refused
from tests.service.commands import command
from tests.service.receiver import Receiver, receiving
from tests.service.running import FEEDER, InProcess, service, until

SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
START = 1_795_212_000.0
gridsec = command("notify")


def targets_file(folder: Path, receiver: Receiver, more: str = "") -> Path:
    path = folder / "targets.toml"
    path.write_text(
        f'[[webhook]]\nname = "hook"\nurl = "{receiver.url}/in"\nsecret = "{SECRET}"\n'
        f"private_addresses = true\ntimeout_s = 5.0\n{more}"
    )
    return path


@pytest.fixture(scope="module")
def receiver() -> Iterator[Receiver]:
    with receiving() as made:
        yield made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("notify")


@pytest.fixture(scope="module")
def live(folder: Path, receiver: Receiver) -> Iterator[InProcess]:
    """A service after an attack on four meters; the first message was refused."""
    site = load(FEEDER)
    attacks = random_attacks(site, 5, "scaling", 4, 0.03, t_on=START + 6, t_off=START + 12)
    scenario = Scenario(seed=4, start=START, duration_s=28.0, attacks=attacks)
    receiver.answers.extend([400] * 3)
    with service(folder, clock="events", notify=targets_file(folder, receiver)) as made:
        for _ in play(site, scenario, made.meters, Pace(float("inf"), ahead=3)):
            pass
        until(lambda: len(receiver.got) >= 4, "the messages")
        yield made


def target(live: InProcess) -> dict[str, Any]:
    (found,) = live.get("/api/v1/notifications")["targets"]
    return dict(found)


@pytest.mark.acceptance
def test_an_attack_is_one_message_at_its_begin_and_one_at_its_end(
    live: InProcess, receiver: Receiver
) -> None:
    assert len(live.alarms()) == 4
    got = receiver.got[:4]
    assert [json.loads(each.body)["type"] for each in got] == ["incident.opened"] * 3 + ["incident.cleared"]
    for each in got:
        name, when = each.headers["webhook-id"], each.headers["webhook-timestamp"]
        made = signature(secret_bytes(SECRET) or b"", name, when, each.body)
        assert (each.path, each.headers["webhook-signature"]) == ("/in", f"v1,{made}")
    incident = json.loads(got[-1].body)["data"]["incident"]
    assert (incident["feeder"], incident["kind"], len(incident["meters"])) == (FEEDER, "manipulation", 4)


@pytest.mark.acceptance
def test_rest_and_the_command_line_show_and_resend_dead_letters(
    live: InProcess, receiver: Receiver, folder: Path, monkeypatch: Any, capsys: Any
) -> None:
    until(lambda: target(live)["waiting"] == 0, "all deliveries")
    shown = target(live)
    assert (shown["name"], shown["kind"], shown["host"], shown["dead_letters"]) == (
        "hook",
        "webhook",
        "127.0.0.1",
        1,
    )
    assert (shown["failing_since"], shown["problem"]) == (None, None)
    (letter,) = live.get("/api/v1/notifications/dead-letters", target="hook")["dead_letters"]
    assert (letter["type"], letter["attempts"], letter["problem"]) == (
        "incident.opened", 3, "status 400 Bad Request: no",
    )  # fmt: skip
    assert letter["message"]["data"]["incident"]["feeder"] == FEEDER
    assert live.metric("gridsec_dead_letters", target="hook") == 1.0
    assert live.metric("gridsec_notifications_total", target="hook", outcome="delivered") == 1.0
    assert live.get("/api/v1/notifications/dead-letters", after=letter["id"])["next"] is None

    before, database = len(receiver.got), f"--database=sqlite:///{folder}/gridsec.db"
    code, out, _ = gridsec(monkeypatch, capsys, "dead-letters", database)
    assert (code, "incident.opened" in out, "status 400" in out) == (0, True, True)
    code, out, _ = gridsec(monkeypatch, capsys, "dead-letters", "--show", str(letter["id"]), database)
    assert (code, json.loads(out)) == (0, letter["message"])
    code, out, _ = gridsec(monkeypatch, capsys, "targets", database)
    assert (code, "hook" in out) == (0, True)
    code, out, _ = gridsec(monkeypatch, capsys, "resend", str(letter["id"]), database)
    assert (code, out) == (0, "1 dead letters are sent again by the service.\n")
    until(lambda: len(receiver.got) == before + 1, "the resent message")
    assert receiver.got[-1].headers["webhook-id"] == letter["message_id"]
    assert receiver.got[-1].body == receiver.got[0].body
    until(lambda: target(live)["dead_letters"] == 0, "the deletion of the letter")
    assert live.get("/api/v1/notifications/dead-letters")["dead_letters"] == []


@pytest.mark.acceptance
def test_dead_letters_are_resent_and_discarded_over_rest(
    live: InProcess, receiver: Receiver, folder: Path
) -> None:
    until(lambda: target(live)["waiting"] == 0, "all deliveries")
    letter = DeadLetter("hook", 1, "msg_x", "incident.opened", START, time.time(), 3, "status 500", "{}")
    with DeliveryStore(f"sqlite:///{folder}/gridsec.db") as store:
        kept = store.positions()["hook"]
        store.keep("hook", kept, [letter, replace(letter, message_id="msg_y")])
        first, second = store.letters()
    json_only = {"Content-Type": "application/json"}
    for action, body, count in (
        ("resend", {"ids": [first.id]}, 1),
        ("resend", {"target": "absent"}, 0),
        ("discard", {"ids": [second.id]}, 1),
    ):
        path = f"/api/v1/notifications/dead-letters/{action}"
        answer = live.http.post(path, content=json.dumps(body), headers=json_only)
        assert (answer.status_code, answer.json()) == (200, {"count": count})
    until(lambda: any(each.headers["webhook-id"] == "msg_x" for each in receiver.got), "the message")
    until(lambda: not live.get("/api/v1/notifications/dead-letters")["dead_letters"], "no dead letters")
    wrong = live.http.post("/api/v1/notifications/dead-letters/resend", content="[]", headers=json_only)
    assert wrong.status_code == 422


def test_a_wrong_file_ends_the_start_with_all_problems(tmp_path: Path) -> None:
    with refused(SettingsInvalid, "no-file"):
        settings({"notify": tmp_path / "absent.toml"})
    path = tmp_path / "targets.toml"
    path.write_text('[[webhook]]\nname = "a b"\nurl = "https://a.example"\n[[alertmanager]]\nname = "c"\n')
    with refused(SettingsInvalid, "wrong-name", "missing"), service(tmp_path, notify=path):
        raise AssertionError("the service has started")


def test_commands_for_the_file(tmp_path: Path, receiver: Receiver, monkeypatch: Any, capsys: Any) -> None:
    code, out, _ = gridsec(monkeypatch, capsys, "secret")
    assert (code, len(secret_bytes(out.strip()) or b"")) == (0, 32)
    more = '[[alertmanager]]\nname = "room"\nurl = "https://127.0.0.1:9"\n'
    path = targets_file(tmp_path, receiver, more)
    code, out, _ = gridsec(monkeypatch, capsys, "check", str(path))
    assert (code, "alertmanager" in out, "opened" in out, SECRET in out) == (0, True, True, False)
    before = len(receiver.got)
    code, out, _ = gridsec(monkeypatch, capsys, "test", str(path), "hook")
    assert (code, "status 200" in out, len(receiver.got)) == (0, True, before + 1)
    assert json.loads(receiver.got[-1].body)["type"] == "test"
    assert gridsec(monkeypatch, capsys, "test", str(path), "room")[0] == 1
    assert gridsec(monkeypatch, capsys, "test", str(path), "absent")[0] == 2
    path.write_text("")
    assert gridsec(monkeypatch, capsys, "check", str(path))[0] == 2
    database = f"--database=sqlite:///{tmp_path}/g.db"
    assert gridsec(monkeypatch, capsys, "resend", database)[0] == 2
    assert gridsec(monkeypatch, capsys, "discard", "--all", database) == (
        0,
        "0 dead letters are deleted.\n",
        "",
    )
    assert gridsec(monkeypatch, capsys, "dead-letters", "--show", "9", database)[0] == 2
