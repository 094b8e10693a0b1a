#!/usr/bin/env bash
# Does a fresh clone work with every Python that this machine has (besides make's own)? For each:
# installation, a short demo, `doctor`, quick tests; by a user without privileges where that user
# can run this Python, with an empty home, no caches, no compiler (ziglang then builds the kernels)
# and none of this shell's settings.
# tools/pythons.sh [PYTHON ...]   those, instead of all that are found
set -euo pipefail
cd "$(dirname "$0")/.."

supported='import sys; v = sys.version_info; print(f"{v[0]}.{v[1]}.{v[2]}" if (3, 11) <= v[:2] < (3, 15) else "")'
declare -A pythons
for python in "${@:-}" /usr/bin/python3 /usr/local/bin/python3.1[1-4] "${HOME:-/}"/.pyenv/versions/*/bin/python3; do
  [ $# -gt 0 ] && [[ " $* " != *" $python "* ]] && continue
  [ -x "$python" ] && version=$("$python" -c "$supported" 2>/dev/null) && [ -n "$version" ] || continue
  "$python" -c 'import ensurepip, venv' 2>/dev/null || { echo "Python $version has no venv: left out"; continue; }
  : "${pythons[$version]:=$python}"
done
if [ $# -eq 0 ] && [ -x .venv/bin/python ]; then
  unset "pythons[$(.venv/bin/python -c "$supported")]"
fi
[ ${#pythons[@]} -gt 0 ] || { echo "no other Python from 3.11 to 3.14 here"; exit 0; }

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
chmod 755 "$work"
mkdir "$work/bin"
for program in /usr/local/bin/* /usr/bin/* /bin/*; do
  case ${program##*/} in cc | gcc* | g++* | c++* | c[89]9* | cpp* | clang* | *-gcc* | *-g++* | tcc) ;; *) ln -sf "$program" "$work/bin/" ;; esac
done
for version in $(printf '%s\n' "${!pythons[@]}" | sort -V); do
  python=${pythons[$version]} home="$work/$version"
  mkdir "$home"
  git clone --quiet . "$home/tumortrack"
  as=()
  who=$(id -un)
  if [ "$(id -u)" -eq 0 ]; then
    nobody=(setpriv --reuid 65534 --regid 65534 --clear-groups)
    # By env: what setpriv itself starts, root's rights may still find in a home closed to others.
    if "${nobody[@]}" env "$python" -c '' 2>/dev/null; then
      as=("${nobody[@]}") who=nobody
      chown -R 65534:65534 "$home"
    fi
  fi
  clean=(env -i "HOME=$home" "PATH=$work/bin" "LANG=C.UTF-8")
  for name in HTTPS_PROXY HTTP_PROXY NO_PROXY https_proxy http_proxy no_proxy; do
    [ -z "${!name:-}" ] || clean+=("$name=${!name}")
  done
  echo "== Python $version ($python), as $who"
  (
    cd "$home/tumortrack"
    step() {
      local began=$SECONDS name=$1
      shift
      "${as[@]}" "${clean[@]}" "$@" >"$home/log" 2>&1 || { tail -40 "$home/log"; echo "FAILED: $name, Python $version"; exit 1; }
      echo "$name: $((SECONDS - began)) s; $(tail -1 "$home/log")"
    }
    step demo make --silent demo "PYTHON=$python" ARGS="--scenes 1"
    step doctor .venv/bin/tumortrack doctor
    step setup make --silent setup "PYTHON=$python"
    step tests make --silent quick "PYTHON=$python"
  )
  rm -rf "$home"
done
