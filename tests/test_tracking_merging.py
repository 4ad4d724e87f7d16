"""The merger: regular steps, records out of order, jumps in time, and --live with a clock of its own."""

import itertools
import os
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avcli.formats.arrivals import Arrivals
from avcli.formats.records import Detections
from avcli.numeric import rate_of
from avcli.tracking import track
from avcli.tracking.live import LiveMerger
from avcli.tracking.merging import Merger, in_turn


def seen(time, sensor="video"):
    """A record of a sensor that sees nobody."""
    return Detections(time, sensor, np.empty((0, 3)))


def merged(times, **how):
    """Merge one sensor's times; [(step, times in it)]."""
    merger, out = Merger(["video"], one_sensor=True, **how), []
    for t in times:
        merger.push(0, "video", t, seen(t))
        out += merger.closed()
    merger.end(0)
    out += merger.closed()
    return [(round(step, 9), [t for t, *_ in inside]) for step, inside in out], merger


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_neighbours_out_of_order_and_repetitions_are_put_right(seed):
    rng = np.random.default_rng(seed)
    times = [k / 10 for k in range(25)]
    keys = [k + (rng.uniform(-1.4, 1.4) if k > 1 else 0) for k in range(25)]
    shuffled = [t for _, t in sorted(zip(keys, times, strict=True))]
    doubled = [t for t in shuffled for _ in range(rng.integers(1, 3))]
    steps, merger = merged(doubled, rate=10.0)
    assert [step for step, _ in steps] == [round(t, 9) for t in times]
    assert {t for _, inside in steps for t in inside} == set(times)
    assert sum(merger.late.values()) <= len(doubled) - len(times)  # second copies only


@given(st.lists(st.floats(0, 9), min_size=1, max_size=40), st.sampled_from([None, 5.0, 10.0]))
@settings(max_examples=60, deadline=None)
def test_steps_are_regular_whatever_the_times(times, rate):
    steps, merger = merged(times, rate=rate)
    assert np.allclose(np.diff([step for step, _ in steps]), 1 / merger.rate if merger.rate else 0)
    taken = sum(len(inside) for _, inside in steps)
    assert taken + sum(merger.late.values()) <= len(times)
    assert all(t <= step + 1e-6 for step, inside in steps for t in inside)


@pytest.mark.parametrize("rate", [7.5, 10, 12.5, 29.97, 30, 60, 120])
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_a_clock_whose_rate_is_found_does_not_run_away(rate, start):
    """Steps were rounded to a microsecond: 60 Hz ran at 59.9988 Hz, 1 ms late after 50 s."""
    times = [round(start + k / rate, 9) for k in range(round(100 * rate))]
    steps, _ = merged(times)
    assert len(steps) == len(times)
    assert np.allclose([step for step, _ in steps], times, rtol=0, atol=1e-5)


@pytest.mark.parametrize("rate", [15 / 1.001, 14.985, 24 / 1.001, 23.976, 30 / 1.001, 60 / 1.001, 59.94])
@pytest.mark.parametrize("digits", [3, 4, 6])
def test_the_rates_of_television_are_found_in_stamps_that_are_rounded(rate, digits):
    """59.9 was found for 59.94, and 23.98 for 23.976, and after ten seconds no record was in time."""
    for begin in np.linspace(0.0, 1.0, 50):
        stamps = (begin + np.arange(round(2 * rate)) / rate).round(digits)
        assert rate_of([np.diff(stamps).tolist()]) == pytest.approx(rate, rel=2e-6)  # 29.97 and 29.97003 are as good
        whole = (begin + np.arange(round(2 * rate)) / round(rate)).round(digits)
        assert rate_of([np.diff(whole).tolist()]) == round(rate)


@pytest.mark.parametrize("rate", [10, 15, 30, 60])
def test_time_stamps_that_are_rounded_or_jitter_are_no_faster_clock(rate):
    """Where no two steps were alike, the shortest of them was taken for the usual one: 44.7 Hz for 30 Hz."""
    exact, rng = np.arange(rate + 1) / rate, np.random.default_rng(0)
    assert rate_of([np.diff(exact.round(3)).tolist()]) == rate
    shaken = np.array([rate_of([np.diff(exact + rng.uniform(-0.1, 0.1, rate + 1) / rate).tolist()]) for _ in range(20)])
    assert abs(np.median(shaken) / rate - 1) < 0.01
    assert np.all(abs(shaken / rate - 1) < 0.1)


