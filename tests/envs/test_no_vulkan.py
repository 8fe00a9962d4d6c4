"""Without a Vulkan device: one line that says so and what to do, from the library and from the command line."""

import os
import subprocess
import sys

import pytest

from manicm_ms import vulkan

MAKE = """
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import RenderDeviceError

if __name__ == "__main__":
    env = make_vec("ur3e/slide-block", backend="cpu")
    try:
        env.reset(seed=[0])
    except RenderDeviceError as error:
        print(error)
    finally:
        env.close()
"""


def without_vulkan(tmp_path, *words):
    """Run Python where the Vulkan loader finds no driver."""
    drivers = dict.fromkeys(("VK_DRIVER_FILES", "VK_ICD_FILENAMES"), str(tmp_path / "missing.json"))
    env = os.environ | drivers | {"MANICM_MS_VULKAN": "system", "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, *map(str, words)], env=env, capture_output=True, text=True, check=False)


def require_the_remedy(line, tmp_path):
    assert "no Vulkan device" in line
    for variable in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        assert f"{variable}={tmp_path / 'missing.json'}" in line
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


def test_reset_raises_a_render_device_error(tmp_path):
    script = tmp_path / "make.py"
    script.write_text(MAKE)
    done = without_vulkan(tmp_path, script)
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.strip().splitlines()
    require_the_remedy(line, tmp_path)


def test_collect_ends_with_status_2_and_one_line(tmp_path):
    out = tmp_path / "demos.zarr"
    collect = ("collect", "ur3e/slide-block", "--episodes", 1, "--backend", "cpu", "--out", out)
    done = without_vulkan(tmp_path, "-m", "manicm_ms.cli", *collect)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    (line,) = [line for line in done.stderr.splitlines() if "Vulkan" in line and "SAPIEN" in line]
    require_the_remedy(line, tmp_path)
