"""How often an address may send a key that isn't valid.

A key that was valid before, from anywhere, is always compared: who works isn't locked out by who guesses behind the
same proxy. Any other key from an address that has used up its failures isn't even compared.
"""

from __future__ import annotations

import ipaddress
import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

#: Failures that an address has at once, and how many a second come back to it.
FAILURES, FAILURES_PER_S = 20.0, 1.0 / 3.0
#: Addresses that are remembered; beyond them the one that failed longest ago is forgotten.
ADDRESSES = 10_000


def network_of(address: str) -> str:
    """Return what is counted as one address: an IPv4 address, or the 64 bits of an IPv6 network, of which a client has
    all addresses.

    >>> network_of("192.0.2.1"), network_of("2001:db8::1")
    ('192.0.2.1', '2001:db8::/64')
    """
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv6Address):
        mapped = parsed.ipv4_mapped
        return str(mapped) if mapped else str(ipaddress.ip_network((parsed, 64), strict=False))
    return str(parsed)


@dataclass
class FailedKeys:
    """The failures that each address has left; one per application."""

    most: float = FAILURES
    per_s: float = FAILURES_PER_S
    clock: Callable[[], float] = time.monotonic
    _left: OrderedDict[str, tuple[float, float]] = field(default_factory=OrderedDict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def _now(self, network: str) -> float:
        left, at = self._left.get(network, (self.most, self.clock()))
        return min(self.most, left + (self.clock() - at) * self.per_s)

    def wait_s(self, address: str) -> int:
        """Return the whole seconds until a key from this address is compared again; 0: now."""
        with self._lock:
            left = self._now(network_of(address))
        return 0 if left >= 1.0 else math.ceil((1.0 - left) / self.per_s)

    def count_failure(self, address: str) -> None:
        """Count a key that wasn't valid."""
        network = network_of(address)
        with self._lock:
            self._left[network] = (self._now(network) - 1.0, self.clock())
            self._left.move_to_end(network)
            while len(self._left) > ADDRESSES:
                self._left.popitem(last=False)
