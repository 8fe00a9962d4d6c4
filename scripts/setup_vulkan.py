"""Give SAPIEN a Vulkan device to render with: keep one that works, else install Mesa's lavapipe 24.3 or newer.

The first that renders is taken:

1. The system's device (an NVIDIA driver, or lavapipe): nothing is installed.
2. An earlier run's choice in `.vulkan/`.
3. The system's lavapipe, named by `.vulkan/vulkan.json` where another driver keeps SAPIEN from finding it.
4. root with apt: `mesa-vulkan-drivers` and `libvulkan1` are installed; where the distribution's own are too
   old (Debian 12 has 22.3), its backports suite is added first, at the mirror and with the key ring that the
   machine's own apt configuration names.
5. no root, with apt: the same packages are downloaded and unpacked into `.vulkan/`, which `manicm_ms.machine.vulkan`
   finds; nothing outside the repository is written.

Each is tried by a real rendering. Only the standard library is used.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]
PRIVATE = REPO / ".vulkan"
PACKAGES = ("mesa-vulkan-drivers", "libvulkan1", "libx11-6")  # SAPIEN itself links libX11
NEEDED_MESA = (24, 3)  # lavapipe before 24.3 lacks what SAPIEN asks of a rendering device
BACKPORTS_FILE = "manicm-ms-backports.sources"
ALIASES = ("stable", "oldstable", "testing")  # suites that a sources file may name in place of the code name
SYSTEM_DRIVERS = (Path("/usr/share/vulkan/icd.d"), Path("/etc/vulkan/icd.d"), Path("/usr/local/share/vulkan/icd.d"))
USERS_DRIVER = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")
# Part of the C runtime: never loaded from a private folder, a process has them already.
RUNTIME = ("libc.so", "libm.so", "libdl.so", "libpthread.so", "librt.so", "ld-linux", "libresolv", "libnsl", "libutil")


class SetupError(Exception):
    """What could not be done, and what to do about it."""


def say(text: str) -> None:
    """Print a line of progress."""
    print(f"setup: {text}", flush=True)


# ---------------------------------------------------------------- apt's own configuration


@dataclass(frozen=True)
class Source:
    """An apt source: where (`uris`), which `suites` and `components`, and further deb822 fields (`extra`)."""

    uris: tuple[str, ...]
    suites: tuple[str, ...]
    components: tuple[str, ...]
    extra: tuple[tuple[str, str], ...] = ()

    def deb822(self) -> str:
        """Return the source as a deb822 stanza."""
        fields = [("Types", "deb"), ("URIs", " ".join(self.uris)), ("Suites", " ".join(self.suites))]
        fields += [("Components", " ".join(self.components)), *self.extra]
        return "".join(f"{key}: {value}\n" for key, value in fields)


_KEPT_FIELDS = {"signed-by": "Signed-By", "architectures": "Architectures", "arch": "Architectures"}
_KEPT_FIELDS |= {"trusted": "Trusted", "check-valid-until": "Check-Valid-Until"}


def parse_deb822(text: str) -> list[Source]:
    """Return the enabled binary sources of a `.sources` file."""
    found = []
    for stanza in re.split(r"\n[ \t]*\n", text):
        fields: dict[str, str] = {}
        key = ""
        for line in stanza.splitlines():
            if line.startswith("#") or not line.strip():
                continue
            if line[0] in " \t" and key:  # an embedded key continues over lines
                fields[key] += "\n" + line
                continue
            key, _, value = line.partition(":")
            key = key.strip().lower()
            fields[key] = value.strip()
        if "deb" not in fields.get("types", "").split() or fields.get("enabled", "yes").lower() in ("no", "false"):
            continue
        extra = tuple((_KEPT_FIELDS[k], v) for k, v in fields.items() if k in _KEPT_FIELDS)
        words = [tuple(fields.get(k, "").split()) for k in ("uris", "suites", "components")]
        found.append(Source(words[0], words[1], words[2], extra))
    return found


_ONE_LINE = re.compile(r"^deb\s+(?:\[(?P<options>[^\]]*)\]\s+)?(?P<uri>\S+)\s+(?P<suite>\S+)\s*(?P<components>[^#]*)")


def _split_options(options: str | None) -> list[tuple[str, str, str]]:
    return [option.partition("=") for option in (options or "").split()]


def parse_one_line(text: str) -> list[Source]:
    """Return the binary sources of a one-line-style `.list` file."""
    found = []
    for line in text.splitlines():
        match = _ONE_LINE.match(line.strip())
        if not match:
            continue
        options = [(k.lower(), v.replace(",", " ")) for k, _, v in _split_options(match["options"])]
        extra = tuple((_KEPT_FIELDS[k], v) for k, v in options if k in _KEPT_FIELDS)
        found.append(Source((match["uri"],), (match["suite"],), tuple(match["components"].split()), extra))
    return found


def apt_sources(root: Path = Path("/etc/apt")) -> list[Source]:
    """Return all binary sources that the machine's apt knows."""
    found = []
    one_line = [root / "sources.list", *sorted((root / "sources.list.d").glob("*.list"))]
    for path in one_line:
        if path.is_file():
            found += parse_one_line(path.read_text(errors="replace"))
    for path in sorted((root / "sources.list.d").glob("*.sources")):
        found += parse_deb822(path.read_text(errors="replace"))
    return found


