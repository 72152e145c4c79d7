"""How many steps a session has, kept beside it: a list of a thousand sessions needn't count their steps."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("steps", sa.Integer(), server_default="0", nullable=False))
    op.execute("UPDATE sessions SET steps = (SELECT count(*) FROM steps WHERE steps.session_id = sessions.id)")


def downgrade() -> None:
    op.drop_column("sessions", "steps")
