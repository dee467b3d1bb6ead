#!/bin/sh
# Installs Fleet Map Server from this bundle, without network: ./install.sh [FOLDER]      (default: /opt/fleetmap)
# Each version has a folder of its own; FOLDER/current is the newest one, and FOLDER/current/bin/fleetmap the program.
# PYTHON: the Python to use [default: pythonX.Y of the bundle, else python3].
set -eu

VERSION=
PROCESSOR=
PYTHON_VERSION=

fail() {
  echo "install.sh: $1" >&2
  exit 1
}

target=${1:-/opt/fleetmap}
case $target in /*) ;; *) target=$PWD/$target ;; esac
cd "$(dirname "$0")"

sha256sum --check --quiet --strict SHA256SUMS || fail "the bundle is damaged: copy it again (the lines above name the files)"
[ "$(uname -s)/$(uname -m)" = "Linux/$PROCESSOR" ] ||
  fail "this bundle is for Linux/$PROCESSOR, this machine is $(uname -s)/$(uname -m): make bundle ARGS=\"--processor $(uname -m)\""

python=${PYTHON:-$(command -v "python$PYTHON_VERSION" || command -v python3 || true)}
[ -n "$python" ] || fail "Python $PYTHON_VERSION is missing: install it, or set PYTHON to its path"
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])') || fail "$python does not run"
[ "$version" = "$PYTHON_VERSION" ] ||
  fail "this bundle is for Python $PYTHON_VERSION, $python is $version: set PYTHON, or make bundle ARGS=\"--python $version\""

# Another version stays in use until this one is complete.
folder=$target/$VERSION
mkdir -p "$target"
rm -rf "$folder"
"$python" -m venv --without-pip "$folder"
"$folder/bin/python" "$(echo wheels/pip-*.whl)/pip" install --quiet --disable-pip-version-check --no-index --no-deps \
  --find-links wheels --require-hashes --requirement requirements.txt
"$folder/bin/fleetmap" --version
ln -sfn "$VERSION" "$target/current.new"
mv -T "$target/current.new" "$target/current"

echo "installed: $target/current/bin/fleetmap"
[ ! -f images.tar ] || echo "container images: docker load --input $PWD/images.tar"
