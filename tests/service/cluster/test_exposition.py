"""Metrics of several processes in one text, read by Prometheus's own parser."""

from __future__ import annotations

from prometheus_client.parser import text_string_to_metric_families

from service.cluster.front import merged
from service.metrics import Metrics


def metrics(samples: int) -> bytes:
    made = Metrics()
    made.samples.inc(samples)
    made.ticks.labels('a"b\\', "clean").inc(2)
    made.cycle.observe(0.01)
    return made.exposition()


def test_samples_keep_their_values_and_get_the_worker() -> None:
    text = merged({"": metrics(1), "w0": metrics(20), "w1": metrics(300)}).decode()
    families = {family.name: family for family in text_string_to_metric_families(text)}
    samples = {
        one.labels.get("worker"): one.value
        for one in families["gridsec_samples"].samples
        if one.name == "gridsec_samples_total"
    }
    assert samples == {None: 1.0, "w0": 20.0, "w1": 300.0}
    ticks = [one for one in families["gridsec_ticks"].samples if one.name == "gridsec_ticks_total"]
    assert [one.labels["feeder"] for one in ticks] == ['a"b\\'] * 3
    assert {one.labels.get("worker") for one in families["gridsec_cycle_seconds"].samples} == {
        None,
        "w0",
        "w1",
    }
    # A family occurs once; Prometheus refuses a second type.
    types = [line for line in text.splitlines() if line.startswith("# TYPE ")]
    assert len(types) == len(set(types))


def test_without_parts_the_text_is_empty() -> None:
    assert merged({}) == b""
