"""Fetching experts from a server and from folders: what is not exactly right is refused, and nothing of it stays."""

import hashlib
import http.server
import io
import pickle
import socket
import threading
import zipfile
from contextlib import contextmanager

import numpy as np
import pytest

from manicm_ms.demos import expert_files
from manicm_ms.demos.expert_files import FOLDER_VARIABLE, ExpertFile, digest, experts_folder, fetch, load_arrays
from manicm_ms.demos.inert_pickle import attributes, describe, tensor
from manicm_ms.errors import ExpertFileError, UnknownNameError
from manicm_ms.registry import Registry

ARRAYS = {"w0": np.arange(12, dtype=np.float32).reshape(3, 4), "n_layers": np.array(1)}
LICENCE = b"Everything is permitted.\n"


class Policy:
    def __init__(self, weights):
        self.w0 = weights


def read(content):
    return {"w0": tensor(attributes(describe(content))["w0"]), "n_layers": np.array(1)}


def sha256(content):
    return hashlib.sha256(content).hexdigest()


@contextmanager
def serving(answers):
    """A server of `answers`, path -> content (None: nonsense); yields its address and what it was asked."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            content = answers.get(self.path, b"")
            if content is None:
                self.wfile.write(b"this is not HTTP\n")
                return
            self.send_response(200 if self.path in answers else 404)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *words):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}", asked
        finally:
            server.shutdown()
            thread.join()


SOURCES = {
    "/door.pickle": pickle.dumps(Policy(ARRAYS["w0"]), 3),
    "/pen.pickle": pickle.dumps(Policy(ARRAYS["w0"] + 1), 3),
    "/LICENSE": LICENCE,
}


def register(monkeypatch, address, **changes):
    """A fresh registry with toy/door and toy/pen; `changes` replaces fields of the pen's."""
    registry = Registry("expert file")
    for name, arrays in (("door", ARRAYS), ("pen", ARRAYS | {"w0": ARRAYS["w0"] + 1})):
        url = f"{address}/{name}.pickle"
        fields = {
            "name": f"toy/{name}", "url": url, "sha256": sha256(SOURCES[f"/{name}.pickle"]), "read": read,
            "arrays_sha256": digest(arrays), "licence": "Free-1.0", "licence_url": f"{address}/LICENSE",
            "licence_sha256": sha256(LICENCE), "credit": "Made by nobody.",
        }  # fmt: skip
        registry.add(f"toy/{name}", ExpertFile(**(fields | (changes if name == "pen" else {}))))
    monkeypatch.setattr(expert_files, "EXPERT_FILES", registry)


@pytest.fixture(scope="module")
def server():
    with serving(dict(SOURCES)) as (address, asked):
        yield address, asked


@pytest.fixture
def cache(tmp_path, monkeypatch, server):
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "experts"))
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    register(monkeypatch, server[0])
    server[1].clear()
    return tmp_path / "experts"


def names_in(folder):
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())


def npz(arrays):
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    return packed.getvalue()


# ---- what goes well -------------------------------------------------------------------------------------------------


def test_fetched_once_with_licence_and_source(cache, server):
    said = []
    assert fetch(["toy/door"], report=said.append) == [cache / "toy" / "door.npz"]
    assert names_in(cache) == ["toy/LICENSE", "toy/door.SOURCE.txt", "toy/door.npz"]
    assert (cache / "toy" / "LICENSE").read_bytes() == LICENCE
    source = (cache / "toy" / "door.SOURCE.txt").read_text()
    for part in ("Made by nobody.", f"{server[0]}/door.pickle", sha256(SOURCES["/door.pickle"]), "Free-1.0"):
        assert part in source
    assert "13 numbers" in said[0]
    arrays = load_arrays("toy/door")
    assert arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(arrays[name], array, strict=True)
    assert server[1] == ["/door.pickle", "/LICENSE"]

    before = {p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in cache.rglob("*") if p.is_file()}
    assert fetch(["toy/door"], report=said.append) == [cache / "toy" / "door.npz"]
    assert "there already" in said[1]
    assert {p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in cache.rglob("*") if p.is_file()} == before
    assert len(server[1]) == 2, "the server was not asked again"


def test_what_is_damaged_or_has_lost_its_licence_is_fetched_again(cache):
    (kept,) = fetch(["toy/door"])
    whole = kept.read_bytes()
    kept.write_bytes(whole[:-30])
    fetch(["toy/door"])
    load_arrays("toy/door")
    (cache / "toy" / "LICENSE").unlink()
    fetch(["toy/door"])
    assert (cache / "toy" / "LICENSE").read_bytes() == LICENCE


