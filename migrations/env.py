"""How Alembic reaches the database.

Through the connection that :mod:`service.storage.database.migrations` gives it, and no other.
"""

from alembic import context

from service.storage.database import tables

connection = context.config.attributes["connection"]
# Both databases undo DDL, and our connections begin transactions themselves: migrations happen whole or not at all.
context.configure(connection=connection, target_metadata=tables.Base.metadata, transactional_ddl=True)
with context.begin_transaction():
    context.run_migrations()
