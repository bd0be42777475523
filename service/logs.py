"""Logs go to standard error, one event a line: for people, or JSON for machines.

Nobody who watches stumbles over a log that cannot be written (a full disk, a closed pipe): such lines are
lost and counted.
"""

from __future__ import annotations

import logging
import sys
import threading
from typing import Any, TextIO

import structlog


class LineLogger:
    """Writes lines into a file, or loses them.

    Parameters
    ----------
    file
        Where to.
    """

    lost = 0
    """Lines that could not be written, of this process."""
    _lock = threading.Lock()

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def msg(self, message: str) -> None:
        """Write a line.

        Parameters
        ----------
        message
            Without its end.
        """
        with self._lock:
            try:
                self._file.write(f"{message}\n")
                self._file.flush()
            except (OSError, ValueError):  # ValueError: it has been closed
                LineLogger.lost += 1

    debug = info = warning = error = critical = exception = msg


def set_up(level: str, form: str) -> None:
    """Set up logging for the process.

    Parameters
    ----------
    level
        `debug`, `info`, `warning` or `error`.
    form
        `console` or `json`.
    """
    stream = sys.stderr

    def logger(*_: Any) -> LineLogger:
        return LineLogger(stream)

    renderer: structlog.typing.Processor
    if form == "json":
        renderer = structlog.processors.JSONRenderer()
    else:
        renderer = structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), pad_event_to=0)
    exceptions = [structlog.processors.dict_tracebacks] if form == "json" else []
    structlog.configure(
        processors=[
            structlog.contextvars.merge_contextvars,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            *exceptions,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(getattr(logging, level.upper())),
        logger_factory=logger,
        cache_logger_on_first_use=True,
    )
    logging.basicConfig(level=logging.WARNING, stream=stream, format="%(levelname)s %(name)s %(message)s")
