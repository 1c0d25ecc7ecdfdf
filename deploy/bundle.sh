#!/usr/bin/env bash
# Prepares a folder from which deploy/install.sh installs without a network:
#   deploy/bundle.sh [--platform x86_64|aarch64] [--extras logs] [--out dist/bundle]
# Run it with the Python version of the target machine (JetPack 6: 3.10), for instance
#   PYTHON=python3.10 deploy/bundle.sh --platform aarch64
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
python=${PYTHON:-python3}
platform=$(uname -m)
version=$("$python" -I -c 'import sys; print("%d.%d" % sys.version_info[:2])')
extras=logs
out=$here/dist/bundle

while (($#)); do
  case $1 in
    --platform) platform=${2:?--platform needs x86_64 or aarch64}; shift ;;
    --extras) extras=${2:?--extras needs a list}; shift ;;
    --out) out=${2:?--out needs a folder}; shift ;;
    -h | --help) sed -n '2,5s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; exit 0 ;;
    *) printf 'bundle.sh: no option %s; see --help\n' "$1" >&2; exit 1 ;;
  esac
  shift
done

rm -rf "$out"
mkdir -p "$out/wheels"
cp -r "$here/deploy" "$here/systemd" "$here/pyproject.toml" "$here/README.md" "$here/LICENSE" "$out/"

# Our own wheel is built in an environment with the pinned build tools only.
builder=$(mktemp -d)
trap 'rm -rf "$builder"' EXIT
"$python" -I -m venv "$builder"
pinned() { "$builder/bin/python" -I -m pip "$@" -qq --disable-pip-version-check --require-hashes --only-binary=:all:; }
builders=(-r "$here/deploy/locked/build.txt")
if [[ $extras != *ground* ]]; then
  export SKYRELIEF_NO_PORTAL=1
elif ! command -v npm >/dev/null; then
  builders+=(-r "$here/deploy/locked/node.txt")
fi
pinned install "${builders[@]}"
"$builder/bin/python" -I -m pip wheel -qq --disable-pip-version-check --no-deps --no-build-isolation \
  -w "$out/wheels" "$here"

tags=()
for tag in 2_17 2_24 2_26 2_27 2_28 2_31 2_34 2_35; do
  tags+=(--platform "manylinux_${tag}_$platform")
done
tags+=(--platform "manylinux2014_$platform")
locked=()
for extra in ${extras//,/ }; do
  [[ -r $here/deploy/locked/$extra.txt ]] || { printf 'bundle.sh: no extra %s\n' "$extra" >&2; exit 1; }
  locked+=(-r "$here/deploy/locked/$extra.txt")
done
# Only wheels, each with its hash in deploy/locked: no downloaded code runs here.
pinned download -d "$out/wheels" --implementation cp --python-version "$version" "${tags[@]}" \
  "${locked[@]}"
"$python" "$here/deploy/inventory.py" "$out"
printf '%s: %d wheels for Python %s on %s, %s\n' "$out" "$(find "$out/wheels" -name '*.whl' | wc -l)" \
  "$version" "$platform" "$(du -sh "$out" | cut -f1)"
