#!/usr/bin/env bash
# Installs, upgrades or removes skyrelief on a drone's computer or a ground station: Jetson
# (JetPack 6) or any Debian or Ubuntu machine with Python 3.10 to 3.13. May be run again at any
# time. Each version has its own folder. The switch is one rename, after the new version has compiled
# its kernels. A version that does not stay up is rolled back.
#
#   sudo deploy/install.sh                      from this clone, with pip's package index
#   sudo deploy/install.sh --bundle DIR         offline, from what 'make bundle' prepared
#   sudo deploy/install.sh --ground             the ground receiver instead of the onboard service
#   sudo deploy/install.sh --profile NAME       settings of deploy/profiles/NAME.toml for a fresh
#                                               configuration; without it the board is recognised
#   sudo deploy/install.sh --rollback           return to the previous version
#   sudo deploy/install.sh --uninstall          remove it; keeps scans and configuration
set -euo pipefail

here=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
root=${SKYRELIEF_ROOT:-}          # for trials: everything goes below this folder
python=${PYTHON:-python3}
bundle=""
extras="logs"
unit=skyrelief
start=1
action=install
keep=3
profile=""
health_s=${SKYRELIEF_HEALTH_S:-45}

say() { printf '%s\n' "$*"; }
die() { printf 'install.sh: %s\n' "$*" >&2; exit 1; }

while (($#)); do
  case $1 in
    --bundle) bundle=${2:?--bundle needs a folder}; shift ;;
    --python) python=${2:?--python needs a command}; shift ;;
    --extras) extras=${2:?--extras needs a list such as gpu,logs}; shift ;;
    --profile) profile=${2:?--profile needs a name such as orin-nano}; shift ;;
    --ground) unit=skyrelief-ground; extras="ground,logs" ;;
    --no-start) start=0 ;;
    --rollback) action=rollback ;;
    --uninstall) action=uninstall ;;
    -h | --help) sed -n '2,13s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; exit 0 ;;
    *) die "no option $1; see --help" ;;
  esac
  shift
done

home=$root/opt/skyrelief
versions=$home/versions
current=$home/current
etc=$root/etc/skyrelief
cache=$root/var/cache/skyrelief
pkla=etc/polkit-1/localauthority/50-local.d

[[ -n $root || $(id -u) -eq 0 ]] || die "run it as root: sudo $0"

# True when this machine is run by systemd and we install for real.
live() { [[ -z $root && -d /run/systemd/system ]]; }

check_python() {
  command -v "$python" >/dev/null || die "no $python; apt install python3 python3-venv"
  "$python" -I -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' ||
    die "$python is $("$python" -V 2>&1); Python 3.10 to 3.13 is needed (--python python3.12)"
  "$python" -I -c 'import ensurepip' 2>/dev/null || die "no venv module; apt install python3-venv"
}

