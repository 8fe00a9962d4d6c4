"""`manicm-ms bench`: help, what is refused before anything is measured, and the cheap ones run for real."""

import re
from pathlib import Path
from typing import get_type_hints

import pytest

from manicm_ms.bench import calibration, pages, suites
from manicm_ms.cli import main
from manicm_ms.cli.bench import COMMANDS
from manicm_ms.cli.counts import least_values
from manicm_ms.errors import ConfigError

REPO = Path(__file__).parents[2]


@pytest.fixture
def told(capsys):
    """Run a command in this process; return its exit status, output and errors."""

    def run(*arguments):
        with pytest.raises(SystemExit) as end:
            main(["bench", *map(str, arguments)])
        return end.value.code, *capsys.readouterr()

    return run


def assert_refused(result, *parts):
    status, out, err = result
    assert (status, out) == (2, "")
    assert err.startswith("manicm-ms: ")
    assert err.count("\n") == 1, err
    for part in parts:
        assert part in err


def test_without_a_command_it_shows_all_of_them_and_fails(told):
    status, out, _ = told()
    assert status == 2
    assert re.findall(r"^  (\w+) ", out, re.MULTILINE) == list(COMMANDS)
    assert told("--help") == (0, out, "")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(told, command):
    status, out, _ = told(command, "--help")
    assert status == 0
    assert f"usage: manicm-ms bench {command}" in out


@pytest.mark.parametrize("command", COMMANDS)
def test_every_whole_number_says_the_least_that_it_takes(command):
    hints = get_type_hints(COMMANDS[command])
    assert {name for name, hint in hints.items() if hint in (int, int | None) and name != "return"} == set(
        least_values(COMMANDS[command])
    )


def test_bad_input_is_one_line_and_measures_nothing(told, tmp_path):
    assert_refused(told("envs"), "unknown benchmark 'envs'", "did you mean 'env'?")
    assert_refused(told("depth", "--rows", 0), "rows must be at least 1, got 0")
    assert_refused(told("depth", "--device", "gpu"), "unknown device 'gpu'")
    assert_refused(told("latency", "--threads", 0), "threads must be at least 1, got 0")
    assert_refused(told("latency", "--write", "--out", tmp_path / "x.md"), "--write and --out")
    assert_refused(told("realism", "--presets", "d435"), "did you mean 'd435i'?")
    assert_refused(told("realism", "--envs", "ur3e/slide-blok"), "did you mean 'ur3e/slide-block'?")
    assert_refused(told("suites", "--tag", "benchmark"), "unknown tag 'benchmark'", "benchmark31")


def test_write_is_for_a_checkout(tmp_path):
    """An installation has no docs/results: that is said before anything is measured."""
    assert pages.results_page("latency.md") == REPO / "docs" / "results" / "latency.md"
    (tmp_path / "docs" / "results").mkdir(parents=True)
    with pytest.raises(ConfigError, match="checkout"):
        pages.results_page("latency.md", tmp_path)
    (tmp_path / "setup.cfg").touch()
    assert pages.results_page("x.md", tmp_path) == tmp_path / "docs" / "results" / "x.md"


def test_the_depth_benchmark_prints_its_page_and_keeps_it_only_where_asked(told, monkeypatch, tmp_path):
    page = REPO / "docs" / "results" / "depth_camera.md"
    before = page.read_bytes()
    monkeypatch.setattr("sys.argv", ["manicm-ms", "bench", "depth", "--rows", "1", "2"])
    status, out, _ = told("depth", "--rows", 1, 2, "--repetitions", 2)
    assert status == 0
    assert page.read_bytes() == before
    assert re.findall(r"^\| (\d) \| [\d.]+ ms \| [\d.]+ ms \| [\d.]+ ms \|$", out, re.MULTILINE) == ["1", "2"]
    assert "Made by `manicm-ms bench depth --rows 1 2`." in out
    monkeypatch.setattr("manicm_ms.bench.depth.results_page", lambda name: tmp_path / name)
    _, out, _ = told("depth", "--rows", 1, "--repetitions", 1, "--write")
    assert (tmp_path / page.name).read_text() == out.removesuffix("\n")


def test_the_calibration_benchmark_solves_a_rendered_session():
    """Of few views: without noise the camera is found within a millimetre."""
    name = "640x480, f 384"
    spoilt = {"as rendered": calibration.CASES["as rendered"]}
    given, solved = calibration.rows({name: calibration.STREAMS[name]}, spoilt, views=8, seeds=1)
    assert given.startswith(f"| {name} | as rendered | given | 8 to 8 | ")
    assert solved.startswith(f"| {name} | as rendered | solved | ")
    assert float(re.search(r"max ([\d.]+)", given)[1]) < 1.0
    assert given.count("|") == solved.count("|") == calibration.HEAD.splitlines()[0].count("|")


def test_the_suites_table_goes_between_its_marks():
    page = (REPO / "docs" / "results" / suites.PAGE).read_text()
    rows = page.split(suites.BEGIN)[1].split(suites.END)[0].strip()
    assert rows.startswith("| env id | group |")
    assert suites.between_marks(page, rows) == page
    changed = suites.between_marks(page, "| x |")
    assert changed == page.replace(rows, "| x |")
