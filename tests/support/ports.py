"""A port that nobody listens on."""

from __future__ import annotations

import socket


def some_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
