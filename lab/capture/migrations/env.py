"""Alembic's entry: upgrades the connection that `lab.capture.store` hands over, or the URL in
CALIBENCH_DATABASE_URL."""

from __future__ import annotations

from alembic import context
from sqlalchemy import create_engine

from lab.capture.settings import Settings
from lab.capture.tables import Base


def run() -> None:
    connection = context.config.attributes.get("connection")
    if connection is not None:
        context.configure(connection=connection, target_metadata=Base.metadata, render_as_batch=True)
        with context.begin_transaction():
            context.run_migrations()
        return
    with create_engine(Settings().url).connect() as connection:
        context.configure(connection=connection, target_metadata=Base.metadata, render_as_batch=True)
        with context.begin_transaction():
            context.run_migrations()


run()
