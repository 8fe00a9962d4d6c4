"""Words that depend on numbers."""

from manicm_ms.wording import counted


def test_one_is_singular():
    assert [counted(n, "episode") for n in (0, 1, 2)] == ["0 episodes", "1 episode", "2 episodes"]
