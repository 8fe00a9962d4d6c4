"""Scripts that worker processes cannot import are told so before any worker is started."""

import subprocess
import sys

import pytest

CHECK = "from manicm_ms.envs.main_script import require_importable_main as check\n"


def run(*words, text=None, cwd=None):
    done = subprocess.run([sys.executable, *words], input=text, capture_output=True, text=True, check=False, cwd=cwd)
    return done.returncode, done.stdout, done.stderr.strip().splitlines()


@pytest.mark.parametrize(
    "body",
    [
        'if __name__ == "__main__":\n    check()\n',
        'def main():\n    check()\n\nif __name__ == "__main__" and True:\n    main()\n',
        'if __name__ != "__main__":\n    raise SystemExit\ncheck()\n',
        'if "__main__" != __name__:\n    pass\nelse:\n    check()\n',
    ],
)
def test_a_guarded_script_passes(tmp_path, body):
    (tmp_path / "script.py").write_text(CHECK + body)
    assert run(tmp_path / "script.py")[0] == 0


@pytest.mark.parametrize("body", ["check()\n", "def main():\n    check()\n\nfor _ in range(1):\n    main()\n"])
def test_a_script_without_the_main_guard_is_told_what_it_lacks(tmp_path, body):
    (tmp_path / "script.py").write_text(CHECK + body)
    for words in ([tmp_path / "script.py"], ["-m", "script"]):
        status, _, err = run(*words, cwd=tmp_path)
        assert status == 1
        assert "script.py has no main guard" in err[-1]
        assert 'if __name__ == "__main__":' in err[-1]


def test_a_guard_that_stands_elsewhere_does_not_count(tmp_path):
    (tmp_path / "script.py").write_text(CHECK + 'check()\nif __name__ == "__main__":\n    pass\n')
    assert "no main guard" in run(tmp_path / "script.py")[2][-1]


def test_a_script_from_standard_input_is_told_that_it_must_be_a_file():
    status, _, err = run("-", text=CHECK + "check()\n")
    assert status == 1
    assert "read from standard input" in err[-1]
    assert "save it to a file" in err[-1]


def test_what_workers_do_not_import_passes(tmp_path):
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__main__.py").write_text(CHECK + "check()\n")
    assert run("-c", CHECK + "check()")[0] == 0
    assert run("-m", "package", cwd=tmp_path)[0] == 0
