"""Pictures of several cameras are put together by time stamps, never across instants; missing ones are reported."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from sphereorient.errors import MovieError
from sphereorient.live.feed import Arrival
from sphereorient.live.instants import Instants, RawPicture


@dataclass(frozen=True)
class Rig:
    """Cameras on one trigger; their clocks begin anywhere and drift. Each picture holds the number of its trigger."""

    seed: int = 0
    cameras: int = 2
    rate_hz: float = 200.0
    count: int = 400
    uneven: float = 0.0  # share of the interval by which triggers come early or late
    jitter: float = 0.3  # mean delay, intervals
    lost: float = 0.0  # share of triggers that a camera does not take
    dropped: float = 0.0  # share of pictures that are lost on the way
    doubled: float = 0.0  # share that comes twice, or of which the trigger bounces
    held_up: float = 0.0  # share that comes 5 to 30 intervals late, with those behind it
    begins: tuple[int, ...] = ()  # trigger at which each camera begins

    def pictures(self) -> list[tuple[int, int, RawPicture]]:
        """Return camera, trigger and picture, in order of arrival."""
        random, step_s, found = np.random.default_rng(self.seed), 1 / self.rate_hz, []
        triggers_s = np.cumsum(step_s * (1 + self.uneven * random.uniform(-1, 1, self.count)))
        for camera in range(self.cameras):
            zero_s, rate, counter, arrived_s = random.uniform(-1e4, 1e4), 1 + 5e-5 * random.uniform(-1, 1), 0, 0.0
            for k, at_s in enumerate(triggers_s):
                if (self.begins and k < self.begins[camera]) or random.random() < self.lost:
                    continue
                counter += 1
                if random.random() < self.dropped:
                    continue
                delay = random.exponential(self.jitter) + (random.random() < self.held_up) * random.uniform(5, 30)
                arrived_s = max(at_s + 0.002 + step_s * delay, arrived_s + 1e-5)
                stamp_s, picture = zero_s + rate * at_s + 1e-6 * random.normal(), np.full((1, 1), k)
                found.append(
                    (camera, k, RawPicture(picture=picture, arrived_s=arrived_s, stamp_s=stamp_s, counter=counter))
                )
                if random.random() < self.doubled:
                    bounced = random.random() < 0.5
                    counter, stamp_s, arrived_s = counter + bounced, stamp_s + 0.05 * step_s * bounced, arrived_s + 1e-4
                    again = RawPicture(picture=picture, arrived_s=arrived_s, stamp_s=stamp_s, counter=counter)
                    found.append((camera, k, again))
        return sorted(found, key=lambda one: one[2].arrived_s)


def played(pictures: list[tuple[int, int, RawPicture]], cameras: int, messages: list[str]) -> Iterator[Arrival]:
    instants = Instants([f"cam{k + 1}" for k in range(cameras)], messages.append)
    for camera, _, raw in pictures:
        while instants.due_s < raw.arrived_s:
            yield from instants.ready(instants.due_s)
        instants.take(camera, raw)
        yield from instants.ready(raw.arrived_s)


def triggers(arrival: Arrival) -> list[int | None]:
    return [None if picture is None else int(picture[0, 0]) for picture in arrival.pictures]


def together(rig: Rig) -> tuple[list[list[int | None]], list[str]]:
    """Return the triggers of each instant's pictures, after checks that hold for all rigs, and the messages."""
    messages: list[str] = []
    found = list(played(rig.pictures(), rig.cameras, messages))
    shown = [triggers(one) for one in found]
    assert all(len({k for k in row if k is not None}) == 1 for row in shown), "a picture of another instant"
    assert all(a.number < b.number and a.time_s < b.time_s for a, b in pairwise(found))
    for camera in range(rig.cameras):
        used = [row[camera] for row in shown[2:] if row[camera] is not None]  # first, no interval is known
        assert used == sorted(set(used)), "each once, in order"
    return shown, messages


def whole(shown: list[list[int | None]]) -> float:
    return np.mean([None not in row for row in shown])


