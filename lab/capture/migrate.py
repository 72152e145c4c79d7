"""A registry of an older revision, or an empty one, brought to the newest."""

from __future__ import annotations

import contextlib
from pathlib import Path

import sqlalchemy as sa

from lab.capture.file_lock import Lock
from lab.capture.tables import SWAPPING
from lab.errors import InputError

#: The registry's migrations; a revision's name begins the name of its file.
VERSIONS = Path(__file__).parent / "migrations" / "versions"


def upgrade(engine: sa.Engine, folder: Path) -> None:
    """Bring the registry of the data folder to the newest revision. Raises InputError where it isn't a registry, and
    where a restored one is only half in its place."""
    if (folder / SWAPPING).exists():
        raise InputError(
            f"{folder}: a restore ended while it put files in place; call the same `calibench restore` again"
        )
    newest = max(file.name.partition("_")[0] for file in VERSIONS.glob("[0-9]*.py"))
    with contextlib.suppress(sa.exc.SQLAlchemyError), engine.connect() as connection:
        if connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalars().all() == [newest]:
            return
    _migrate(engine, folder)


def _migrate(engine: sa.Engine, folder: Path) -> None:
    """Bring a registry that isn't of the newest revision to that."""
    from alembic import command  # here, as it takes a tenth of a second to load
    from alembic.config import Config
    from alembic.runtime.migration import MigrationContext
    from alembic.script import ScriptDirectory

    config = Config()
    config.set_main_option("script_location", str(VERSIONS.parent))
    scripts = ScriptDirectory.from_config(config)
    newest, known = scripts.get_current_head(), {script.revision for script in scripts.walk_revisions()}
    lock = Lock(folder / ".migration.lock")
    if not lock.acquire(patience_s=60.0):
        raise InputError(f"{folder}: its registry is being migrated by another process; try again when it is done")
    try:
        with engine.execution_options(writes=True).connect() as connection:
            revision = MigrationContext.configure(connection).get_current_revision()
            if revision == newest:
                return
            if revision is not None and revision not in known:
                raise InputError(
                    f"{folder}: its registry has the revision {revision}, written by a newer calibench; install that "
                    "version, or restore "
                    "the backup of before the upgrade"
                )
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
            connection.commit()
    except sa.exc.OperationalError as error:
        words = " ".join(str(error.orig).split())
        if engine.dialect.name == "sqlite":
            raise InputError(
                f"registry {engine.url.database}: can't be opened ({words}); end what else uses it, or name another "
                "folder (--data, CALIBENCH_DATA)"
            ) from error
        raise InputError(
            f"registry {engine.url!r}: can't be reached ({words}); start it, or correct CALIBENCH_DATABASE_URL"
        ) from error
    except sa.exc.DatabaseError as error:
        raise InputError(
            f"{engine.url}: isn't a registry ({str(error.orig or error).splitlines()[0]}); "
            "set CALIBENCH_DATA to another folder"
        ) from error
    finally:
        lock.release()