def test_the_commonest_step_is_that_of_one_sensor():
    assert rate_of([[0.1] * 9, [1 / 12] * 11]) == 12
    assert rate_of([[0.1] * 30, [0.04] * 25]) == 10


def test_a_step_closes_when_all_sensors_have_passed_it():
    merger = Merger(["v", "a"], rate=10.0)
    merger.push(0, "video", 0.0, seen(0.0))
    merger.push(0, "video", 0.1, seen(0.1))
    assert not list(merger.closed())
    merger.push(1, "audio", 0.0, seen(0.0))
    assert not list(merger.closed())
    merger.push(1, "audio", 0.1, seen(0.1))
    assert [step for step, _ in merger.closed()] == [0.0]
    merger.end(1)
    merger.push(0, "video", 0.2, seen(0.2))
    assert [step for step, _ in merger.closed()] == [0.1]


# --- jumps in time ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [100.0, 3000.0, 1e9, 1e11, -1e11])
@pytest.mark.parametrize("place", [5, 20, 40])
def test_one_wrong_time_costs_one_record_and_no_others(far, place):
    said = []
    times = [k / 10 for k in range(41)]
    steps, merger = merged([*times[:place], far, *times[place:]], rate=10.0, say=said.append)
    assert [t for _, inside in steps for t in inside if t < 5 and t >= 0] == times
    assert len(steps) <= 42
    assert len(said) == (1 if far > 0 else 0)
    assert not merger.late or far < 0


@given(st.lists(st.floats(-1e11, 1e11), min_size=1, max_size=8), st.sampled_from([None, 0.01, 10.0]))
@settings(max_examples=40, deadline=None)
def test_there_are_no_more_steps_than_the_records_justify(times, rate):
    steps, merger = merged(times, rate=rate)
    most = 10.0 * merger.rate + 2 if merger.rate else 0
    assert len(steps) <= len(times) * most


@pytest.mark.parametrize("time", [1.1e11, 1e300, float("inf"), float("nan")])
def test_a_time_that_no_clock_can_reach_is_refused(time):
    with pytest.raises(ValueError, match="within 1e"):
        track(None, [seen(time)])


# --- arrival ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_records_does_not_depend_on_their_arrival(seed):
    rng = np.random.default_rng(seed)
    times = [np.sort(rng.uniform(0, 20, rng.integers(0, 600))).round(1).tolist() for _ in range(3)]
    pipes = [os.pipe() for _ in times]

    def write(number):
        data = b"".join(b"%300.1f\n" % t for t in times[number])
        chunks = np.random.default_rng(seed + number)
        with open(pipes[number][1], "wb", buffering=0) as stream:
            while data:
                size = int(chunks.integers(1, 9000))
                stream.write(data[:size])
                data = data[size:]

    def read(number, stream):
        return (seen(float(text), f"s{number}") for text in stream)

    writers = [threading.Thread(target=write, args=(k,)) for k in range(3)]
    for writer in writers:
        writer.start()
    arrivals = Arrivals(["a", "b", "c"], [os.fdopen(end, "rb", 0) for end, _ in pipes], read)
    arrived = [(k, None if one is None else one.timestamp) for k, one in in_turn([arrivals.of(k) for k in range(3)])]
    for writer in writers:
        writer.join()
    in_files = in_turn([iter([seen(t, f"s{k}") for t in times[k]]) for k in range(3)])
    assert arrived == [(k, None if one is None else one.timestamp) for k, one in in_files]


def test_a_fault_in_one_pipe_is_raised_where_its_item_is_wanted():
    ends = [os.pipe() for _ in range(2)]
    arrivals = Arrivals(["a", "b"], [os.fdopen(end, "rb", 0) for end, _ in ends], lambda k, s: map(int, s))
    os.write(ends[0][1], b"1\n")
    os.write(ends[1][1], b"2\nthree\n")
    assert next(arrivals.of(1)) == 2
    assert next(arrivals.of(0)) == 1
    with pytest.raises(ValueError, match="three"):
        next(arrivals.of(1))
    for _, end in ends:
        os.close(end)


