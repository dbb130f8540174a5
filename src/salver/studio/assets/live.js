// The live mode of the studio: frames come as server-sent events, wishes go as small messages. Beside the arm stands
// another one, which the same hand moves without protection.
"use strict";

const SECONDS = 10;  // of the strips
const SLOW = { before: 0.5, after: 0.9, speed: 0.25 };  // s around a fall, which is shown again, and how fast
let source = null, due = false;

async function enter() {
  if (state.live || state.entering) return;
  [state.entering, state.said] = [true, "The live mode begins."];
  while (!state.idle()) await new Promise((done) => setTimeout(done, 50));
  designing();
  const found = await post("live", { text: state.text });
  [state.entering, state.said] = [false, found.problem ?? ""];
  if (found.problem) return tell();
  const [start] = state.answer.scene.variants;
  state.viewer?.furnish({ variants: [start, { ...start, key: "beside", path: [] }].map((v) => ({ ...v, red: [] })) });
  mode(true);
  hear(found.frame);
  source = new EventSource(`${here}frames/${own}`);
  source.onmessage = (event) => source && hear(JSON.parse(event.data));
  source.onerror = () => (state.said = "salver does not answer.");
}

function leave() {
  if (!state.live) return;
  source.close();
  [state.live, state.held, source, state.said, fall, state.time] = [null, null, null, "", null, 0];
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
  if (!dragged && frame.goal === null && !moving) state.held = null;
  watch(frame.beside[0]);
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    if (!state.live) return;
    pose(state.live);
    state.time = fall?.to ? fall.at() : 0;
    paint();
    tell();
    report(state.live);
  });
}

// What the unprotected arm did of late; when it loses its load, that is shown again and again, slowly.
let late = [], fall = null;
function watch(frame) {
  if (!frame) return (late = []);
  if (late.length && late[late.length - 1].t > frame.t) [late, fall] = [[], null];  // it has begun again
  const lost = frame.gone && !late[late.length - 1]?.gone;
  late.push(frame);
  if (lost) fall = { t: frame.t };
  if (!fall) while (late[0].t < frame.t - SLOW.before) late.shift();
  if (!fall || fall.to || frame.t < fall.t + SLOW.after) return;
  const [from, to, begun] = [late[0].t, frame.t, performance.now()];
  Object.assign(fall, { to, at: () => from + ((((performance.now() - begun) / 1000) * SLOW.speed) % (to - from)), frames: late });
}

// Puts a motion in place of a variant's: frames, one after the other.
function put(variant, frames) {
  const all = (of) => new Float32Array(frames.flatMap(of));
  variant.t = frames.map((frame) => frame.t);
  [variant.joints, variant.tray, variant.objects] = [all((f) => f.joints), all((f) => f.tray), all((f) => f.objects.flat())];
  frames[0].inside.forEach((seen, i) => {
    const beyond = frames[frames.length - 1].inside[i]?.beyond ?? null;
    if (seen) Object.assign(variant.inside[i], { moves: all((f) => f.inside[i].moves), beyond: frames.length > 1 ? beyond : beyond && 0 });
  });
}

function pose(frame) {
  if (!state.viewer) return;
  const [live, beside] = state.viewer.variants, { options } = state.viewer;
  put(live, [frame]);
  if (frame.beside.length) put(beside, fall?.frames ?? frame.beside);
  options.path = frame.path.length > 1;
  if (options.path) state.viewer.refill(live.path, tube(frame.path, 0.0025));
}

