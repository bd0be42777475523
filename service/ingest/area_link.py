"""Boundary messages of distributed estimation over zenoh.

A concentrator publishes on ``<prefix>/<feeder>/<sender>/<receiver>`` and subscribes to
``<prefix>/<feeder>/*/<own number>``. Payloads are `gridsec.estimators.distributed.Message.to_json`. The
prefix is not that of the service. With one access rule per certificate (docs/access.md) a concentrator writes
only the keys with its own number as sender.
"""

from __future__ import annotations

from contextlib import ExitStack
from typing import Any

from gridsec.errors import InputInvalid
from gridsec.estimators.distributed import Concentrator, Message
from service.ingest.queues import BusConfig
from service.ingest.zenoh_bus import session

PREFIX = "gridsec-area"
"""First chunk of every key."""


class AreaLink:
    """zenoh session of one concentrator; the newest message of each neighbour counts.

    refused: messages that were no messages of a neighbour, since the start.
    """

    def __init__(self, config: BusConfig, feeder: str, post: Concentrator, prefix: str = PREFIX) -> None:
        self.post, self.refused = post, 0
        self._config, self._root = config, f"{prefix}/{feeder}"
        self._stack = ExitStack()
        self._live: Any = None
        self._newest: dict[int, bytes] = {}

    def __enter__(self) -> AreaLink:
        """Open the session and subscribe."""
        live: Any = self._stack.enter_context(session(self._config))
        key = f"{self._root}/*/{self.post.area.number}"
        self._stack.callback(live.declare_subscriber(key, self._arrived).undeclare)
        self._live = live
        return self

    def __exit__(self, *_: object) -> None:
        """Close the session."""
        self._live = None
        self._stack.close()

    def round(self) -> None:
        """Take what has arrived, decide, and send to all neighbours."""
        arrived, self._newest = self._newest, {}
        for sender, payload in sorted(arrived.items()):
            try:
                self.post.receive(sender, Message.from_json(payload, self.post.area.size))
            except InputInvalid:
                self.refused += 1
        self.post.decide()
        for receiver, message in self.post.send().items():
            self._live.put(f"{self._root}/{self.post.area.number}/{receiver}", message.to_json())

    def _arrived(self, sample: Any) -> None:
        """Called on a zenoh thread."""
        sender = str(sample.key_expr).split("/")[-2]
        if sender.isdecimal() and int(sender) in self.post.area.neighbours:
            self._newest[int(sender)] = sample.payload.to_bytes()
        else:
            self.refused += 1