def backports_of(sources: list[Source], codename: str) -> Source | None:
    """Return the backports source that belongs to the distribution's main one; None where there is no main one."""
    for source in sources:
        if {codename, *ALIASES} & set(source.suites) and "main" in source.components:
            return replace(source, suites=(f"{codename}-backports",), components=("main",))
    return None


# ---------------------------------------------------------------- apt


def run(command: list[str]) -> str:
    """Run a command and return its output, which a failure shows."""
    env = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C.UTF-8"}
    done = subprocess.run(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=env, check=False)
    if done.returncode:
        tail = "\n".join(done.stdout.strip().splitlines()[-15:])
        raise SetupError(f"this command failed:\n  {' '.join(command)}\n{tail}\nRepeat 'make setup' once it can work.")
    return done.stdout


def os_release(path: Path = Path("/etc/os-release")) -> dict[str, str]:
    """Return the fields of os-release."""
    lines = path.read_text().splitlines() if path.is_file() else []
    return {k: v.strip("\"'") for k, eq, v in (line.partition("=") for line in lines) if eq}


def mesa_version(version: str) -> tuple[int, int]:
    """Return (major, minor) of a Debian version string of Mesa, (0, 0) where it has none."""
    match = re.match(r"(?:\d+:)?(\d+)\.(\d+)", version)
    return (int(match[1]), int(match[2])) if match else (0, 0)


class Apt:
    """apt-get on the system's own state, or, given `options`, on a private one that needs no root."""

    def __init__(self, options: tuple[str, ...] = ()) -> None:
        self.options = options

    def update(self) -> None:
        """Fetch the package lists; a source that fails (a third party's, say) is told and does not stop it."""
        try:
            run(["apt-get", *self.options, "update"])
        except SetupError as error:
            say(f"warning: {error}")

    def target_release(self, codename: str) -> tuple[str, ...] | None:
        """Return the apt arguments that select a new enough Mesa, or None where no known suite has one."""
        rows = [line.split("|") for line in run(["apt-cache", *self.options, "madison", PACKAGES[0]]).splitlines()]
        binaries = [(row[1].strip(), row[2].strip()) for row in rows if len(row) == 3 and "Packages" in row[2]]
        new = [suite for version, suite in binaries if mesa_version(version) >= NEEDED_MESA]
        if not new:
            return None
        only_backports = all(f"{codename}-backports" in suite for suite in new)
        return ("-t", f"{codename}-backports") if only_backports else ()

    def install(self, packages: tuple[str, ...], *arguments: str) -> None:
        """Install `packages` (with `--download-only`: fetch them and what they lack here)."""
        run(["apt-get", *self.options, "install", "-y", "--no-install-recommends", *arguments, *packages])


NO_MESA = (
    "no apt suite of this machine has mesa-vulkan-drivers 24.3 or newer: enable a newer suite (Debian: backports; "
    "Ubuntu 24.04: noble-updates), or install an NVIDIA driver, then repeat 'make setup'"
)


def needed_backports(codename: str) -> Source:
    """Return the backports source to add; raise SetupError where there is none to be had."""
    found = backports_of(apt_sources(), codename) if os_release().get("ID") == "debian" else None
    if found is None:
        raise SetupError(NO_MESA)
    return found


def update_until_found(apt: Apt, codename: str, sources_file: Path) -> tuple[str, ...]:
    """Return the arguments that select a new enough Mesa, adding backports as `sources_file` if that is needed."""
    say("reading apt's package lists")
    apt.update()
    target = apt.target_release(codename)
    if target is None:
        source = needed_backports(codename)
        say(f"adding {codename}-backports of this machine's own mirror in {sources_file}")
        sources_file.write_text("# Added by manicm_ms's set-up, for mesa-vulkan-drivers >= 24.3.\n" + source.deb822())
        apt.update()
        target = apt.target_release(codename)
    if target is None:
        raise SetupError(NO_MESA)
    return target


def install_as_root(codename: str) -> None:
    """Install the Vulkan packages system-wide."""
    apt = Apt()
    target = update_until_found(apt, codename, Path("/etc/apt/sources.list.d") / BACKPORTS_FILE)
    say(f"installing {' and '.join(PACKAGES)} with apt")
    apt.install(PACKAGES, *target)


