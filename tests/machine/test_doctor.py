"""The doctor's findings on this machine and on machines made to lack something."""

import shutil
import subprocess
import sys
from importlib import metadata

import pytest

from manicm_ms.errors import RenderDeviceError
from manicm_ms.machine import doctor, vulkan

DRIVER_VARIABLES = ("MANICM_MS_VULKAN", "VK_DRIVER_FILES", "VK_ICD_FILENAMES")


@pytest.fixture(autouse=True)
def keep_environment(monkeypatch):
    """Put back the driver that this process uses, whatever a test made of it."""
    for name in DRIVER_VARIABLES:
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


def no_driver(tmp_path):
    """A Vulkan choice whose driver file names a library that does not exist."""
    (tmp_path / "driver.json").write_text(
        '{"file_format_version": "1.0.0", "ICD": {"library_path": "/nonexistent.so", "api_version": "1.3.0"}}'
    )
    (tmp_path / vulkan.MANIFEST).write_text('{"driver": "driver.json", "preload": []}')
    return tmp_path


def test_a_healthy_machine_renders_and_passes(capsys):
    findings = {finding.name: finding for finding in doctor.diagnose()}
    assert len(findings) == len(doctor.CHECKS)
    assert findings["Vulkan device"].status in ("ok", "warn")
    assert metadata.version("sapien") in findings["packages"].found
    assert all(f.remedy for f in findings.values() if f.status != "ok")
    assert all("\n" not in f.found + f.remedy for f in findings.values())


def test_no_vulkan_device_fails_with_its_remedy_and_exit_status_1(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MANICM_MS_VULKAN", str(no_driver(tmp_path)))
    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_python, doctor.check_vulkan))
    assert doctor.doctor() == 1
    printed = capsys.readouterr().out
    assert "fail" in printed
    assert "make setup" in printed


def test_no_opengl_fails_and_a_refused_mujoco_warns(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    finding = doctor.check_mujoco()
    assert finding.status == "fail"
    assert "no OpenGL" in finding.found
    assert "make setup" in finding.remedy
    answer = subprocess.CompletedProcess([], 1, "", "Trace\nmanicm_ms.errors.BackendError: metaworld needs another")
    monkeypatch.setattr(doctor, "_python", lambda code: answer)
    finding = doctor.check_mujoco()
    assert finding.status == "warn"
    assert finding.found == "Adroit and Meta-World cannot be played: metaworld needs another"


def test_a_healthy_check_alone_gives_exit_status_0(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_python, doctor.check_disk))
    assert doctor.doctor() == 0
    assert sys.executable.rsplit("/", 1)[-1] in capsys.readouterr().out.replace("\n", "")


def test_a_crashing_driver_is_survived(tmp_path):
    crashing = tmp_path / "python"
    crashing.write_text("#!/bin/sh\nkill -SEGV $$\n")
    crashing.chmod(0o755)
    assert vulkan.probe(python=str(crashing)).reason == "the driver crashed the process (signal 11)"


def test_a_hanging_driver_is_told(tmp_path):
    hanging = tmp_path / "python"
    hanging.write_text("#!/bin/sh\nexec sleep 60\n")
    hanging.chmod(0o755)
    assert "did not end" in vulkan.probe(python=str(hanging), timeout_s=0.2).reason


def test_too_little_disk_fails(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10**8))
    finding = doctor.check_disk(tmp_path)
    assert (finding.status, finding.found) == ("fail", f"0.1 GB free in {tmp_path}")


@pytest.mark.parametrize(("headless", "status"), [(True, "ok"), (False, "warn")])
def test_the_opencv_that_was_installed_last_is_named(headless, status, tmp_path, monkeypatch):
    (tmp_path / "cv2").mkdir()
    (tmp_path / "cv2" / "__init__.py").write_text("")
    (tmp_path / "cv2" / "version.py").write_text(f'opencv_version = "5.0.0.93"\nheadless = {headless}\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "cv2", raising=False)
    finding = doctor.check_opencv()
    winner = "opencv-python-headless" if headless else "opencv-python"
    assert finding.status == status
    assert f"{winner} is the one" in finding.found


@pytest.mark.parametrize(
    ("mplib", "numpy", "status"),
    [("0.1.1", "2.4.6", "warn"), ("0.1.1", "1.26.4", "ok"), ("0.2.1", "2.4.6", "ok"), (None, "2.4.6", "ok")],
)
def test_mplib_is_a_warning_with_numpy_2_alone(mplib, numpy, status, monkeypatch):
    monkeypatch.setattr(doctor, "_version", {"mplib": mplib, "numpy": numpy}.get)
    assert doctor.check_mplib().status == status


def test_a_missing_package_is_named(monkeypatch):
    known = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == "zarr" else known(name))
    finding = doctor.check_packages()
    assert (finding.status, finding.found) == ("fail", "missing: zarr")


def test_a_named_folder_without_a_manifest_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("MANICM_MS_VULKAN", str(tmp_path))
    with pytest.raises(RenderDeviceError, match=str(tmp_path)):
        vulkan.prepare()


@pytest.mark.parametrize("text", ["", "[]", '{"driver": "gone.json", "preload": []}', '{"preload": []}'])
def test_a_broken_manifest_is_refused(text, tmp_path, monkeypatch):
    (tmp_path / vulkan.MANIFEST).write_text(text)
    monkeypatch.setenv("MANICM_MS_VULKAN", str(tmp_path))
    with pytest.raises(RenderDeviceError, match="make setup"):
        vulkan.prepare()


def test_a_driver_that_the_user_named_is_left_alone(tmp_path, monkeypatch):
    import os

    monkeypatch.setenv("MANICM_MS_VULKAN", str(no_driver(tmp_path)))
    monkeypatch.setenv("VK_DRIVER_FILES", "/their/own.json")
    vulkan.prepare()
    assert os.environ["VK_DRIVER_FILES"] == "/their/own.json"


def test_preloaded_libraries_are_found_without_a_search_path(tmp_path):
    """`outer` needs `inner`, which lies in no place the linker searches: preloading it makes `outer` loadable."""
    compiler = shutil.which("cc") or pytest.skip("no C compiler to build two libraries with")
    (tmp_path / "inner.c").write_text("int inner(void) { return 41; }\n")
    (tmp_path / "outer.c").write_text("int inner(void); int outer(void) { return inner() + 1; }\n")
    build = [compiler, "-shared", "-fPIC"]
    inner, outer = tmp_path / "libinner_probe.so.1", tmp_path / "libouter_probe.so"
    subprocess.run([*build, "-Wl,-soname,libinner_probe.so.1", "-o", inner, tmp_path / "inner.c"], check=True)
    subprocess.run([*build, "-o", outer, tmp_path / "outer.c", inner], check=True)
    (tmp_path / "driver.json").write_text("{}")
    (tmp_path / vulkan.MANIFEST).write_text('{"driver": "driver.json", "preload": ["libinner_probe.so.1"]}')

    def run(prepare: str) -> subprocess.CompletedProcess[str]:
        code = f"import ctypes\n{prepare}\nprint(ctypes.CDLL({str(outer)!r}).outer())"
        env = {"MANICM_MS_VULKAN": str(tmp_path)}
        return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=False)

    assert run("").returncode != 0
    assert run("from manicm_ms import vulkan; vulkan.prepare()").stdout.strip() == "42"
