"""Files and folders are replaced whole, wherever a kill falls, and nothing but our own leftovers is removed."""

import os
import signal
import subprocess
import sys

import pytest

from manicm_ms.errors import OutputExistsError
from manicm_ms.paths import (
    exclusive_lock,
    is_disk_full,
    replaced_folder,
    require_free,
    set_aside,
    temporary_folder,
    without_temporaries,
    write_text,
)

# Replaces a folder, or a file, and is killed just before or just after its n-th rename.
KILLED = """
import os, signal, sys
from pathlib import Path
from manicm_ms import paths
what, path, moment, when = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4]
rename, calls = os.replace, 0
def replace(source, target):
    global calls
    calls += 1
    if calls == moment and when == "before":
        os.kill(os.getpid(), signal.SIGKILL)
    rename(source, target)
    if calls == moment:
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = replace
if what == "file":
    paths.write_text(path, "new")
else:
    with paths.replaced_folder(path) as fresh:
        paths.write_text(fresh / "a.txt", "new a")
        paths.write_text(fresh / "b.txt", "new b")
"""
OLD, NEW = {"a.txt": "old a"}, {"a.txt": "new a", "b.txt": "new b"}


def killed(what, path, moment, when):
    done = subprocess.run([sys.executable, "-c", KILLED, what, str(path), str(moment), when], check=False)
    assert done.returncode == -signal.SIGKILL


def content(folder):
    return {p.name: p.read_text() for p in folder.iterdir()}


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("moment", [1, 2, 3, 4])  # two files, the old folder aside, the new one in its place
def test_a_kill_at_any_rename_leaves_a_whole_folder_and_the_next_call_leaves_nothing_else(tmp_path, moment, when):
    path = tmp_path / "teacher"
    path.mkdir()
    (path / "a.txt").write_text("old a")
    killed("folder", path, moment, when)
    where = path if path.exists() else set_aside(path)
    assert content(where) == (NEW if (moment, when) == (4, "after") else OLD)
    with pytest.raises(RuntimeError), replaced_folder(path):
        raise RuntimeError  # a call that fails brings back what the kill left aside, and changes nothing
    assert content(path) == (NEW if (moment, when) == (4, "after") else OLD)
    with replaced_folder(path) as fresh:
        (fresh / "c.txt").write_text("newest")
    assert content(path) == {"c.txt": "newest"}
    assert [p.name for p in tmp_path.iterdir()] == ["teacher"]


@pytest.mark.parametrize(("when", "expected"), [("before", "old"), ("after", "new")])
def test_a_kill_while_a_file_is_written_leaves_the_old_or_the_new_one(tmp_path, when, expected):
    path = tmp_path / "results.json"
    path.write_text("old")
    killed("file", path, 1, when)
    assert path.read_text() == expected
    write_text(path, "newest")
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"results.json": "newest"}


def test_only_leftovers_of_the_same_name_are_removed(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "thesis.tex").write_text("years of work")
    ours = [".a.txt.abcd_123.tmp", ".a.txt.wxyz0000.tmp"]
    others = [
        ".a.txt.original",
        ".a.txt.abcd1234.tmp~",
        ".b.txt.abcd1234.tmp",
        "a.txt.abcd1234.tmp",
        ".a.txt.ABCD1234.tmp",
    ]
    for name in ours[:1] + others:
        (tmp_path / name).write_text(name)
    (tmp_path / ours[1]).mkdir()
    (tmp_path / ".a.txt.linked00.tmp").symlink_to(tmp_path / "elsewhere")
    write_text(tmp_path / "a.txt", "text")
    assert {p.name for p in tmp_path.iterdir()} == {"a.txt", "elsewhere", ".a.txt.linked00.tmp", *others}
    assert content(tmp_path / "elsewhere") == {"thesis.tex": "years of work"}