def test_taken_from_a_folder_without_a_server(cache, server, tmp_path):
    folder = tmp_path / "given"
    folder.mkdir()
    (folder / "LICENSE").write_bytes(LICENCE)
    with (folder / "door.npz").open("wb") as f:
        np.savez_compressed(f, n_layers=ARRAYS["n_layers"], w0=ARRAYS["w0"])  # other bytes, the same numbers
    before = names_in(folder)
    fetch(["toy/door"], source=folder)
    np.testing.assert_array_equal(load_arrays("toy/door")["w0"], ARRAYS["w0"])
    assert names_in(cache) == ["toy/LICENSE", "toy/door.SOURCE.txt", "toy/door.npz"]
    assert (names_in(folder), server[1]) == (before, [])


def test_the_digest_is_of_names_types_shapes_and_numbers():
    changed = [
        {"w1": ARRAYS["w0"], "n_layers": ARRAYS["n_layers"]},
        ARRAYS | {"w0": ARRAYS["w0"].astype(np.float64)},
        ARRAYS | {"w0": ARRAYS["w0"].reshape(4, 3)},
        ARRAYS | {"w0": ARRAYS["w0"] * np.float32(1.0000001)},
        ARRAYS | {"more": np.zeros(0)},
        {"w0": ARRAYS["w0"]},
    ]
    assert len({digest(ARRAYS), *map(digest, changed)}) == 7
    same = {"n_layers": ARRAYS["n_layers"], "w0": np.asfortranarray(ARRAYS["w0"])}
    assert digest(same) == digest(ARRAYS)


def test_where_experts_are_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    assert experts_folder() == tmp_path / ".cache" / "manicm_ms" / "experts"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "c"))
    assert experts_folder() == tmp_path / "c" / "manicm_ms" / "experts"
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "mine"))
    assert experts_folder() == tmp_path / "mine"


# ---- what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"sha256": "0" * 64}, r"pen\.pickle has the SHA-256 \w{16}\.\.\. where 0{16}\.\.\. is expected: not taken"),
        ({"licence_sha256": "0" * 64}, r"/LICENSE has the SHA-256 .*not taken"),
        ({"arrays_sha256": "0" * 64}, r"pen\.pickle was read into other arrays than those of toy/pen"),
        ({"url": "{}/lost.pickle"}, r"lost\.pickle cannot be fetched \(Not Found\): .*--from FOLDER"),
        ({"licence_url": "{}/lost"}, r"/lost cannot be fetched"),
        ({"url": "nowhere"}, r"nowhere cannot be fetched \(unknown url type"),
        ({"url": "{}/door.pickle", "sha256": sha256(SOURCES["/door.pickle"])}, "read into other arrays"),
        ({"url": "{}/LICENSE", "sha256": sha256(LICENCE)}, "pickle"),  # a file of another kind
    ],
)
def test_a_source_that_is_not_right_leaves_nothing_and_keeps_what_was_there(
    cache, server, monkeypatch, changes, told
):  # fmt: skip
    register(monkeypatch, server[0], **{k: v.format(server[0]) for k, v in changes.items()})
    with pytest.raises(ExpertFileError, match=told):
        fetch(["toy/door", "toy/pen"])
    assert names_in(cache) == ["toy/LICENSE", "toy/door.SOURCE.txt", "toy/door.npz"], "the one before it stays"
    load_arrays("toy/door")
    with pytest.raises(ExpertFileError, match=r"toy/pen is not at .*pen\.npz: 'manicm-ms experts fetch' gets it"):
        load_arrays("toy/pen")


def test_servers_that_are_away_or_speak_nonsense(cache, monkeypatch):
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        register(monkeypatch, f"http://127.0.0.1:{taken.getsockname()[1]}")
        with pytest.raises(ExpertFileError, match=r"door\.pickle cannot be fetched .*refused.*try again later, or"):
            fetch(["toy/door"])
    with serving(dict.fromkeys(SOURCES)) as (address, _):
        register(monkeypatch, address)
        with pytest.raises(ExpertFileError, match=r"door\.pickle cannot be fetched \(this is not HTTP\): try"):
            fetch(["toy/door"])
    assert not cache.exists()


def damaged(offset):
    """An archive with one bit of it flipped."""
    content = bytearray(npz(ARRAYS))
    content[offset] ^= 4
    return bytes(content)


