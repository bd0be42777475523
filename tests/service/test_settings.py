"""Settings by command line and environment; every problem at once."""

from __future__ import annotations

from pathlib import Path

import pytest

from gridsec.errors import InputInvalid
from service.ingest.align import Clock
from service.settings import Settings, SettingsInvalid, settings, split_address, strangers
from tests.codes import refused


@pytest.fixture(autouse=True)
def _clean(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in Settings.model_fields:
        monkeypatch.delenv(f"GRIDSEC_{name.upper()}", raising=False)


def test_defaults() -> None:
    found = settings({})
    assert found.listen == ("tcp/127.0.0.1:7447",)
    assert (found.http, found.database, found.clock) == ("127.0.0.1:8000", "sqlite:///gridsec.db", Clock.WALL)


def test_what_is_given_goes_before_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRIDSEC_HTTP", "0.0.0.0:80")
    monkeypatch.setenv("GRIDSEC_CLOCK", "events")
    monkeypatch.setenv("GRIDSEC_FEEDERS", "one, two")
    monkeypatch.setenv("GRIDSEC_GRACE_S", "0.25")
    found = settings({"http": "[::1]:8001", "clock": None, "grace_s": None})
    assert found.http == "[::1]:8001"
    assert found.clock is Clock.EVENTS
    assert found.feeders == ("one", "two")
    assert found.grace_s == 0.25


def test_every_problem_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("GRIDSEC_QUEUE", "few")
    with pytest.raises(SettingsInvalid) as caught:
        settings(
            {
                "http": "localhost",
                "clock": "sundial",
                "zenoh_listen": ("127.0.0.1:7447",),
                "zenoh_config": tmp_path / "none.json5",
                "max_skew_s": -1.0,
                "prefix": "a//b",
                "http_hosts": ("grid.example", "grid.example:80"),
            }
        )
    where = [problem.partition(": ")[0] for problem in caught.value.problems]
    assert dict(zip(where, caught.value.codes, strict=True)) == {
        "--zenoh-listen or GRIDSEC_ZENOH_LISTEN": "wrong-endpoint",
        "--zenoh-config or GRIDSEC_ZENOH_CONFIG": "no-file",
        "--prefix or GRIDSEC_PREFIX": "wrong-prefix",
        "--http or GRIDSEC_HTTP": "wrong-address",
        "--http-host or GRIDSEC_HTTP_HOSTS": "wrong-host",
        "--clock or GRIDSEC_CLOCK": "unknown-name",
        "--max-skew or GRIDSEC_MAX_SKEW_S": "out-of-range",
        "--queue or GRIDSEC_QUEUE": "wrong-type",
    }
    shown = dict(zip(where, caught.value.problems, strict=True))
    # Of several hosts the wrong one alone is named.
    assert ": grid.example:80: " in shown["--http-host or GRIDSEC_HTTP_HOSTS"]


def test_a_zenoh_file_of_one_s_own_says_where_to_listen(tmp_path: Path) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{}")
    assert settings({"zenoh_config": file}).listen == ()
    assert settings({"zenoh_config": file, "zenoh_listen": ("tcp/[::]:1",)}).listen == ("tcp/[::]:1",)
    assert settings({"zenoh_mode": "client"}).listen == ()


def test_addresses() -> None:
    assert split_address("127.0.0.1:0") == ("127.0.0.1", 0)
    assert split_address("[fe80::1]:65535") == ("fe80::1", 65535)
    for wrong in ("", ":80", "host:", "host:65536", "host:-1", "host:8o", "host:²"):
        with refused(InputInvalid, "wrong-address"):
            split_address(wrong)


def test_a_variable_that_is_nearly_a_setting_is_named() -> None:
    mine = {"GRIDSEC_MAX_SKEW": "3", "GRIDSEC_PORT_8000_TCP_ADDR": "10.0.0.7", "gridsec_htpp": "[::1]:80"}
    none = {"GRIDSEC_HTTP": "[::1]:80", "gridsec_queue": "200", "GRIDSEC_CACHE_DIR": "/tmp", "HOME": "/"}
    assert strangers(mine | none) == {
        "GRIDSEC_MAX_SKEW": "GRIDSEC_MAX_SKEW_S",
        "GRIDSEC_PORT_8000_TCP_ADDR": "",
        "gridsec_htpp": "GRIDSEC_HTTP",
    }
    assert strangers(none) == {}
