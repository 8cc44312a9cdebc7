"""The playground's sessions, without sockets: pressure, wave and hand, and what is no message."""

import json
import struct

import numpy as np
import pytest

from turgor.errors import InvalidInput
from turgor.simulate import Simulator
from turgor.web.session import HAND_STRENGTH, Control, Drag, Session, Start, Wave, read


def drive(session: Session, seconds: float) -> Session:
    for _ in range(round(60 * seconds)):
        session.step()
    return session


def area_ratio(session: Session) -> float:
    return struct.unpack("<3f", session.frame()[:12])[2]


@pytest.mark.parametrize("body", ["small", "medium", "large"])
def test_the_pressure_is_what_it_is_told_half_a_second_later_and_moves_the_area(body: str) -> None:
    session = drive(Session(Start(task="flat", body=body)), 2)
    low, high = session.task.pressure_range[0]
    areas = []
    for share in (1.0, 0.0, 0.5):
        session.tell(Control(share))
        drive(session, 0.51)
        np.testing.assert_allclose(session.stand.pressure[0, 0], low + share * (high - low), rtol=1e-5)
        areas.append(area_ratio(drive(session, 1.5)))
    assert areas[0] > 0.8
    assert areas[1] < areas[0] - 0.2


def test_an_agent_that_is_told_nothing_stays_as_it_is() -> None:
    session = Session(Start(task="flat"))
    pressure = session.stand.pressure[0, 0]
    drive(session, 3)
    assert session.stand.pressure[0, 0] == pytest.approx(pressure, rel=1e-5)
    assert abs(session.com[0]) < 0.1


@pytest.mark.parametrize("task", ["flat", "hilly"])
def test_a_wave_moves_the_agent(task: str) -> None:
    session = Session(Start(task=task))
    session.tell(Control(0.5, Wave(amplitude=1.0, frequency=1.2, length=1.0, direction=-1)))
    before = session.com[0]
    assert abs(drive(session, 10).com[0] - before) > 0.5


def test_the_wave_is_the_one_of_the_formula() -> None:
    session = Session(Start(task="flat"))
    session.tell(Control(0.5, Wave(amplitude=0.7, frequency=1.5, length=2.0, direction=1)))
    drive(session, 0.5)
    t, j = 29 / 60, np.arange(10)
    expected = 0.7 * np.sin(2 * np.pi * (1.5 * t - 2 * j / 10))
    np.testing.assert_allclose(session._commands[0, :10], expected, atol=1e-5)


def test_a_hand_pulls_a_mass_where_it_points_and_carries_the_body() -> None:
    for body in ("small", "large"):
        session = drive(Session(Start(task="flat", body=body)), 1)
        target = session.com + [5.0, 30.0]
        session.drag(Drag(3, *target.tolist()))
        drive(session, 4)
        assert np.linalg.norm(session.stand.position[0, 3] - target) < 1.5
        assert session.com[1] > 15
        session.drag(None)
        drive(session, 4)
        assert session.com[1] < 12


@pytest.mark.parametrize("far", [1e9, -1e300])
def test_a_hand_is_strong_but_not_endless(far: float) -> None:
    session = Session(Start(task="flat", gravity=0.0))
    session.drag(Drag(0, far, far))
    drive(session, 1)
    assert np.isfinite(session.stand.stand).all()
    momentum = session._share @ session.stand.velocity[0].astype(np.float64)
    assert np.linalg.norm(momentum) <= HAND_STRENGTH * 1.01
    with pytest.raises(InvalidInput, match="mass: expected 0 to 9; got 10"):
        session.drag(Drag(10, 0.0, 0.0))


