"""An index of PostgreSQL that finds environments by any part of their texts, as SQLite's of migration 0020 does.

Revision ID: 0026
Revises: 0025
"""

from __future__ import annotations

from alembic import op

revision = "0026"
down_revision = "0025"
branch_labels = None
depends_on = None
min_compatible = "0019"

STATEMENTS = (
    """
CREATE TABLE environment_text (
    environment_id VARCHAR(32) PRIMARY KEY REFERENCES environment (id) ON DELETE CASCADE, grams TSVECTOR NOT NULL)""",
    # All three characters in a row; the last ones of the text begin shorter groups.
    """
CREATE FUNCTION environment_grams(text) RETURNS tsvector LANGUAGE sql IMMUTABLE AS $$
    SELECT array_to_tsvector(array_agg(DISTINCT gram)) FROM (
        SELECT character || lead(character, 1, '') OVER places || lead(character, 2, '') OVER places AS gram
        FROM unnest(string_to_array($1, NULL)) WITH ORDINALITY AS characters (character, place)
        WINDOW places AS (ORDER BY place)) AS groups $$""",
    """
CREATE FUNCTION environment_text_write() RETURNS trigger LANGUAGE plpgsql AS $$ BEGIN
    INSERT INTO environment_text VALUES (new.id, environment_grams(lower({TEXT})))
    ON CONFLICT (environment_id) DO UPDATE SET grams = excluded.grams;
    RETURN NULL; END $$""",
    """
CREATE TRIGGER environment_text_insert AFTER INSERT ON environment
    FOR EACH ROW EXECUTE FUNCTION environment_text_write()""",
    """
CREATE TRIGGER environment_text_update AFTER UPDATE OF name, title, description, tags ON environment
    FOR EACH ROW EXECUTE FUNCTION environment_text_write()""",
    "INSERT INTO environment_text SELECT id, environment_grams(lower({TEXT})) FROM environment AS new",
    "CREATE INDEX ix_environment_text_grams ON environment_text USING gin (grams)",
)
TEXT = " || chr(10) || ".join(f"new.{column}" for column in ("name", "title", "description", "tags::text"))


def upgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        for statement in STATEMENTS:
            op.execute(statement.replace("{TEXT}", TEXT))


def downgrade() -> None:
    if op.get_bind().dialect.name == "postgresql":
        op.execute("DROP FUNCTION environment_text_write CASCADE")
        op.execute("DROP TABLE environment_text")
        op.execute("DROP FUNCTION environment_grams")
