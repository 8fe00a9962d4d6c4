"""Gather what a machine with a GPU lacks into `.gpu_kit/`, one folder for each call, and add up what travels.

    python scripts/gpu/prepare.py learning      # wheels, demonstrations of two tasks
    python scripts/gpu/prepare.py simulation    # wheels, ManiSkill and SAPIEN without what no part reads, loaders
    python scripts/gpu/prepare.py software      # a software driver, for a machine whose own makes no pictures
    python scripts/gpu/prepare.py families      # wheels, demonstrations of one task with voxel grids

Wheels come from pip's configured index, in the versions of constraints.txt; packages of the system from apt. What is
there already is kept. The exit status is 1 where tree and load are more than travels. See docs/gpu_kit.md.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

from kit import LEFT_BEHIND, MIB, REPO, TRAVELS_BYTES, TREE_BYTES, folder_bytes, tracked_bytes

KIT = REPO / ".gpu_kit"
PAGE = REPO / "docs" / "gpu_kit.md"
PYTHON = ("--python-version", "3.12", "--implementation", "cp", "--only-binary=:all:", "--no-deps")
GLIBC = (17, 24, 27, 28, 31, 34, 35)  # minor versions of manylinux_2_N that are accepted
STORES = ("metaworld/pick-place", "adroit/hammer")
EPISODES = 10


@dataclass(frozen=True)
class Load:
    """What one call carries.

    Attributes:
        wheels: distributions, whole.
        stripped: distribution -> patterns of the files in its wheel that stay behind.
        stores: environment ids whose demonstrations go along.
        collected: options of `manicm-ms collect` for them.
        debs: packages of the system that are unpacked beside the tree there.
        software: whether it is the software driver for Vulkan, which does not fit beside the rest.
    """

    wheels: tuple[str, ...]
    stripped: Mapping[str, tuple[str, ...]]
    stores: tuple[str, ...] = ()
    collected: tuple[str, ...] = ()
    debs: tuple[str, ...] = ()
    software: bool = False


_BASE = ("gymnasium", "Farama-Notifications", "tyro", "docstring_parser", "typeguard")
_LEARNING = ("diffusers", "importlib_metadata", "lightning-fabric", "zarr", "numcodecs", "donfig", "google-crc32c")
_MANI_SKILL = (
    "dacite", "defusedxml", "ipython", "traitlets", "transforms3d", "pytorch-kinematics", "pytorch-seed",
    "arm_pytorch_utilities",
)  # fmt: skip
_LOADERS = ("libvulkan1", "libegl1", "libglvnd0", "libopengl0", "libgl1", "libglx0", "libgles2")
_X11 = ("libx11-6", "libxext6", "libxcb1", "libxau6", "libxdmcp6", "libbsd0", "libmd0")  # SAPIEN links libX11
_NOT_READ = {  # meshes and pictures of others' robots and scenes; headers, denoiser's CUDA part, projectors' patterns
    "mani_skill": tuple(f"*.{kind}" for kind in ("glb", "hdr", "stl", "STL", "dae", "obj", "mtl", "ply", "png", "jpg")),
    "sapien": ("sapien/include/*", "sapien/oidn_library/*_device_*", "sapien/sensor/assets/*"),
}
LOADS = {
    "learning": Load(wheels=(*_BASE, *_LEARNING), stripped={}, stores=STORES),
    "simulation": Load(
        wheels=(*_BASE, "trimesh", "fpsample", *_MANI_SKILL), stripped=_NOT_READ, debs=(*_LOADERS, *_X11)
    ),
    "software": Load(wheels=(), stripped={}, software=True),
    "families": Load(
        wheels=(*_BASE, *_LEARNING),
        stripped={},
        stores=("adroit/hammer",),
        collected=("--extras", "voxel_grid", "--voxel-size", "64"),
    ),
}


def pinned(name: str) -> str:
    """Return `name==version` as constraints.txt has it; raise SystemExit where it has none."""
    wanted = name.lower().replace("-", "_")
    for line in (REPO / "constraints.txt").read_text(encoding="utf-8").splitlines():
        if line.partition("==")[0].strip().lower().replace("-", "_") == wanted:
            return line.strip()
    raise SystemExit(f"constraints.txt pins no {name}")


def run(command: list[str], cwd: Path = REPO) -> None:
    """Run a command; raise SystemExit with its last words where it fails."""
    done = subprocess.run(command, cwd=cwd, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command[:6])} ... failed:\n" + "\n".join(done.stdout.splitlines()[-8:]))


def download(names: tuple[str, ...], folder: Path) -> None:
    """Fetch the wheels of `names` for the other machine's Python."""
    platforms = [f"manylinux_2_{minor}_x86_64" for minor in GLIBC] + ["manylinux2014_x86_64", "manylinux1_x86_64"]
    places = [word for platform in platforms for word in ("--platform", platform)]
    wanted = [pinned(name) for name in names]
    run([sys.executable, "-m", "pip", "download", "-q", *PYTHON, *places, "-d", str(folder), *wanted])


