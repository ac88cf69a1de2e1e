"""A model that falls behind skips to the newest sample, and never sees a stream with a hole."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_rt.classifier import classifier as classifier_module
from tactile_rt.classifier.classifier import BEHIND_S, Classifier
from tactile_rt.classifier.decision_rules import Deadline
from tactile_rt.classifier.skips import Skip, Skips
from tactile_rt.core.errors import ConfigError
from tests.helpers.tiny_model import PERIOD_NS, STEPS, SUBSTEPS
from tests.helpers.touch_streams import QUIET, SAME_RATE, push_all, same, signal, stream

TOUCHES = [(start, start + 60, 1.0) for start in range(QUIET, 900, 110)]
VALUES = signal(TOUCHES, 950)
AGES = (0.0, 0.0, 0.0, 0.01, 0.1, 0.14, 0.151, 0.3, 1.0, 2.5)


@pytest.fixture(scope="module", autouse=True)
def prompt() -> Iterator[None]:
    """Every step takes no time, as it would not on a busy machine: ages alone say what is late."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(classifier_module, "time", SimpleNamespace(perf_counter=lambda: 0.0))
        yield


class Ages:
    """How old samples are, as a script says: each look takes the next."""

    def __init__(self, ages: list[float]) -> None:
        self.ages, self.looks = ages, 0

    def __call__(self, t_ns: int) -> float:
        self.looks += 1
        return self.ages[self.looks % len(self.ages)]


@settings(max_examples=60, deadline=None)
@given(
    ages=st.lists(st.sampled_from(AGES), min_size=3, max_size=40),
    mode=st.sampled_from(["episode", "sliding"]),
    samples=st.integers(1, 40),
)
def test_what_was_skipped_live_and_is_skipped_again_gives_the_same_decisions(
    model: Path, ages: list[float], mode: str, samples: int
) -> None:
    options = {"age": Ages(ages), "catch_up": "newest", "behind_s": BEHIND_S}
    live = Classifier(model, SAME_RATE, mode=mode, **options)
    decisions = push_all(live, stream(VALUES))
    skips = list(live.skips.found)
    again = Classifier(model, SAME_RATE, mode=mode, skips=skips)
    assert same(push_all(again, stream(VALUES, samples)), decisions)
    assert again.stats.skips <= live.stats.skips == len(skips)
    for d in decisions:
        assert not any(s.from_ns <= d.t_ns < s.until_ns for s in skips)
        # the network has taken every step of the episode, and none of a skip
        taken = d.t_ns - d.onset_ns + PERIOD_NS
        assert taken == d.step * SUBSTEPS * PERIOD_NS or mode == "sliding"
        assert not any(d.onset_ns <= s.from_ns <= d.t_ns for s in skips)


def test_who_is_never_behind_decides_as_if_nobody_looked(model: Path) -> None:
    watched = Classifier(model, SAME_RATE, age=lambda t_ns: 0.119, catch_up="newest")
    plain = Classifier(model, SAME_RATE)
    decisions = push_all(plain, stream(VALUES))
    assert same(push_all(watched, stream(VALUES)), decisions) and watched.stats.skips == 0
    assert len(decisions) == STEPS * len(TOUCHES)


def test_a_late_episode_ends_and_the_next_onset_begins_one(model: Path) -> None:
    """Behind once, in the second touch: its later steps are missing, and no other decision."""
    plain = push_all(Classifier(model, SAME_RATE), stream(VALUES))
    second = [d for d in plain if d.onset_ns == plain[STEPS].onset_ns]
    at = second[1].t_ns
    live = Classifier(model, SAME_RATE, age=lambda t: 0.2 * (t == at), catch_up="newest")
    decisions = push_all(live, stream(VALUES))
    assert live.skips.found == [Skip(at, at + 200_000_000)] and live.stats.skips == 1
    assert same(decisions, [d for d in plain if d not in second[1:]])


def test_all_computes_every_step_and_marks_what_is_late(model: Path) -> None:
    old = Classifier(model, SAME_RATE, age=lambda t_ns: 3.0, catch_up="all")
    plain = push_all(Classifier(model, SAME_RATE), stream(VALUES))
    decisions = push_all(old, stream(VALUES))
    assert same(decisions, plain) and all(d.late for d in decisions)
    assert not any(d.late for d in plain) and old.stats.late == old.stats.steps