# ---------------------------------------------------------------- without root


def private_apt(folder: Path, codename: str) -> tuple[Apt, Path]:
    """Return an apt whose lists and downloads lie in `folder`, and where its sources are.

    It knows the distribution's own suites alone, and what is installed here, so that it fetches only what is missing.
    """
    sources = folder / "sources"
    for part in (sources, folder / "lists" / "partial", folder / "cache" / "archives" / "partial"):
        part.mkdir(parents=True)
    wanted = [s for s in apt_sources() if "main" in s.components]
    own = [s for s in wanted if all(x in ALIASES or x.split("-")[0] == codename for x in s.suites)]
    (sources / "distribution.sources").write_text("\n".join(s.deb822() for s in own))
    settings = {
        "Dir::Etc::sourcelist": "/dev/null",
        "Dir::Etc::sourceparts": sources,
        "Dir::State::lists": folder / "lists",
        "Dir::Cache": folder / "cache",
        "Dir::Cache::archives": folder / "cache" / "archives",
        "Debug::NoLocking": "1",  # the system's lock files need root; nothing of the system is written
    }
    options = tuple(word for key, value in settings.items() for word in ("-o", f"{key}={value}"))
    return Apt(options), sources


def unpack_privately(python: str, codename: str) -> None:
    """Fetch the Vulkan packages with what they need and unpack them into `.vulkan/`, without root."""
    fresh = PRIVATE.with_name(".vulkan.new")
    say("fetching Mesa's Vulkan driver and what it needs (about 40 to 100 MB)")
    unpack(PACKAGES, fresh, codename, update_until_found)
    write_private_manifest(python, fresh)
    shutil.rmtree(PRIVATE, ignore_errors=True)
    fresh.rename(PRIVATE)


def unpack(
    packages: tuple[str, ...], fresh: Path, codename: str, choose: Callable[[Apt, str, Path], tuple[str, ...]]
) -> None:
    """Fetch `packages` with what they lack here and unpack them into `fresh`/root, without root.

    `choose` reads the package lists and returns the apt arguments that select a suite, as `update_until_found` does.
    """
    shutil.rmtree(fresh, ignore_errors=True)
    apt, sources = private_apt(fresh / "apt", codename)
    target = choose(apt, codename, sources / BACKPORTS_FILE)
    apt.install(packages, "--download-only", *target)
    for package in sorted((fresh / "apt" / "cache" / "archives").glob("*.deb")):
        run(["dpkg-deb", "-x", str(package), str(fresh / "root")])
    shutil.rmtree(fresh / "apt")


def write_private_manifest(python: str, folder: Path) -> None:
    """Write the driver file and the manifest of the packages unpacked in `folder`/root, with relative paths."""
    libraries = sorted(folder.glob("root/usr/lib/**/libvulkan_lvp.so"))
    drivers = sorted(folder.glob("root/usr/share/vulkan/icd.d/lvp_icd*.json"))
    if not (libraries and drivers):
        raise SetupError(
            f"the packages unpacked in {folder} hold no lavapipe: remove that folder and repeat 'make setup'"
        )
    library = libraries[0]
    driver = json.loads(drivers[0].read_text())
    driver["ICD"]["library_path"] = f"./{library.relative_to(folder)}"  # the loader reads it relative to the file
    (folder / "lvp_icd.json").write_text(json.dumps(driver, indent=2) + "\n")
    x11 = list(folder.glob("root/usr/lib/**/libX11.so.6"))  # there where the system lacks it; SAPIEN needs it
    write_manifest(folder, "lvp_icd.json", preload_list(python, x11, [library], folder))


def preload_list(python: str, libraries: list[Path], drivers: list[Path], folder: Path) -> list[str]:
    """Return `libraries` of `folder` and what they and `drivers` need there, relative to it, each after its needs."""
    wanted = dict.fromkeys([*libraries, *private_needs([*libraries, *drivers], folder)])
    return [str(p.relative_to(folder)) for p in load_order(python, list(wanted))]


def private_needs(libraries: list[Path], folder: Path) -> list[Path]:
    """Return the libraries in `folder` that `libraries` need, as the linker finds them there."""
    places = sorted({str(p.parent) for p in folder.glob("root/**/*.so*")})
    env = {**os.environ, "LD_LIBRARY_PATH": ":".join(places)}
    text = "".join(
        subprocess.run(["ldd", str(path)], text=True, capture_output=True, env=env, check=False).stdout
        for path in libraries
    )
    missing = sorted(set(re.findall(r"(\S+) => not found", text)))
    if missing:
        raise SetupError(
            f"the packages in {folder} also need {', '.join(missing)}: install it, or run 'make setup' as root"
        )
    found = [Path(p) for p in re.findall(r"=> (/\S+)", text)]
    return [p for p in dict.fromkeys(found) if p.is_relative_to(folder) and not p.name.startswith(RUNTIME)]