def test_pictures_of_one_trigger_are_one_instant_with_any_clocks():
    shown, messages = together(Rig())
    assert whole(shown[20:]) == 1
    assert shown[-1] == [399, 399]
    assert messages == []


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("rig", "share"),
    [
        ({"lost": 0.02, "dropped": 0.02, "doubled": 0.02}, 0.85),
        ({"lost": 0.02, "doubled": 0.02, "cameras": 4}, 0.8),
        ({"jitter": 1.0, "rate_hz": 500.0, "begins": (0, 21)}, 0.85),
        ({"jitter": 2.0, "rate_hz": 500.0, "begins": (13, 0)}, 0.1),
        ({"held_up": 0.01}, 0.4),
        ({"uneven": 0.8, "lost": 0.02}, 0.85),
        ({"lost": 0.1, "dropped": 0.1, "doubled": 0.1, "held_up": 0.02}, 0.02),
    ],
)
def test_nothing_of_another_instant_comes_in(rig, share, seed):
    shown, _ = together(Rig(seed=seed, **rig))
    assert whole(shown) > share


def test_what_is_missing_is_counted_and_reported_in_few_lines():
    rig = Rig(seed=1, count=4000, lost=0.01, doubled=0.01, begins=(0, 0))
    pictures, messages = rig.pictures(), []
    shown = [triggers(one) for one in played(pictures, 2, messages)]
    assert 2 <= len(messages) <= 3, "20 s"
    counts = {what: int(count) for what, count in re.findall(r"(cam\d \w+) (\d+)", messages[-1])}
    until_s = 10.0  # a line may be 10 s old
    twice = sum(a[:2] == b[:2] for a, b in pairwise(sorted(pictures, key=lambda a: a[:2])) if a[2].arrived_s < until_s)
    assert counts["cam1 doubled"] + counts["cam2 doubled"] >= twice > 0
    assert 0 < counts["cam2 missing"] <= sum(row[1] is None for row in shown)


def times(camera: int, stamps: list[float], zero_s: float = 0.0) -> list[tuple[int, int, RawPicture]]:
    """Return pictures that arrive 1 ms after they were taken."""
    raw = [
        RawPicture(picture=np.full((1, 1), round(100 * at_s)), arrived_s=at_s + 0.001, stamp_s=at_s + zero_s)
        for at_s in stamps
    ]
    return [(camera, k, one) for k, one in enumerate(raw)]


def test_a_lost_trigger_costs_one_picture_and_no_wait():
    stamps = (0.01 * np.arange(40)).tolist()
    both = times(0, stamps) + times(1, [at_s for k, at_s in enumerate(stamps) if k != 30], 500.0)
    messages: list[str] = []
    found = [triggers(one) for one in played(sorted(both, key=lambda one: one[2].arrived_s), 2, messages)]
    assert found[30] == [30, None]
    assert found[20:30] + found[31:] == [[k, k] for k in [*range(20, 30), *range(31, 40)]]
    assert "cam2 missing 1;" in messages[-1]


def test_an_instant_waits_one_interval_for_a_late_picture_which_is_not_used_then():
    stamps = (0.01 * np.arange(40)).tolist()
    one, other = times(0, stamps), times(1, stamps, -70.0)
    raw = other[30][2]
    other[30] = (1, 30, RawPicture(picture=raw.picture, arrived_s=raw.arrived_s + 0.0105, stamp_s=raw.stamp_s))
    messages: list[str] = []
    instants = Instants(["cam1", "cam2"], messages.append)
    for camera, _, each in sorted(one[:31] + other[:30], key=lambda one: one[2].arrived_s):
        instants.take(camera, each)
        list(instants.ready(each.arrived_s))
    assert instants.due_s == pytest.approx(0.301 + 0.01)
    assert [triggers(one) for one in instants.ready(instants.due_s)] == [[30, None]]
    instants.take(1, other[30][2])
    assert list(instants.ready(other[30][2].arrived_s)) == []
    instants.take(0, one[31][2])
    instants.take(1, other[31][2])
    assert [triggers(one) for one in instants.ready(1.0)] == [[31, 31]]
    assert "cam2 late 1" in last_message(messages, instants)


def last_message(messages: list[str], instants: Instants) -> str:
    list(instants.ready(1e6))
    return messages[-1]


def test_no_instant_waits_for_a_camera_that_is_silent_and_it_comes_back_into_step():
    stamps = (0.01 * np.arange(200)).tolist()
    both = times(0, stamps) + times(1, stamps[:50] + stamps[120:], 3.0)
    found = [triggers(one) for one in played(sorted(both, key=lambda one: one[2].arrived_s), 2, [])]
    assert found[60:120] == [[k, None] for k in range(60, 120)]
    assert found[121:] == [[k, k] for k in range(121, 200)]