def encrypted():
    """An archive that says that its first entry is encrypted."""
    content = bytearray(npz(ARRAYS))
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(signature) + flags] |= 1
    return bytes(content)


def other_entry(content):
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("w0.npy", content)
    return packed.getvalue()


def npy(array):
    packed = io.BytesIO()
    np.save(packed, array)
    return packed.getvalue()


WRONG = {
    "other numbers": (npz(ARRAYS | {"w0": ARRAYS["w0"] + 1}), "is not the expert of toy/door: the SHA-256"),
    "one number missing": (npz({"w0": ARRAYS["w0"]}), "is not the expert of toy/door"),
    "array of objects": (npz(ARRAYS | {"w0": np.array([None, {}], object)}), "it holds pickles, which are never read"),
    "a raw pickle": (SOURCES["/door.pickle"], "it holds pickles, which are never read"),
    "a pickle in the archive": (other_entry(SOURCES["/door.pickle"]), "is not the expert|holds pickles"),
    "one array, no archive": (npy(ARRAYS["w0"]), "it is damaged"),
    "a bit of the numbers": (damaged(npz(ARRAYS).index(ARRAYS["w0"].tobytes()) + 5), "it is damaged"),
    "a bit of the header": (damaged(npz(ARRAYS).index(b"NUMPY") + 12), "it is damaged"),
    "encrypted": (encrypted(), "it is damaged"),
    "cut short": (npz(ARRAYS)[:-40], "no archive of plain arrays"),
    "nothing": (b"", "no archive of plain arrays"),
    "text": (b"404: Not Found", "no archive of plain arrays"),
}


@pytest.mark.parametrize("kind", list(WRONG))
def test_a_file_that_is_not_right_is_refused_from_folder_and_cache(cache, tmp_path, kind):
    content, told = WRONG[kind]
    folder = tmp_path / "given"
    folder.mkdir()
    (folder / "LICENSE").write_bytes(LICENCE)
    (folder / "door.npz").write_bytes(content)
    with pytest.raises(ExpertFileError, match=told) as caught:
        fetch(["toy/door"], source=folder)
    assert str(folder / "door.npz") in str(caught.value)
    assert not cache.exists()

    (kept,) = fetch(["toy/door"])
    whole = kept.read_bytes()
    kept.write_bytes(content)
    with pytest.raises(ExpertFileError, match="delete it and run 'manicm-ms experts fetch'") as caught:
        load_arrays("toy/door")
    assert str(kept) in str(caught.value)
    fetch(["toy/door"])
    assert kept.read_bytes() == whole, "fetched again"


def test_a_pickle_under_an_array_s_name_executes_nothing(cache, tmp_path):
    class Touch:
        def __reduce__(self):
            return open, (str(tmp_path / "touched"), "w")

    folder = tmp_path / "given"
    folder.mkdir()
    for content in (
        pickle.dumps(Touch()),
        npz({"w0": np.array([Touch()], object)}),
        other_entry(pickle.dumps(Touch())),
    ):
        (folder / "door.npz").write_bytes(content)
        with pytest.raises(ExpertFileError):
            fetch(["toy/door"], source=folder)
        assert not (tmp_path / "touched").exists()


def test_folders_that_lack_something(cache, tmp_path):
    folder = tmp_path / "given"
    with pytest.raises(ExpertFileError, match=r"given/door\.npz is not there: name a folder that holds door\.npz"):
        fetch(["toy/door"], source=folder)
    folder.mkdir()
    (folder / "door.npz").write_bytes(npz(ARRAYS))
    with pytest.raises(ExpertFileError, match=r"given lacks LICENSE: .*Free-1\.0"):
        fetch(["toy/door"], source=folder)
    (folder / "LICENSE").write_bytes(LICENCE + b"Except on Sundays.\n")
    with pytest.raises(ExpertFileError, match=r"given/LICENSE is not the licence of toy/door \(Free-1\.0\)"):
        fetch(["toy/door"], source=folder)
    assert not cache.exists()
    (folder / "LICENSE").write_bytes(LICENCE)
    with pytest.raises(ExpertFileError, match=r"given/pen\.npz is not there"):
        fetch(["toy/door", "toy/pen"], source=folder)
    load_arrays("toy/door")


def test_unknown_names_are_told_before_anything_is_fetched(cache, server):
    with pytest.raises(UnknownNameError, match="did you mean 'toy/door'"):
        fetch(["toy/pen", "toy/dor"])
    with pytest.raises(UnknownNameError):
        load_arrays("toy/dor")
    assert server[1] == []
    assert not cache.exists()
