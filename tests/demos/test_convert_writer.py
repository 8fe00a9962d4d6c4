"""The process that writes for other libraries: what it is sent arrives, and why it failed is passed on."""

import io
import sys

import numpy as np
import pytest

from manicm_ms.demos.convert.child import pack, unpack
from manicm_ms.demos.convert.writer import Writer
from manicm_ms.errors import ManicmError


def test_messages_come_out_as_they_went_in():
    sent = [{"a": np.arange(6).reshape(2, 3)}, {"job": np.array("text"), "b": np.zeros(0)}]
    received = list(unpack(io.BytesIO(b"".join(map(pack, sent)))))
    assert len(received) == len(sent)
    for ours, theirs in zip(sent, received, strict=True):
        assert set(ours) == set(theirs)
        for name, values in ours.items():
            np.testing.assert_array_equal(theirs[name], values)


@pytest.mark.parametrize("missing", [1, 40])
def test_a_stream_that_is_cut_short_is_no_end(missing):
    with pytest.raises(EOFError, match="cut short"):
        list(unpack(io.BytesIO(pack({"a": np.arange(6)})[:-missing])))


def test_a_failure_is_told_in_its_last_line(tmp_path):
    with (
        pytest.raises(ManicmError, match=r"KeyError: 'unknown'\): try another --out, or report this$"),
        Writer("unknown", sys.executable, tmp_path / "a", {}),
    ):
        pass


def test_a_writer_that_ended_early_is_noticed_while_sending(tmp_path):
    big = {"action": np.zeros(1 << 20)}  # more than a pipe holds
    with pytest.raises(ManicmError, match="KeyError"), Writer("unknown", sys.executable, tmp_path / "a", {}) as writer:
        writer.send(big)
    with pytest.raises(ManicmError, match="KeyError"), Writer("minari", sys.executable, tmp_path / "a", {}) as writer:
        writer.send(big)


def test_an_error_in_the_block_stops_the_process(tmp_path):
    with pytest.raises(ZeroDivisionError), Writer("minari", sys.executable, tmp_path / "a", {}) as writer:
        _ = 1 / 0
    assert writer._process.returncode is not None


def test_only_a_failed_import_is_blamed_on_the_installation(tmp_path):
    script = tmp_path / "python"
    script.write_text('#!/bin/sh\ncat > /dev/null\necho "ImportError: no minari here" >&2\nexit 1\n')
    script.chmod(0o755)
    with (
        pytest.raises(ManicmError, match=r"\(ImportError: no minari here\): check that library's installation$"),
        Writer("minari", str(script), tmp_path / "a", {}),
    ):
        pass
