"""Which enrolled object is it, or none: the score, what a stream's decisions say, damaged cards."""

import msgspec
import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.enrolment import (
    NONE_OF_THESE,
    EnrolledObject,
    identify,
    log_odds,
    margins,
)
from tactile_rt.classifier.model_file import load_model
from tactile_rt.core.errors import ConfigError, ModelError
from tests.helpers.tiny_model import force_rule, identity_rule, write_model
from tests.helpers.touch_streams import SAME_RATE, push_all, pushes

UNITS, SPREAD = 16, 0.15
RULE = identity_rule(SPREAD, (9.0,) * UNITS, 2, 3, *[4, 5] * 4, *[6] * 10)
rng = np.random.default_rng(0)
PLACES = 3 * SPREAD * rng.normal(size=(20, UNITS))  # of objects


def touches(place, count, spread=SPREAD):
    return PLACES[place] + spread * rng.normal(size=(count, UNITS))


def test_touches_are_of_the_object_they_are_like_and_a_stranger_of_none():
    known = [EnrolledObject.of(f"{k}", touches(k, 4)) for k in range(10)]
    for k in range(10):
        name, margin = identify(RULE, known, touches(k, 1))
        assert name == f"{k}" and margin > 0
        both = touches(k, 2)
        assert identify(RULE, known, both) == identify(RULE, known, both[::-1])
    found = [identify(RULE, known, touches(k, 1)) for k in range(10, 20)]
    assert {name for name, _ in found} == {NONE_OF_THESE}
    assert max(margin for _, margin in found) < 0


def test_two_touches_tell_more_than_one():
    rule = msgspec.structs.replace(RULE, thresholds=(-1e4,) * 20)
    known = [EnrolledObject.of(f"{k}", touches(k, 9, 5 * SPREAD)) for k in range(10)]
    right = [
        [
            identify(rule, known, touches(k % 10, m, 5 * SPREAD))[0] == f"{k % 10}"
            for k in range(200)
        ]
        for m in (1, 2)
    ]
    assert np.mean(right[1]) > np.mean(right[0]) + 0.1


def test_the_threshold_is_that_of_so_many_touches():
    place = PLACES[0] / SPREAD  # in the rule's directions
    cases = (1, 1, 1, 2), (5, 1, 9, 6), (1, 2, 1, 4), (1, 7, 2, 5), (9, 1, 1, 6)
    for count, n, m, least in cases:
        enrolled = [EnrolledObject.of("a", np.repeat(PLACES[:1], n, axis=0))]
        enrolled += [EnrolledObject.of(f"{k}", PLACES[k : k + 1]) for k in range(1, count)]
        name, margin = identify(RULE, enrolled, PLACES[:1].repeat(m, axis=0))
        odds = log_odds(np.array(RULE.between), place, n, place, m)
        assert (name, margin) == ("a", pytest.approx(odds - least, rel=1e-2))
    between = margins(RULE, np.array([place] * 2), np.array([1, 1]), place)[0]
    assert between == pytest.approx(odds - 2 - (6 - 2) * np.log(2) / np.log(5))


def test_log_odds_are_those_of_two_gaussians():
    between, n, m = np.array([3.0, 0.5]), 3, 2
    both = rng.normal(size=(n + m, 2))
    found = log_odds(between, both[:n].mean(0), n, both[n:].mean(0), m)

    def log_density(values, b):
        covariance = b + np.eye(len(values))
        size = np.linalg.slogdet(covariance)[1]
        return -(values @ np.linalg.solve(covariance, values) + size) / 2

    expected = sum(
        log_density(both[:, k], b) - log_density(both[:n, k], b) - log_density(both[n:, k], b)
        for k, b in enumerate(between)
    )
    assert found == pytest.approx(expected)


HIGH = EnrolledObject.of("high", np.array([[4.0, 8.0]]))
LOW = EnrolledObject.of("low", np.array([[4.0, -8.0]]))
RULE_OF_FORCE = force_rule()


@pytest.fixture(scope="module")
def enrolled(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "tiny.onnx"
    return write_model(path, identity=RULE_OF_FORCE, enrolled=(HIGH, LOW))


def felt(path, sizes, **options):
    return push_all(Classifier(path, SAME_RATE, **options), pushes(sizes))


def test_the_last_step_of_a_touch_names_its_object(enrolled):
    found = felt(enrolled, [8, -8, 1])
    last = [d for d in found if d.final]
    assert [d.object for d in last] == ["high", "low", NONE_OF_THESE]
    assert [d.object_touches for d in last] == [1, 1, 1]
    assert [d.object_margin > 0 for d in last] == [True, True, False]
    assert all((d.object, d.object_margin) == ("", None) for d in found if not d.final)
    sliding = felt(enrolled, [8], mode="sliding", every=2)
    assert [d.step for d in sliding if d.object] == [4] and len(sliding) > 5


def test_touches_that_follow_each_other_are_fused_if_asked(enrolled):
    last = [d for d in felt(enrolled, [8, 7.5, -8], fuse_s=1.0) if d.final]
    assert [d.object_touches for d in last] == [1, 2, 3]
    assert [d.object for d in last] == ["high", "high", NONE_OF_THESE]
    apart = [d for d in felt(enrolled, [8, 7.5, -8], fuse_s=0.5) if d.final]
    assert [d.object_touches for d in apart] == [1, 1, 1]
    with pytest.raises(ConfigError, match="fuse_s"):
        felt(enrolled, [8], fuse_s=-1)


@pytest.mark.parametrize(
    ("rule", "change", "said"),
    [
        (None, {}, "no rule `identity`"),
        ({"score": "magic"}, {}, "'magic'.*update"),
        ({"thresholds": ()}, {}, "0 thresholds among"),
        ({"thresholds": (float("nan"),) * 10}, {}, "float"),
        ({"among": (2,)}, {}, "10 thresholds among"),
        ({"refused": 1.0}, {}, "identity.refused"),
        ({"directions": b"123"}, {}, "3 bytes for 2 units"),
        ({"between": (0.0, 1.0)}, {}, "identity.between"),
        ({"origin": b"\xff" * 4}, {}, "numbers that are none"),
        ({}, {"name": "low"}, "repeat"),
        ({}, {"name": "a\n"}, "printable"),
        ({}, {"name": NONE_OF_THESE}, "repeat, are"),
        ({}, {"mean": b"12345"}, "5, 4. bytes for 2 units"),
        ({}, {"mean": b"\xff" * 4}, "numbers that are none"),
        ({}, {"touches": 0}, "enrolled.*touches"),
    ],
)
def test_damaged_enrolment_is_refused_in_one_line(tmp_path, rule, change, said):
    identity = None if rule is None else msgspec.structs.replace(RULE_OF_FORCE, **rule)
    objects = (msgspec.structs.replace(HIGH, **change), LOW)
    with pytest.raises(ModelError, match=said) as refused:
        load_model(write_model(tmp_path / "model.onnx", identity=identity, enrolled=objects))
    assert "\n" not in str(refused.value)
    assert len(str(refused.value).replace(str(tmp_path), "")) <= 200
