#!/bin/sh
# Writes the lock files from pyproject.toml: what the demo, a service, development and audit run on.
# Hashes are kept and no index is named, so a mirror or a folder of wheels serves as well.
set -eu
cd "$(dirname "$0")/.."
lock() {
    out=$1
    shift
    uv pip compile "$@" --universal --python-version 3.11 --generate-hashes \
        --no-emit-index-url --no-annotate --no-header --quiet --output-file "$out"
}
lock requirements.lock pyproject.toml --extra fleet --extra opcua --extra reports --extra tables --group build
lock requirements-service.lock pyproject.toml --constraint requirements.lock --group build \
    --extra opcua --extra postgres --extra reports --extra serve
lock requirements-dev.lock pyproject.toml --constraint requirements.lock --all-extras \
    --group build --group dev --group docs
lock requirements-audit.lock --group audit --constraint requirements-dev.lock
