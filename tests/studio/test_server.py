"""Who may open the page, what it begins with, and where it writes."""

import json
import tomllib
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from salver.cli.plans.studio import begun
from salver.errors import ScenarioError
from salver.scenario import parse
from salver.studio.server import Studio
from studio_windows import CUBE, asked, say


def test_the_page_is_for_who_knows_its_address_on_this_machine_alone(tmp_path):
    with Studio(CUBE, tmp_path / "cube.toml", tmp_path) as studio:
        place = urlsplit(studio.url)
        assert place.hostname == "127.0.0.1"
        status, page = asked(studio, "GET", place.path)
        assert status == 200
        assert b"http://" not in page.replace(b"http://www.w3.org", b"")
        for path, host in (
            ("/", None),
            ("/wrong/", None),
            (place.path, "evil.example:80"),
            (place.path + "report/x", None),
        ):
            assert asked(studio, "GET", path, host=host)[0] == 404
        assert asked(studio, "POST", "/wrong/say", b"{}")[0] == 404
        for wrong in (
            7,
            [],
            {},
            {"do": "dance"},
            {"do": "look", "text": CUBE, "changes": [7]},
            {"do": "look", "text": CUBE, "near": 5},
        ):
            answer = json.loads(asked(studio, "POST", place.path + "say", json.dumps(wrong).encode())[1])
            assert answer["problem"].endswith(".")
        assert "kB" in say(studio, "look", text="#" * 300_000)["problem"]
        assert asked(studio, "POST", place.path + "say", b"{")[0] == 400
        assert asked(studio, "POST", place.path + "say", b"[" * 9000)[0] == 400
        assert asked(studio, "POST", place.path + "say", b"")[0] == 400
        far = json.loads(asked(studio, "POST", place.path + "say", b"x" * 3_000_000)[1])
        assert far == {"problem": "The message has 3000 kB; it may have at most 400 kB."}


def test_a_file_that_somebody_else_has_changed_is_not_written_over(tmp_path):
    file = tmp_path / "cube.toml"
    with Studio(CUBE, file, tmp_path) as studio:
        one, other = CUBE + "\n# one", CUBE + "\n# other"
        assert say(studio, "save", text=CUBE)["saved"] == str(file)
        assert say(studio, "save", text=one, over=CUBE)["saved"]
        for over in (CUBE, None):  # another window, which has not seen that
            assert "has changed" in say(studio, "save", text=other, over=over)["problem"]
        assert file.read_text() == one
        assert say(studio, "save", text=one)["saved"]  # it says what it would say
        file.write_bytes(b"\xff\xfe")
        assert "has changed" in say(studio, "save", text=other, over=one)["problem"]
        file.write_text(one)
        file.chmod(0o444)
        assert "may not be written" in say(studio, "save", text=other, over=one)["problem"]
        assert file.read_text() == one


def test_the_command_says_what_it_cannot_begin_with(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, place, _, saved = begun("bottle.toml")
    assert (place, saved) == (Path("bottle.toml"), False)
    assert parse(tomllib.loads(text), "it").name == "bottle"
    assert begun("panda-cube")[:2] == (CUBE, Path("panda-cube.toml"))
    (tmp_path / "broken.toml").write_text("a = [")
    assert begun("broken.toml")[0] == "a = ["  # the page shows what is wrong
    with pytest.raises(ScenarioError, match="did you mean panda-cube"):
        begun("panda-cubee")
    (tmp_path / "odd.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(ScenarioError, match="UTF-8"):
        begun("odd.toml")
    (tmp_path / "big.toml").write_bytes(b"# " * 5_000_000)
    with pytest.raises(ScenarioError, match="is larger than 200 kB"):
        begun("big.toml")
