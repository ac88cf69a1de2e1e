"""Messages that name some of many, and none that fills a screen."""

import pytest

from tactile_rt.core.errors import LONGEST, length, name_some, shorten


@pytest.mark.parametrize(
    ("items", "said"),
    [
        ([], ""),
        (["a"], "a"),
        (["a", "b", "c"], "a, b, c"),
        (["a", "b", "c", "d"], "a, b, c and 1 more"),
        ([f"x{k}" for k in range(20)], "x0, x1, x2 and 17 more"),
    ],
)
def test_some_are_named_and_the_rest_is_counted(items, said):
    assert name_some(iter(items)) == said


def test_a_message_that_is_short_enough_or_long_by_a_path_stays_as_it_is():
    path = "/" + "folder/" * 60 + "robot.toml"
    for message in ("x.toml:3: no such file", f"{path}:3: no key 'sorce'; did you mean source?"):
        assert shorten(message) == message


def test_what_is_too_long_keeps_its_beginning_and_its_end():
    message = f"no animal can be used: {'; '.join(f'session {k} has no trial' for k in range(90))}"
    short = shorten(f"{message}: give others")
    assert length(short) <= LONGEST and len(short) <= LONGEST
    assert short.startswith("no animal can be used: session 0") and short.endswith(": give others")


def test_a_word_of_a_user_does_not_fill_the_message():
    assert len(shorten(f"no source {'x' * 5000}; did you mean sim:?")) < LONGEST
