"""What makes lists of a thousand sessions quick: how many steps each has, and indexes of their order and of their
states."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("steps", sa.Integer(), server_default="0", nullable=False))
    op.create_index(op.f("ix_sessions_created"), "sessions", ["created", "id"], unique=False)
    op.create_index(op.f("ix_sessions_state"), "sessions", ["state"], unique=False)
    op.execute("UPDATE sessions SET steps = (SELECT count(*) FROM steps WHERE steps.session_id = sessions.id)")


def downgrade() -> None:
    op.drop_index(op.f("ix_sessions_state"), "sessions")
    op.drop_index(op.f("ix_sessions_created"), "sessions")
    op.drop_column("sessions", "steps")
