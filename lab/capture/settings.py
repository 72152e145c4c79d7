"""Where data are kept and where work is done, from the environment."""

from __future__ import annotations

from pathlib import Path

from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """Where data are kept and where work is done; from the environment, `CALIBENCH_DATA` and so on."""

    model_config = SettingsConfigDict(env_prefix="CALIBENCH_")

    data: Path = Path("calibench-data")
    database_url: str | None = None  # None: SQLite in the data folder
    scheduler: str | None = None  # address of a Dask scheduler; None: in this process

    @property
    def url(self) -> str:
        """The registry's SQLAlchemy URL."""
        return self.database_url or f"sqlite:///{(self.data / 'registry.sqlite').resolve()}"
