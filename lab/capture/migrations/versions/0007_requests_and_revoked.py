"""What a session was asked to start with and what follows its end, and certificates that are revoked."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None

_OF_SESSIONS: dict[str, sa.types.TypeEngine[Any]] = {
    "request": sa.JSON(),
    "then_state": sa.String(20),
    "then": sa.JSON(),
}
_OF_CALIBRATIONS: dict[str, sa.types.TypeEngine[Any]] = {
    "revoked": sa.DateTime(timezone=True),
    "revoked_by": sa.String(100),
    "revoked_why": sa.Text(),
}


def upgrade() -> None:
    for table, columns in (("sessions", _OF_SESSIONS), ("calibrations", _OF_CALIBRATIONS)):
        for name, kind in columns.items():
            op.add_column(table, sa.Column(name, kind, nullable=True))
    op.create_index("ix_sessions_then_state", "sessions", ["then_state"])


def downgrade() -> None:
    op.drop_index("ix_sessions_then_state", "sessions")
    for table, columns in (("sessions", _OF_SESSIONS), ("calibrations", _OF_CALIBRATIONS)):
        for name in columns:
            op.drop_column(table, name)
