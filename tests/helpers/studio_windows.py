"""A text as the studio's page shows it, and a window of the studio without its browser."""

import http.client
import json
from urllib.parse import urlsplit

from salver.scenario import SCENARIO_DIR
from salver.studio.look import look

CUBE = (SCENARIO_DIR / "panda-cube.toml").read_text()
ROUND = (SCENARIO_DIR / "waiters-round.toml").read_text()


def shown(text, **more):
    return look(text, SCENARIO_DIR, **more)


def asked(studio, method, path, body=None, host=None):
    place = urlsplit(studio.url)
    line = http.client.HTTPConnection(place.hostname, place.port, timeout=120)
    line.request(method, path, body, {"Host": host} if host else {})
    answer = line.getresponse()
    return answer.status, answer.read()


def say(studio, do, **more):
    status, answer = asked(studio, "POST", urlsplit(studio.url).path + "say", json.dumps({"do": do, **more}).encode())
    assert status == 200
    return json.loads(answer)
