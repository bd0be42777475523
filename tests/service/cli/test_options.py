"""All that is wrong with the options of a command is told at once, before the work."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.service.commands import command, plain

run = command("study")

DROOP = (
    *("droop", "cigre-lv", "--at", "baker", "--draws", "3", "--who", "you", "--compare", "nope"),
    *("--busbar", "1.2", "0.9", "--band", "2", "1", "--tau-factor", "-1", "--dead", "2", "--interval", "0"),
    *("--hosting-preset", "grid"),
)
CAMPAIGN = (
    *("campaign", "cigre-lv", "--season", "foo", "--place", "bar", "--design", "baz", "--kind", "qux"),
    *("--setting", "foo=1", "--setting", "colour", "--meters", "no", "--estimator", "zzz", "--workers", "2"),
    *("--dask", "tcp://127.0.0.1:1", "--duration", "30", "--step", "10", "--no-journal"),
)
COMPARE = (
    *("compare", "cigre-lv", "--family", "zz", "--case", "yy", "--meters", "ww", "--csv", "."),
    *("--write", "nofile.md"),
)
REPORT = (
    *("report", "cigre-lv", "--studies", "droop,foo,protect,campaign", "--readings", "nofile"),
    *("--estimator", "zz", "--preset", "yy", "--busbar", "2", "1", "--band", "1", "1", "--at", "yesterday"),
    *("--goal", "zz"),
)
CALIBRATE = (
    *("calibrate", "cigre-lv", "--look-for", "ghosts", "--look-for", "bus", "--look-for", "gold"),
    *("--readings", "nofile", "--tolerance", "7"),
)
REDUNDANCY = (
    *("redundancy", "cigre-lv", "--unknown", "nobody", "--silent", "m99", "--curves", "flat"),
    "--no-journal",
)


@pytest.mark.parametrize(
    ("words", "wrong"),
    [
        (DROOP, ("--who is 'you'", "'nope'", "--hosting-preset is 'grid'", "(--at)", "(--draws)",
                 "busbar voltage", "the band from 2 to 1", "is -1", "interval")),
        (CAMPAIGN, ("--season is 'foo'", "--place is 'bar'", "--design is 'baz'", "--kind 'qux'",
                    "'foo' is no", "--setting 'colour'", "--meters is 'no'", "estimator 'zzz'", "--workers: ",
                    "--duration: ")),
        (COMPARE, ("--family is 'zz'", "--case is 'yy'", "--meters is 'ww'", "--csv .: ",
                   "--write nofile.md")),
        (REPORT, ("--studies is 'foo'", "--readings nofile: ", "--estimator is 'zz'", "--preset is 'yy'",
                  "--busbar: ", "--band: ", "--at 'yesterday': ", "goal is 'zz'")),
        (CALIBRATE, ("--look-for is 'ghosts'", "--look-for is 'gold'", "--readings nofile: ",
                     "tolerance is 7.0")),
        (REDUNDANCY, ("no customer 'nobody'", "no meter 'm99'", "curves is 'flat'")),
    ],
    ids=lambda words: words[0],
)  # fmt: skip
def test_all_problems_are_named(
    words: tuple[str, ...],
    wrong: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, told = run(monkeypatch, capsys, *words)
    assert (code, out) == (2, "")
    for part in wrong:
        assert part in plain(told), (part, plain(told))
    assert not list(tmp_path.iterdir())


def test_problems_of_all_feeders_are_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, told = run(monkeypatch, capsys, "droop", "atlantis", "--also", "nowhere", "--no-journal")
    assert code == 3
    assert "atlantis: " in told
    assert "nowhere: " in told
