"""Certification and expiry of calibrations, their figures, and sessions that demand a certified calibration."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.add_column("sessions", sa.Column("demands_certified", sa.Boolean(), nullable=False, server_default=sa.false()))
    op.create_table(
        "calibrations",
        sa.Column("id", sa.String(length=40), nullable=False),
        sa.Column("session_id", sa.String(length=40), nullable=False),
        sa.Column("created", sa.DateTime(timezone=True), nullable=False),
        sa.Column("rig", sa.Text(), nullable=False),
        sa.Column("cameras", sa.JSON(), nullable=False),
        sa.Column("certified", sa.DateTime(timezone=True), nullable=True),
        sa.Column("certified_by", sa.String(length=100), nullable=True),
        sa.Column("limits", sa.JSON(), nullable=True),
        sa.Column("judgements", sa.JSON(), nullable=True),
        sa.Column("expires", sa.DateTime(timezone=True), nullable=True),
        sa.Column("superseded", sa.DateTime(timezone=True), nullable=True),
        sa.Column("superseded_by", sa.String(length=40), nullable=True),
        sa.ForeignKeyConstraint(["id"], ["results.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id"),
    )
    for column in ("session_id", "created", "rig"):
        op.create_index(op.f(f"ix_calibrations_{column}"), "calibrations", [column], unique=False)
    op.create_table(
        "figures",
        sa.Column("id", sa.Integer(), nullable=False),
        sa.Column("calibration_id", sa.String(length=40), nullable=False),
        sa.Column("camera", sa.Text(), nullable=False),
        sa.Column("side", sa.String(length=10), nullable=True),
        sa.Column("name", sa.String(length=200), nullable=False),
        sa.Column("place", sa.String(length=60), nullable=False),
        sa.Column("value", sa.Double(), nullable=False),
        sa.Column("std", sa.Double(), nullable=False),
        sa.ForeignKeyConstraint(["calibration_id"], ["calibrations.id"], ondelete="CASCADE"),
        sa.PrimaryKeyConstraint("id"),
    )
    op.create_index(op.f("ix_figures_calibration_id"), "figures", ["calibration_id"], unique=False)
    op.create_index("ix_figures_history", "figures", ["camera", "name", "place"], unique=False)


def downgrade() -> None:
    op.drop_table("figures")
    op.drop_table("calibrations")
    op.drop_column("sessions", "demands_certified")
