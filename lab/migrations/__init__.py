"""Migrations of the registry (Alembic). `lab.store.Store` runs them when it opens a registry."""
