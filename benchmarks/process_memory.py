"""Memory and CPU time of a process and of all that it started, from /proc.

Proportional set size (PSS): a page that several processes share counts for each by its share, so that the sum over the
processes is what they take of the computer's memory."""

from __future__ import annotations

import threading
from collections import defaultdict
from pathlib import Path
from types import TracebackType

import psutil

#: How often (s) the processes are looked at. A look takes about 5 ms a process.
EVERY_S = 0.5
#: What a process does, by a word of its command line.
KINDS = {
    "lab.side_processes": "one side's fit and diagnosis",
    "lab.quick_look.process": "curves of a running session",
    "bench": "mock bench",
    "serve": "service",
    "run": "command",
}


def pss_bytes(pid: int) -> int:
    """Return a process's proportional set size (bytes); 0 where it has ended."""
    try:
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1]) << 10
    except OSError:
        pass
    return 0


def kind_of(process: psutil.Process) -> str:
    """Return what a process does, by its command line."""
    words = process.cmdline()
    return next((kind for word, kind in KINDS.items() if word in words), "other")


def by_kind(root: psutil.Process) -> dict[str, int]:
    """Return the PSS (bytes) of `root` and of its descendants, summed by what they do."""
    found: dict[str, int] = defaultdict(int)
    try:
        for process in [root, *root.children(recursive=True)]:
            found[kind_of(process)] += pss_bytes(process.pid)
    except psutil.NoSuchProcess:
        pass
    return found


class MemoryWatch:
    """Looks at a process and its descendants every `EVERY_S` while the context is open. `peak`: the largest PSS (bytes)
    of each kind of process; `together`: the largest sum over all, and `then`, the kinds at that moment."""

    def __init__(self, pid: int) -> None:
        self.peak: dict[str, int] = defaultdict(int)
        self.together = 0
        self.then: dict[str, int] = {}
        self._root = psutil.Process(pid)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> MemoryWatch:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._over.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._over.wait(EVERY_S):
            found = by_kind(self._root)
            for kind, size in found.items():
                self.peak[kind] = max(self.peak[kind], size)
            if sum(found.values()) > self.together:
                self.together, self.then = sum(found.values()), dict(found)