# --- live -------------------------------------------------------------------------------------------------------------


class Live:
    """A live merger whose wall clock the test moves."""

    def __init__(self, sources=("in",), **how):
        self.wall, self.said = 1000.0, []
        self.merger = LiveMerger(list(sources), **{"rate": 10.0, **how}, say=self.said.append, clock=lambda: self.wall)

    def now(self, time, sensor="video", source=0):
        """Steps that close when a record comes now."""
        return self._closed([(source, seen(time, sensor))])

    def after(self, seconds):
        """Steps that close in so much time without a record."""
        out, until = [], self.wall + seconds
        while (due := self.merger.due()) is not None and self.wall + due <= until:
            self.wall += due
            out += self._closed([None])
        self.wall = until
        return out + self._closed([None])

    def _closed(self, events):
        return [round(step, 6) for event in events for step, _ in self.merger.steps([event])]


def test_live_a_record_at_the_tick_closes_the_tick():
    live = Live()
    for k in range(20):
        assert live.now(k / 10) == [k / 10]
        assert live.after(0.1) == []
    assert live.said == []


def test_live_a_step_waits_for_every_sensor_that_is_present():
    live = Live()
    assert live.now(0.0) == [0.0]  # the other sensor is not known yet
    assert live.now(0.0, "audio") == []
    for k in range(1, 9):
        assert live.now(k / 10) == []
        assert live.after(0.06) == []
        assert live.now(k / 10, "audio") == [k / 10]
        live.after(0.04)
    assert live.said == []
    assert not live.merger.late


def test_live_a_quiet_sensor_is_left_behind_and_taken_up_again():
    live = Live(["a.fifo", "v.fifo"])
    for k in range(10):
        assert live.now(k / 10, "audio", 0) == []
        assert live.now(k / 10, "video", 1) == [k / 10]
        live.after(0.1)
    held = []
    for k in range(10, 30):
        held += live.now(k / 10, "video", 1)
        assert k >= 20 or live.merger.tick * 0.1 > k / 10 - 1.0
        held += live.after(0.1)
    assert np.allclose(held, np.arange(10, 30) / 10)
    assert live.said == ["sensor 'audio' has been quiet for more than 1 s (--max-wait); its records are not waited for"]
    assert live.now(3.0, "audio", 0) == []
    assert live.said[1:] == ["sensor 'audio' is back; its records are waited for again"]
    assert live.now(3.0, "video", 1) == [3.0]
    assert live.now(3.1, "video", 1) == []
    assert live.now(3.1, "audio", 0) == [3.1]


def test_live_the_end_of_the_only_source_that_spoke_holds_nothing_back():
    live = Live(["a.fifo", "v.fifo"], rate=1.0)
    out = [step for k in range(3) for step in live.now(float(k), "video", 1)]
    live.merger.end(1)
    assert out + live.after(1.5) == [0.0, 1.0, 2.0]
    assert live.after(5.0) == []


def test_live_a_source_that_never_speaks_is_left_behind():
    live = Live(["a.fifo", "v.fifo"])
    assert live.now(0.0, "video", 1) == []
    assert live.after(0.9) == []
    assert live.after(0.2) == [0.0]
    assert live.said[1:] == ["a.fifo has no record after 1 s (--max-wait); it is not waited for"]


def test_live_the_clock_goes_on_while_all_are_silent_and_no_further():
    live = Live()
    for k in range(5):
        live.now(k / 10)
        live.after(0.1)
    out = live.after(60.0)
    assert len(out) == pytest.approx(591, abs=2)  # 60 s less --max-wait, and what the last step took
    assert np.allclose(np.diff(out), 0.1)
    assert live.now(60.5)[-1] == 60.5
    assert len(live.said) == 2


def tenths(begin, end, *sensors):
    """Records of sensors at 10 Hz: (sensor, time), in the order in which they are sent."""
    return [(sensor, k / 10) for k in range(10 * begin, 10 * end) for sensor in sensors]


