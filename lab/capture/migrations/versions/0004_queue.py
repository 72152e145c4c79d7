"""The queue of sessions, and indices that make deleting a session quick."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("queue_place", sa.Integer(), nullable=True))
    op.add_column("sessions", sa.Column("not_before", sa.DateTime(timezone=True), nullable=True))
    op.create_index(op.f("ix_sessions_queue_place"), "sessions", ["queue_place"], unique=False)
    for column in ("step", "file"):  # a step or file that is deleted looks for its captures
        op.create_index(op.f(f"ix_captures_{column}"), "captures", [column], unique=False)


def downgrade() -> None:
    for column in ("step", "file"):
        op.drop_index(op.f(f"ix_captures_{column}"), "captures")
    op.drop_index(op.f("ix_sessions_queue_place"), "sessions")
    op.drop_column("sessions", "not_before")
    op.drop_column("sessions", "queue_place")
