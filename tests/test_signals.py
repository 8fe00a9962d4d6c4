"""Signals that wait, signals that stop a program, and children that Ctrl-C passes by."""

import os
import signal
import subprocess
import sys
import threading
import time
import weakref
from pathlib import Path

import pytest

from manicm_ms import signals


@pytest.fixture(autouse=True)
def as_in_a_shell():
    """SIGTERM and SIGHUP would end the tests; SIGINT is what pytest itself answers."""
    before = {number: signal.getsignal(number) for number in signals.STOPPING}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler, "somebody left a handler behind"
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_held_interrupt_comes_when_the_block_has_ended():
    done = []

    def block():
        with signals.held(), signals.held():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("all of it")
        done.append("no more")

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["all of it"]


def test_a_held_interrupt_comes_after_an_error_too():
    def block():
        with signals.held():
            os.kill(os.getpid(), signal.SIGINT)
            raise ValueError("trouble")

    with pytest.raises(KeyboardInterrupt) as told:
        block()
    assert isinstance(told.value.__context__, ValueError)


def test_holding_in_another_thread_changes_nothing():
    seen = []

    def work():
        with signals.held():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [signal.default_int_handler]


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_program_is_stopped_by_each_signal_with_its_status(number, status):
    with pytest.raises(signals.Stopped) as told, signals.stoppable():
        os.kill(os.getpid(), number)
    assert told.value.status == status
    assert isinstance(told.value, KeyboardInterrupt)


def test_a_signal_that_the_starter_ignores_stays_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with signals.stoppable():
        os.kill(os.getpid(), signal.SIGHUP)


def test_an_interrupt_that_a_library_made_an_error_of_its_own_still_stops():
    def import_of_compiled_code():
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error

    with pytest.raises(signals.Stopped), signals.stoppable():
        import_of_compiled_code()
    with pytest.raises(ImportError, match="plain"), signals.stoppable():
        raise ImportError("plain")


def test_an_interrupt_that_a_library_swallowed_comes_again():
    """As trimesh does, which catches BaseException around each of its optional imports."""
    swallowed = []

    def block():
        with signals.stoppable():
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(5)
            except BaseException as error:
                swallowed.append(error)
            time.sleep(30)

    with pytest.raises(signals.Stopped):
        block()
    assert len(swallowed) == 1


@pytest.mark.parametrize(("signals_sent", "whole"), [(2, True), (3, False)])
def test_tidying_up_is_not_interrupted_unless_the_user_insists(signals_sent, whole):
    tidied = []

    def block():
        with signals.stoppable():
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(5)
            finally:
                for _ in range(signals_sent - 1):
                    os.kill(os.getpid(), signal.SIGINT)
                time.sleep(1)  # longer than until it comes again
                tidied.append(True)

    with pytest.raises(signals.Stopped):
        block()
    assert bool(tidied) == whole


def test_an_interrupt_while_an_object_is_destroyed_is_not_lost():
    class Thing:
        pass

    def destroy():
        thing = Thing()
        kept = weakref.ref(thing, lambda _: os.kill(os.getpid(), signal.SIGTERM))
        del thing
        return kept

    def block():
        with signals.stoppable():
            kept = destroy()
            while kept is not None:  # until the interrupt comes again
                time.sleep(0.01)

    with pytest.raises(signals.Stopped) as told:
        block()
    assert told.value.status == 143


def test_children_inherit_that_ctrl_c_passes_them_by():
    def blocked(pid):
        (line,) = [line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if "SigBlk" in line]
        return bool(int(line.split()[1], 16) >> (signal.SIGINT - 1) & 1)

    idle = [sys.executable, "-c", "input()"]
    with signals.spared_children():
        spared = subprocess.Popen(idle, stdin=subprocess.PIPE)
    other = subprocess.Popen(idle, stdin=subprocess.PIPE)
    try:
        assert blocked(spared.pid)
        assert not blocked(other.pid)
        assert not blocked(os.getpid())
    finally:
        for child in (spared, other):
            child.communicate(b"\n")


LOOK = "print(signal.getsignal(signal.SIGINT).__name__)"


def told(*words, **options):
    """Return the last word that a Python process prints."""
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=True, **options)
    return done.stdout.split()[-1]


@pytest.mark.parametrize(("name", "handler"), [("pytest", "default_int_handler"), ("manicm-ms", "_end_at_once")])
def test_importing_the_package_leaves_signals_alone_but_in_the_command(name, handler):
    """In the command they are answered before Gymnasium is imported: compiled imports can lose an interrupt."""
    code = f"""if True:
        import signal, sys
        sys.argv[0] = "/usr/bin/{name}"
        class Watch:
            def find_spec(name, path, target=None):
                if name == "gymnasium":
                    {LOOK}
        sys.meta_path.insert(0, Watch)
        import manicm_ms
    """
    assert told("-c", code) == handler


def test_a_module_of_the_users_that_imports_the_package_keeps_its_signals(tmp_path):
    package = tmp_path / "theirs"
    package.mkdir()
    (package / "__init__.py").write_text("import manicm_ms\n")
    (package / "work.py").write_text(f"import signal\n{LOOK}\n")
    assert told("-m", "theirs.work", cwd=tmp_path) == "default_int_handler"


PARENT = """
import multiprocessing, sys, time
sys.argv = ["manicm-ms"]
from manicm_ms import signals
signals.quiet_start("manicm-ms", "manicm_ms.cli")
def work(begun):
    begun.set()
    time.sleep(60)
if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    worker = context.Process(target=work, args=(begun,))
    worker.start()
    begun.wait()
    worker.terminate()
    worker.join()
    print(worker.exitcode)
"""


def test_a_worker_that_its_parent_ends_says_nothing(tmp_path):
    script = tmp_path / "manicm-ms.py"
    script.write_text(PARENT)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True, timeout=60)
    assert int(done.stdout) != 0
    assert done.stderr == ""


def test_a_worker_that_imports_the_command_line_is_no_program(tmp_path):
    """It has the command's name: what ends it must not be answered as the command answers."""
    script = tmp_path / "manicm-ms"
    script.write_text(
        "import multiprocessing, signal\nfrom manicm_ms import cli\n\n"
        "def look():\n    print(signal.getsignal(signal.SIGTERM) is signal.SIG_DFL)\n\n"
        'if __name__ == "__main__":\n'
        '    worker = multiprocessing.get_context("spawn").Process(target=look)\n'
        "    worker.start()\n    worker.join()\n    look()\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]
