"""Migrations of the registry (Alembic). `lab.capture.store.Store` runs them when it opens a registry."""