def merged_sensors(events, sources, *, live):
    """Merge records (sensor, time) that come as their times go on; [(step, times in it)], sentences, merger."""
    now, said = [0.0], []
    names = sorted(set(sources.values()))
    merger = LiveMerger(names, 10.0, clock=lambda: now[0]) if live else Merger(names, 10.0)
    merger.say = said.append

    def sent():
        if not live:
            yield from in_turn([iter([seen(t, s) for s, t in events if sources[s] == name]) for name in names])
            return
        before = events[0][1]
        for sensor, time in events:
            now[0] += 0.1 * (time != before)
            before = time
            yield names.index(sources[sensor]), seen(time, sensor)
            yield None
        for source in range(len(names)):
            yield source, None

    return [(round(t, 6), [at for at, *_ in inside]) for t, inside in merger.steps(sent())], said, merger


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("sources", [{"audio": "both", "video": "both"}, {"audio": "a", "video": "v"}])
@pytest.mark.parametrize("after", [("audio", "video"), ("video",)])
def test_a_clock_that_was_set_back_loses_no_record(live, sources, after):
    events = tenths(7200, 7204, "audio", "video") + tenths(100, 104, *after)
    steps, said, merger = merged_sensors(events, sources, live=live)
    assert [t for t, _ in steps] == [k / 10 for begin in (72000, 1000) for k in range(begin, begin + 40)]
    assert sum(len(inside) for _, inside in steps[1:]) == 78 + 40 * len(after)
    assert "time goes back from 7203.9000 to 100.0000 s; the tracks go on from there" in said
    assert merger.late.total() <= live, "nobody waits for the first record of all of a sensor"


@pytest.mark.parametrize("live", [False, True])
def test_a_sensor_whose_clock_alone_was_set_back_is_ignored_while_the_other_goes_on(live):
    both = itertools.chain.from_iterable(zip(tenths(0, 10, "audio"), tenths(7204, 7214, "video"), strict=True))
    events = [*tenths(7200, 7204, "audio", "video"), *both]
    steps, _, merger = merged_sensors(events, {"audio": "both", "video": "both"}, live=live)
    assert [t for t, _ in steps] == [k / 10 for k in range(72000, 72140)]
    assert merger.late["audio"] == 100
    assert len(merger.set_back.records[0, "audio"]) <= 21, "nothing piles up"


def test_files_whose_clocks_were_set_back_are_read_in_turn_before_and_after():
    times = [*range(7200, 7260), *range(60)]
    read = [one.timestamp for _, one in in_turn([map(seen, times), map(seen, times)]) if one is not None]
    assert sum(time < 100 for time in read[:120]) <= 4
    tracks = track(None, *([seen(t, name) for t in times] for name in ("camera", "ring")))
    assert np.allclose([one.timestamp for one in tracks], times)


@pytest.mark.parametrize("lag", [0, 5, np.inf])
def test_people_stay_who_they_were_when_a_clock_is_set_back(lag):
    nan, times = np.full((1, 3, 3), np.nan), [*np.arange(7200, 7203, 0.1), *np.arange(60, 63, 0.1)]
    places = [np.array([[1 + k / 20, 2.0, 0.0]]) for k in range(len(times))]
    walk = [
        Detections(t, "ceiling", place, nan, np.array([0.9]), "camera") for t, place in zip(times, places, strict=True)
    ]
    tracks = track(None, walk, lag=lag)
    assert np.allclose([one.timestamp for one in tracks], times)
    assert np.allclose([one.last_seen[0] for one in tracks], times)
    assert {one.ids.tolist()[0] for one in tracks} == {0}
    assert np.abs([one.positions[0] - place for one, place in zip(tracks[5:], places[5:], strict=True)]).max() < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_records_in_disorder_are_no_clock_that_was_set_back(seed):
    order = np.random.default_rng(seed).permutation(500).tolist()
    for times in (order, sorted(order, reverse=True)):
        steps, _ = merged([0.0, *times], rate=1.0)
        assert np.all(np.diff([step for step, _ in steps]) > 0)


def test_live_one_wrong_time_is_ignored_at_the_end_too():
    events = [("video", time) for time in [0.0, 0.1, 0.2, 9000.0, 0.3, 0.4, 0.5]]
    steps, _, _ = merged_sensors(events, {"video": "v"}, live=True)
    assert [t for t, _ in steps] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]


