#!/bin/sh
# mlflow-server.sh ARGUMENT...: `mlflow server`, with secrets from files, which no `docker inspect` shows: each variable
# NAME_FILE names the file that holds NAME.
set -eu
for name in PGPASSWORD MLFLOW_AUTH_ADMIN_PASSWORD MLFLOW_FLASK_SERVER_SECRET_KEY; do
    eval "file=\${${name}_FILE:-}"
    [ -n "$file" ] || continue
    value=$(cat "$file") || { echo "mlflow-server.sh: ${name}_FILE must name a readable file, got $file" >&2; exit 1; }
    [ -n "$value" ] || { echo "mlflow-server.sh: the file of ${name}_FILE must not be empty, got $file" >&2; exit 1; }
    export "$name=$value"
    unset "${name}_FILE"
done
unset value
exec mlflow server "$@"
