"""The playground: a wild hand, with and without protection; its page in a real browser."""

import os
import time
from urllib.parse import urlsplit

import numpy as np
import pytest

import salver as sv
from browser import chromium, missing
from salver.live import Worker
from salver.models.arm.arm import load_arm
from salver.playground import World
from salver.playground.unprotected import Unprotected
from salver.scenario import SCENARIO_DIR
from salver.simulation.outcome import inner_motions
from salver.simulation.trace import Recorder
from salver.studio.server import Studio


def run(world, seconds, every=None):
    """In simulated time; planning takes none of it."""
    for k in range(round(seconds / world.period)):
        world.advance()
        if every and k % every == 0:
            world.live.plan(60.0)


def wild(world, seconds, every=None):
    """Twists that change their mind; the top speed, m/s."""
    top = 0.0
    for k in range(round(seconds / 0.06)):
        world.say({"twist": [1.2 * (-1) ** (k // 4), 1.0 * (-1) ** (k // 3), 0.0, 0.0]})
        run(world, 0.06, every)
        top = max(top, world.frame()["speed"])
    return top


def became(world):
    return [item["became"] for item in world.frame()["load"]]


@pytest.mark.slow
def test_a_wild_hand_drops_nothing_but_without_protection():
    world = World(sv.load_scenario("panda-tall-bottle"), {"friction": 0.36}, lead=0.02)
    run(world, 0.02)
    assert world.friction_used()[0] < 0.01
    assert wild(world, 0.48, 60) > 0.2
    run(world, 1.2, 120)
    assert became(world) == [""]

    free = World(world.scenario, {"friction": 0.36}, protected=False)
    wild(free, 0.6)
    assert became(free) != [""]
    assert free.say({"again": True}).ok
    run(free, 0.2)
    assert became(free) == [""]
    assert free.frame()["speed"] < 1e-3


def test_that_a_goal_is_being_planned_is_said_at_once():
    world = World(sv.load_scenario("panda-cube"), lead=0.02)
    first = world.frame()["objects"][0][:3]
    assert not world.frame()["planning"]
    assert world.say({"goto": [first[0], first[1] - 0.1, first[2]]}).ok
    assert (world.frame()["doing"], world.frame()["planning"]) == ("resting", True)
    run(world, 1.2, 60)
    assert not world.frame()["planning"]


def test_a_ball_that_meets_the_load_has_hit_it():
    """One that nothing moves away from is thrown at the middle of what is carried: it falls on it from above."""
    world = World(sv.load_scenario("panda-cube"), protected=False)
    assert world.say({"throw": True}).ok
    said, apart = [], []
    for k in range(1400):
        world.advance()
        cube = world.plant.p_SB()
        apart.append(float(np.linalg.norm(world.ball.at(world.t)[0] - cube)) - 0.05)  # from its middle to the ball
        if k % 50 == 0:
            said.append((k, world.frame()["said"]))
    assert min(apart) < 0.02
    outside = next(k for k, distance in enumerate(apart) if distance < 0.02 * np.sqrt(3))  # the half diagonal
    assert all("has come to" in text and "-" not in text for k, text in said if k < outside)
    inside = next(k for k, distance in enumerate(apart) if distance < 0.02) + 10
    assert {text for k, text in said if inside <= k} == {"The ball has hit the cube, and flies through."}


def test_without_protection_the_arm_keeps_its_own_limits():
    scenario = sv.load_scenario("panda-cube")
    arm = load_arm(scenario.arm, scenario.tray)
    world_q = sv.Live(scenario).problem.start.q
    free, rng, limits = Unprotected(arm, world_q, np.zeros(7)), np.random.default_rng(1), arm.limits
    for k in range(1500):
        if k % 100 == 0:
            v, omega = rng.uniform(-2, 2, 3), rng.uniform(-2, 2, 3)
        free.step(v, omega, 1e-3)
        assert np.all(np.abs(free.dq) <= limits.velocity * (1 + 1e-9))
        assert np.all(np.abs(free.ddq) <= limits.acceleration * (1 + 1e-9))
        assert np.all((free.q >= limits.q_min) & (free.q <= limits.q_max))


def test_without_protection_the_arm_of_the_engine_goes_no_faster_than_it_can():
    """Accelerations that jump ask torques of it that its interface does not take: it swung up to 30 times that."""
    world, rng, top = World(sv.load_scenario("panda-cube"), protected=False), np.random.default_rng(1), 0.0
    for _ in range(8):
        world.say({"twist": [*rng.uniform(-1.2, 1.2, 3), rng.uniform(-1.5, 1.5)]})
        for _ in range(80):
            world.advance()
            top = max(top, float((np.abs(world.plant.data.qvel[:7]) / world.arm.limits.velocity).max()))
    assert 0.5 < top < 1.05


@pytest.mark.slow
def test_a_liquid_is_shown_as_the_whole_run_has_it_and_told_when_it_spills(monkeypatch):
    world = World(sv.load_scenario("panda-coffee"), {"fill": 0.065}, protected=False)
    whole, took, shown, said = Recorder(world.plant.scene, 4000), world.plant.inner.took, [], None
    period, late = world.period, world.plant.inner._late
    first = world.t

    def taken(t, q, dq, tau, data):
        took(t, q, dq, tau, data)
        whole.take(t, q, dq, tau, data)

    monkeypatch.setattr(world.plant.inner, "took", taken)
    for k in range(1200):
        if k % 60 == 0:
            speed = 0.02 if k < 400 else 0.5 if k < 900 else 0.0
            world.say({"twist": [speed * (-1) ** (k // 120), 0.6 * speed, 0.0, 0.0]})
        world.advance()
        if k % 37 == 0 and k > 200:  # now and then, as a page does, and later than what is kept is long
            shown.append((world.t, world.frame()["inside"][0]))
            if said is None and became(world) == ["spilt"]:
                said = world.t
    seen = inner_motions(world.plant.scene, whole.trace())[:, 0]
    liquid, half = world.scenario.payload.bodies[0].inner, world.plant.scene.loads[0].modes.half
    for t, drawn in shown:
        eta = seen[round((t - first) / period) - 1 - late, :2]
        if np.linalg.norm(eta) < 0.06:  # all of the bottom is wet
            np.testing.assert_allclose(np.array(drawn["moves"]) * half, eta, atol=1e-5)
    over = whole.t[late : whole.count - late][seen[late : whole.count - late, 2] > liquid.brim - 0.065][0]
    assert shown[-1][1]["beyond"] == pytest.approx(over)
    assert over < said < over + 0.06
    assert world.say({"again": True}).ok
    assert became(world) == [""]


def test_what_nobody_can_mean_is_refused_and_changes_nothing():
    world = World(sv.load_scenario("panda-cube"))
    for message in (
        None, [], 3, {}, {"goto": 1, "stop": 2}, {"goto": [1, 2]}, {"goto": [0, 0, float("nan")]}, {"goto": "there"},
        {"twist": [9, 9, 9, 9]}, {"twist": [1, 2, 3]}, {"protected": False},
        {"fly": 1}, {"twist": {"x": 1}}, {"goto": [[1], [2], [3]]},
    ):  # fmt: skip
        status = world.say(message)
        assert not status.ok, message
        assert status.sentence
    assert world.live.idle


@pytest.mark.slow
def test_a_process_that_plans_may_die_and_another_one_goes_on():
    live = sv.Live("panda-cube", lead=0.2)
    files = len(os.listdir("/dev/fd"))
    with Worker(live, process=True) as worker:

        def until(done):
            end, t = time.monotonic() + 60, 0.0
            while not done() and time.monotonic() < end:
                live.command(t := t + 1e-3)
                time.sleep(1e-3)
            assert done()

        live.command(0.0)
        worker._process._running.kill()
        live.goto((0.5, -0.25, 0.45))
        until(lambda: "died" in live.state.refused)
        assert live.committed.at_rest
        live.goto((0.5, -0.25, 0.45))
        until(lambda: not live.committed.at_rest)
    assert not worker.alive
    assert len(os.listdir("/dev/fd")) == files  # nothing of either process is left open


@pytest.mark.slow
@pytest.mark.skipif(missing() is not None, reason=str(missing()))
def test_in_a_browser_the_goal_is_dragged_and_nothing_is_asked_of_others(tmp_path):
    text = (SCENARIO_DIR / "panda-cube.toml").read_text()
    with Studio(text, tmp_path / "cube.toml", SCENARIO_DIR, live=True) as studio, chromium(900, 800) as browser:
        browser.call("POST", "url", {"url": studio.url})
        told = "document.getElementById('detail').textContent.includes('Drag the ring')"  # drawn after the first frames
        browser.wait_for(f"window.salver && salver.state.frames > 1 && {told}")
        browser.script(
            """
            const canvas = document.getElementById("canvas"), box = canvas.getBoundingClientRect();
            const [eye, p] = [salver.state.viewer.ray(0.5, 0.5)[0], salver.state.live.objects[0]];
            let best = null;  // the point of the picture where the load is
            for (let x = 0; x <= 1; x += 0.01) for (let y = 0; y <= 1; y += 0.01) {
              const way = salver.state.viewer.ray(x, y)[1], to = [0, 1, 2].map((i) => p[i] - eye[i]);
              const off = 1 - to.reduce((s, v, i) => s + v * way[i], 0) / Math.hypot(...to);
              if (best === null || off < best[0]) best = [off, x, y];
            }
            const at = (x, y) => ({ clientX: box.left + 0.5 * x * box.width, clientY: box.top + y * box.height });
            canvas.setPointerCapture = () => {};
            const send = (kind, x, y) => canvas.dispatchEvent(new PointerEvent(kind, at(x, y)));
            send("pointerdown", best[1], best[2]);
            window.up = () => send("pointerup", best[1] + 0.04, best[2]);
            window.first = document.getElementById("detail").textContent;
            window.before = salver.state.viewer.marks.length;
            send("pointermove", best[1] + 0.04, best[2]);
            """
        )
        assert "Drag the ring" in browser.script("return first")
        assert browser.script("return before") == 2  # the ring is there before there is a goal
        drawn = browser.script(
            "return new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() =>"
            "done([...salver.state.viewer.marks[0].model.slice(12, 15), ...salver.state.held]))))"
        )
        assert drawn[:3] == pytest.approx(drawn[3:], abs=1e-6)
        browser.script("up()")
        browser.wait_for(  # the motion itself is shorter than a busy machine looks away
            "(({ goal, objects, doing, planning }) => goal && doing === 'resting' && !planning &&"
            "Math.hypot(...goal.map((x, i) => x - objects[0][i])) < 1e-3)(salver.state.live)"
        )
        (live,) = studio.lives.values()
        world = live.world
        assert became(world) == [""]
        goal, p = world.frame()["goal"], world.frame()["objects"][0][:3]
        assert np.linalg.norm(np.subtract(goal, p)) < 1e-3
        assert [entry for entry in browser.log("browser") if entry["level"] == "SEVERE"] == []
        assert {urlsplit(url).netloc for url in browser.requests()} <= {urlsplit(studio.url).netloc, ""}
        browser.click("#design")  # the same page, where a plan is drawn again
        browser.wait_for("!salver.state.live")
        browser.script("document.getElementById('plan').click()")
        browser.wait_for("salver.state.plan")
        assert studio.lives == {}
