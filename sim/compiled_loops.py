"""Where compiled loops are kept: with the modules or in the user's cache, as numba does; else in a folder that can be
written."""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path


def choose_cache() -> None:
    """Set NUMBA_CACHE_DIR where neither the installation nor the user's cache can be written, as for a service's user
    without a home: to `.numba` in the data folder (CALIBENCH_DATA), else to a folder of this user among the temporary
    ones.

    The cache holds code. So a folder that another user made, or may write, is never taken.
    """
    if os.environ.get("NUMBA_CACHE_DIR"):
        return
    here = Path(__file__).parent / "optics"
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    if _can_make(here / "__pycache__") or _can_make(user / "numba"):
        return
    data = os.environ.get("CALIBENCH_DATA")
    if data and _is_own(Path(data)) and _can_make(Path(data) / ".numba"):
        chosen = Path(data).absolute() / ".numba"
    else:
        chosen = Path(tempfile.gettempdir()) / f"calibench-numba-{os.getuid()}"
        try:
            chosen.mkdir(mode=0o700, exist_ok=True)
            chosen = chosen if _is_own(chosen) else Path(tempfile.mkdtemp(prefix="calibench-numba-"))
        except OSError:  # numba reports it when it compiles
            return
    os.environ["NUMBA_CACHE_DIR"] = str(chosen)
    if (imported := sys.modules.get("numba")) is not None:
        imported.config.reload_config()


def _can_make(folder: Path) -> bool:
    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)


def _is_own(folder: Path) -> bool:
    """Return whether a folder, no link, is this user's, and no other user may write it."""
    try:
        there = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(there.st_mode) and there.st_uid == os.getuid() and not there.st_mode & 0o022
