"""The queue before the runtime is bounded, and what it drops is counted."""

from __future__ import annotations

import threading
from collections import Counter
from random import Random

import pytest

from service.ingest.queues import THINNED, THINNED_FROM, Inbox, Sample


def sample(number: int, size: int = 10) -> Sample:
    return Sample(str(number), b"x" * size, "", 0.0, size)


def keys(samples: list[Sample]) -> list[int]:
    return [int(s.key) for s in samples]


def test_the_oldest_go_and_are_counted() -> None:
    woken: list[int] = []
    box = Inbox(lambda: woken.append(1), max_samples=5, lossless=False)
    assert box.put([sample(k) for k in range(4)]) == 0
    assert box.put([sample(k) for k in range(4, 12)]) == 7
    assert len(woken) == 2
    assert keys(box.drain(2)) == [7, 8]
    assert keys(box.drain(100)) == [9, 10, 11]
    assert box.drain(1) == []


def test_bytes_are_bounded_too() -> None:
    box = Inbox(lambda: None, max_samples=1000, max_bytes=10_000, lossless=False)
    assert box.put([sample(k, 1_000) for k in range(20)]) == 13
    assert keys(box.drain(100)) == list(range(13, 20))
    assert box.put([sample(1, 100_000)]) == 0
    assert keys(box.drain(100)) == [1]


def test_keys_and_encodings_count_as_bytes() -> None:
    box = Inbox(lambda: None, max_bytes=1 << 20, lossless=False)
    long = [Sample("k" * 60_000, b"{}", "", 0.0, 2)] * 50 + [Sample("k", b"{}", "e" * 60_000, 0.0, 2)] * 50
    assert box.put(long) == 100 - (1 << 20) // 60_307
    assert len(box.drain(100)) == (1 << 20) // 60_307


def test_what_has_been_taken_out_is_counted_no_more() -> None:
    box = Inbox(lambda: None, max_samples=4, max_bytes=5_000, lossless=False)
    for k in range(10_000):
        assert box.put([sample(k, k % 1_000)]) == 0
        assert keys(box.drain(1 + k % 3)) == [k]
    # What was dropped is not counted either.
    for k in range(10_000):
        box.put([sample(k, 1_000)])
    assert keys(box.drain(10)) == [9_997, 9_998, 9_999]
    assert box.put([sample(k, 100) for k in range(4)]) == 0


@pytest.mark.parametrize("keys_of_queue", [1, 2, 4, 41, 100_000])
@pytest.mark.parametrize("seed", range(3))
def test_a_long_queue_drops_of_the_keys_with_the_most(keys_of_queue: int, seed: int) -> None:
    random = Random(seed)
    most = random.randint(THINNED_FROM + 1, THINNED_FROM + 200)
    numbers = [random.randrange(keys_of_queue) for _ in range(most + 1)]
    box = Inbox(lambda: None, max_samples=most, lossless=False)
    # An eighth is dropped at once: a flood of distinct keys does not read the whole queue for each sample.
    assert box.put([sample(k) for k in numbers]) == (most + 1) // THINNED
    kept = keys(box.drain(2 * most))
    before, after = Counter(numbers), Counter(kept)
    # A key that has lost samples has at most one less than the others that have more than it.
    fewest = min(after[k] for k in before if after[k] < before[k])
    assert all(after[k] <= fewest + 1 for k in before)
    # The newest of each key stay, in their order.
    places = {k: [at for at, one in enumerate(numbers) if one == k] for k in before}
    newest = [at for k, all_ in places.items() for at in all_[len(all_) - after[k] :]]
    assert kept == [numbers[at] for at in sorted(newest)]


def test_lossless_lets_the_sender_wait() -> None:
    box = Inbox(lambda: None, max_samples=5, lossless=True)
    dropped: list[int] = []
    sender = threading.Thread(target=lambda: dropped.append(box.put([sample(k) for k in range(100)])))
    sender.start()
    found: list[int] = []
    while len(found) < 100:
        assert len(box) <= 5
        found += keys(box.drain(2))
    sender.join(5.0)
    assert found == list(range(100))
    assert dropped == [0]


def test_closing_lets_a_waiting_sender_go() -> None:
    box = Inbox(lambda: None, max_samples=1, lossless=True)
    sender = threading.Thread(target=lambda: box.put([sample(k) for k in range(3)]))
    sender.start()
    box.close()
    sender.join(5.0)
    assert not sender.is_alive()