# What the packages of version folder $1 load from the system (service/packages.py has the list).
check_libraries() {
  [[ -z $root ]] || return 0
  local missing
  mapfile -t missing < <("$1/bin/python" -I -m service.packages)
  ((${#missing[@]})) || return 0
  if [[ -z $bundle ]] && command -v apt-get >/dev/null; then
    say "installing ${missing[*]}"
    apt-get install -y -q --no-install-recommends "${missing[@]}" >/dev/null && return 0
  fi
  say "missing: ${missing[*]} (skyrelief doctor says what for); apt install ${missing[*]}"
}

# NVIDIA's own builds of torch and onnxruntime live in the system's Python on a Jetson; a
# virtual environment with system packages uses them; PyPI's builds lack the GPU.
site_packages() {
  if "$python" -I - <<'PY' 2>/dev/null
import importlib.util, sys
found = [n for n in ("torch", "onnxruntime", "tensorrt") if importlib.util.find_spec(n)]
sys.exit(not found)
PY
  then printf '%s' --system-site-packages; fi
}

# The extras without those that the system's Python brings, when $1 says that it is seen.
wanted_extras() {
  local kept=()
  for extra in ${extras//,/ }; do
    case $extra in
      gpu) [[ -n $1 ]] && system_has torch && continue ;;
      onnx) [[ -n $1 ]] && system_has onnxruntime && continue ;;
    esac
    kept+=("$extra")
  done
  (IFS=,; printf '%s' "${kept[*]:-logs}")
}

system_has() { "$python" -I -c "import importlib.util as u, sys; sys.exit(u.find_spec('$1') is None)"; }

# Makes $versions/$1 from this clone or the bundle; an unfinished one is deleted.
build_version() {
  local target=$versions/$1 part=$versions/$1.part from=$bundle site
  rm -rf "$part"
  mkdir -p "$versions"
  site=$(site_packages)
  if [[ -z $from ]]; then
    say "downloading packages"
    from=$(mktemp -d -p /var/tmp)
    # shellcheck disable=SC2064  # this folder, now
    trap "rm -rf '$from'" EXIT
    PYTHON=$python "$here/deploy/bundle.sh" --extras "$(wanted_extras "$site")" --out "$from/bundle" ||
      die "the download failed; see above, or use --bundle"
    from=$from/bundle
  fi
  say "making $target${site:+ (with the packages of the system)}"
  # shellcheck disable=SC2086  # empty or one word
  "$python" -I -m venv $site "$part"
  "$part/bin/python" -I -m pip install -qq --disable-pip-version-check --no-index \
    --find-links "$from/wheels" --require-hashes -r "$from/requirements.txt"
  # A virtual environment holds its own path in the scripts it writes.
  grep -rlIZ --fixed-strings "$part" "$part/bin" "$part/pyvenv.cfg" |
    xargs -0 -r sed -i "s|$part|${target#"$root"}|g"
  "$part/bin/python" -I -c 'import service.cli, recon, mavlink' || die "the new version does not start"
  check_libraries "$part"
  install -D -m 0644 -t "$part/share/skyrelief" "${bundle:-$here}"/systemd/*.service
  mv "$part" "$target"
}

# Points 'current' at $1 by one rename, and gives systemd that version's unit.
switch_to() {
  local own=$versions/$1/share/skyrelief/$unit.service
  [[ ! -r $own ]] || install -D -m 0644 -t "$root/etc/systemd/system" "$own"
  ln -sfn "versions/$1" "$home/current.new"
  mv -T "$home/current.new" "$current"
  if live; then systemctl daemon-reload; fi
}

# Makes $1 (versions/NAME) the previous version; none when it is empty.
remember() {
  rm -f "$home/previous"
  [[ -z $1 ]] || ln -s "$1" "$home/previous"
}

# The profile of this board: by its device tree, else by its processor.
board() {
  local model=""
  [[ -r $root/proc/device-tree/model ]] && model=$(tr -d '\0' <"$root/proc/device-tree/model")
  case $model in
    *Orin*Nano*) printf 'orin-nano' ;;
    *Orin*NX*) printf 'orin-nx' ;;
    *AGX*Orin*) printf 'orin-agx' ;;
    *"Raspberry Pi 5"* | *"Compute Module 5"*) printf 'raspberry-pi-5' ;;
    *) [[ $(uname -m) != x86_64 ]] || printf 'x86-bench' ;;
  esac
}

version_now() { [[ -L $current ]] && basename "$(readlink "$current")" || true; }

# Users, folders and device rules; and the configuration, by version $1, when there is none.
install_files() {
  local from=${bundle:-$here}
  install -D -m 0644 "$from/systemd/skyrelief.sysusers" "$root/usr/lib/sysusers.d/skyrelief.conf"
  install -D -m 0644 "$from/systemd/skyrelief.tmpfiles" "$root/usr/lib/tmpfiles.d/skyrelief.conf"
  install -D -m 0644 "$from/deploy/60-skyrelief.rules" "$root/etc/udev/rules.d/60-skyrelief.rules"
  install -D -m 0644 "$from/deploy/50-skyrelief.polkit.rules" \
    "$root/etc/polkit-1/rules.d/50-skyrelief.rules"
  install -D -m 0644 -t "$root/$pkla" "$from/deploy/50-skyrelief.pkla"
  install -d -m 0755 "$etc"
  [[ $unit == skyrelief && ! -e $etc/skyrelief.toml ]] || return 0
  local settings=()
  [[ -n $profile ]] || profile=$(board)
  [[ -z $profile ]] || settings=("$from/deploy/profiles/$profile.toml")
  "$versions/$1/bin/python" -I -m service.cli config default "${settings[@]}" >"$etc/skyrelief.toml.new"
  chmod 0640 "$etc/skyrelief.toml.new"  # it may hold a password; tmpfiles gives it its group
  mv "$etc/skyrelief.toml.new" "$etc/skyrelief.toml"
  say "wrote $etc/skyrelief.toml${profile:+ with the settings of $profile}:" \
    "set camera.source, camera.model, mavlink.links, datalink.connect"
}

prepare_machine() {
  live || return 0
  systemd-sysusers skyrelief.conf
  systemd-tmpfiles --create skyrelief.conf
  # The Jetson's console on its header UART would talk into the autopilot.
  if systemctl list-unit-files nvgetty.service >/dev/null 2>&1; then
    systemctl disable --now nvgetty.service >/dev/null 2>&1 || true
  fi
  udevadm control --reload 2>/dev/null || true
  # Ports that are there already: nvgetty leaves its own with the group tty until then.
  udevadm trigger --subsystem-match=tty 2>/dev/null || true
}

# Compiles the kernels of version $1 as the service's user, before the first flight.
warm_up() {
  live && [[ $unit == skyrelief ]] || return 0
  say "compiling kernels: a minute or two on a PC, longer on a small board"
  runuser -u skyrelief -- env NUMBA_CACHE_DIR="$cache" HOME=/var/lib/skyrelief \
    "$versions/$1/bin/skyrelief" warm-up --config "$etc/skyrelief.toml" ||
    say "the kernels are not compiled: the first scan starts later"
}

# True when the service is up and stays up without a restart.
healthy() {
  local before after
  systemctl restart "$unit.service" || return 1
  before=$(systemctl show -p NRestarts --value "$unit.service")
  for ((i = 0; i < health_s; i++)); do
    sleep 1
    after=$(systemctl show -p NRestarts --value "$unit.service")
    [[ $after == "$before" ]] || return 1
  done
  systemctl is-active --quiet "$unit.service"
}

# True when the configuration has the settings that the service requires.
is_configured() {
  [[ $unit == skyrelief ]] || return 0
  "$current/bin/python" -I - "$etc/skyrelief.toml" <<'PY' 2>/dev/null
import sys
from pathlib import Path
from service.config import load_config
camera = load_config(Path(sys.argv[1])).camera
sys.exit(not (camera.source and camera.model))
PY
}

# Starts version $2; when that fails, $1 is restored with $3 as its previous version.
start_or_roll_back() {
  local old=$1 new=$2 before=$3
  if ! live || ((!start)); then
    say "not started: run 'systemctl enable --now $unit' when the configuration is right"
    return 0
  fi
  systemctl enable "$unit.service" >/dev/null
  if ! is_configured; then
    say "installed, not started: set camera.source and camera.model in $etc/skyrelief.toml," \
      "run 'sudo -u skyrelief $current/bin/skyrelief doctor', then 'systemctl restart $unit'"
    return 0
  fi
  say "starting $unit; it must stay up for $health_s s"
  if healthy; then
    say "$unit $new is running"
  elif [[ -n $old && $old != "$new" ]]; then
    switch_to "$old"
    remember "$before"
    systemctl restart "$unit.service" || true
    die "$new did not stay up; $old is back in place (journalctl -u $unit)"
  else
    die "$new did not stay up; see journalctl -u $unit and 'skyrelief config check'"
  fi
}

# Keeps the current version, the previous one, and the newest others: $keep in all.
prune() {
  find "$versions" -mindepth 1 -maxdepth 1 -type d -printf '%T@ %f\n' | sort -rn |
    awk -v now="$(version_now)" -v kept="$((keep - 1))" '$2 != now && n++ >= kept { print $2 }' |
    while read -r old; do
      [[ $(readlink "$home/previous") == "versions/$old" ]] || rm -rf "${versions:?}/$old"
    done
  [[ -d $cache ]] || return 0
  # Kernels compiled before the oldest version that is left was made are of none that is.
  local oldest
  oldest=$(find "$versions" -mindepth 1 -maxdepth 1 -type d -printf '%T@ %p\n' | sort -n |
    head -n 1 | cut -d ' ' -f 2-)
  find "$cache" -mindepth 1 -maxdepth 1 -type d -name '*_*' ! -newer "$oldest" -exec rm -rf {} +
}

version_to_install() {
  local from=${bundle:-$here} release stamp
  release=$(sed -n 's/^version = "\(.*\)"/\1/p' "$from/pyproject.toml" | head -n 1)
  stamp=$(cd "$from" && find pyproject.toml service recon mavlink systemd wheels -type f \
    ! -name '*.pyc' ! -name '*.nb[ic]' -print0 2>/dev/null |
    sort -z | xargs -0 -r cat | sha256sum | cut -c1-8)
  printf '%s-%s' "${release:?no version in $from/pyproject.toml}" "$stamp"
}

do_install() {
  [[ -z $bundle || -d $bundle/wheels ]] || die "$bundle contains no wheels/; make one with 'make bundle'"
  [[ -z $bundle || -r $bundle/requirements.txt ]] ||
    die "$bundle contains no requirements.txt with hashes; make it again with 'make bundle'"
  [[ -z $bundle ]] || bundle=$(cd "$bundle" && pwd)
  [[ -z $profile || -r ${bundle:-$here}/deploy/profiles/$profile.toml ]] ||
    die "no profile $profile; there are $(cd "${bundle:-$here}/deploy/profiles" && echo ./*.toml)"
  check_python
  local new old before
  new=$(version_to_install)
  old=$(version_now)
  before=$(readlink "$home/previous" || true)
  if [[ -x $versions/$new/bin/skyrelief ]]; then
    say "version $new is already there"
  else
    build_version "$new"
  fi
  install_files "$new"
  prepare_machine
  warm_up "$new"
  [[ -z $old || $old == "$new" ]] || remember "versions/$old"
  switch_to "$new"
  start_or_roll_back "$old" "$new" "$before"
  prune
}

do_rollback() {
  [[ -L $home/previous ]] || die "there is no previous version"
  local now previous
  now=$(version_now)
  previous=$(basename "$(readlink "$home/previous")")
  [[ -x $versions/$previous/bin/skyrelief ]] || die "version $previous was deleted"
  switch_to "$previous"
  remember "versions/$now"
  if live; then systemctl restart "$unit.service"; fi
  say "version $previous is in place; --rollback returns to $now"
}

do_uninstall() {
  if live; then
    systemctl disable --now skyrelief.service skyrelief-ground.service 2>/dev/null || true
  fi
  rm -rf "$home" "$cache"
  rm -f "$root"/etc/systemd/system/skyrelief{,-ground}.service \
    "$root"/usr/lib/{sysusers.d,tmpfiles.d}/skyrelief.conf \
    "$root/etc/udev/rules.d/60-skyrelief.rules" "$root/etc/polkit-1/rules.d/50-skyrelief.rules" \
    "$root/$pkla/50-skyrelief.pkla"
  if live; then systemctl daemon-reload; fi
  say "removed; $etc and $root/var/lib/skyrelief are kept"
}

"do_$action"
