#!/usr/bin/env bash
# Set-up: the environment .venv with the pinned dependencies, one OpenCV, a Vulkan device and an OpenGL that render.
#
# Run by `make setup`, and by `make demo` and `make test` before their work. A second run finds the stamp and ends at
# once; FORCE=1 looks at everything again. An interrupted run is repaired by the next one.
#   PYTHON=...   interpreter to make .venv with (3.11 to 3.13); default: the first suitable one on PATH
set -euo pipefail
cd "$(dirname "$0")/.."

VENV=.venv
STAMP=$VENV/.setup-done           # holds the checksum of the inputs; written last
INSTALLING=$VENV/.setup-installing # there while pip writes: a kill then may leave half a package behind
INPUTS="setup.cfg pyproject.toml constraints.txt scripts/setup.sh scripts/setup_vulkan.py scripts/setup_mujoco.py"

say() { echo "setup: $*"; }
fail() { echo "setup: $*" >&2; exit 1; }
inputs_sum() { cat $INPUTS | cksum; }

up_to_date() {
    [ -z "${FORCE:-}" ] && [ -x $VENV/bin/python ] && [ -f $STAMP ] || return 1
    [ "$(head -n 1 $STAMP)" = "$(inputs_sum) $PWD" ] || return 1
    sed 1d $STAMP | while read -r driver; do # the driver files that rendered then must still be there
        [ -e "$driver" ] || exit 1
    done
}

suitable() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; }

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        suitable "$PYTHON" || fail "PYTHON=$PYTHON is not a Python 3.11, 3.12 or 3.13"
        echo "$PYTHON"
        return
    fi
    for candidate in python3 python3.12 python3.11 python3.13; do
        if suitable $candidate; then command -v $candidate; return; fi
    done
    fail "no Python 3.11, 3.12 or 3.13 found: install one (Debian 12 or 13, Ubuntu 24.04: apt install python3" \
        "python3-venv), or name one, as in 'make setup PYTHON=/path/to/python3.12'"
}

make_venv() {
    python=$(find_python)
    say "creating $VENV with $("$python" --version) ($python)"
    rm -rf $VENV
    if "$python" -c 'import ensurepip' 2>/dev/null; then
        "$python" -m venv $VENV
    elif "$python" -m pip --version >/dev/null 2>&1; then # a system pip can fill an environment that has none
        "$python" -m venv --without-pip $VENV
        "$python" -m pip --python $VENV/bin/python install -q pip
    elif [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
        say "this Python lacks venv: installing python$version-venv with apt"
        apt-get update -qq
        DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "python$version-venv" >/dev/null
        "$python" -m venv $VENV
    else
        fail "$python lacks venv and pip: as root 'apt install python3-venv' (Debian, Ubuntu), or name another Python," \
            "as in 'make setup PYTHON=/path/to/python3.12'"
    fi
}

venv_works() {
    [ ! -e $INSTALLING ] && suitable $VENV/bin/python && $VENV/bin/python -m pip --version >/dev/null 2>&1
}

# pip, telling the large downloads and the installation alone.
pip_install() {
    $VENV/bin/python -m pip install --no-input --disable-pip-version-check --progress-bar off -c constraints.txt "$@" \
        2> >(grep -v '^WARNING: Location' >&2) |
        { grep --line-buffered -o -E '^ *(Downloading .* \(?[0-9.]+ MB.*|Installing collected packages)' || true; }
}

install_packages() {
    say "installing the pinned dependencies (the first time fetches some hundred MB and takes minutes)"
    touch $INSTALLING
    status=0
    {
        pip_install setuptools && # the build backend, so that building needs no environment of its own
            pip_install --no-build-isolation -e '.[dev]' &&
            install_mani_skill && prefer_headless_opencv
    } || status=$?
    # A failure that pip reports itself leaves whole packages; a kill or Ctrl-C may not, so then the mark stays.
    [ $status -ge 128 ] || rm -f $INSTALLING
    [ $status = 0 ] || fail "pip failed (see above): put right what it names (network, disk, index) and run it again"
}

# mani_skill requires mplib, which has no wheel for Python 3.13 and which nothing here imports (it crashes with
# numpy 2). setup.cfg lists the rest of mani_skill's requirements for 3.13; mani_skill itself comes without them.
install_mani_skill() {
    if $VENV/bin/python -c 'import sys; sys.exit(sys.version_info[:2] >= (3, 13))'; then return; fi
    pip_install --no-deps mani_skill
}

# sapien requires opencv-python and the project opencv-python-headless (no X11 or Qt libraries needed). Both write
# into cv2/ and the last one installed wins, so where the wrong one did, the headless one is laid over it again.
prefer_headless_opencv() {
    version_file=$($VENV/bin/python -c 'import sysconfig; print(sysconfig.get_path("platlib") + "/cv2/version.py")')
    if grep -q '^headless = True' "$version_file"; then return; fi
    say "putting opencv-python-headless over opencv-python"
    pip_install --force-reinstall --no-deps opencv-python-headless && grep -q '^headless = True' "$version_file"
}

# The files whose disappearance means that rendering must be set up anew.
driver_files() {
    if [ -e .mujoco_gl/mujoco_gl.json ]; then echo .mujoco_gl/mujoco_gl.json; fi
    for file in .vulkan/vulkan.json /dev/nvidiactl /usr/share/vulkan/icd.d/lvp_icd*.json; do
        if [ -e "$file" ]; then echo "$file"; return; fi
    done
}

if up_to_date; then exit 0; fi
if command -v flock >/dev/null && [ -z "${MANICM_MS_SETUP_LOCKED:-}" ]; then
    MANICM_MS_SETUP_LOCKED=1 exec flock .setup-lock "$0" "$@" # one set-up at a time; a kill frees the lock
fi
if up_to_date; then exit 0; fi
trap 'exit 130' INT TERM
rm -f $STAMP
if ! venv_works; then make_venv; fi
install_packages
$VENV/bin/python scripts/setup_vulkan.py $VENV/bin/python
$VENV/bin/python scripts/setup_mujoco.py $VENV/bin/python
{ echo "$(inputs_sum) $PWD"; driver_files; } >$STAMP.new
mv $STAMP.new $STAMP
say "done"
