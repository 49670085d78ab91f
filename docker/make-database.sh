#!/bin/sh
# Run by PostgreSQL's image when its volume is empty: MLflow's role, which owns its database and nothing else. The
# superuser loses its password: from then on it gets in inside the container only, for backups.
set -eu
psql -X -q -v ON_ERROR_STOP=1 -U "${POSTGRES_USER:-postgres}" -d postgres <<'SQL'
\set password `cat "$POSTGRES_PASSWORD_FILE"`
create role mlflow login password :'password';
create database mlflow owner mlflow;
revoke all on database mlflow from public;
alter role current_user password null;
SQL
