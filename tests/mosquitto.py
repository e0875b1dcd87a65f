"""A real MQTT broker, mosquitto (Debian), a relay before it that can be cut, and who listens."""

import getpass
import json
import queue
import socket
import subprocess
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Self

from independent import free_port
from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion

PATIENCE_S = 20.0


class Broker:
    """mosquitto on a port of its own; started and killed as often as a test likes."""

    def __init__(self, folder: Path, lines: Sequence[str] = ("allow_anonymous true",)) -> None:
        self.port = free_port()
        self._config = folder / f"mosquitto-{self.port}.conf"
        own = [f"listener {self.port} 127.0.0.1", "persistence false", "max_queued_messages 0"]
        own.append(f"user {getpass.getuser()}")  # else root becomes one who cannot read our files
        self._config.write_text("\n".join([*own, *lines]) + "\n", encoding="utf-8")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        command = ["mosquitto", "-c", str(self._config)]
        self.process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        end = time.monotonic() + PATIENCE_S
        while True:
            with suppress(OSError):
                socket.create_connection(("127.0.0.1", self.port), 1.0).close()
                return
            if time.monotonic() > end or self.process.poll() is not None:
                self.kill()
                raise RuntimeError("mosquitto did not start")
            time.sleep(0.01)

    def kill(self) -> None:
        """Without warning; it forgets everything."""
        if self.process is not None:
            self.process.kill()
            self.process.wait(PATIENCE_S)
        self.process = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


class Listener:
    """A client of the broker that hears everything from when it came, retained topics first."""

    def __init__(self, port: int, topics: str = "#", **user: str) -> None:
        self._heard: queue.SimpleQueue[tuple[str, dict[str, Any], bool]] = queue.SimpleQueue()
        self.all: list[tuple[str, dict[str, Any], bool]] = []  # topic, document, retained
        self._client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
        if user:
            self._client.username_pw_set(user["name"], user["password"])
        ready = threading.Event()
        self._client.on_message = lambda _c, _u, message: self._heard.put(
            (message.topic, json.loads(message.payload), message.retain)
        )
        self._client.on_connect = lambda client, *_: client.subscribe(topics, qos=1)
        self._client.on_subscribe = lambda *_: ready.set()
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        assert ready.wait(PATIENCE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.disconnect()
        self._client.loop_stop()

    def until(self, topic: str, **wanted: Any) -> dict[str, Any]:
        """The next document on a topic that says what is wanted."""
        while True:
            heard, document, retained = self._heard.get(timeout=PATIENCE_S)
            self.all.append((heard, document, retained))
            if heard.endswith(topic) and all(document[key] == it for key, it in wanted.items()):
                return document

    def on(self, topic: str) -> list[dict[str, Any]]:
        """What has been heard on a topic."""
        while not self._heard.empty():
            self.all.append(self._heard.get())
        return [document for heard, document, _ in self.all if heard.endswith(topic)]


class Relay:
    """Between a client and the broker; a cut lets it swallow what comes back, then hangs up."""

    def __init__(self, port: int) -> None:
        self._behind = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._open: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept)]
        self.swallows = threading.Event()
        self.refuses = threading.Event()
        self._threads[0].start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.cut()
        for thread in self._threads:
            thread.join()

    def cut(self) -> None:
        for connection in self._open:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._open = []

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                front, _ = self._listener.accept()
                if self.refuses.is_set():
                    front.close()
                    continue
                back = socket.create_connection(("127.0.0.1", self._behind))
                self._open += [front, back]
                for source, target in ((front, back), (back, front)):
                    thread = threading.Thread(target=self._carry, args=(source, target, back))
                    self._threads.append(thread)
                    thread.start()

    def _carry(self, source: socket.socket, target: socket.socket, back: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                if not (source is back and self.swallows.is_set()):
                    target.sendall(data)
        for connection in (source, target):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        source.close()


@contextmanager
def broker(folder: Path, *lines: str) -> Iterator[Broker]:
    with Broker(folder, lines or ("allow_anonymous true",)) as running:
        yield running