def test_a_camera_that_stops_without_a_word_holds_up_no_other():
    both = times(0, [0.0, 0.01, 0.02]) + times(1, (0.01 * np.arange(200)).tolist(), 3.0)
    found = [triggers(one) for one in played(sorted(both, key=lambda one: one[2].arrived_s), 2, [])]
    assert found[-80:] == [[None, k] for k in range(120, 200)]


def test_a_device_that_is_opened_again_comes_into_step_by_its_new_clock():
    stamps = (0.01 * np.arange(200)).tolist()
    instants, found = Instants(["cam1", "cam2"], [].append), []
    both = times(0, stamps[:50]) + times(0, stamps[100:], 1e5) + times(1, stamps, 3.0)
    for camera, k, raw in sorted(both, key=lambda one: one[2].arrived_s):
        if (camera, k) == (0, 0):
            instants.restart(0)
        instants.take(camera, raw)
        found += [triggers(one) for one in instants.ready(raw.arrived_s)]
    assert found[60:100] == [[None, k] for k in range(60, 100)]
    assert found[120:] == [[k, k] for k in range(120, 200)]


def test_after_a_pause_that_clocks_do_not_bridge_cameras_come_into_step_again():
    stamps = (0.01 * np.arange(40)).tolist()
    later = (1000 + 0.01 * np.arange(60)).tolist()
    drifted = [
        (1, k, RawPicture(picture=raw.picture, arrived_s=raw.arrived_s, stamp_s=raw.stamp_s + 0.05))
        for _, k, raw in times(1, later, 3.0)
    ]
    both = times(0, stamps + later) + times(1, stamps, 3.0) + drifted
    found = [triggers(one) for one in played(sorted(both, key=lambda one: one[2].arrived_s), 2, [])]
    assert all(len(set(row) - {None}) == 1 for row in found)
    assert found[-30:] == [[k, k] for k in range(100_030, 100_060)]


def test_the_counter_of_one_camera_shows_what_was_lost_on_the_way():
    messages: list[str] = []
    instants = Instants(["cam1"], messages.append)
    found = []
    for counter in (7, 8, 8, 11):
        at_s = 0.01 * counter
        instants.take(0, RawPicture(picture=np.zeros((1, 1)), arrived_s=5 + at_s, stamp_s=at_s, counter=counter))
        found += instants.ready(5 + at_s)
    assert [one.number for one in found] == [0, 1, 4]
    assert np.diff([one.time_s for one in found]) == pytest.approx([0.01, 0.03])
    assert "cam1 doubled 1" in messages[0]
    assert "cam1 missing 2" in last_message(messages, instants)


def test_a_picture_that_is_not_whole_is_none_and_its_instant_does_not_wait():
    messages: list[str] = []
    instants = Instants(["cam1"], messages.append)
    instants.take(0, RawPicture(picture=None, arrived_s=1.0, stamp_s=1.0))
    (found,) = instants.ready(1.0)
    assert found.pictures == [None]
    assert "cam1 incomplete 1" in messages[0]


def test_several_cameras_need_clocks():
    instants, raw = Instants(["cam1", "cam2"], print), RawPicture(picture=np.zeros((1, 1)), arrived_s=1.0, counter=3)
    instants.take(1, raw)
    with pytest.raises(MovieError, match="cam2: expected time stamps"):
        instants.take(1, raw)


def test_pictures_that_cameras_lose_one_after_the_other_are_no_lost_instants():
    """On the way are lost: of cam2 picture 60, of cam1 picture 61, of both picture 70."""
    both = []
    for camera in (0, 1):
        for _, k, raw in times(camera, (0.01 * np.arange(100)).tolist(), 500.0 * camera):
            if (camera, k) not in [(1, 60), (0, 61), (0, 70), (1, 70)]:
                both.append((camera, k, replace(raw, counter=k + 1)))
    found = list(played(sorted(both, key=lambda one: one[2].arrived_s), 2, []))
    assert [triggers(one) for one in found[60:63]] == [[60, None], [None, 61], [62, 62]]
    assert [one.number for one in found[20:]] == [k for k in range(20, 100) if k != 70]
