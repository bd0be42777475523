"""The targets file: every problem at once, with its place; filters; secrets."""

from __future__ import annotations

from pathlib import Path

import pytest

from gridsec.errors import InputInvalid
from service.notify.targets import Alertmanager, Webhook, read_targets
from service.notify.webhook import PREFIX, SECRET_BYTES, new_secret, secret_bytes, signature
from tests.codes import refused

SECRET = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"


def write(folder: Path, text: str) -> Path:
    path = folder / "targets.toml"
    path.write_text(text)
    return path


def test_a_file_with_both_kinds(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text(SECRET + "\n")
    text = f"""
external_url = "https://grid.example"
[[webhook]]
name = "dispatch"
url = "https://hooks.example/in?a=1"
secret_file = "{tmp_path}/secret"
severities = ["critical"]
feeders = ["village"]
[[alertmanager]]
name = "room"
url = "http://127.0.0.1:9093/"
private_addresses = true
labels = {{ site = "north" }}
"""
    found = read_targets(write(tmp_path, text))
    hook, room = found.all
    assert isinstance(hook, Webhook)
    assert isinstance(room, Alertmanager)
    assert (hook.kind, hook.host, hook.key()) == ("webhook", "hooks.example", secret_bytes(SECRET))
    assert hook.endpoint().url == "https://hooks.example/in?a=1"
    assert not hook.endpoint().private
    assert room.endpoint("/api/v2/alerts").url == "http://127.0.0.1:9093/api/v2/alerts"
    assert room.endpoint().private
    assert SECRET not in repr(hook)


def test_all_problems_at_once_with_their_places(tmp_path: Path) -> None:
    text = """
colour = "red"
[[webhook]]
name = "a b"
url = "https://hooks.example/"
secret = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
severities = ["grave"]
timeout_s = 0.0
[[webhook]]
name = "plain"
url = "http://hooks.example/"
secret = "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw"
[[webhook]]
url = "https://hooks.example/"
[[alertmanager]]
name = "room"
url = "ftp://x"
"""
    path = write(tmp_path, text)
    codes = ("unknown-name", "wrong-name", "out-of-range", "unknown-name", "plaintext-network", "missing",
             "wrong-address")  # fmt: skip
    with pytest.raises(InputInvalid) as caught:
        read_targets(path)
    assert sorted(caught.value.codes) == sorted(codes)
    problems = "\n".join(caught.value.problems)
    for place in ("webhook 'a b', timeout_s", "webhook 'plain'", "webhook 3, name", "alertmanager 'room'"):
        assert f"{path}: {place}" in problems
    assert "colour" in problems
    assert SECRET not in problems


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", "missing"),
        ("[[webhook]", "not-toml"),
        ('[[webhook]]\nname = "a"\nurl = "https://a.example"', "missing"),
        ('[[webhook]]\nname = "a"\nurl = "https://a.example"\nsecret = "whsec_AAAA"', "wrong-secret"),
        ('[[webhook]]\nname = "a"\nurl = "https://a.example"\nsecret_file = "/absent"', "no-file"),
        (f'[[webhook]]\nname = "a"\nurl = "https://a:b@a.example"\nsecret = "{SECRET}"', "wrong-address"),
        (f'[[webhook]]\nname = "a"\nurl = "https://a.example:99999"\nsecret = "{SECRET}"', "wrong-address"),
        (f'[[webhook]]\nname = "a"\nurl = "https://a.example"\nsecret = "{SECRET}"\n' * 2, "duplicate"),
        ('[[alertmanager]]\nname = "a"\nurl = "https://a.example"\nlabels = { "a-b" = "c" }', "wrong-name"),
        ('[[alertmanager]]\nname = "a"\nurl = "https://a.example"\nchanges = ["cleared"]', "unknown-name"),
        ('[[alertmanager]]\nname = "a"\nurl = "https://a.example"\nca_file = "/absent"', "no-file"),
        (
            "".join(f'[[alertmanager]]\nname = "a{k}"\nurl = "https://a.example"\n' for k in range(17)),
            "out-of-range",
        ),
    ],
)
def test_one_problem(tmp_path: Path, text: str, code: str) -> None:
    with refused(InputInvalid, code):
        read_targets(write(tmp_path, text))
    with refused(InputInvalid, "no-file"):
        read_targets(tmp_path / "absent.toml")


def test_the_signature_is_that_of_the_reference_implementation() -> None:
    """Vector of the libraries of Standard Webhooks."""
    found = secret_bytes(SECRET)
    assert found is not None
    made = signature(found, "msg_p5jXN8AQM9LWM0D4loKWxJek", "1614265330", b'{"test": 2432232314}')
    assert made == "g0hM9SsE+OTPJTGt/tmIKtSyZlE3uFJELVlNIOLJ1OE="


def test_secrets_are_random_and_checked() -> None:
    made = {new_secret() for _ in range(20)}
    assert len(made) == 20
    assert all(len(secret_bytes(each) or b"") == SECRET_BYTES for each in made)
    for wrong in ("", PREFIX, PREFIX + "AAAA", PREFIX + "?" * 32, SECRET.removeprefix(PREFIX)):
        assert secret_bytes(wrong) is None
