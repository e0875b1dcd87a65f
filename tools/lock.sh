#!/bin/sh
# Writes the lock files from pyproject.toml: what runs the twin, what develops it, what audits it.
# Hashes are kept and no index is named, so a mirror or a folder of wheels serves as well.
set -eu
cd "$(dirname "$0")/.."
lock() {
    out=$1
    shift
    uv pip compile "$@" --universal --python-version 3.11 --generate-hashes \
        --no-emit-index-url --no-annotate --no-header --quiet --output-file "$out"
}
lock requirements.lock pyproject.toml --group build
lock requirements-dev.lock pyproject.toml --extra aas --extra dask --extra notebook --extra serve --extra view \
    --group build --group dev --group docs --constraint requirements.lock
lock requirements-audit.lock --group audit --constraint requirements-dev.lock
