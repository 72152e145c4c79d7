"""Where data are kept and where jobs run, from the environment."""

from __future__ import annotations

from pathlib import Path

from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """Where data are kept and where jobs run: the environment's `CALIBENCH_DATA`, `CALIBENCH_DATABASE_URL`,
    `CALIBENCH_SCHEDULER`."""

    model_config = SettingsConfigDict(env_prefix="CALIBENCH_")

    data: Path = Path("calibench-data")
    database_url: str | None = None  # None: SQLite in the data folder
    scheduler: str | None = None  # address of a Dask scheduler; None: in this process

    @property
    def registry_file(self) -> Path | None:
        """The registry's file; None where it is a database server's."""
        return None if self.database_url else self.data / "registry.sqlite"

    @property
    def url(self) -> str:
        """The registry's SQLAlchemy URL."""
        return self.database_url or f"sqlite:///{(self.data / 'registry.sqlite').resolve()}"