def test_the_same_messages_at_the_same_steps_give_the_same_bits() -> None:
    def story() -> list[bytes]:
        session, frames = Session(Start(task="hilly", seed=3, gravity=7.0, frequency=6.0)), []
        random = np.random.default_rng(5)
        for k in range(600):
            if k % 40 == 0:
                wave = Wave(*random.uniform(0, 1, 3).tolist(), direction=int(random.choice([-1, 1])))
                session.tell(Control(float(random.uniform()), wave))
            if k % 90 == 10:
                session.drag(Drag(int(random.integers(10)), *(session.com + random.uniform(-9, 9, 2)).tolist()))
            if k % 90 == 60:
                session.drag(None)
            if k == 400:
                session.restart()
            session.step()
            frames.append(session.frame())
        return frames

    assert story() == story()


def test_a_session_without_a_hand_is_the_same_bits_as_the_simulator() -> None:
    session = Session(Start(task="hilly", body="medium", seed=1))
    session.tell(Control(0.3, Wave(0.8, 1.0, 1.0, 1)))
    simulator, seen = Simulator(session.task, threads=2), None
    simulator.reset(20)
    for _ in range(100):
        session.step()
        seen = simulator.step(np.repeat(session._commands, 20, axis=0))
    assert seen is not None
    assert seen.position[7].tobytes() == session.stand.position[0].tobytes()


def test_numbers_beyond_what_is_possible_are_cut() -> None:
    session = Session(Start(task="flat", gravity=1e9, frequency=-3.0))
    assert (session.start.gravity, session.start.frequency) == (30.0, 1.0)
    session.tell(Control(-5.0, Wave(9.0, 1e300, -1.0, 1)))
    assert session.control == Control(0.0, Wave(1.0, 4.0, 0.0, 1))
    drive(session, 2)
    assert np.isfinite(session.stand.stand).all()


def test_an_agent_that_fell_off_the_world_is_lost() -> None:
    session = Session(Start(task="flat"))
    assert not session.lost
    session.stand.position[0, :, 1] -= 200
    assert session.lost
    session.stand.position[:] = np.nan
    assert session.lost


def test_a_scene_tells_all_that_a_page_needs() -> None:
    scene = json.loads(Session(Start(task="escape", body="large")).scene())
    assert (scene["type"], scene["masses"], len(scene["springs"]), scene["end"]) == ("scene", 20, 20, 16.0)
    assert len(scene["scene"]["segments"]) == len(scene["scene"]["depth"]) == 9
    assert scene["start"] == {
        "type": "start", "task": "escape", "body": "large", "seed": 0, "gravity": 10.0, "frequency": 8.0,
    }  # fmt: skip
    assert len(Session(Start(body="large")).frame()) == 4 * (3 + 40) + 20


MALFORMED = [
    "", "nonsense", "[]", "1", "null", "{}", '{"type":"x"}', '{"type":5}',
    '{"type":"pause"}', '{"type":"pause","on":1}',
    '{"type":"reset","more":1}', '{"type":"control"}', '{"type":"control","pressure":"high"}',
    '{"type":"control","pressure":NaN}', '{"type":"control","pressure":1e999}', '{"type":"control","pressure":null}',
    '{"type":"control","pressure":0.5,"wave":{"direction":0}}', '{"type":"control","pressure":0.5,"wave":[1]}',
    '{"type":"start","task":"moon"}', '{"type":"start","seed":-1}', '{"type":"start","seed":1.5}',
    '{"type":"start","seed":%s}' % ("9" * 300), '{"type":"start","body":"huge"}', '{"type":"drag","mass":0,"x":0}',
    '{"type":"drag","mass":-1,"x":0,"y":0}', '{"type":"drag","mass":99999999999999999999,"x":0,"y":0}',
    "[" * 4000, '{"a":' * 700, " " * 5000, '{"type":"pause","on":true}' + " " * 4096, "\x00", "\ud800", "💥" * 50,
]  # fmt: skip


@pytest.mark.parametrize("text", MALFORMED, ids=range(len(MALFORMED)))
def test_what_is_no_message_is_refused_in_one_line(text: str) -> None:
    def take() -> None:
        message = read({"type": "websocket.receive", "text": text})
        Session(message) if isinstance(message, Start) else Session(Start()).drag(message)

    with pytest.raises(InvalidInput) as error:
        take()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 150
