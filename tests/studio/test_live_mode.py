"""The live mode of a window, with and without protection."""

import http.client
import json
import time
from urllib.parse import urlsplit

import numpy as np
import pytest

import salver as sv
from salver.scenario import SCENARIO_DIR
from salver.studio.live_mode import LiveMode
from salver.studio.server import Studio
from salver.studio.words import compared
from studio_windows import CUBE, asked, say


@pytest.mark.slow
def test_the_live_mode_of_a_window_is_its_own_and_ends_when_nobody_watches_it(tmp_path):
    with Studio(CUBE, tmp_path / "cube.toml", SCENARIO_DIR, true={"mass": 0.25}) as studio:
        assert "Line" in say(studio, "live", text=CUBE.replace("mass = 0.256", "mass = -1", 1), window="one")["problem"]
        assert "There is no message" in say(studio, "hand", window="one", say={"stop": True})["problem"]
        frame = say(studio, "live", text=CUBE, window="one")["frame"]
        assert frame["verdict"][1] == "The arm rests."
        assert not say(studio, "hand", window="one", say={"goto": [9, 9]})["ok"]
        place = urlsplit(studio.url)
        line = http.client.HTTPConnection(place.hostname, place.port, timeout=60)
        line.request("GET", place.path + "frames/one")
        answer = line.getresponse()
        first = json.loads(answer.readline().removeprefix(b"data: "))
        assert say(studio, "hand", window="one", say={"twist": [0.0, 0.1, 0.0, 0.0]})["ok"]
        assert asked(studio, "GET", place.path + "frames/two")[0] == 404
        for _ in range(40):
            frame = json.loads(answer.readline().removeprefix(b"data: ")) if answer.readline() else frame
        assert frame["t"] > first["t"]
        answer.close()
        line.close()
        end = time.monotonic() + 60
        while studio.lives:
            assert time.monotonic() < end
            time.sleep(0.05)


@pytest.mark.slow
def test_the_same_hand_keeps_the_load_of_one_arm_and_loses_that_of_the_other():
    live = LiveMode(sv.load_scenario("panda-tall-bottle"), {"com_z": 0.003})
    try:
        frame = live.frame()
        assert [(title, line) for title, line, _ in frame["names"]] == [("salver", ""), ("without protection", "")]
        for k in range(80):
            assert live.say({"twist": [0.0, 0.4 * (-1) ** (k // 10), 0.0, 0.0]}).ok  # to and fro
            for _ in range(round(0.02 / live.world.period)):
                live.world.advance()
            time.sleep(0.01)  # for the planner
            frame = live.frame()
            if frame["beside"][0]["gone"]:
                break
        (kept, lost), (beside,) = frame["names"], frame["beside"]
        since = live.world.t - live._moved
        assert kept[1] == f"In place for {since:.1f} s."
        assert beside["load"][0]["became"] == "fallen"
        assert lost[1] == f"The bottle has fallen over, lost {since:.1f} s after the hand's first move."
        assert "a what-if" in lost[2]
        assert "lost 1 ×" in lost[2]
        assert beside["t"] + live._later == pytest.approx(live.world.t, abs=2 * live.world.period)
        assert "lost 1 ×" in live.frame()["names"][1][2]  # once, however long it lies there
        assert live.say({"again": True}).ok
        again = live.frame()
        assert again["beside"][0]["t"] + live._later == pytest.approx(live.world.t, abs=2 * live.world.period)
        assert [line for _, line, _ in again["names"]] == ["", ""]
        assert "lost 1 ×" in again["names"][1][2]  # the score goes on
        np.testing.assert_allclose(again["beside"][0]["tray"], again["tray"], atol=1e-3)
        assert live.say({"stop": True}).ok  # it stops both arms, until it is lifted
        assert not live.say({"twist": [0.0, 0.4, 0.0, 0.0]}).ok
        for _ in range(100):
            live.world.advance()
        still = live.frame()
        np.testing.assert_allclose(still["beside"][0]["tray"], again["tray"], atol=1e-3)
        assert [line for _, line, _ in still["names"]] == ["", ""]
        assert live.say({"beside": False}).ok
        assert live.frame()["beside"] == []
    finally:
        live.close()


def test_the_score_has_the_soonest_loss_of_all_rounds():
    frame = {"protected": False, "load": []}
    assert compared(frame, 2.0, None, "", [0.8, 0.3, 0.5]) == [
        "without protection",
        "In place for 2.0 s.",
        "a what-if: nothing keeps its load, lost 3 ×, soonest after 0.3 s",
    ]