_LOAD_ORDER = """
import ctypes, json, sys
left, order = json.loads(sys.argv[1]), []
while left:
    again = []
    for path in left:
        try:
            ctypes.CDLL(path)
            order.append(path)
        except OSError as error:
            again.append(path)
            last = error
    if len(again) == len(left):
        sys.exit(str(last))
    left = again
print(json.dumps(order))
"""


def load_order(python: str, libraries: list[Path]) -> list[Path]:
    """Return `libraries` in the order of their needs, in which a process without a search path can load them."""
    return [Path(p) for p in json.loads(run([python, "-c", _LOAD_ORDER, json.dumps([str(p) for p in libraries])]))]


def write_manifest(folder: Path, driver: str, preload: list[str]) -> None:
    """Write the manifest that `manicm_ms.machine.vulkan` reads."""
    folder.mkdir(exist_ok=True)
    (folder / "vulkan.json").write_text(json.dumps({"driver": driver, "preload": preload}, indent=2) + "\n")


# ---------------------------------------------------------------- the choice


def device(python: str, source: str) -> str:
    """Return the name of the device that SAPIEN renders with, "" for none; `source` is as MANICM_MS_VULKAN.

    A driver that this shell names is left out: what renders here must render in a shell that names none.
    """
    env = {key: value for key, value in os.environ.items() if key not in USERS_DRIVER}
    env["MANICM_MS_VULKAN"] = source
    try:
        done = subprocess.run(
            [python, "-m", "manicm_ms.machine.vulkan"],
            capture_output=True, text=True, env=env, timeout=300, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return ""
    return done.stdout.strip().splitlines()[-1] if done.returncode == 0 else ""


def system_lavapipe(python: str) -> str:
    """Try the system's own lavapipe by name; where it renders, record it in `.vulkan/` and return its device's name."""
    for driver in (path for folder in SYSTEM_DRIVERS for path in sorted(folder.glob("lvp_icd*.json"))):
        fresh = PRIVATE.with_name(".vulkan.new")
        shutil.rmtree(fresh, ignore_errors=True)
        write_manifest(fresh, str(driver), [])
        if name := device(python, str(fresh)):
            shutil.rmtree(PRIVATE, ignore_errors=True)
            fresh.rename(PRIVATE)
            return name
        shutil.rmtree(fresh)
    return ""


def existing_device(python: str) -> str:
    """Return the name of a device that renders without anything being installed, '' for none."""
    if name := device(python, "system"):
        shutil.rmtree(PRIVATE, ignore_errors=True)  # what an earlier run chose is not needed any more
        return name
    if (PRIVATE / "vulkan.json").is_file() and (name := device(python, str(PRIVATE))):
        return name
    return system_lavapipe(python)


def ensure_device(python: str) -> str:
    """Return the name of a device that renders, installing a driver if that is needed."""
    say("looking for a Vulkan device that SAPIEN can render with")
    if name := existing_device(python):
        return name
    say("none renders yet: setting up Mesa's lavapipe")
    if not shutil.which("apt-get"):
        raise SetupError(
            "this machine has no apt: install Mesa's Vulkan drivers 24.3 or newer, or an NVIDIA driver, with its own "
            "package manager, then repeat 'make setup'"
        )
    codename = os_release().get("VERSION_CODENAME", "")
    if os.geteuid() == 0:
        install_as_root(codename)
    else:
        say("not root: the packages are unpacked into .vulkan/ instead of being installed")
        unpack_privately(python, codename)
    if name := existing_device(python):
        return name
    raise SetupError(
        f"Mesa's driver is in place and still nothing renders: '{python} -m manicm_ms.machine.vulkan' says why"
    )


def note_missing_graphics(name: str) -> None:
    """Say so where an NVIDIA GPU computes here and does not render."""
    if Path("/dev/nvidiactl").exists() and "NVIDIA" not in name.upper():
        say(
            "note: this machine's NVIDIA GPU does not render (its driver's graphics part, libGLX_nvidia, is missing; "
            "in a container ask for the 'graphics' driver capability), so pictures are made in software"
        )


def main() -> int:
    """Run the set-up; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("python", help="interpreter of the environment that SAPIEN and manicm_ms are installed in")
    try:
        name = ensure_device(parser.parse_args().python)
    except (SetupError, OSError) as error:
        print(f"setup: {error}", file=sys.stderr)
        return 1
    say(f"rendering with {name}")
    note_missing_graphics(name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