def strip(wheel: Path, target: Path, left_out: tuple[str, ...]) -> None:
    """Write the wheel again without the files that match a pattern of `left_out`, compressed as well as zip can."""
    with zipfile.ZipFile(wheel) as whole, zipfile.ZipFile(target, "w", zipfile.ZIP_LZMA) as kept:
        for entry in whole.infolist():
            if not any(fnmatch(entry.filename, pattern) for pattern in left_out):
                kept.writestr(entry, whole.read(entry), zipfile.ZIP_LZMA)


def gather_wheels(load: Load, folder: Path) -> None:
    """Fetch what is not there yet into `folder`/wheels."""
    if not load.wheels:
        return
    wheels = folder / "wheels"
    wheels.mkdir(parents=True, exist_ok=True)
    download(load.wheels, wheels)
    for name, left_out in load.stripped.items():
        if not list(wheels.glob(f"{name}-*.whl")):
            with tempfile.TemporaryDirectory(dir=KIT) as scratch:
                download((name,), Path(scratch))
                (wheel,) = Path(scratch).glob("*.whl")
                print(f"writing {wheel.name} again without {', '.join(left_out)}", flush=True)
                strip(wheel, Path(scratch) / "stripped", left_out)
                shutil.move(Path(scratch) / "stripped", wheels / wheel.name)


def gather_stores(load: Load, folder: Path) -> None:
    """Collect the demonstrations that are not there yet and pack each store as one file.

    Each load has stores of its own: the same task's may hold more in one than in another.
    """
    for env_id in load.stores:
        packed, store = folder / "stores" / f"{env_id}.zip", KIT / "stores" / folder.name / f"{env_id}.zarr"
        if packed.is_file():
            continue
        print(f"collecting {EPISODES} demonstrations of {env_id}", flush=True)
        command = ["-m", "manicm_ms.cli", "collect", env_id, "--episodes", str(EPISODES), "--out", str(store)]
        run([sys.executable, *command, *load.collected])
        packed.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
            for file in sorted(p for p in store.rglob("*") if p.is_file()):
                archive.write(file, f"{store.name}/{file.relative_to(store)}")


def gather_debs(load: Load, folder: Path) -> None:
    """Fetch the system's packages, for x86-64, without installing them."""
    if not load.debs:
        return
    debs = folder / "debs"
    debs.mkdir(parents=True, exist_ok=True)
    missing = [name for name in load.debs if not list(debs.glob(f"{name}_*.deb"))]
    if missing:
        run(["apt-get", "download", *(f"{name}:amd64" for name in missing)], cwd=debs)
    for package in debs.glob("*%3a*"):  # an epoch's colon; not every way of copying takes such names
        package.rename(package.with_name(package.name.replace("%3a", ".")))


