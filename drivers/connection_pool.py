"""Connections that the ejectors of one process share: PLCs grant few of them."""

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

C = TypeVar("C")


class ConnectionPool:
    """The shared connections of a process, of any driver."""

    def __init__(self) -> None:
        self._connections: dict[Hashable, Any] = {}

    def shared(self, key: Hashable, make: Callable[[], C]) -> C:
        """The one connection of this ``key``, made by the first who asks for it.

        A key begins with the kind of driver, so that drivers do not mix.
        """
        connection: C = self._connections.setdefault(key, make())
        return connection
