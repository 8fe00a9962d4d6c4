"""Without a Vulkan device: one line that says so and what to do, from the library and from the command line."""

import os
import subprocess
import sys

import pytest

from manicm_ms.machine import vulkan

# One process for both: it takes longest to begin.
SCRIPT = """
import sys

from manicm_ms.cli import main
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import RenderDeviceError

if __name__ == "__main__":
    env = make_vec("ur3e/slide-block", backend="cpu")
    try:
        env.reset(seed=[0])
    except RenderDeviceError as error:
        print(error, flush=True)
    finally:
        env.close()
    print("now the command", flush=True)
    main(["collect", "ur3e/slide-block", "--episodes", "1", "--backend", "cpu", "--out", sys.argv[1]])
"""


@pytest.fixture(scope="module")
def ended(tmp_path_factory):
    """The script's folder and end where the Vulkan loader finds no driver: the library's error, then the command's."""
    folder = tmp_path_factory.mktemp("no_vulkan")
    (folder / "script.py").write_text(SCRIPT)
    drivers = dict.fromkeys(("VK_DRIVER_FILES", "VK_ICD_FILENAMES"), str(folder / "missing.json"))
    env = os.environ | drivers | {"MANICM_MS_VULKAN": "system"}
    words = [sys.executable, folder / "script.py", folder / "demos.zarr"]
    return folder, subprocess.run(words, env=env, capture_output=True, text=True, check=False)


def require_the_remedy(line, folder):
    assert "no Vulkan device" in line
    for variable in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        assert f"{variable}={folder / 'missing.json'}" in line
    assert "missing.json does not exist; unset it" in line


@pytest.mark.parametrize("variable", ["VK_DRIVER_FILES", "VK_ICD_FILENAMES"])
def test_the_variable_that_names_a_driver_is_told_with_its_value(monkeypatch, variable):
    monkeypatch.setenv("MANICM_MS_VULKAN", "system")
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.delenv(name, raising=False)
    assert "make setup" in str(vulkan.no_device())
    assert "manicm-ms doctor" in str(vulkan.no_device())
    monkeypatch.setenv(variable, f"{vulkan.__file__}:/gone/driver.json")
    line = str(vulkan.no_device("VkResult -9"))
    assert f"(VkResult -9): it was told to use {variable}={vulkan.__file__}:/gone/driver.json" in line
    assert "where /gone/driver.json does not exist; unset it" in line
    assert "make setup" not in line


def test_the_driver_that_set_up_chose_is_nobodys_mistake(monkeypatch, tmp_path):
    (tmp_path / "driver.json").touch()
    (tmp_path / vulkan.MANIFEST).write_text('{"driver": "driver.json", "preload": []}')
    monkeypatch.setenv("MANICM_MS_VULKAN", str(tmp_path))
    monkeypatch.delenv("VK_ICD_FILENAMES", raising=False)
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "driver.json"))
    assert "make setup" in str(vulkan.no_device())


def test_reset_raises_a_render_device_error(ended):
    folder, done = ended
    said, marker, _ = done.stdout.partition("now the command\n")
    assert marker, done.stderr
    (line,) = said.strip().splitlines()
    require_the_remedy(line, folder)


def test_collect_ends_with_status_2_and_one_line(ended):
    folder, done = ended
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "Vulkan" in line and "SAPIEN" in line]
    require_the_remedy(line, folder)
