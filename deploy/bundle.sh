#!/usr/bin/env bash
# Prepares a folder from which deploy/install.sh installs without a network:
#   deploy/bundle.sh [--platform x86_64|aarch64] [--extras logs] [--out dist/bundle]
# Run it with the Python version of the machine that will fly it (JetPack 6: 3.10), for instance
#   PYTHON=python3.10 deploy/bundle.sh --platform aarch64
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
python=${PYTHON:-python3}
platform=$(uname -m)
version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
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
cp -r "$here/deploy" "$here/systemd" "$here/pyproject.toml" "$here/README.md" "$out/"

[[ $extras == *ground* ]] || export SKYRELIEF_NO_PORTAL=1
"$python" -m pip wheel -q --disable-pip-version-check --no-deps -w "$out/wheels" "$here"
wheel=$(find "$out/wheels" -name 'skyrelief-*.whl')

tags=()
for tag in 2_17 2_26 2_27 2_28 2_31 2_34 2_35; do
  tags+=(--platform "manylinux_${tag}_$platform")
done
tags+=(--platform "manylinux2014_$platform")
"$python" -m pip download -q --disable-pip-version-check -d "$out/wheels" \
  --only-binary=:all: --implementation cp --python-version "$version" "${tags[@]}" \
  -c "$here/constraints.txt" "${wheel}[$extras]"
printf '%s: %d wheels for Python %s on %s, %s\n' "$out" "$(find "$out/wheels" -name '*.whl' | wc -l)" \
  "$version" "$platform" "$(du -sh "$out" | cut -f1)"
