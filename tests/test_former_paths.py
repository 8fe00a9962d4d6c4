"""Scripts that moved run under their former paths for one release, with a line of notice."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from manicm_ms.cli.bench import COMMANDS as BENCH

SCRIPTS = Path(__file__).parents[1] / "scripts"
FORMER = runpy.run_path(str(SCRIPTS / "former_paths.py"))
COMMANDS, MOVED, present_command = FORMER["COMMANDS"], FORMER["MOVED"], FORMER["present_command"]


def test_every_former_script_forwards_and_no_other_does():
    forwarding = {path.stem for path in SCRIPTS.glob("*.py") if "forward(__file__)" in path.read_text()}
    assert forwarding == {*COMMANDS, *MOVED}


@pytest.mark.parametrize("script", COMMANDS)
def test_a_former_benchmark_is_a_command_of_the_group(script):
    shown, command = present_command(script, ["--help"])
    name = COMMANDS[script]
    assert name in BENCH
    assert shown == f"manicm-ms bench {name} --help"
    assert command == [sys.executable, "-m", "manicm_ms.cli", "bench", name, "--help"]


@pytest.mark.parametrize("script", MOVED)
def test_a_former_script_is_one_in_a_folder(script):
    shown, (python, path, option) = present_command(script, ["--help"])
    assert shown == f"python scripts/{MOVED[script]} --help"
    assert (python, option) == (sys.executable, "--help")
    assert Path(path) == SCRIPTS / MOVED[script]
    assert '__name__ == "__main__"' in Path(path).read_text()


def test_the_former_latency_benchmark_keeps_its_page_as_it_did():
    assert present_command("bench_latency", ["--threads", "1"])[0] == "manicm-ms bench latency --threads 1 --write"
    assert present_command("bench_latency", ["--out=x.md"])[0] == "manicm-ms bench latency --out=x.md"


@pytest.mark.parametrize("script", [*COMMANDS, *MOVED])
def test_a_former_script_says_the_present_command_and_becomes_it(script, monkeypatch, capsys):
    path, became = str(SCRIPTS / f"{script}.py"), []
    monkeypatch.setattr(sys, "argv", [path, "--seeds", "1 2"])
    monkeypatch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
    monkeypatch.setattr(os, "execv", lambda program, words: became.append((program, words)))
    monkeypatch.setitem(sys.modules, "__main__", sys.modules["__main__"])  # runpy puts the script there
    runpy.run_path(path, run_name="__main__")
    sys.modules.pop("former_paths")
    shown, command = present_command(script, ["--seeds", "1 2"])
    assert became == [(sys.executable, command)]
    (line,) = capsys.readouterr().err.splitlines()
    assert line == f"{path} has moved and goes with the next release; this is: {shown}"


def test_a_former_script_really_runs_and_is_not_imported(tmp_path):
    """Of each kind one, from a folder elsewhere."""
    for script, usage in (("bench_env", "usage: manicm-ms bench env"), ("generate_robot", "usage: generate_robot.py")):
        command = [sys.executable, SCRIPTS / f"{script}.py", "--help"]
        done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)
        assert done.returncode == 0, done.stderr
        assert usage in done.stdout
        (line,) = done.stderr.splitlines()
        assert "has moved and goes with the next release" in line
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [str(SCRIPTS), *sys.path])
        with pytest.raises(ImportError, match=r"bench_env has moved: manicm-ms bench env"):
            __import__("bench_env")
        sys.modules.pop("former_paths")
