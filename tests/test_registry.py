"""Names are found, near misses suggested, duplicates refused."""

import pytest

from manicm_ms.errors import DuplicateNameError, UnknownNameError
from manicm_ms.registry import Registry


@pytest.fixture
def fruits():
    registry: Registry[int] = Registry("fruit")
    registry.add("apple", 1, tags=("red",))
    registry.add("pear", 2, tags=("green",))
    return registry


def test_get_and_tags(fruits):
    assert fruits.get("pear") == 2
    assert fruits.names() == ("apple", "pear")
    assert fruits.names(tag="green") == ("pear",)


def test_near_miss_is_suggested(fruits):
    with pytest.raises(UnknownNameError, match=r"unknown fruit 'aple': did you mean 'apple'\? known: apple, pear"):
        fruits.get("aple")


def test_duplicates_are_refused(fruits):
    with pytest.raises(DuplicateNameError):
        fruits.add("apple", 3)
    assert fruits.get("apple") == 1
