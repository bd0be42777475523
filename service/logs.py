"""Log on standard error, one event per line, as text or as JSON.

A log that cannot be written (a full disk, a closed pipe) does not stop the monitoring: such lines are lost
and counted.
"""

from __future__ import annotations

import atexit
import logging
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, MutableMapping
from typing import Any, TextIO

import structlog

REPEATS = 5
"""Records of one kind that are written within `WINDOW_S`; the others are counted."""
WINDOW_S = 10.0
"""Window of repeated records, s."""
_KINDS = 256
"""Largest number of kinds of records that are counted at a time; the oldest is dropped."""


class Repeats:
    """Limits the records of one kind: the first of a window are written, the others counted in one line.

    report: called with a kind and the number of its suppressed records.
    clock: monotonic time, s.
    window_s, first: as `WINDOW_S` and `REPEATS`.
    """

    def __init__(
        self,
        report: Callable[[tuple[str, ...], int], None],
        clock: Callable[[], float] = time.monotonic,
        *,
        window_s: float = WINDOW_S,
        first: int = REPEATS,
    ) -> None:
        self._report, self._clock = report, clock
        self._window_s, self._first = window_s, first
        self._kinds: OrderedDict[tuple[str, ...], tuple[float, int]] = OrderedDict()
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None

    def admit(self, kind: tuple[str, ...]) -> bool:
        """True if a record is written. Records with equal level, event and source are of one kind."""
        self.flush(over_only=True)
        with self._lock:
            begun, count = self._kinds.get(kind, (self._clock(), 0))
            self._kinds[kind] = begun, count + 1
            gone = [self._kinds.popitem(last=False)] if len(self._kinds) > _KINDS else []
            if count == self._first and self._timer is None:
                # Writes the number if no further record follows.
                self._timer = threading.Timer(self._window_s, self._on_timer)
                self._timer.daemon = True
                self._timer.start()
        self._tell(gone)
        return count < self._first

    def flush(self, *, over_only: bool = False) -> None:
        """Write the numbers of suppressed records. With `over_only` only of windows that have ended."""
        now, ended = self._clock(), []
        with self._lock:
            # In the order of their starts.
            while self._kinds:
                begun, _ = next(iter(self._kinds.values()))
                if over_only and now - begun < self._window_s:
                    break
                ended.append(self._kinds.popitem(last=False))
        self._tell(ended)

    def _on_timer(self) -> None:
        with self._lock:
            self._timer = None
        self.flush()

    def _tell(self, ended: list[tuple[tuple[str, ...], tuple[float, int]]]) -> None:
        for kind, (_, count) in ended:
            if count > self._first:
                self._report(kind, count - self._first)


class _OncePerWindow(logging.Filter):
    """Limits the records of other libraries (uvicorn, asyncio), by the first line of their text."""

    def __init__(self) -> None:
        super().__init__()
        self._repeats = Repeats(_report_repeats)
        atexit.register(self._repeats.flush)

    def filter(self, record: logging.LogRecord) -> bool:
        """True if a record is written."""
        # Digits are removed: texts that differ in an object's address or a task's number are of one kind.
        text = "".join(c for c in str(record.msg).partition("\n")[0] if not c.isdigit())[:200]
        return self._repeats.admit((record.levelname.lower(), text, record.name))


def _report_repeats(kind: tuple[str, ...], count: int) -> None:
    level, event, source = kind
    again = {"of": event, "times": count, "within_s": WINDOW_S, "source": source or None}
    getattr(structlog.get_logger("gridsec.logs"), level, structlog.get_logger().warning)("repeated", **again)


def _bounded(repeats: Repeats) -> structlog.typing.Processor:
    def process(_logger: Any, level: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
        text = str(event.get("event"))
        if text != "repeated" and not repeats.admit((level, text, str(event.get("feeder") or ""))):
            raise structlog.DropEvent
        return event

    return process


class LineLogger:
    """Writes lines to a file; a line that cannot be written is lost."""

    lost = 0
    """Number of lost lines of this process."""
    _lock = threading.Lock()

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def msg(self, message: str) -> None:
        """Write a line."""
        with self._lock:
            try:
                self._file.write(f"{message}\n")
                self._file.flush()
            except (OSError, ValueError):  # ValueError: the file is closed
                LineLogger.lost += 1

    debug = info = warning = error = critical = exception = msg


def set_up(level: str, form: str) -> None:
    """Set up logging for the process."""
    stream = sys.stderr

    def logger(*_: Any) -> LineLogger:
        return LineLogger(stream)

    renderer: structlog.typing.Processor
    if form == "json":
        renderer = structlog.processors.JSONRenderer()
    else:
        renderer = structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), pad_event_to=0)
    repeats = Repeats(_report_repeats)
    atexit.register(repeats.flush)
    exceptions = [structlog.processors.dict_tracebacks] if form == "json" else []
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            _bounded(repeats),
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            *exceptions,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(getattr(logging, level.upper())),
        logger_factory=logger,
        cache_logger_on_first_use=True,
    )
    logging.basicConfig(level=logging.WARNING, stream=stream, format="%(levelname)s %(name)s %(message)s")
    for handler in logging.getLogger().handlers:
        if not any(isinstance(one, _OncePerWindow) for one in handler.filters):
            handler.addFilter(_OncePerWindow())
