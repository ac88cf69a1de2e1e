"""Touches in a stream: where a classifier finds them, whole, or with the reason why not."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.classifier.contact import ContactDetector
from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.stream import NS_PER_S, concatenate
from tactile_rt.core.stream.sensor_spec import channel_limits
from tactile_rt.models.onsets import find_onsets
from tactile_rt.recording.touches import ENDS, GAP, REST, find_touches
from tests.helpers.labelled import ARRAY, REST_S, TOUCH_S, chunks_of_touches

PERIOD_NS = 9_000_000
LIMITS = channel_limits(ARRAY)
START_NS = 10**9


def found(chunks):
    return list(find_touches(ARRAY, chunks, PERIOD_NS, LIMITS.floor))


def test_every_touch_is_cut_at_its_onset_after_its_rest():
    touches = found(chunks_of_touches(["mug", "cup", "mug"], start_ns=START_NS))
    begins = [START_NS / NS_PER_S + REST_S + k * (REST_S + TOUCH_S) for k in range(3)]
    assert [t.onset_ns / NS_PER_S for t in touches] == pytest.approx(begins, abs=0.03)
    for touch in touches:
        assert touch.flaw == ""
        assert touch.values.shape == (REST + 110, *ARRAY.shape)
        assert touch.end_ns - touch.onset_ns == 109 * PERIOD_NS
        rest, window = np.split(touch.values - touch.values[:REST].mean(axis=0), [REST])
        quiet = np.abs(rest[:-4]).max() / LIMITS.noise.max()
        assert quiet < 5 < np.abs(window).max() / LIMITS.noise.max()


def test_a_touch_does_not_depend_on_how_the_stream_was_cut():
    chunks = chunks_of_touches(["mug", "cup"])
    whole, parts = found([concatenate(chunks)]), found(chunks)
    assert len(whole) == 2
    for one, other in zip(whole, parts, strict=True):
        assert np.array_equal(one.values, other.values)


def test_a_touch_that_the_stream_ends_or_a_gap_cuts_short_says_so():
    chunks = chunks_of_touches(["mug", "cup"], after_s=0.0)
    assert [t.flaw for t in found(chunks)] == ["", ""]
    touch = round((REST_S + TOUCH_S + REST_S + 0.5) * ARRAY.rate_hz / 5)
    assert [t.flaw for t in found(chunks[:touch])] == ["", ENDS]
    silent = [
        replace(c, seq=c.seq + 1000, t_ns=c.t_ns + 4 * NS_PER_S) for c in chunks[touch:]
    ]  # longer than the resampler bridges
    assert [t.flaw for t in found(chunks[:touch] + silent)][:2] == ["", GAP]


def test_lost_samples_within_a_touch_are_a_gap_and_a_dead_element_is_none():
    chunks = chunks_of_touches(["mug", "cup"])
    at = round((REST_S + 0.5) * ARRAY.rate_hz / 5)
    assert [t.flaw for t in found(chunks[:at] + chunks[at + 20 :])] == [GAP, ""]

    def without(element):
        for chunk in chunks:
            valid = chunk.valid.copy()
            valid[:, element] = False
            yield replace(chunk, valid=valid)

    touches = found(without(2))
    assert [t.flaw for t in touches] == ["", ""]
    assert not touches[0].values[:, 2].any(), "as it has no baseline, it reads nothing"
    assert touches[0].values[:, 1].any()


def test_numbers_that_are_none_are_invalid():
    chunks = chunks_of_touches(["mug"])
    at = round((REST_S + 0.5) * ARRAY.rate_hz / 5)
    for k in range(at, at + 20):
        values = chunks[k].values.copy()
        values[:, 0] = np.nan
        chunks[k] = replace(chunks[k], values=values)
    assert [t.flaw for t in found(chunks)] == [GAP]


def test_a_short_rest_is_there_again_and_again():
    (touch,) = found(chunks_of_touches(["mug"], rest_s=0.5))
    assert touch.flaw == ""
    rest = touch.values[:REST]
    assert 40 < len(np.unique(rest, axis=0)) < 60
    again = [(rest == sample).all(axis=(1, 2)).sum() for sample in rest]
    assert again[-6:] == [1] * 6, "what may be of the touch already is there once"
    assert min(again[:-16]) > 2


def test_the_baseline_is_that_of_the_stream_also_after_short_rests():
    """It rests on quiet samples of before the last touches, too, and on none that was doubted."""
    detector = ContactDetector(ARRAY.shape, LIMITS.floor)
    chunks = chunks_of_touches(["mug", "cup"] * 3, rest_s=0.7)
    stream = Resampler(PERIOD_NS, ARRAY.rate_hz).push(concatenate(chunks))
    baselines = [
        (detector.offset, detector.sigma)
        for values, valid in zip(stream.values, stream.valid, strict=True)
        if detector.update(values, valid)
    ]
    touches = found(chunks)
    onsets = find_onsets(np.stack([t.values for t in touches]), LIMITS.floor)
    assert onsets.start.tolist() == [REST] * 6
    for k, (offset, sigma) in enumerate(baselines):
        error = np.abs(onsets.offset[k] - offset) / sigma
        assert error.max() < (1e-6 if k > 1 else 0.2)
