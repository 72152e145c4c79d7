"""The sensor temperature of a calibration's dark currents, and each figure once a calibration."""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_COLUMNS = ("temperature_c", "doubling_c", "doubling_c_std")


def upgrade() -> None:
    for column in _COLUMNS:
        op.add_column("figures", sa.Column(column, sa.Double(), nullable=True))
    # Figures that no two calibrations have alike: bands that are chosen anew in each, dark currents at a session's own
    # temperatures.
    op.execute(
        "DELETE FROM figures WHERE name LIKE '% maker_departures %' OR name LIKE '% dark_current_temperature %e_per_s'"
    )
    op.execute(
        "DELETE FROM figures WHERE id NOT IN (SELECT max(id) FROM figures GROUP BY calibration_id, camera, side, "
        "name, place)"
    )
    # The temperature of earlier ones isn't known; silicon's law is as in lab/fit/noise/dark_current.py.
    op.execute("UPDATE figures SET doubling_c = 7.2, doubling_c_std = 1.4 WHERE name LIKE 'noise dark_current%e_per_s'")
    op.create_index("ix_figures_once", "figures", ["calibration_id", "camera", "side", "name", "place"], unique=True)


def downgrade() -> None:
    op.drop_index("ix_figures_once", "figures")
    for column in _COLUMNS:
        op.drop_column("figures", column)