def gather_software(load: Load, folder: Path) -> None:
    """Pack this machine's own lavapipe with the libraries that it needs, as `manicm_ms.machine.vulkan` reads them."""
    archive = folder / "software.tar.xz"
    if not load.software or archive.is_file():
        return
    sys.path.append(str(REPO / "scripts"))
    import setup_vulkan

    with tempfile.TemporaryDirectory(dir=KIT) as scratch:
        place = Path(scratch)
        copied = copy_libraries(lavapipe(setup_vulkan.SYSTEM_DRIVERS), place, setup_vulkan.RUNTIME)
        driver = {"file_format_version": "1.0.0", "ICD": {"library_path": f"./{copied[0]}", "api_version": "1.4.305"}}
        (place / "lvp_icd.json").write_text(json.dumps(driver, indent=2), encoding="utf-8")
        order = setup_vulkan.load_order(sys.executable, [place / name for name in copied[1:]])
        setup_vulkan.write_manifest(place, "lvp_icd.json", [path.name for path in order])
        print("packing the software driver", flush=True)
        with tarfile.open(archive, "w:xz", preset=9) as packed:
            for file in sorted(place.iterdir()):
                packed.add(file, file.name)


def lavapipe(folders: tuple[Path, ...]) -> Path:
    """Return the library of the system's lavapipe; raise SystemExit where there is none."""
    for manifest in (path for folder in folders for path in sorted(folder.glob("lvp_icd*.json"))):
        named = Path(json.loads(manifest.read_text(encoding="utf-8"))["ICD"]["library_path"])
        for path in (manifest.parent / named, Path("/usr/lib/x86_64-linux-gnu") / named):
            if path.is_file():
                return path
    raise SystemExit("this machine has no lavapipe to pack: as root, 'make setup' installs it")


def copy_libraries(library: Path, place: Path, runtime: tuple[str, ...]) -> list[str]:
    """Copy a library and those that it needs, but for the language runtimes, which every machine has; return names."""
    needed = subprocess.run(["ldd", str(library)], capture_output=True, text=True, check=True).stdout
    paths = [library, *(Path(path) for path in re.findall(r"=> (/\S+)", needed))]
    carried = [path for path in paths if not path.name.startswith((*runtime, "libstdc++", "libgcc_s"))]
    for path in carried:
        shutil.copy(path, place / path.name)
    return [path.name for path in carried]


def sizes(name: str) -> dict[str, int]:
    """Return path -> bytes of all that travels with a load, with what is set aside for the tree in one line."""
    folder = KIT / name
    paths = sorted(p for p in folder.rglob("*") if p.is_file())
    tree = f"the tree's tracked files, without {', '.join(f'{part}/' for part in LEFT_BEHIND)}: room for"
    return {tree: max(TREE_BYTES, tracked_bytes())} | {str(p.relative_to(REPO)): folder_bytes(p) for p in paths}


def table(travelling: dict[str, int]) -> str:
    """Return Markdown of `sizes`."""
    lines = ["| path | bytes |", "| --- | ---: |", *(f"| {path} | {size} |" for path, size in travelling.items())]
    return "\n".join([*lines, f"| **together** | **{sum(travelling.values())}** |"])


def write_page(name: str, text: str) -> None:
    """Put the table of a load between its marks in the page."""
    page = PAGE.read_text(encoding="utf-8")
    marked = re.compile(rf"(<!-- {name}: begin -->\n).*?(<!-- {name}: end -->)", re.DOTALL)
    PAGE.write_text(marked.sub(lambda found: f"{found[1]}{text}\n{found[2]}", page), encoding="utf-8")


def main() -> int:
    """Gather a load, print its sizes and return 1 where it is too large."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("load", choices=tuple(LOADS), help="which call it is for")
    parser.add_argument("--write-page", action="store_true", help="put the sizes into docs/gpu_kit.md")
    args = parser.parse_args()
    load, folder = LOADS[args.load], KIT / args.load
    folder.mkdir(parents=True, exist_ok=True)
    for gather in (gather_wheels, gather_stores, gather_debs, gather_software):
        gather(load, folder)
    travelling = sizes(args.load)
    print(table(travelling))
    if args.write_page:
        write_page(args.load, table(travelling))
    together = sum(travelling.values())
    print(f"{together / MIB:.1f} MiB of {TRAVELS_BYTES / MIB:.0f}")
    if together > TRAVELS_BYTES:
        print(f"{(together - TRAVELS_BYTES) / MIB:.1f} MiB too much: strip more, or split the load", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