def test_what_a_living_process_writes_is_not_taken_for_a_leftover(tmp_path):
    path = tmp_path / "store.zarr"
    with temporary_folder(path) as fresh:
        (fresh / "a").write_text("in the making")
        code = f"from manicm_ms.paths import *\nfrom pathlib import Path\nwrite_text(Path({str(path)!r}), 'x')"
        subprocess.run([sys.executable, "-c", code], check=True)
        assert content(fresh) == {"a": "in the making"}
    assert [p.name for p in tmp_path.iterdir()] == ["store.zarr"]


def test_a_backup_of_ones_own_is_left_alone(tmp_path):
    path, backup = tmp_path / "teacher", tmp_path / "teacher.old"
    backup.mkdir()
    (backup / "a.txt").write_text("precious")
    for text in ("first", "second"):
        with replaced_folder(path) as fresh:
            (fresh / "a.txt").write_text(text)
    assert content(backup) == {"a.txt": "precious"}


def test_the_new_folder_is_on_the_disk_before_the_old_one_makes_room(tmp_path, monkeypatch):
    path = tmp_path / "teacher"
    with replaced_folder(path) as fresh:
        (fresh / "a.txt").write_text("old")
    events, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (events.append(os.fstat(handle).st_ino), fsync(handle)))
    monkeypatch.setattr(os, "replace", lambda a, b: (events.append("rename"), replace(a, b)))
    with replaced_folder(path) as fresh:
        (fresh / "deep").mkdir()
        (fresh / "deep" / "a.txt").write_text("new")
        wanted = {p.stat().st_ino for p in (fresh, fresh / "deep", fresh / "deep" / "a.txt")}
    assert wanted <= set(events[: events.index("rename")])
    assert events[-1] == tmp_path.stat().st_ino


def test_a_lock_names_its_holder_and_ends_with_it(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", f"""
import os, sys
from pathlib import Path
from manicm_ms.paths import take_lock
take_lock(Path({str(tmp_path / "lock")!r}), ValueError)
print("held", flush=True)
sys.stdin.read()
"""],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(OutputExistsError, match=str(holder.pid)), exclusive_lock(tmp_path / "lock", OutputExistsError):
        pass
    holder.kill()
    holder.communicate()
    with exclusive_lock(tmp_path / "lock", OutputExistsError):
        assert (tmp_path / "lock").read_text() == f"{os.getpid()}\n"


def test_a_full_disk_is_recognised():
    with pytest.raises(OSError, match="No space") as caught, open("/dev/full", "w") as f:
        f.write("x" * 100_000)
    assert is_disk_full(caught.value)
    assert is_disk_full(ValueError("I/O error: No space left on device (os error 28)"))
    assert not is_disk_full(FileNotFoundError(2, "No such file"))


# ---- what a user is told


def test_messages_name_what_a_temporary_was_to_become(tmp_path):
    out = tmp_path / "my page.html"
    out.mkdir()
    with pytest.raises(IsADirectoryError) as caught:
        write_text(out, "x")
    assert without_temporaries(f"{caught.value.filename}: no") == f"{out}: no"
    with temporary_folder(tmp_path / "data.zarr") as fresh:
        inner = f"cannot write '{fresh / 'data' / '.zarray'}'"
    assert without_temporaries(inner) == f"cannot write '{tmp_path}/data.zarr/data/.zarray'"
    assert without_temporaries("/tmp/.x.tmp and notes.tmp") == "/tmp/.x.tmp and notes.tmp"


def test_a_file_that_cannot_be_written_is_refused_beforehand(tmp_path):
    (tmp_path / "file.ply").touch()
    (tmp_path / "folder.ply").mkdir()
    require_free(tmp_path / "new" / "cloud.ply", overwrite=False)
    require_free(tmp_path / "file.ply", overwrite=True)
    for out, overwrite, words in (
        ("file.ply", False, "file.ply exists: choose another --out or add --overwrite"),
        ("folder.ply", False, r"folder.ply is a folder: name a file for --out, as in .*folder.ply/NAME\.ply"),
        ("folder.ply", True, "is a folder"),
        ("file.ply/cloud.ply", True, "file.ply is a file, so that .*cloud.ply cannot lie in it"),
    ):
        with pytest.raises(OutputExistsError, match=words):
            require_free(tmp_path / out, overwrite)