def test_live_one_wrong_time_is_ignored():
    live = Live()
    out = []
    for k in range(30):
        out += live.now(k / 10)
        if k == 10:
            out += live.now(3000.0)
        out += live.after(0.1)
    assert out == [k / 10 for k in range(30)]
    assert live.said == ["sensor 'video': a record with a time far ahead of the others was ignored"]
    assert not live.merger.records


def test_live_a_clock_that_was_set_forward_is_believed_after_some_records():
    live = Live()
    out = []
    for k in range(30):
        out += live.now(k / 10 + (3600.0 if k >= 10 else 0.0))
        live.after(0.1)
    assert len(out) <= 30
    assert out[-1] == 3602.9
    assert any("go on with the next record" in text for text in live.said)


def test_live_a_sensor_that_lags_is_left_behind_though_it_speaks():
    live = Live()
    live.now(0.0)
    live.now(0.0, "audio")
    out = []
    for k in range(1, 60):  # audio delivers at a third of the pace
        out += live.now(k / 10)
        if k % 3 == 0:
            out += live.now(k / 30, "audio")
        live.after(0.1)
    assert out[-1] == 5.9
    assert live.said[0] == "sensor 'audio' lags more than 1 s (--max-wait); its records are not waited for"


def test_live_what_has_piled_up_is_taken_as_a_whole():
    live = Live(["a", "v"])
    out = [step for k in range(50) for step in live.now(k / 10, "audio", 0)]  # all at once, as after a stop
    out += [step for k in range(50) for step in live.now(k / 10, "video", 1)]
    assert out == [k / 10 for k in range(50)]
    assert live.said == []
    assert not live.merger.late


def test_live_a_sensor_is_not_quiet_while_its_records_wait_for_a_slow_tracker():
    live = Live(["a", "v"])
    out = []
    for k in range(60):
        out += live.now(k % 30 / 10, ["audio", "video"][k // 30], k // 30)
        live.wall += 0.1
    assert out == [k / 10 for k in range(30)]
    assert live.said == []


def test_live_with_infinite_patience_waits():
    live = Live(["a", "v"], max_wait=float("inf"))
    for k in range(5):
        assert live.now(k / 10, source=1) == []
    assert live.merger.due() is None
    assert live.now(0.0, "audio", 0) == [0.0]


SPARSE = [0.0, 0.7, 1.2, 1.8, 2.3, 2.5, 2.8, 3.3, 3.5, 3.6, 3.7, 3.8, 3.9, 4.0, 4.1]  # 10 Hz, empty records left out


def test_the_rate_is_found_where_records_of_nobody_are_missing():
    said = []
    steps, merger = merged(SPARSE, say=said.append)
    assert merger.rate == 10
    assert [step for step, _ in steps] == [round(k / 10, 9) for k in range(42)]
    assert not said
    live = Live(rate=None)
    for before, now in itertools.pairwise(SPARSE):
        live.now(before)
        live.after(now - before)
    assert live.merger.rate == 10


@pytest.mark.parametrize(("rate", "share", "digits"), [(10, 0.3, 3), (25, 0.5, 9), (29.97, 0.7, 9)])
def test_a_clock_with_missing_records_does_not_run_away(rate, share, digits):
    rng = np.random.default_rng(0)
    for _ in range(20):
        stamps = (np.flatnonzero(rng.random(2000) < share) / rate + 5.0).round(digits)
        _, merger = merged(stamps[stamps < 25])
        assert merger.rate == pytest.approx(rate, rel=1e-4)


def test_times_that_tell_no_rate_are_said():
    said = []
    merged(np.cumsum(np.random.default_rng(1).exponential(0.4, 30)).tolist(), say=said.append)
    assert said[0].startswith("the times of the records do not tell a rate; tracks are written at ")


def test_two_records_of_one_moment_are_no_fast_clock():
    times = sorted([k / 10 for k in range(40)] + [k / 10 + 0.001 for k in range(0, 40, 8)])
    assert merged(times)[1].rate == pytest.approx(10, rel=2e-3)


def test_live_without_a_rate_begins_when_the_rate_shows():
    live = Live(rate=None)
    steps = [live.now(k / 25) for k in range(10)]
    assert list(itertools.chain(*steps)) == [round(k / 25, 6) for k in range(10)]
    assert steps[8]
    alone = Live(rate=None)
    assert alone.now(0.0) == []
    assert alone.after(1.1)[0] == 0.0
