// The live mode of the studio: frames come as server-sent events, wishes go as small messages.
"use strict";

const SECONDS = 10;  // of the strips
let source = null, due = false;

async function enter() {
  if (state.live || state.entering) return;
  [state.entering, state.said] = [true, "The live mode begins."];
  while (!state.idle()) await new Promise((done) => setTimeout(done, 50));
  designing();
  const found = await post("live", { text: state.text });
  [state.entering, state.said] = [false, found.problem ?? ""];
  if (found.problem) return tell();
  state.viewer?.furnish({ variants: [{ ...state.answer.scene.variants[0], red: [] }] });
  mode(true);
  hear(found.frame);
  source = new EventSource(`${here}frames/${own}`);
  source.onmessage = (event) => source && hear(JSON.parse(event.data));
  source.onerror = () => (state.said = "salver does not answer.");
}

function leave() {
  if (!state.live) return;
  source.close();
  [state.live, state.held, source, state.said] = [null, null, null, ""];
  if (state.viewer) state.viewer.options.path = true;
  post("close");
  mode(false);
  designing();
  paint();
}

function mode(live) {
  document.body.classList.toggle("live", live);
  byId("live").setAttribute("aria-pressed", live);
  byId("design").setAttribute("aria-pressed", !live);
}

// Drawn when there is something new: a browser that draws all the time takes the processor away from the planner.
function hear(frame) {
  [state.live, state.frames] = [frame, state.frames + 1];
  strips.forEach((strip, i) => strip.take(frame.t, frame.values[i]));
  if (!dragged && frame.goal === null && !state.keys.size) state.held = null;
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    if (!state.live) return;
    pose(state.live);
    paint();
    tell();
    report(state.live);
  });
}

function pose(frame) {
  if (!state.viewer) return;
  const live = state.viewer.variants[0];
  [live.joints, live.tray, live.objects] = [frame.joints, frame.tray, frame.objects.flat()].map((x) => new Float32Array(x));
  frame.inside.forEach((seen, i) => {
    if (seen) Object.assign(live.inside[i], { moves: new Float32Array(seen.moves), beyond: seen.beyond === null ? null : 0 });
  });
  state.viewer.options.path = frame.path.length > 1;
  if (state.viewer.options.path) state.viewer.refill(live.path, tube(frame.path, 0.0025));
}

function report(frame) {
  byId("protected").checked = frame.protected;
  byId("stop").textContent = frame.stopped ? "Resume" : "Stop";
  byId("pace").textContent = frame.pace;
  byId("record").setAttribute("aria-pressed", frame.recording !== null);
  byId("record").textContent = frame.recording === null ? "Record" : `Recording, ${frame.recording.toFixed(0)} s`;
  if (performance.now() - shownAt < 200) return;
  shownAt = performance.now();
  strips.forEach((strip, i) => strip.draw(frame.t, frame.legends[i]));
}

// Values of the last seconds, the newest on the right.
let shownAt = 0;
const strips = [[50, 0], [1.2, 1], [2, null]].map(([high, limit], i) => {
  const figure = byId("strips").children[i], points = [], series = { colour: "var(--robust)", x: [-SECONDS], y: [null] };
  const lines = limit === null ? [] : [{ y: limit, colour: "var(--bad)" }];
  const draw = chart(figure.querySelector(".plot"), { x: "s", y: "", height: 130, range: [0, high], series: [series], lines });
  return {
    take(t, value) {
      if (points.length && points[points.length - 1][0] > t) points.length = 0;  // another world
      points.push([t, value === null ? null : Math.min(value, high)]);
      while (points[0][0] < t - SECONDS) points.shift();
    },
    draw(t, legend) {
      figure.querySelector(".legend").textContent = legend;
      [series.x, series.y] = [[-SECONDS, ...points.map(([at]) => at - t)], [null, ...points.map(([, y]) => y)]];
      draw();
    },
  };
});

// --- the hand

function hand(message) {
  return post("hand", { say: message }).then((answer) => (state.said = answer.problem ?? (answer.ok ? "" : answer.sentence)));
}

// The ring: at the goal; without one around the load, where it is taken hold of.
const goal = () => ({ name: "goal", handle: { of: "world", at: state.held || state.live.goal || state.live.objects[0].slice(0, 3) } });

let said = 0;
function wish(p) {
  dragged.p[2] = Math.max(state.answer.scene.floor + 0.02 || -Infinity, p[2]);
  state.held = dragged.p;
  paint();
  if (performance.now() - said < 80) return;
  said = performance.now();
  hand({ goto: state.held });
}

function twist() {
  const k = state.keys, speed = Number(byId("speed").value), a = state.viewer ? state.viewer.orbit.azimuth : 0;
  const both = (plus, minus) => Number(k.has(plus)) - Number(k.has(minus)), along = both("w", "s"), across = both("d", "a"), up = both("r", "f");
  const size = Math.hypot(along, across, up) || 1;
  // Away from who looks, and to the right.
  const v = [-along * Math.cos(a) - across * Math.sin(a), -along * Math.sin(a) + across * Math.cos(a), up];
  return [...v.map((x) => (x / size) * speed), 1.5 * both("q", "e")];
}

let steering = null;
function steer() {
  if (state.keys.size) {
    state.held = null;
    steering ??= setInterval(steer, 40);
  } else if (steering !== null) {
    clearInterval(steering);
    steering = null;
  } else return;
  hand({ twist: twist() });
}

function stop(does = { stop: true }) {
  state.held = null;
  state.keys.clear();
  clearInterval(steering);
  steering = null;
  return hand(does);
}

document.addEventListener("keydown", (event) => {
  const key = event.key.toLowerCase();
  if (!state.live || event.ctrlKey || event.metaKey || event.altKey || !" wasdrfqe".includes(key)) return;
  event.preventDefault();
  if (event.repeat || state.keys.has(key)) return;
  if (key === " ") return stop();
  state.keys.add(key);
  steer();
});
document.addEventListener("keyup", (event) => state.keys.delete(event.key.toLowerCase()) && steer());
window.addEventListener("blur", () => {
  state.keys.clear();
  steer();
});
byId("stop").addEventListener("click", () => stop(state.live.stopped ? { resume: true } : { stop: true }));
byId("again").addEventListener("click", () => hand({ again: true }));
byId("throw").addEventListener("click", () => hand({ throw: true }));
byId("record").addEventListener("click", () => hand({ record: state.live.recording === null }));
byId("protected").addEventListener("change", (event) => hand({ protected: event.target.checked }));
byId("speed").addEventListener("input", () => (byId("speed-shown").textContent = `${Number(byId("speed").value).toFixed(2)} m/s`));
byId("speed").dispatchEvent(new Event("input"));
byId("live").addEventListener("click", enter);
byId("design").addEventListener("click", leave);
if (given.live) enter();
