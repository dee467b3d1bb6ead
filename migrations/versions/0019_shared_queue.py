"""Jobs that any server follows, and on PostgreSQL the tables of Procrastinate, the queue of all servers.

Revision ID: 0019
Revises: 0018
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0019"
down_revision = "0018"
branch_labels = None
depends_on = None
min_compatible = "0018"

TABLES = ("procrastinate_events", "procrastinate_periodic_defers", "procrastinate_jobs", "procrastinate_workers")
TYPES = ("procrastinate_job_to_defer_v1", "procrastinate_job_event_type", "procrastinate_job_status")


def upgrade() -> None:
    op.add_column("job", sa.Column("task", sa.String(64), nullable=True))
    op.add_column("job", sa.Column("location", sa.Text, nullable=True))
    op.add_column("job", sa.Column("outcome", sa.JSON(none_as_null=True), nullable=True))
    op.add_column("job", sa.Column("followed", sa.Boolean, nullable=False, server_default=sa.true()))
    op.create_index("ix_job_task", "job", ["task"])
    if op.get_bind().dialect.name == "postgresql":
        from procrastinate.schema import SchemaManager

        driver = op.get_bind().connection.driver_connection  # the schema contains percent signs
        assert driver is not None
        driver.execute(SchemaManager.get_schema())


def downgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        for name in TABLES:
            op.execute(f"DROP TABLE {name} CASCADE")
        op.execute(
            "DO $$ DECLARE routine record; BEGIN FOR routine IN SELECT oid::regprocedure AS name FROM pg_proc"
            " WHERE proname LIKE 'procrastinate%' LOOP EXECUTE 'DROP FUNCTION ' || routine.name || ' CASCADE';"
            " END LOOP; END $$"
        )
        for name in TYPES:
            op.execute(f"DROP TYPE {name} CASCADE")
    op.drop_index("ix_job_task", "job")
    for column in ("followed", "outcome", "location", "task"):
        op.drop_column("job", column)
