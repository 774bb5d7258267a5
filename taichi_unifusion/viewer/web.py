"""A web page that shows a scene, by viser: the server, its address, and the thread that answers.

Whatever a page asks for waits in a queue, and one thread, the one that calls `serve` or `poll`,
does it: kernels must not be launched from two threads at once.
"""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import os
import queue
import socket
import sys
import time
import warnings
import webbrowser
from collections.abc import Callable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MissingDependency, UniFusionError

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

HOME = "127.0.0.1"  # only this machine can open the page
PORT, PORTS = 8080, 100  # the first port that is tried, and how many
FLIGHT_STEPS, FLIGHT_PAUSE = 12, 0.03  # [s] of a camera on its way
GONE = r"Queued an? \w+ on a closed connection"  # as viser warns
WAIT = 0.2  # [s] between two looks at whether to stop


class WebViewer:
    """A page on a server of its own. Raises MissingDependency without viser, InputError where the
    address cannot be used.
    """

    def __init__(self, host: str = HOME, port: int = PORT, title: str = "unifusion") -> None:
        self.server = start_server(host, port, title)
        self.host, self.asked_port = host, port
        self.requests: queue.SimpleQueue[tuple[Callable[[], None], Any]] = queue.SimpleQueue()

    @property
    def address(self) -> str:
        """What to type into a browser."""
        shown = "localhost" if self.host in ("0.0.0.0", "::") else self.host
        return f"http://{shown}:{self.server.get_port()}"

    def request(self, work: Callable[[], None], client: viser.ClientHandle | None = None) -> None:
        """Let the thread that serves do something; `client` is told where it fails."""
        self.requests.put((work, client))

    def poll(self) -> int:
        """Do what pages have asked for until now; returns how much that was."""
        done = 0
        while not self.requests.empty():
            self._do(*self.requests.get())
            done += 1
        return done

    def serve(self, stop: Callable[[], bool] = lambda: False) -> None:
        """Do what pages ask for until `stop` says so, or Ctrl-C."""
        with contextlib.suppress(KeyboardInterrupt):
            while not stop():
                with contextlib.suppress(queue.Empty):
                    self._do(*self.requests.get(timeout=WAIT))

    def _do(self, work: Callable[[], None], client: viser.ClientHandle | None) -> None:
        try:
            work()
        except UniFusionError as error:
            logger.warning("%s", error)
            self.say("That did not work", str(error), client, color="red")
        except Exception as error:  # a page outlives a fault behind one of its buttons
            logger.exception("a request of the page failed")
            self.say("That did not work", f"{type(error).__name__}: {error}", client, color="red")

    def say(
        self, title: str, text: str, client: viser.ClientHandle | None = None, color: Any = None
    ) -> None:
        """Show a sentence on one page, or on all of them."""
        clients = [client] if client is not None else list(self.server.get_clients().values())
        for each in clients:
            each.add_notification(title, text, color=color, auto_close_seconds=12.0)

    def announce(self, open_browser: bool) -> None:
        """Say where the page is, and open it in a browser where somebody would see that."""
        port = self.server.get_port()
        if port != self.asked_port:
            logger.info("port %d is taken, so the page is on port %d", self.asked_port, port)
        if self.host != HOME:
            logger.warning(
                "the page listens on %s: whoever reaches this machine can look at the map, ask it, and have parts "
                "written into its folder",
                self.host,
            )
        logger.info("the page is at %s until Ctrl-C", self.address)
        if open_browser and has_screen():
            webbrowser.open(self.address)

    def close(self) -> None:
        """End the server."""
        with _quiet():
            self.server.stop()


def start_server(host: str, port: int, title: str) -> viser.ViserServer:
    """A server without a public tunnel, on `port` or the next one that is free."""
    check_viser()
    import viser

    class LocalServer(viser.ViserServer):
        """Pages could ask for a tunnel that opens the map to everybody; this one makes none."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    # a browser may go away before it is answered
    warnings.filterwarnings("ignore", GONE, UserWarning)
    port = free_port(host, port)
    with _quiet():
        server = LocalServer(host=host, port=port, label=title, verbose=False)
    server.gui.configure_theme(
        control_width="medium", show_logo=False, show_share_button=False, brand_color=(30, 90, 160)
    )
    server.gui.set_panel_label(title)
    server.gui.main_panel.dock_right()  # beside the picture, not over it
    return server


def check_viser() -> None:
    """Raise MissingDependency where viser is not installed."""
    if find_spec("viser") is None:
        raise MissingDependency(
            "the page is shown by viser: pip install 'taichi-unifusion[viewer]'"
        )


def free_port(host: str, port: int) -> int:
    """The first port from `port` on that nobody listens on; raises InputError where the host is not
    this machine's, or no port is free.
    """
    if not 0 < port < 65536:
        raise InputError(f"port: must lie in 1..65535, got {port}")
    for candidate in range(port, min(port + PORTS, 65536)):
        try:
            family, *_, address = socket.getaddrinfo(host, candidate, type=socket.SOCK_STREAM)[0]
            with socket.create_server(address, family=family):
                return candidate
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise InputError(
                    f"{host}, port {candidate}: the page cannot be put there ({error.strerror or error})"
                ) from None
    raise InputError(
        f"{host}: ports {port} to {port + PORTS - 1} are all taken; give another --port"
    )


@contextlib.contextmanager
def _quiet():
    """Keep back what viser prints of itself: addresses are said in one way, and results are stdout."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def has_screen() -> bool:
    """Whether a browser that is opened here is seen by whoever started this."""
    if os.environ.get("SSH_CONNECTION") or os.environ.get("CI"):
        return False
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def fly(client: viser.ClientHandle, eye: NDArray, look_at: NDArray, up: NDArray) -> None:
    """Move the camera of a page to `eye` (3,) [m], looking at a point, with `up` upwards."""
    start, start_look = client.camera.position, client.camera.look_at
    for share in np.linspace(0, 1, FLIGHT_STEPS + 1)[1:]:
        smooth = share * share * (3 - 2 * share)
        with client.atomic():
            client.camera.up_direction = up
            client.camera.position = start + smooth * (eye - start)
            client.camera.look_at = start_look + smooth * (look_at - start_look)
        client.flush()
        time.sleep(FLIGHT_PAUSE)
