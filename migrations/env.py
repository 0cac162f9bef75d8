"""How Alembic reaches the database: through the connection that :mod:`service.db.migrating` gives it, and no other."""

from alembic import context

from service.db import models

connection = context.config.attributes["connection"]
# Both databases undo DDL, and our connections begin transactions themselves: migrations happen whole or not at all.
context.configure(connection=connection, target_metadata=models.Base.metadata, transactional_ddl=True)
with context.begin_transaction():
    context.run_migrations()