function report(frame) {
  byId("names").classList.toggle("stacked", state.stacked);
  byId("names").replaceChildren(...frame.names.map(([title, line, about], i) => {
    const box = document.createElement("div"), texts = [title, line, about, i && fall?.to ? "the fall again, at a quarter of its speed" : ""];
    box.append(...texts.map((text, k) => Object.assign(document.createElement(k ? "div" : "b"), { textContent: text })));
    return box;
  }));
  byId("stop").textContent = frame.stopped ? "Resume" : "Stop";
  byId("pace").textContent = frame.pace;
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

// What the hand wants along each axis, -1 to 1: keys, a gamepad's sticks, thumbs on a touch screen.
const KEYS = { ahead: "ws", right: "da", up: "rf", turn: "qe" }, STICKS = { right: [0, 1], ahead: [1, -1], turn: [2, -1], up: [3, -1] };
const thumbs = {};
let pressed = [];
function wanted(axis) {
  const [plus, minus] = KEYS[axis], pad = navigator.getGamepads().find(Boolean), [stick, sign] = STICKS[axis];
  const pushed = sign * (pad?.axes[stick] ?? 0), sum = state.keys.has(plus) - state.keys.has(minus) + (thumbs[axis] ?? 0);
  return Math.max(-1, Math.min(1, sum + (Math.abs(pushed) < 0.15 ? 0 : pushed)));  // a stick does not quite come back
}

let moving = false;
function steer() {
  if (!state.live) return;
  const does = [() => stop(state.live.stopped ? { resume: true } : { stop: true }), () => hand({ again: true }), () => hand({ throw: true })];
  const buttons = navigator.getGamepads().find(Boolean)?.buttons.map((button) => button.pressed) ?? [];
  does.forEach((it, k) => buttons[k] && !pressed[k] && it());
  pressed = buttons;
  const [ahead, right, up, turn] = ["ahead", "right", "up", "turn"].map(wanted), a = state.viewer ? state.viewer.orbit.azimuth : 0;
  const moves = Boolean(ahead || right || up || turn), share = Number(byId("speed").value) / Math.max(1, Math.hypot(ahead, right, up));
  // Away from who looks, and to the right.
  if (moves || moving) hand({ twist: [...[-ahead * Math.cos(a) - right * Math.sin(a), -ahead * Math.sin(a) + right * Math.cos(a), up].map((x) => x * share), 1.5 * turn] });
  moving = moves;
  if (moves) state.held = null;
}
setInterval(steer, 40);

function stop(does = { stop: true }) {
  [state.held, moving] = [null, false];
  state.keys.clear();
  return hand(does);
}

for (const pad of document.querySelectorAll(".thumb")) {
  const axes = pad.dataset.axes.split(" ");
  const put = ([x, y]) => {
    [thumbs[axes[0]], thumbs[axes[1]]] = [axes[0] === "turn" ? -x : x, -y];
    pad.style.setProperty("--x", x);
    pad.style.setProperty("--y", y);
  };
  const follow = (event) => {
    const box = pad.getBoundingClientRect(), r = box.width / 2, at = [event.clientX - box.left - r, event.clientY - box.top - r];
    put(at.map((x) => x / Math.max(r, Math.hypot(...at))));
  };
  pad.addEventListener("pointerdown", (event) => (pad.setPointerCapture(event.pointerId), follow(event)));
  pad.addEventListener("pointermove", (event) => pad.hasPointerCapture(event.pointerId) && follow(event));
  for (const end of ["pointerup", "pointercancel"]) pad.addEventListener(end, () => put([0, 0]));
}

document.addEventListener("keydown", (event) => {
  const key = event.key.toLowerCase();
  if (!state.live || event.ctrlKey || event.metaKey || event.altKey || !" wasdrfqe".includes(key)) return;
  event.preventDefault();
  if (event.repeat) return;
  if (key === " ") return stop();
  state.keys.add(key);
});
document.addEventListener("keyup", (event) => state.keys.delete(event.key.toLowerCase()));
window.addEventListener("blur", () => state.keys.clear());
byId("stop").addEventListener("click", () => stop(state.live.stopped ? { resume: true } : { stop: true }));
byId("again").addEventListener("click", () => hand({ again: true }));
byId("throw").addEventListener("click", () => hand({ throw: true }));
byId("beside-live").addEventListener("change", (event) => hand({ beside: event.target.checked }));
byId("speed").addEventListener("input", () => (byId("speed-shown").textContent = `${Number(byId("speed").value).toFixed(2)} m/s`));
byId("speed").dispatchEvent(new Event("input"));
byId("live").addEventListener("click", enter);
byId("design").addEventListener("click", leave);
if (given.live) enter();
