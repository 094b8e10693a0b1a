#!/usr/bin/env bash
# Install what tests of ROS 2, RealSense and the web viewer need of Debian. Where that is not
# possible (another system, no root), say so: those tests then skip, with this reason.
set -euo pipefail
cd "$(dirname "$0")"
mapfile -t packages < <(grep -v '^#' debian-packages.txt)
missing=()
for package in "${packages[@]}"; do
  dpkg -s "$package" >/dev/null 2>&1 || missing+=("$package")
done
[ ${#missing[@]} -eq 0 ] && exit 0
root=""
[ "$(id -u)" -eq 0 ] || root="sudo -n"
if ! command -v apt-get >/dev/null || { [ -n "$root" ] && ! $root true 2>/dev/null; }; then
  echo "tools/debian.sh: cannot install ${missing[*]} here (not Debian, or no root); tests that need them skip." >&2
  exit 0
fi
export DEBIAN_FRONTEND=noninteractive
$root apt-get update -qq
$root apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