def test_windows_that_slide_go_on_within_a_contact(model: Path) -> None:
    values = signal([(QUIET, 600, 1.0)], 650)
    plain = push_all(Classifier(model, SAME_RATE, mode="sliding", every=1), stream(values))
    middle = plain[len(plain) // 2].t_ns
    skips = [Skip(middle, middle + 30 * PERIOD_NS)]
    skipping = Classifier(model, SAME_RATE, mode="sliding", every=1, skips=skips)
    found = push_all(skipping, stream(values))
    after = [d for d in found if d.t_ns >= skips[0].until_ns]
    assert after and after[0].onset_ns >= skips[0].until_ns and after[0].coverage is None
    assert abs(after[-1].t_ns - plain[-1].t_ns) < SUBSTEPS * PERIOD_NS


def test_a_step_that_would_be_late_is_not_begun() -> None:
    skips = Skips(most_s=0.15, age=lambda t_ns: 0.1)
    assert not skips.before_step(10)  # what a step takes is not known yet
    for _ in range(50):
        assert not skips.after_step(10, 0.021)  # and then a fifth is left to publish it
    assert skips.before_step(20) and skips.found == [Skip(20, 20 + 100_000_000)]
    assert skips.covers(20) and skips.covers(100_000_019) and not skips.covers(100_000_020)


def test_one_slow_step_does_not_silence_a_model_for_ever() -> None:
    age = [0.0]
    skips = Skips(most_s=0.15, age=lambda t_ns: age[0])
    skips.after_step(1, 60.0)
    assert not skips.before_step(2)  # fresh samples are tried
    age[0] = 0.02
    assert skips.before_step(3)


def test_age_makes_a_step_late_as_work_does() -> None:
    assert not Deadline(0.1, age=lambda t_ns: 0.1).add_step(0, 0.01)
    assert Deadline(0.1, age=lambda t_ns: 0.1001).add_step(0, 0.01)
    assert Deadline(0.1, age=lambda t_ns: 0.0).add_step(0, 0.1001)


def test_an_unknown_way_to_catch_up_is_refused(model: Path) -> None:
    with pytest.raises(ConfigError, match="catch_up must be one of newest, all, not 'oldest'"):
        Classifier(model, SAME_RATE, catch_up="oldest")  # type: ignore[arg-type]


def test_at_its_bounds_a_step_is_taken() -> None:
    age = [0.0]
    skips = Skips(most_s=1.0, age=lambda t_ns: age[0])
    age[0] = 1.0
    assert not skips.after_step(1, 1.0)  # as old as may be
    # A fifth of what the last step took is expected of the next; four fifths may be over by then.
    age[0] = 0.6
    assert not skips.before_step(2)
    age[0] = 0.61
    assert skips.before_step(3)


def test_a_skip_is_at_least_a_nanosecond() -> None:
    skips = Skips(most_s=0.0, age=lambda t_ns: 1e-12)
    assert skips.after_step(5, 0.0)
    assert skips.found == [Skip(5, 6)] and skips.covers(5) and not skips.covers(6)


def test_what_was_sure_in_an_episode_that_was_cut_does_not_count_in_the_next(model: Path) -> None:
    plain = push_all(Classifier(model, SAME_RATE, sure=0.01, in_a_row=3), stream(VALUES))
    assert [d.step for d in plain if d.final] == [3] * len(TOUCHES)
    cut = Skip(plain[1].t_ns + 1, plain[1].t_ns + 10 * PERIOD_NS)
    cutting = Classifier(model, SAME_RATE, sure=0.01, in_a_row=3, skips=[cut])
    assert same(push_all(cutting, stream(VALUES)), plain[:2] + plain[3:])


def test_while_something_is_touched_it_is_deciding_though_the_episode_is_skipped(
    model: Path,
) -> None:
    skips = [Skip((QUIET + 5) * PERIOD_NS, (QUIET + 20) * PERIOD_NS)]
    classifier = Classifier(model, SAME_RATE, skips=skips)
    push_all(classifier, stream(VALUES[: QUIET + 40]))
    assert classifier.deciding and classifier.stats.skips == 1
