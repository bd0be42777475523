"""Prometheus rules and Grafana dashboard in `deploy/`: their metrics and labels are those of /metrics."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client import Counter, Gauge, Histogram

from service.metrics import Metrics

DEPLOY = Path(__file__).parents[2] / "deploy"
RULES, RULE_TESTS = DEPLOY / "prometheus-rules.yml", DEPLOY / "prometheus-rules-test.yml"
DASHBOARD = json.loads((DEPLOY / "grafana-dashboard.json").read_text("utf-8"))
PAGES = [DEPLOY.parent / "docs" / name for name in ("notification.md", "operations.md", "rest-api.md")]
NAME = re.compile(r"\bgridsec_[a-z_]+")
MATCHER = re.compile(r"(gridsec_[a-z_]+)\{([^}]*)\}")
FOREIGN = {"instance", "le"}
"""Labels that Prometheus adds, and that of a histogram's buckets."""


def served() -> dict[str, set[str]]:
    """Labels by the name of each sample in the text format."""
    out: dict[str, set[str]] = {}
    for each in vars(Metrics()).values():
        if not isinstance(each, Counter | Gauge | Histogram):
            continue
        labels = set(each._labelnames)
        endings = {Counter: ["_total"], Gauge: [""], Histogram: ["_bucket", "_sum", "_count"]}[type(each)]
        out |= {each._name + ending: labels for ending in endings}
    return out | {"gridsec_log_lines_lost": set()}


def queries(value: Any) -> Iterator[str]:
    """Queries of the dashboard's panels and variables."""
    if isinstance(value, dict):
        yield from (value[key] for key in ("expr", "query") if isinstance(value.get(key), str))
        for each in value.values():
            yield from queries(each)
    elif isinstance(value, list):
        for each in value:
            yield from queries(each)


def test_all_samples_are_served() -> None:
    text = Metrics().exposition().decode()
    for name in served():
        family = re.sub(r"_(bucket|sum|count)$", "", name)
        assert f"# TYPE {family} " in text, name


@pytest.mark.parametrize("source", ["rules", "dashboard"])
def test_queries_name_metrics_and_labels_that_exist(source: str) -> None:
    texts = [RULES.read_text("utf-8")] if source == "rules" else list(queries(DASHBOARD))
    text, known = "\n".join(texts), served()
    assert len(set(NAME.findall(text))) > 10
    assert set(NAME.findall(text)) <= known.keys()
    for name, matchers in MATCHER.findall(text):
        used = set(re.findall(r"([a-z_]+)\s*(?:=~|!~|!=|=)", matchers))
        assert used <= known[name] | FOREIGN, (name, matchers)


def test_every_metric_is_on_the_dashboard() -> None:
    shown = set(NAME.findall("\n".join(queries(DASHBOARD))))
    families = {re.sub(r"_(bucket|sum|count)$", "", name) for name in served()}
    left_out = {"gridsec_meters_learned"}  # counted by state as well
    assert families - {re.sub(r"_(bucket|sum|count)$", "", name) for name in shown} == left_out


def test_the_documents_name_metrics_that_exist() -> None:
    known = served()
    for page in PAGES:
        assert set(NAME.findall(page.read_text("utf-8"))) <= known.keys() | {
            "gridsec_session",
            "gridsec_role",
        }


def test_the_dashboard_is_complete() -> None:
    panels = DASHBOARD["panels"]
    assert len({each["id"] for each in panels}) == len(panels)
    for each in panels:
        place = each["gridPos"]
        assert 0 <= place["x"] <= place["x"] + place["w"] <= 24
        if each["type"] != "row":
            assert all(target["legendFormat"] for target in each["targets"])
    variables = {each["name"] for each in DASHBOARD["templating"]["list"]}
    text = json.dumps(panels)
    assert set(re.findall(r"\$\{?([a-z]+)\}?", text)) <= variables
    assert variables == {"datasource", "instance", "feeder"}


def test_each_rule_says_what_to_do_and_has_a_test() -> None:
    text, tests = RULES.read_text("utf-8"), RULE_TESTS.read_text("utf-8")
    names = re.findall(r"- alert: (\w+)", text)
    assert len(names) == len(set(names)) == text.count("summary: ") == text.count("action: ")
    assert set(re.findall(r"severity: (\w+)", text)) == {"critical", "major", "minor"}
    assert set(names) == set(re.findall(r'alertname="(\w+)"', tests))


@pytest.mark.promtool
def test_promtool_accepts_the_rules() -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed")
    for what, path in (("check", RULES), ("test", RULE_TESTS)):
        command = [promtool, what, "rules", path.name]
        done = subprocess.run(command, cwd=DEPLOY, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
