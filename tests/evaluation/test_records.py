"""An evaluation's folder survives kills and refuses strangers."""

import dataclasses
import json
import multiprocessing
import os
import signal
import time

import pytest
from point_mass import PointMass, Proportional

from manicm_ms.errors import OutputExistsError
from manicm_ms.evaluation.records import EpisodeLog, claimed_folder
from manicm_ms.evaluation.rollout import EpisodeResult, rollout

REQUEST = {"env_id": "toy/point-mass", "seed": 1, "policies": [["a", "teacher", "ff"]]}


def episodes(seeds):
    return rollout(PointMass(2), Proportional(), seeds)


def test_a_log_returns_what_was_appended(tmp_path):
    results = episodes([1, 2, 3])
    with EpisodeLog(tmp_path / "a.jsonl") as log:
        for result in results[:2]:
            log.append(result)
    with EpisodeLog(tmp_path / "a.jsonl") as log:
        assert [1 in log, 2 in log, 3 in log] == [True, True, False]
        assert [log[1], log[2]] == results[:2]
        log.append(results[2])
    with EpisodeLog(tmp_path / "a.jsonl") as log:
        assert len(log) == 3


def test_a_record_of_an_earlier_version_is_read_and_leaves_open_what_it_does_not_say(tmp_path):
    (result,) = episodes([1])
    record = result.to_record()
    old = {key: value for key, value in record.items() if key not in ("success_once", "success_at_end")}
    (tmp_path / "a.jsonl").write_text(json.dumps(old) + "\n")
    with EpisodeLog(tmp_path / "a.jsonl") as log:
        assert log[1] == dataclasses.replace(result, success_once=None, success_at_end=None)
        assert EpisodeResult.from_record(record) == result


def test_a_torn_last_line_is_cut_and_its_episode_played_again(tmp_path):
    path = tmp_path / "a.jsonl"
    with EpisodeLog(path) as log:
        for result in episodes([1, 2]):
            log.append(result)
    whole = path.read_bytes()
    first = whole.index(b"\n") + 1
    for cut in range(first, len(whole) - 1, 7):
        path.write_bytes(whole[:cut])
        with EpisodeLog(path) as log:
            assert (1 in log, 2 in log) == (True, False)
            log.append(episodes([2])[0])
        assert path.read_bytes() == whole


def test_a_damaged_line_is_named_with_the_remedy_and_the_file_stays(tmp_path):
    path = tmp_path / "a.jsonl"
    with EpisodeLog(path) as log:
        for result in episodes([1, 2, 3]):
            log.append(result)
    first, second, third = path.read_bytes().splitlines(keepends=True)
    for damaged in (
        second[:30] + b"\n",
        b"{}\n",
        b"[1]\n",
        second.replace(b'"actions": "', b'"actions": "A'),
        b"\xff\n",
    ):
        path.write_bytes(first + damaged + third)
        with pytest.raises(OutputExistsError, match=r"line 2 of .*a\.jsonl is damaged: delete this line"):
            EpisodeLog(path)
        assert path.read_bytes() == first + damaged + third
    path.write_bytes(first + third)  # what the message asks for
    with EpisodeLog(path) as log:
        assert (1 in log, 2 in log, 3 in log) == (True, False, True)


def _append_for_ever(path):
    with EpisodeLog(path) as log:
        for seed in range(10_000):
            log.append(episodes([seed])[0])


def test_nothing_appended_is_lost_when_the_process_is_killed(tmp_path):
    path = tmp_path / "a.jsonl"
    writer = multiprocessing.get_context("fork").Process(target=_append_for_ever, args=(path,))
    writer.start()
    while not path.exists() or path.stat().st_size < 5_000:
        time.sleep(0.01)
    os.kill(writer.pid, signal.SIGKILL)
    writer.join()
    lines = path.read_bytes().count(b"\n")
    with EpisodeLog(path) as log:
        assert len(log) == lines > 0
        assert [log[s] for s in range(lines)] == episodes(list(range(lines)))


def test_the_same_request_goes_on_and_another_one_is_refused(tmp_path):
    out = tmp_path / "report"
    for _ in range(2):
        with claimed_folder(out, REQUEST):
            pass
    with (
        pytest.raises(OutputExistsError, match=r"seed differ; seed there: 1, asked: 2"),
        claimed_folder(out, {**REQUEST, "seed": 2}),
    ):
        pass
    assert json.loads((out / "run.json").read_text()) == REQUEST


def test_a_folder_of_other_files_and_a_file_are_refused_untouched(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(OutputExistsError, match="holds other files"), claimed_folder(tmp_path, REQUEST):
        pass
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]
    with pytest.raises(OutputExistsError, match="is a file"), claimed_folder(tmp_path / "thesis.tex", REQUEST):
        pass


def test_a_second_writer_is_refused(tmp_path):
    with (
        claimed_folder(tmp_path / "r", REQUEST),
        pytest.raises(OutputExistsError, match=f"written by process {os.getpid()}"),
        claimed_folder(tmp_path / "r", REQUEST),
    ):
        pass
