"""Keys, sessions and audit log in SQLite and PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import sqlalchemy as sa
from typer.testing import CliRunner, Result

from service.access.audit import broken
from service.access.identity import Role
from service.access.keys import create
from service.cli.main import app
from service.store.access import SESSION_S, SUFFIX, AccessStore
from tests.service.databases import both

NOW = 1_795_212_000.0


@pytest.fixture
def store(url: str) -> Iterator[AccessStore]:
    with AccessStore(url) as made:
        yield made


@both
def test_keys_and_sessions(store: AccessStore) -> None:
    assert not store.any_key()
    _, record = create("Ada", Role.OPERATOR, frozenset({"north", "south"}), NOW, NOW + 100.0)
    store.add_key(record)
    assert store.any_key()
    assert store.key(record.id) == record
    assert store.keys() == [record]
    assert store.key("0000000000") is None
    end = store.open_session("cookie", record.id, NOW)
    assert end == NOW + SESSION_S
    assert store.session("cookie", NOW + SESSION_S - 1.0) == record
    assert store.session("cookie", NOW + SESSION_S) is None
    assert store.session("other", NOW) is None
    assert store.revoke(record.id, NOW + 5.0)
    assert not store.revoke(record.id, NOW + 6.0)
    kept = store.session("cookie", NOW + 7.0)
    assert kept is not None
    assert kept.ended(NOW + 7.0) == "the key is revoked"
    store.close_session("cookie")
    assert store.session("cookie", NOW + 7.0) is None
    # A revoked key does not open the service again.
    assert store.any_key()


def verify(url: str, *more: str) -> Result:
    return CliRunner().invoke(app, ["audit", "verify", "--database", url, *more])


@both
def test_entries_of_many_writers_are_one_chain(store: AccessStore, url: str) -> None:
    """Two stores on one database, eight threads; a changed entry is found by the command, too."""
    with AccessStore(url) as second, ThreadPoolExecutor(8) as pool:
        stores = (store, second)
        jobs = [
            pool.submit(stores[k % 2].append, NOW + k, f"w{k}", "key 1", "PUT", "feeder") for k in range(40)
        ]
        for job in jobs:
            job.result()
    entries = store.audit()
    assert [each.seq for each in entries] == list(range(1, 41))
    assert broken(entries) is None
    assert {each.identity for each in entries} == {f"w{k}" for k in range(40)}
    assert [each.seq for each in store.audit(after=10, limit=5)] == [11, 12, 13, 14, 15]
    last = f"40:{entries[-1].hash}"
    intact = verify(url, "--expect", last)
    assert (intact.exit_code, last in intact.output) == (0, True)
    address = url + SUFFIX if url.startswith("sqlite") else url
    engine = sa.create_engine(address)
    with engine.begin() as raw:
        raw.execute(sa.text("UPDATE audit SET identity = 'Eve' WHERE seq = 30"))
    engine.dispose()
    assert broken(store.audit()) == "entry 30 was changed after it was written"
    assert verify(url).exit_code == 1
